//! The report as a page: one HTML file with vector pictures that asks the network for nothing and runs no script.

use std::fmt::Write;

use super::comparison::Comparison;
use super::decisions::{JudgedRecipe, Measures};
use super::looks::Look;
use super::measures::at_recall;
use super::report::{LearningPoint, Report, TableRow};
use super::split::Split;
use super::statistics::{Estimate, Interval};
use crate::dataset::label_line;
use blindgrasp_pictures::chart::{
    Axis, BarChart, COLOURS, Chart, Line, NumberFormat, Series, bar_chart_svg, chart_svg, range_from_zero, thousands,
};
use blindgrasp_pictures::{DrawnWord, PictureError, ReportPage, dictionary_svg, escape, report_table};
use blindgrasp_stages::hand::Hand;

/// As in the paper's Figure 2: green for errors, yellow for false positives.
const ERRORS: &str = "#2f9e44";
const FALSE_POSITIVES: &str = "#f2b701";
/// Two charts beside each other, and one alone.
const HALF: [f64; 2] = [566.0, 430.0];
const FULL_WIDTH: f64 = 1152.0;

/// The page.
///
/// # Errors
/// A dictionary that cannot be drawn on this hand.
pub fn report_page(hand: &Hand, report: &Report) -> Result<String, PictureError> {
    let mut page = ReportPage::begin(&title(report), &summary(report));
    page.section(&format!("Table I: learning performance{}", world(report)), &table_1(report));
    page.section("Decisions", &measures_table(report));
    if !report.looks.is_empty() {
        page.section("By stage", &stages_table(&report.looks));
    }
    if !report.comparisons.is_empty() {
        page.section("Compared with each other", &comparisons(report));
    }
    if !report.repeats.is_empty() {
        page.section("The same with other folds", &repeats(report));
    }
    let mut charts = vec![roc(report), precision_recall(report), reliability(report), thresholds(report)];
    charts.extend(learning_curves(report));
    page.pairs(charts.iter().map(chart_svg));
    let problems: Vec<String> = report
        .learning_curve
        .iter()
        .filter_map(|point| {
            let (recipe, share) = (escape(&point.recipe), 100.0 * point.share);
            Some(format!("{recipe} at {share:.0} %: {}", escape(point.problem.as_ref()?)))
        })
        .collect();
    if !problems.is_empty() {
        page.raw(&format!("<p class=\"aside\">Too little to learn from: {}.</p>\n", problems.join("; ")));
    }
    for chart in figure_2(report) {
        page.figure(&bar_chart_svg(&chart), "");
    }
    if let Some(picture) = figure_1(hand, report)? {
        let caption = format!(
            "As the paper's Figure 1. The dictionary is {}; each word stands for the contacts nearest to it. The hand is in the \
             median posture of the grasps.",
            escape(&report.dictionary.from)
        );
        page.figure(&picture, &caption);
    }
    page.section("By class", &classes_table(report));
    page.section("How this was made", &how_made(report));
    Ok(page.finish())
}

/// The names and texts of tables (CSV): Table I, and the points of the curves.
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
        ("roc.csv".into(), points(["threshold", "false_positive_rate", "recall"], &roc)?),
        ("pr.csv".into(), points(["threshold", "recall", "precision"], &precision_recall)?),
        ("reliability.csv".into(), points(["mean_probability", "share_stable", "n_grasps"], &reliability)?),
    ])
}

/// The names and texts of figures (SVG): Figure 1 if there is a grasp, Figure 2 of each judge, and the curves.
///
/// # Errors
/// As of [`report_page`].
pub fn figures(hand: &Hand, report: &Report) -> Result<Vec<(String, String)>, PictureError> {
    let figure_1 = figure_1(hand, report)?.map(|picture| ("figure-1.svg".to_string(), picture));
    let judges = report.judges.iter().map(|judge| judge.name.replace('/', "_"));
    let figures_2 = judges.zip(figure_2(report));
    let figures_2 = figures_2.map(|(judge, chart)| (format!("figure-2-{judge}.svg"), bar_chart_svg(&chart)));
    let curves = [("roc", roc(report)), ("pr", precision_recall(report)), ("reliability", reliability(report))];
    let curves = curves.map(|(name, chart)| (format!("{name}.svg"), chart_svg(&chart)));
    Ok(figure_1.into_iter().chain(figures_2).chain(curves).collect())
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
    let bytes = table.into_inner().map_err(|error| error.into_error())?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
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
    let bytes = table.into_inner().map_err(|error| error.into_error())?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// Where the grasps were made, behind a title; empty unless all recordings are simulated.
fn world(report: &Report) -> &'static str {
    let n_simulated: usize = report.made.labels.values().sum();
    if n_simulated > 0 && n_simulated == report.made.recordings.len() { " in simulation" } else { "" }
}

