//! The columns of a table, found by patterns over the header's names.

use std::collections::HashMap;

use super::{BY_PANDAS, Day, ImportOptions, Joints};
use blindgrasp_stages::hand::Hand;

/// How many names an error lists.
const MAX_NAMES: usize = 12;

/// Indices of the columns that are read.
#[derive(Debug)]
pub(super) struct Columns {
    /// One for each cell of the hand, in its order.
    pub(super) cells: Vec<usize>,
    /// One for each joint of the hand, in its order; empty for a fixed posture.
    pub(super) joints: Vec<usize>,
    pub(super) label: usize,
    pub(super) group: usize,
    pub(super) class: Option<usize>,
    pub(super) day: Option<usize>,
    pub(super) grasp: Option<usize>,
    pub(super) phase: Option<usize>,
    pub(super) warnings: Vec<String>,
}

impl Columns {
    /// Finds the columns of the options. Errors do not name the file.
    pub(super) fn find(header: &[String], hand: &Hand, options: &ImportOptions) -> Result<Columns, String> {
        let label = column(header, &options.label, "--label")?;
        let group = column(header, &options.group, "--group")?;
        let day = match &options.day {
            Day::Column(day) => Some(column(header, day, "--day-column")?),
            _ => None,
        };
        let optional = |name: &Option<String>, flag| name.as_ref().map(|name| column(header, name, flag)).transpose();
        let grasp = optional(&options.grasp, "--grasp-column")?;
        let phase = optional(&options.phase, "--phase-column")?;
        let class = optional(&options.class, "--class")?;
        let by_pattern = matches(header, &options.cells, "--cells")?;
        check_cells(hand, &options.cells, &by_pattern)?;
        let warnings = out_of_order(header, &by_pattern);
        let cells = by_pattern.concat();
        let joints = match &options.joints {
            Joints::Fixed(_) => Vec::new(),
            Joints::Columns(patterns) => {
                let joints = matches(header, patterns, "--joint-columns")?.concat();
                check_joints(hand, header, &joints)?;
                joints
            }
        };
        // The label must not be among the features, and other overlaps are slips. Group and class may be one column.
        let of = |idxs: &[usize], what: &'static str| idxs.iter().map(|idx| (*idx, what)).collect::<Vec<_>>();
        let mut uses = of(&cells, "--cells");
        uses.extend(of(&joints, "--joint-columns"));
        uses.extend([(label, "--label"), (group, "--group")]);
        uses.extend(class.filter(|class| *class != group).map(|class| (class, "--class")));
        uses.extend(day.map(|day| (day, "--day-column")));
        uses.extend(grasp.map(|grasp| (grasp, "--grasp-column")));
        uses.extend(phase.map(|phase| (phase, "--phase-column")));
        for (n_before, (idx, what)) in uses.iter().enumerate() {
            if let Some((_, first)) = uses[..n_before].iter().find(|(other, _)| other == idx) {
                return Err(format!("column '{}' is read twice, by {first} and by {what}", header[*idx]));
            }
        }
        check_names(header, &uses.iter().map(|(idx, _)| *idx).collect::<Vec<_>>())?;
        Ok(Columns { cells, joints, label, group, class, day, grasp, phase, warnings })
    }
}

/// Refuses a column that is read and whose name another one has, too.
fn check_names(header: &[String], used: &[usize]) -> Result<(), String> {
    let mut by_name: HashMap<&String, Vec<usize>> = HashMap::new();
    for (idx, name) in header.iter().enumerate().filter(|(_, name)| !name.is_empty()) {
        by_name.entry(name).or_default().push(idx);
    }
    let twins = used.iter().filter_map(|idx| by_name.get(&header[*idx]).filter(|idxs| idxs.len() > 1));
    match twins.into_iter().next() {
        Some(idxs) => Err(format!(
            "line 1: columns {} and {} are both called '{}': expected names that differ",
            idxs[0] + 1,
            idxs[1] + 1,
            shortened(&header[idxs[0]])
        )),
        None => Ok(()),
    }
}

fn column(header: &[String], name: &str, flag: &str) -> Result<usize, String> {
    let found = header.iter().position(|column| column == name);
    found.ok_or_else(|| format!("{flag}: there is no column '{name}'; {}", help(header, name)))
}

