//! The report as a page, and its picture of the dictionary.

use serde::Serialize;

use super::report::Report;
use blindgrasp_grasps::dataset::label_line;
use blindgrasp_pictures::{PictureError, ReportKind, dictionary_svg, report_html};
use blindgrasp_stages::hand::Hand;

/// The name of the picture of the dictionary among the figures.
pub const FIGURE_1_FILE: &str = "figure-1.svg";

/// The data of the page: the report, and the parts that only this program can make.
#[derive(Serialize)]
struct EvaluationPage<'a> {
    #[serde(flatten)]
    report: &'a Report,
    /// The dictionary over the hand, as SVG.
    figure_1: Option<String>,
    /// The definition of stable, unless it is the wrench space's.
    label: Option<String>,
}

/// The page.
///
/// # Errors
/// A dictionary that cannot be drawn on this hand.
pub fn report_page(hand: &Hand, report: &Report) -> Result<String, PictureError> {
    let page = EvaluationPage { report, figure_1: figure_1(hand, report)?, label: label_line(&report.made.labels) };
    report_html(ReportKind::Evaluation, &page, None)
}

/// The contact dictionary over the hand (SVG), as the paper's Figure 1; `None` if there is no grasp.
///
/// # Errors
/// As of [`report_page`].
pub fn figure_1(hand: &Hand, report: &Report) -> Result<Option<String>, PictureError> {
    if report.dictionary.joints.is_empty() {
        return Ok(None);
    }
    dictionary_svg(hand, &report.dictionary.joints, &report.dictionary.words).map(Some)
}