/// The contact dictionary; `None` if there is no grasp.
fn figure_1(hand: &Hand, report: &Report) -> Result<Option<String>, PictureError> {
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

fn title(report: &Report) -> String {
    let names: Vec<&str> = report.judges.iter().map(|judge| judge.name.as_str()).collect();
    match (&report.made.split, names.as_slice()) {
        (None, [model]) => format!("What {model} is worth"),
        (None, _) => format!("Will the grasp hold? {} judged on the same grasps", names.join(", ")),
        (Some(_), _) if report.made.predictions.is_some() => {
            format!("Will the grasp hold? {} judged on grasps held out", names.join(", "))
        }
        (Some(_), _) => "Will the grasp hold? Recipes judged on grasps held out".into(),
    }
}

/// What a reader who reads no further should know.
fn summary(report: &Report) -> String {
    let Some(best) = report.judges.first() else { return String::new() };
    let whose = match &report.made.split {
        None => "of these recordings",
        Some(split) => match split.by {
            Split::Grasp => "held out",
            Split::Object => "of objects never seen in training",
            Split::Class => "of classes never seen in training",
        },
    };
    let mut text = format!(
        "<b>{}</b> decides {} of {} grasps {whose} rightly; {} of them are false positives, unstable grasps that it \
         would lift.",
        escape(&best.name),
        estimate(best.judged.accuracy),
        count(best.judged.n_grasps as f64),
        estimate(best.judged.false_positive_share),
    );
    let against: Vec<String> = report
        .comparisons
        .iter()
        .filter(|comparison| comparison.first == best.name)
        .filter_map(|comparison| {
            let reduction = comparison.relative_error_reduction?;
            let name = escape(&comparison.second);
            Some(if reduction.value < 0.0 {
                format!("{} more than <b>{name}</b>", percent(-reduction.value))
            } else {
                format!("{} fewer than <b>{name}</b>", estimate(Some(reduction)))
            })
        })
        .collect();
    if !against.is_empty() {
        let _ = write!(text, " Errors: {}.", against.join(", "));
    }
    text
}

fn table_1(report: &Report) -> String {
    let row = |row: &TableRow| {
        let whose = if row.of_paper { "Dang &amp; Allen: " } else { "" };
        (
            !row.of_paper,
            vec![
                format!("{whose}{}", escape(&row.data_set)),
                count(row.n_grasps),
                format!("{} ({})", count(row.n_stable), percent(row.stable_share)),
                count(row.n_unstable),
                estimate(row.accuracy),
                estimate(row.false_positive_share),
            ],
        )
    };
    let head = [
        ("Data set", false),
        ("grasps", true),
        ("stable grasps", true),
        ("unstable grasps", true),
        ("accuracy", true),
        ("false positives", true),
    ];
    let mut text = report_table(&head, &report.table_1.iter().map(row).collect::<Vec<_>>());
    let data = &report.data;
    let _ = writeln!(
        text,
        "<p class=\"caption\">False positives as a share of all grasps, as the paper's text has them (8.6 %). {}{}</p>",
        if data.n_held_unjudged > 0 {
            format!(
                "{} grasps were held without a judgement (no cell feels them, say), of which {} are stable: they count as \
                 decided in the rows that say so, and nowhere else. ",
                count(data.n_held_unjudged as f64),
                count(data.n_held_unjudged_stable as f64)
            )
        } else {
            String::new()
        },
        if report.made.split.is_some() { "Each grasp is judged once, in the fold that holds it." } else { "" }
    );
    text
}

fn measures_table(report: &Report) -> String {
    let row = |judge: &JudgedRecipe, name: &str, m: &Measures, of_curve: bool| {
        let curve = |value: Option<f64>| if of_curve { decimals(value) } else { "–".into() };
        let reliability = judge.reliability.as_ref();
        vec![
            format!("{}{name}", escape(&judge.name)),
            estimate(m.accuracy),
            estimate(m.precision),
            estimate(m.recall),
            decimals(m.f1),
            estimate(m.false_positive_share),
            estimate(m.false_positive_rate),
            curve(judge.roc_auc),
            curve(judge.average_precision),
            curve(reliability.map(|reliability| reliability.brier)),
            curve(reliability.map(|reliability| reliability.ece)),
        ]
    };
    let head = [
        ("judged grasps", false),
        ("accuracy", true),
        ("precision", true),
        ("recall", true),
        ("F1", true),
        ("false positives<br>of all", true),
        ("false positives<br>of unstable", true),
        ("ROC area", true),
        ("average<br>precision", true),
        ("Brier<br>score", true),
        ("calibration<br>error", true),
    ];
    let mut rows: Vec<(bool, Vec<String>)> =
        report.judges.iter().map(|judge| (true, row(judge, "", &judge.judged, true))).collect();
    if report.data.n_held_unjudged > 0 {
        let all = |judge| (false, row(judge, ", all", &judge.all, false));
        rows.extend(report.judges.iter().map(all));
    }
    let mut text = report_table(&head, &rows);
    let about: Vec<String> = report
        .judges
        .iter()
        .map(|judge| {
            let (name, about) = (escape(&judge.name), escape(&judge.about));
            format!("{name}: {about}; lifts from probability {} on", judge.threshold_probability)
        })
        .collect();
    let majority = report.judges.first().and_then(|judge| judge.judged.majority);
    let _ = writeln!(
        text,
        "<p class=\"caption\">{}. {}Positive is stable. Deciding always the same would be right for {}. Intervals are {}.</p>",
        about.join(". "),
        if report.data.n_held_unjudged > 0 { "All: with the grasps held without a judgement. " } else { "" },
        majority.map_or("none".into(), percent),
        escape(&report.made.intervals)
    );
    text
}

fn stages_table(looks: &[Look]) -> String {
    let share = |n: usize, of: usize| if of > 0 { percent(n as f64 / of as f64) } else { "–".into() };
    let row = |look: &Look| {
        let cells = vec![
            escape(&look.look.replace('_', "-")),
            count(look.n_grasps as f64),
            share(look.n_stable, look.n_grasps),
            decimals(look.roc_area),
            decimals(Some(look.ece)),
            format!("{} ({})", count(look.n_lifted as f64), share(look.n_lifted, look.n_grasps)),
            format!("{} ({})", count(look.n_kept as f64), share(look.n_kept, look.n_lifted)),
        ];
        (false, cells)
    };
    let head = [
        ("stage", false),
        ("grasps", true),
        ("stable", true),
        ("ROC area", true),
        ("calibration<br>error", true),
        ("lifted by<br>the thresholds", true),
        ("stable ones<br>of these", true),
    ];
    let mut text = report_table(&head, &looks.iter().map(row).collect::<Vec<_>>());
    text.push_str(
        "<p class=\"caption\">Of the grasps that some cell feels, each by one frame. Votes and the limits of the training data \
         are not considered: the graph lifts fewer.</p>\n",
    );
    text
}

fn comparisons(report: &Report) -> String {
    let row = |comparison: &Comparison| {
        let equal = comparison.at_equal_recall.as_ref();
        let cells = vec![
            format!("{} against {}", escape(&comparison.first), escape(&comparison.second)),
            estimate(comparison.relative_error_reduction),
            estimate(comparison.accuracy_difference),
            format!(
                "{} : {}",
                count(comparison.n_only_first_right as f64),
                count(comparison.n_only_second_right as f64)
            ),
            p_value(comparison.mcnemar_p),
            equal.map_or("–".into(), |equal| percent(equal.recall)),
            equal.map_or("–".into(), |equal| {
                format!(
                    "{} : {}",
                    count(equal.first.n_false_positive as f64),
                    count(equal.second.n_false_positive as f64)
                )
            }),
            estimate(equal.and_then(|equal| equal.relative_reduction)),
        ];
        (false, cells)
    };
    let head = [
        ("pair", false),
        ("fewer errors", true),
        ("accuracy gained", true),
        ("only one right", true),
        ("McNemar’s p", true),
        ("at recall", true),
        ("false positives", true),
        ("fewer", true),
    ];
    let mut text = report_table(&head, &report.comparisons.iter().map(row).collect::<Vec<_>>());
    text.push_str("<p class=\"caption\">The same grasps");
    if report.made.split.is_some() {
        text.push_str(", the same folds");
    }
    text.push_str(
        ". Fewer errors: by which share of the second one's errors \
         the first one's are fewer. Only one right: grasps that only the first, and only the second, decides rightly; \
         McNemar's exact test on them takes grasps as independent, the intervals do not. The last columns compare false \
         positives where both lift as many of the stable grasps, at the recall that the second has at its threshold.</p>\n",
    );
    text
}

fn repeats(report: &Report) -> String {
    let names: Vec<&str> = report.judges.iter().map(|judge| judge.name.as_str()).collect();
    let escaped: Vec<String> =
        names.iter().map(|name| format!("{}<br>accuracy, false positives", escape(name))).collect();
    let mut head = vec![("seed", false)];
    head.extend(escaped.iter().map(|name| (name.as_str(), true)));
    let pairs: Vec<String> = report
        .repeated_comparisons
        .iter()
        .map(|pair| format!("fewer errors,<br>{} against {}", escape(&pair.first), escape(&pair.second)))
        .collect();
    head.extend(pairs.iter().map(|pair| (pair.as_str(), true)));
    let mut rows = Vec::new();
    for (idx, repeat) in report.repeats.iter().enumerate() {
        let share = |of: Option<&f64>| of.map_or("–".into(), |share| percent(*share));
        let mut cells = vec![repeat.seed.to_string()];
        cells.extend(names.iter().map(|name| {
            format!("{}, {}", share(repeat.accuracy.get(*name)), share(repeat.false_positive_share.get(*name)))
        }));
        cells.extend(report.repeated_comparisons.iter().map(|pair| share(pair.relative_error_reduction.get(idx))));
        rows.push((false, cells));
    }
    let mut means = vec!["mean (range)".to_string()];
    means.extend(names.iter().map(|_| String::new()));
    means.extend(report.repeated_comparisons.iter().map(|pair| {
        format!(
            "{} <span class=\"interval\">({} to {})</span>",
            percent(pair.mean),
            number(pair.least),
            number(pair.greatest)
        )
    }));
    rows.push((true, means));
    report_table(&head, &rows)
}

fn classes_table(report: &Report) -> String {
    let escaped: Vec<String> =
        report.judges.iter().map(|judge| format!("{}<br>errors, false positives", escape(&judge.name))).collect();
    let mut head = vec![("class", false), ("grasps", true)];
    head.extend(escaped.iter().map(|name| (name.as_str(), true)));
    let Some(first) = report.judges.first() else { return String::new() };
    let rows: Vec<(bool, Vec<String>)> = first
        .by_class
        .iter()
        .enumerate()
        .map(|(idx, class)| {
            let mut cells = vec![escape(&class.class), count(class.n_grasps as f64)];
            cells.extend(report.judges.iter().filter_map(|judge| judge.by_class.get(idx)).map(|class| {
                format!(
                    "{} ({}), {} ({})",
                    percent(class.error_share),
                    class.n_wrong,
                    percent(class.false_positive_share),
                    class.n_false_positive
                )
            }));
            (false, cells)
        })
        .collect();
    format!("<details><summary>The numbers of Figure 2</summary>\n{}</details>\n", report_table(&head, &rows))
}

fn how_made(report: &Report) -> String {
    let made = &report.made;
    let mut items = vec![("command", format!("<code>{}</code>", escape(&made.command)))];
    items.push(("version", format!("blindgrasp {}", escape(&made.version))));
    items.push(("hand", escape(&made.hand)));
    if let Some(split) = &made.split {
        let n_repeats = report.repeats.len().max(1);
        let repeats =
            if n_repeats > 1 { format!(", {n_repeats} times, each with the next seed") } else { String::new() };
        items.push((
            "split",
            format!(
                "by {}, {} folds, seed {}{repeats}. Dictionary, scaling and classifier of a recipe are learned from the other \
                 folds alone; the calibration, too, on decision values out of {} inner folds, split alike.",
                split.by.word(),
                split.n_folds,
                split.seed,
                split.n_calibration_folds
            ),
        ));
    }
    if let Some(predictions) = &made.predictions {
        items.push((
            "predictions",
            format!(
                "{}, taken as they are: the outside model must have made each one without having seen the grasp",
                escape(predictions)
            ),
        ));
    }
    let data = &report.data;
    items.push((
        "grasps",
        format!(
            "{} with a label, of {} objects in {} classes; {} judged, {} held without a judgement",
            count(data.n_grasps as f64),
            count(data.n_objects as f64),
            count(data.n_classes as f64),
            count(data.n_judged as f64),
            count(data.n_held_unjudged as f64)
        ),
    ));
    let excluded: Vec<String> =
        data.n_excluded.iter().map(|(reason, n)| format!("{n} with {}", reason.replace('_', " "))).collect();
    items.push(("left out", if excluded.is_empty() { "none".into() } else { escape(&excluded.join(", ")) }));
    if let Some(graph) = &report.graph {
        let reasons: Vec<String> =
            graph.by_reason.iter().map(|(reason, n)| format!("{n} {}", reason.replace('_', " "))).collect();
        items.push(("decisions", escape(&reasons.join(", "))));
    }
    items.push(("intervals", escape(&made.intervals)));
    items.push(("recordings", escape(&recordings(&made.recordings))));
    let makers: Vec<String> =
        made.made_by.iter().map(|(maker, n)| format!("{n} by <code>{}</code>", escape(maker))).collect();
    items.push(("made by", makers.join("<br>")));
    items.extend(label_line(&made.labels).map(|label| ("label", escape(&label))));
    let mut text = String::from("<dl>\n");
    for (name, value) in items {
        let _ = writeln!(text, "<dt>{name}</dt><dd>{value}</dd>");
    }
    text.push_str("</dl>\n");
    text
}

/// All of a few; of many parts, the first and the last.
fn recordings(names: &[String]) -> String {
    match names {
        [first, .., last] if names.len() > 8 => format!("{}: {first} to {last}", names.len()),
        _ => names.join(", "),
    }
}

fn axis(label: &str, range: [f64; 2], format: NumberFormat) -> Axis {
    Axis { label: label.into(), range, format }
}

fn percent_axis(label: &str, range: [f64; 2]) -> Axis {
    axis(label, range, NumberFormat::Percent)
}

fn series(name: String, colour: &'static str, points: Vec<[f64; 2]>) -> Series {
    Series { name, colour, line: Line::Solid, points, discs: vec![], intervals: vec![] }
}

/// A line to compare with, without a name.
fn guide(points: Vec<[f64; 2]>) -> Series {
    Series { line: Line::Dashed, ..series(String::new(), "#9aa5b1", points) }
}

/// Each judge with its colour.
fn coloured(report: &Report) -> impl Iterator<Item = (&JudgedRecipe, &'static str)> {
    report.judges.iter().zip(COLOURS.into_iter().cycle())
}

fn with_number(name: &str, what: &str, value: Option<f64>) -> String {
    value.map_or(name.into(), |value| format!("{name}, {what} {value:.3}"))
}

fn roc(report: &Report) -> Chart {
    let mut all = vec![guide(vec![[0.0, 0.0], [1.0, 1.0]])];
    for (judge, colour) in coloured(report) {
        let mut points = vec![[0.0, 0.0]];
        points.extend(judge.curve.iter().map(|point| [point.false_positive_rate, point.recall]));
        let m = &judge.judged;
        let own = m.false_positive_rate.zip(m.recall).map(|(rate, recall)| [rate.value, recall.value, 5.5]);
        let name = with_number(&judge.name, "area", judge.roc_auc);
        all.push(Series { discs: own.into_iter().collect(), ..series(name, colour, points) });
    }
    Chart {
        title: "Receiver operating characteristic (disc: the threshold)".into(),
        size: HALF,
        x: percent_axis("unstable grasps that are lifted (%)", [0.0, 1.0]),
        y: percent_axis("stable grasps that are lifted (%)", [0.0, 1.0]),
        series: all,
    }
}

fn precision_recall(report: &Report) -> Chart {
    let mut all = Vec::new();
    for (judge, colour) in coloured(report) {
        let points: Vec<[f64; 2]> = judge.curve.iter().map(|point| [point.recall, point.precision]).collect();
        let m = &judge.judged;
        let own = m.recall.zip(m.precision).map(|(recall, precision)| [recall.value, precision.value, 5.5]);
        let name = with_number(&judge.name, "average", judge.average_precision);
        all.push(Series { discs: own.into_iter().collect(), ..series(name, colour, points) });
    }
    if let Some(share) = report.judges.first().and_then(|judge| at_recall(&judge.curve, 1.0)) {
        all.insert(0, guide(vec![[0.0, share.precision], [1.0, share.precision]]));
    }
    Chart {
        title: "Precision over recall (disc: the threshold)".into(),
        size: HALF,
        x: percent_axis("recall: stable grasps that are lifted (%)", [0.0, 1.0]),
        y: percent_axis("precision: lifted grasps that are stable (%)", [0.0, 1.0]),
        series: all,
    }
}

fn reliability(report: &Report) -> Chart {
    let mut all = vec![guide(vec![[0.0, 0.0], [1.0, 1.0]])];
    for (judge, colour) in coloured(report) {
        let Some(reliability) = &judge.reliability else { continue };
        let points: Vec<[f64; 2]> =
            reliability.bins.iter().map(|bin| [bin.mean_probability, bin.share_positive]).collect();
        let most = reliability.bins.iter().map(|bin| bin.n).max().unwrap_or(1) as f64;
        let discs = reliability
            .bins
            .iter()
            .map(|bin| [bin.mean_probability, bin.share_positive, 5.0 * (bin.n as f64 / most).sqrt()])
            .collect();
        let name = with_number(&judge.name, "calibration error", Some(reliability.ece));
        all.push(Series { discs, ..series(name, colour, points) });
    }
    Chart {
        title: "Reliability: what a probability is worth".into(),
        size: HALF,
        x: percent_axis("probability of stable, mean of a bin (%)", [0.0, 1.0]),
        y: percent_axis("grasps of the bin that are stable (%)", [0.0, 1.0]),
        series: all,
    }
}

/// What lifting from another probability on would do.
fn thresholds(report: &Report) -> Chart {
    let mut all = Vec::new();
    for (judge, colour) in coloured(report) {
        let dropped = judge.curve.iter().map(|point| [point.threshold, point.false_positive_rate]).collect();
        let held = judge.curve.iter().map(|point| [point.threshold, 1.0 - point.recall]).collect();
        all.push(series(format!("{}, lifted", judge.name), colour, dropped));
        all.push(Series { line: Line::Dashed, ..series(format!("{}, held", judge.name), colour, held) });
    }
    Chart {
        title: "What another threshold would do".into(),
        size: HALF,
        x: percent_axis("lift from this probability on (%)", [0.0, 1.0]),
        y: percent_axis("unstable grasps lifted, stable ones held (%)", [0.0, 1.0]),
        series: all,
    }
}

/// Errors, and false positives, over the grasps learned from; nothing without them.
fn learning_curves(report: &Report) -> Vec<Chart> {
    let errors = |point: &LearningPoint| {
        point.accuracy.map(|Estimate { value, interval }| Estimate {
            value: 1.0 - value,
            interval: interval.map(|Interval { low, high }| Interval { low: 1.0 - high, high: 1.0 - low }),
        })
    };
    if report.learning_curve.is_empty() {
        return Vec::new();
    }
    vec![
        learning_curve(report, "errors", &errors),
        learning_curve(report, "false positives", &|point| point.false_positive_share),
    ]
}

fn learning_curve(report: &Report, what: &str, of: &dyn Fn(&LearningPoint) -> Option<Estimate>) -> Chart {
    let (mut all, mut highest) = (Vec::new(), Vec::new());
    for (judge, colour) in coloured(report) {
        let mut own = series(judge.name.clone(), colour, vec![]);
        for point in report.learning_curve.iter().filter(|point| point.recipe == judge.name) {
            let n = point.n_grasps as f64;
            if let Some(Estimate { value, interval }) = of(point) {
                own.points.push([n, value]);
                own.discs.push([n, value, 4.0]);
                own.intervals.extend(interval.map(|interval| [n, interval.low, interval.high]));
                highest.push(interval.map_or(value, |interval| interval.high));
            }
        }
        all.push(own);
    }
    let n_judged = report.learning_curve.iter().map(|point| point.n_judged).max().unwrap_or(0);
    let most = report.learning_curve.iter().map(|point| point.n_grasps as f64);
    Chart {
        title: format!("Learning curve: {what} among {} grasps of the first fold", count(n_judged as f64)),
        size: HALF,
        x: axis("grasps learned from", range_from_zero(most), NumberFormat::Count),
        y: percent_axis(&format!("{what} (%)"), range_from_zero(highest)),
        series: all,
    }
}

/// Figure 2, for each judge, all in one scale.
fn figure_2(report: &Report) -> Vec<BarChart> {
    let highest =
        range_from_zero(report.judges.iter().flat_map(|judge| &judge.by_class).map(|class| class.error_share));
    let chart = |judge: &JudgedRecipe| BarChart {
        title: format!("Figure 2: errors and false positives by class, {}", judge.name),
        size: [FULL_WIDTH, 330.0],
        y: percent_axis("share of the class's grasps (%)", highest),
        groups: judge.by_class.iter().map(|class| class.class.clone()).collect(),
        series: vec![
            ("errors".into(), ERRORS, judge.by_class.iter().map(|class| class.error_share).collect()),
            (
                "false positives".into(),
                FALSE_POSITIVES,
                judge.by_class.iter().map(|class| class.false_positive_share).collect(),
            ),
        ],
    };
    report.judges.iter().map(chart).collect()
}

/// With thousands apart, as the paper writes them.
fn count(n: f64) -> String {
    thousands(&format!("{n:.0}"))
}

/// Percent without the sign.
fn number(share: f64) -> String {
    format!("{:.1}", 100.0 * share + 0.0).replace('-', "−")
}

fn percent(share: f64) -> String {
    format!("{} %", number(share))
}

/// A share as a percentage with its interval.
fn estimate(estimate: Option<Estimate>) -> String {
    let Some(Estimate { value, interval }) = estimate else { return "–".into() };
    let interval = interval.map(|interval| {
        let dash = if interval.low < 0.0 { " to " } else { "–" };
        format!(" <span class=\"interval\">({}{dash}{})</span>", number(interval.low), number(interval.high))
    });
    format!("{}{}", percent(value), interval.unwrap_or_default())
}

fn decimals(value: Option<f64>) -> String {
    value.map_or("–".into(), |value| format!("{value:.3}"))
}

fn p_value(p: f64) -> String {
    if p >= 0.001 { format!("{p:.3}") } else { format!("{p:.1e}").replace('-', "−") }
}

#[cfg(test)]
mod tests {
    use super::super::statistics::Interval;
    use super::*;

    #[test]
    fn numbers_are_written_as_people_write_them() {
        assert_eq!([count(0.0), count(999.0), count(24_640.0), count(1e6)], ["0", "999", "24,640", "1,000,000"]);
        let of = |low, high| Some(Estimate { value: 0.883, interval: Some(Interval { low, high }) });
        assert_eq!(estimate(of(0.8764, 0.89)), "88.3 % <span class=\"interval\">(87.6–89.0)</span>");
        assert!(estimate(of(-0.01, 0.02)).ends_with("(−1.0 to 2.0)</span>"));
        assert_eq!((estimate(None), decimals(Some(0.95))), ("–".into(), "0.950".into()));
        assert_eq!((p_value(0.25), p_value(1.234e-9)), ("0.250".into(), "1.2e−9".into()));
    }
}