/// The columns that each pattern matches, as they lie in the table.
fn matches(header: &[String], patterns: &[String], flag: &str) -> Result<Vec<Vec<usize>>, String> {
    // Tables of the Python package name a sense so: `joint_*` means the angles.
    let is_torque = |name: &str| name.starts_with("joint_torques");
    let of = |pattern: &String| {
        let fits = |name: &String| {
            !name.is_empty() && matches_pattern(pattern, name) && (is_torque(pattern) || !is_torque(name))
        };
        let found: Vec<usize> = (0..header.len()).filter(|idx| fits(&header[*idx])).collect();
        if found.is_empty() {
            Err(format!("{flag}: no column is called '{pattern}'; {}", help(header, pattern)))
        } else {
            Ok(found)
        }
    };
    patterns.iter().map(of).collect()
}

/// Warns of a pattern of cells whose columns are numbered and do not lie in the order of their numbers.
fn out_of_order(header: &[String], by_pattern: &[Vec<usize>]) -> Vec<String> {
    let numbered = |idx: usize| {
        let stem = header[idx].trim_end_matches(|char: char| char.is_ascii_digit());
        Some((stem, header[idx][stem.len()..].parse::<u64>().ok()?))
    };
    let falls = |pair: &&[usize]| match (numbered(pair[0]), numbered(pair[1])) {
        (Some((stem, number)), Some((next_stem, next))) => stem == next_stem && number > next,
        _ => false,
    };
    let warning = |pair: &[usize]| {
        let [before, name] = [pair[0], pair[1]].map(|idx| shortened(&header[idx]));
        format!(
            "column '{name}' lies behind '{before}', and cells follow the table's order: if the numbers are those of the \
             cells, sort the columns by number"
        )
    };
    by_pattern.iter().filter_map(|found| found.windows(2).find(falls).map(warning)).collect()
}

/// Whether a name is like a pattern, in which `*` stands for any text.
fn matches_pattern(pattern: &str, name: &str) -> bool {
    let Some((start, rest)) = pattern.split_once('*') else { return pattern == name };
    let Some(mut name) = name.strip_prefix(start) else { return false };
    let mut parts: Vec<&str> = rest.split('*').collect();
    let end = parts.pop().unwrap_or_default();
    for part in parts {
        // The earliest match leaves most text to the parts that follow.
        let Some(at) = name.find(part) else { return false };
        name = &name[at + part.len()..];
    }
    name.ends_with(end)
}

fn check_cells(hand: &Hand, patterns: &[String], by_pattern: &[Vec<usize>]) -> Result<(), String> {
    let n_found: usize = by_pattern.iter().map(Vec::len).sum();
    // One pattern for each pad must fit pad by pad: 30 and 18 columns are not two pads of 24.
    let fits = n_found == hand.n_cells()
        && (patterns.len() != hand.pads.len()
            || by_pattern.iter().zip(&hand.pads).all(|(found, pad)| found.len() == pad.cells.len()));
    if fits {
        return Ok(());
    }
    let found: Vec<_> =
        patterns.iter().zip(by_pattern).map(|(pattern, found)| format!("'{pattern}' {}", found.len())).collect();
    let expected: Vec<_> = hand.pads.iter().map(|pad| format!("{} {}", pad.name, pad.cells.len())).collect();
    Err(format!(
        "--cells: {n_found} columns for the {} cells of {}: found {}; expected {}, pad after pad in this order",
        hand.n_cells(),
        hand.name,
        listed(&found),
        expected.join(", ")
    ))
}

fn check_joints(hand: &Hand, header: &[String], joints: &[usize]) -> Result<(), String> {
    if joints.len() == hand.joints.len() {
        return Ok(());
    }
    let found: Vec<_> = joints.iter().map(|idx| header[*idx].clone()).collect();
    let expected: Vec<_> = hand.joints.iter().map(|joint| joint.name.as_str()).collect();
    Err(format!(
        "--joint-columns: {} columns for the {} joints of {}: found {}; expected one each for {}, in this order",
        joints.len(),
        hand.joints.len(),
        hand.name,
        listed(&found),
        expected.join(", ")
    ))
}

/// A hint for a name or pattern that no column matches.
fn help(header: &[String], wanted: &str) -> String {
    if let [only] = header {
        return format!("line 1 has no comma, only '{}': {BY_PANDAS}", shortened(only));
    }
    // Numbered columns stand for the pattern that matches them all.
    let has_star = wanted.contains('*');
    let likeness = |name: &String| match name.trim_end_matches(|char: char| char.is_ascii_digit()) {
        stem if has_star && stem.len() < name.len() => format!("{stem}*"),
        _ => name.clone(),
    };
    let distance = |name: &String| strsim::osa_distance(&wanted.to_lowercase(), &name.to_lowercase());
    let nearest = header.iter().filter(|name| !name.is_empty()).map(likeness).min_by_key(distance);
    match nearest.filter(|name| distance(name) <= 2 && *name != "*") {
        Some(name) => format!("did you mean '{}'?", shortened(&name)),
        None => format!("the table has {}", listed(header)),
    }
}

