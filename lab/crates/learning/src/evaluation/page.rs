//! The report as a page, and as tables (CSV) and a picture for other programs.

use serde::Serialize;

use super::decisions::JudgedRecipe;
use super::report::Report;
use super::statistics::Estimate;
use blindgrasp_grasps::dataset::label_line;
use blindgrasp_pictures::{DrawnWord, PictureError, ReportKind, dictionary_svg, report_html};
use blindgrasp_stages::hand::Hand;

/// The name of the picture of the dictionary among the files of [`tables`].
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

/// The names and texts of tables (CSV): Table I, the errors by class of Figure 2, and the points of the curves.
///
/// # Errors
/// A row cannot be written.
pub fn tables(report: &Report) -> Result<Vec<(String, String)>, csv::Error> {
    let roc = |judge: &JudgedRecipe| -> Vec<[f64; 3]> {
        let points = judge.curve.iter().map(|point| [point.threshold, point.false_positive_rate, point.recall]);
        // No threshold is so high: the corner from which the curve begins.
        std::iter::once([f64::INFINITY, 0.0, 0.0]).chain(points).collect()
    };
    let precision_recall = |judge: &JudgedRecipe| -> Vec<[f64; 3]> {
        judge.curve.iter().map(|point| [point.threshold, point.recall, point.precision]).collect()
    };
    let reliability = |judge: &JudgedRecipe| -> Vec<[f64; 3]> {
        let bins = judge.reliability.iter().flat_map(|reliability| &reliability.bins);
        bins.map(|bin| [bin.mean_probability, bin.share_positive, bin.n as f64]).collect()
    };
    let points = |columns, of: &dyn Fn(&JudgedRecipe) -> Vec<[f64; 3]>| points_csv(&report.judges, columns, of);
    Ok(vec![
        ("table-1.csv".into(), table_1_csv(report)?),
        ("figure-2.csv".into(), figure_2_csv(report)?),
        ("roc.csv".into(), points(["threshold", "false_positive_rate", "recall"], &roc)?),
        ("pr.csv".into(), points(["threshold", "recall", "precision"], &precision_recall)?),
        ("reliability.csv".into(), points(["mean_probability", "share_stable", "n_grasps"], &reliability)?),
    ])
}

/// The contact dictionary over the hand (SVG), as the paper's Figure 1; `None` if there is no grasp.
///
/// # Errors
/// As of [`report_page`].
pub fn figure_1(hand: &Hand, report: &Report) -> Result<Option<String>, PictureError> {
    if report.dictionary.joints.is_empty() {
        return Ok(None);
    }
    let words: Vec<DrawnWord> = report
        .dictionary
        .words
        .iter()
        .map(|word| DrawnWord {
            position_m: word.position_m,
            share_of_contacts: word.share_of_contacts,
            share_stable: word.share_stable,
        })
        .collect();
    dictionary_svg(hand, &report.dictionary.joints, &words).map(Some)
}

fn table_1_csv(report: &Report) -> Result<String, csv::Error> {
    let share = |estimate: Option<Estimate>| estimate.map(|estimate| estimate.value.to_string()).unwrap_or_default();
    let mut table = csv::Writer::from_writer(Vec::new());
    let head = ["of_paper", "data_set", "n_grasps", "n_stable", "n_unstable", "accuracy", "false_positive_share"];
    table.write_record(head)?;
    for row in &report.table_1 {
        table.write_record([
            row.of_paper.to_string(),
            row.data_set.clone(),
            row.n_grasps.to_string(),
            row.n_stable.to_string(),
            row.n_unstable.to_string(),
            share(row.accuracy),
            share(row.false_positive_share),
        ])?;
    }
    csv_text(table)
}

/// A row for each class of each judge.
fn figure_2_csv(report: &Report) -> Result<String, csv::Error> {
    let mut table = csv::Writer::from_writer(Vec::new());
    table.write_record(["model", "class", "n_grasps", "n_wrong", "n_false_positive"])?;
    for judge in &report.judges {
        for class in &judge.by_class {
            table.serialize((&judge.name, &class.class, class.n_grasps, class.n_wrong, class.n_false_positive))?;
        }
    }
    csv_text(table)
}

/// A row for each point of each judge.
fn points_csv(
    judges: &[JudgedRecipe],
    columns: [&str; 3],
    of: &dyn Fn(&JudgedRecipe) -> Vec<[f64; 3]>,
) -> Result<String, csv::Error> {
    let mut table = csv::Writer::from_writer(Vec::new());
    table.write_record(["model"].into_iter().chain(columns))?;
    for judge in judges {
        for point in of(judge) {
            table.write_record([judge.name.clone()].into_iter().chain(point.map(|number| number.to_string())))?;
        }
    }
    csv_text(table)
}

fn csv_text(table: csv::Writer<Vec<u8>>) -> Result<String, csv::Error> {
    let bytes = table.into_inner().map_err(|error| error.into_error())?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}
