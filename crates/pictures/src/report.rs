//! A report as a page: one HTML file that holds its data as JSON and the script that draws them. It asks the network for nothing.

use serde::Serialize;

use super::scene::{STAGE_JS, THREE_JS};
use super::{DrawnFrames, PictureError};

/// Charts of reports and of the page of a graph, as a module.
pub const CHART_JS: &str = include_str!("../assets/chart.js");
const GRASP_JS: &str = include_str!("../assets/grasp.js");
const REPORT_JS: &str = include_str!("../assets/report.js");
const STYLE: &str = include_str!("../assets/report.css");

/// The reports that the page's script draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ReportKind {
    Evaluation,
    /// One grasp, or a hand by itself.
    Grasp,
    Trials,
}

#[derive(Serialize)]
struct Page<'a, T> {
    kind: ReportKind,
    data: &'a T,
    /// The hand that it shows in three dimensions.
    drawn: Option<&'a DrawnFrames>,
}

/// The page of a report.
///
/// # Errors
/// The data cannot be written as JSON.
pub fn report_html(
    kind: ReportKind,
    data: &impl Serialize,
    drawn: Option<&DrawnFrames>,
) -> Result<String, PictureError> {
    Ok(format!(
        include_str!("../assets/report.html"),
        style = STYLE,
        data = json_for_page(&Page { kind, data, drawn })?,
        modules = if drawn.is_some() { stage_modules() } else { String::new() },
        script = format!("{CHART_JS}{GRASP_JS}{REPORT_JS}"),
    ))
}

/// JSON that can stand in a script of a page: a name in it does not end the script.
fn json_for_page(data: &impl Serialize) -> Result<String, PictureError> {
    Ok(serde_json::to_string(data)?.replace('<', "\\u003c"))
}

/// The modules of a page that shows a hand in three dimensions: its script loads them out of the page.
fn stage_modules() -> String {
    format!(
        "<script type=\"text/plain\" id=\"three.js\">{THREE_JS}</script>\n\
         <script type=\"text/plain\" id=\"stage.js\">{STAGE_JS}</script>\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_strangers_stay_data_and_the_page_may_not_use_the_network() {
        let hostile = serde_json::json!({ "name": "</script><script>alert(1)</script><!--" });
        let html = report_html(ReportKind::Trials, &hostile, None).expect("a page");
        assert_eq!(html.matches("</script>").count(), 2, "only the page's own scripts end");
        assert!(html.contains("\\u003c/script>\\u003cscript>alert(1)") && !html.contains("<!--"));
        assert!(html.contains("default-src 'none'; script-src 'unsafe-inline' blob:;"));
        // Texts are set, never read as HTML.
        for reads in ["innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval("] {
            assert!([CHART_JS, GRASP_JS, REPORT_JS].iter().all(|script| !script.contains(reads)), "{reads}");
        }
    }
}