fn listed(names: &[String]) -> String {
    let shown: Vec<String> = names.iter().take(MAX_NAMES).map(|name| shortened(name)).collect();
    match names.len().saturating_sub(MAX_NAMES) {
        0 => shown.join(", "),
        n_more => format!("{} and {n_more} more", shown.join(", ")),
    }
}

/// The beginning of a name or value for an error: they may have any length.
pub(crate) fn shortened(text: &str) -> String {
    const MAX_CHARS: usize = 60;
    let shown = match text.char_indices().nth(MAX_CHARS) {
        None => text.into(),
        Some((end, _)) => format!("{}…", &text[..end]),
    };
    in_one_line(&shown)
}

/// A text of a table with blanks in the place of line breaks and other control characters, which would fake lines in messages.
pub(super) fn in_one_line(text: &str) -> String {
    text.replace(char::is_control, " ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_fakes_no_line_of_a_message() {
        assert_eq!(shortened("no\n  line 2: good\r"), "no   line 2: good ");
    }

    #[test]
    fn a_star_stands_for_any_text() {
        for (pattern, name, expected) in [
            ("ff_*", "ff_1", true),
            ("ff_*", "ff_", true),
            ("ff_*", "mff_1", false),
            ("*_1", "ff_1", true),
            ("*_1", "ff_11", false),
            ("f*_*1", "ff_11", true),
            ("a*a", "a", false),
            ("a*b*b", "ab", false),
            ("a*b*b", "abb", true),
            ("*", "ü", true),
            ("ff_1", "ff_1", true),
            ("ff_1", "ff_10", false),
            ("ff.1", "ff_1", false),
        ] {
            assert_eq!(matches_pattern(pattern, name), expected, "{pattern} {name}");
        }
    }

    #[test]
    fn names_of_columns_differ() {
        let twice = ["", "a", "", "b", "a"].map(String::from);
        let error = check_names(&twice, &[0, 4]).expect_err("twice");
        assert!(error.contains("columns 2 and 5 are both called 'a'"), "{error}");
        // Every name was compared with every other: minutes.
        let many: Vec<String> = (0..500_000).map(|idx| format!("column_{idx}")).collect();
        assert_eq!(check_names(&many, &(0..500_000).collect::<Vec<_>>()), Ok(()));
        assert_eq!(check_names(&twice, &[0, 2]), Ok(()), "no column of that name is read");
    }

    #[test]
    fn a_pattern_takes_columns_as_they_lie() {
        let header = ["c10", "x", "c2", "", "c1"].map(String::from);
        assert_eq!(matches(&header, &["c*".into(), "x".into()], "--cells"), Ok(vec![vec![0, 2, 4], vec![1]]));
        assert_eq!(matches(&header, &["*".into()], "--cells"), Ok(vec![vec![0, 1, 2, 4]]));
    }

    #[test]
    fn numbers_that_do_not_ascend_are_told() {
        let header = ["a_1", "a_10", "a_2", "b_3", "c_1", "x", "y"].map(String::from);
        let warnings = out_of_order(&header, &[vec![0, 1, 2, 3], vec![3, 4], vec![5, 6]]);
        assert!(warnings.len() == 1 && warnings[0].starts_with("column 'a_2' lies behind 'a_10'"), "{warnings:?}");
    }

    #[test]
    fn help_finds_what_was_meant() {
        let header = ["object", "slipped", "ff_biotac_1", "ff_biotac_2"].map(String::from);
        assert_eq!(help(&header, "sliped"), "did you mean 'slipped'?");
        assert_eq!(help(&header, "f_biotac_*"), "did you mean 'ff_biotac_*'?");
        assert!(help(&["held", "c1", "c2"].map(String::from), "cell*").starts_with("the table has"));
        assert_eq!(help(&header, "pressure"), "the table has object, slipped, ff_biotac_1, ff_biotac_2");
        assert_eq!(help(&["a;b".into()], "a"), format!("line 1 has no comma, only 'a;b': {BY_PANDAS}"));
    }
}
