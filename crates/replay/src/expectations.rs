//! The expectations of a recording's replay: `NAME.expect.yaml` beside `NAME.mcap`.
//!
//! ```yaml
//! version: 1
//! dataflow: ../dataflow.yaml        # for a recording of another hand; relative to this file
//! set: [lift_arbiter.probe=none, classifier.model=../models/mine.json]    # as --set; a path that begins with . likewise
//! accuracy_at_least: 0.9            # of the labelled grasps
//! false_positives_at_most: 0        # unstable grasps that are lifted
//! decisions: {3: lift, 7: hold no_contact}
//! reasons: {out_of_order: 2}        # the number of grasps decided for this reason
//! tolerances:
//!   /prediction: {absolute: 1e-12, relative: 0}
//! ```

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::comparison::Tolerance;
use blindgrasp_messages::files::read_regular;
use blindgrasp_messages::{Action, Reason};
use blindgrasp_operator::text::did_you_mean;

/// The keys of an expectations file.
const KEYS: [&str; 8] = [
    "version",
    "dataflow",
    "set",
    "accuracy_at_least",
    "false_positives_at_most",
    "decisions",
    "reasons",
    "tolerances",
];

/// Expectations beyond the recorded samples; by default there are none.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Expectations {
    /// The dataflow file for the recording, if it is another than the usual one.
    pub dataflow: Option<PathBuf>,
    /// Params with other values than in the dataflow file, as they stand after `--set`.
    pub set: Vec<String>,
    pub accuracy_at_least: Option<f64>,
    /// The most unstable grasps that may be lifted.
    pub false_positives_at_most: Option<usize>,
    /// By grasp, the decision and perhaps its reason.
    pub decisions: BTreeMap<u64, (Action, Option<Reason>)>,
    /// By reason, the number of grasps.
    pub reasons: BTreeMap<String, usize>,
    pub tolerances: BTreeMap<String, Tolerance>,
}

#[derive(Debug, thiserror::Error)]
#[error("expectations {}: {message}", path.display())]
pub struct ExpectationsError {
    path: PathBuf,
    message: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    version: u64,
    #[serde(default, deserialize_with = "given")]
    dataflow: Option<PathBuf>,
    #[serde(default)]
    set: Vec<String>,
    #[serde(default, deserialize_with = "given")]
    accuracy_at_least: Option<f64>,
    #[serde(default, deserialize_with = "given")]
    false_positives_at_most: Option<usize>,
    #[serde(default)]
    decisions: BTreeMap<u64, String>,
    #[serde(default)]
    reasons: BTreeMap<String, usize>,
    #[serde(default)]
    tolerances: BTreeMap<String, Tolerance>,
}

/// The end of an expectations file's name, in place of the recording's `.mcap`.
pub const SUFFIX: &str = ".expect.yaml";

pub fn path_of(recording: &Path) -> PathBuf {
    recording.with_extension(&SUFFIX[1..])
}

impl Expectations {
    /// Reads a recording's expectations; `None` if it has none.
    ///
    /// # Errors
    /// The file cannot be read, or is wrong.
    pub fn of(recording: &Path) -> Result<Option<Expectations>, ExpectationsError> {
        let path = path_of(recording);
        let invalid = |message: String| ExpectationsError { path: path.clone(), message };
        let text = match read_regular(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(invalid(error.to_string())),
        };
        let mut expectations = Expectations::parse(&text).map_err(invalid)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        if let Some(dataflow) = &mut expectations.dataflow {
            *dataflow = folder.join(&*dataflow);
        }
        for set in &mut expectations.set {
            if let Some((place, value)) = set.split_once('=')
                && (value.starts_with("./") || value.starts_with("../"))
            {
                *set = format!("{place}={}", folder.join(value).display());
            }
        }
        Ok(Some(expectations))
    }

    /// Reads the text of an expectations file.
    ///
    /// # Errors
    /// A text that says what is wrong.
    pub fn parse(text: &str) -> Result<Expectations, String> {
        let written: Written =
            serde_saphyr::from_str(text).map_err(|error| with_suggestion(&error.without_snippet().to_string()))?;
        if written.version != 1 {
            return Err(format!("version must be 1, found {}", written.version));
        }
        let share = |name: &str, value: Option<f64>| match value {
            Some(value) if !(0.0..=1.0).contains(&value) => Err(format!("{name} must be from 0 to 1, found {value}")),
            value => Ok(value),
        };
        for reason in written.reasons.keys() {
            reason_named(reason).map_err(|what| format!("reasons: {what}"))?;
        }
        for (topic, tolerance) in &written.tolerances {
            let is_allowed = |value: f64| value >= 0.0 && value.is_finite();
            if !topic.starts_with('/') {
                return Err(format!("tolerances: '{topic}' is no topic: expected one like /prediction"));
            }
            if !(is_allowed(tolerance.absolute) && is_allowed(tolerance.relative)) {
                return Err(format!("tolerances: {topic}: expected numbers from 0 on"));
            }
        }
        let decisions = written.decisions.iter().map(|(grasp_id, text)| {
            let decision = decision(text).map_err(|what| format!("decisions: grasp {grasp_id}: {what}"))?;
            Ok((*grasp_id, decision))
        });
        Ok(Expectations {
            dataflow: written.dataflow,
            set: written.set,
            accuracy_at_least: share("accuracy_at_least", written.accuracy_at_least)?,
            false_positives_at_most: written.false_positives_at_most,
            decisions: decisions.collect::<Result<_, String>>()?,
            reasons: written.reasons,
            tolerances: written.tolerances,
        })
    }

    /// The text of the file, which [`Expectations::parse`] reads; `remarks` stand behind the decisions of grasps.
    pub fn to_yaml(&self, remarks: &BTreeMap<u64, String>) -> String {
        let mut lines = vec!["version: 1".to_string()];
        if let Some(dataflow) = &self.dataflow {
            lines.push(format!("dataflow: {}", serde_json::json!(dataflow)));
        }
        if !self.set.is_empty() {
            lines.push("set:".into());
        }
        lines.extend(self.set.iter().map(|set| format!("  - {}", serde_json::json!(set))));
        if let Some(share) = self.accuracy_at_least {
            lines.push(format!("accuracy_at_least: {share}"));
        }
        if let Some(n) = self.false_positives_at_most {
            lines.push(format!("false_positives_at_most: {n}"));
        }
        if !self.decisions.is_empty() {
            lines.push("decisions:".into());
        }
        for (grasp_id, (action, reason)) in &self.decisions {
            let reason = reason.map_or(String::new(), |reason| format!(" {}", reason.as_str()));
            let remark = remarks.get(grasp_id).map_or(String::new(), |remark| format!("    # {remark}"));
            lines.push(format!("  {grasp_id}: {}{reason}{remark}", action.as_str()));
        }
        lines.join("\n") + "\n"
    }

    /// Whether there are expectations of the decisions.
    pub fn has_demands(&self) -> bool {
        let is_counted = self.accuracy_at_least.is_some() || self.false_positives_at_most.is_some();
        is_counted || !self.decisions.is_empty() || !self.reasons.is_empty()
    }
}

/// Refuses a key without a value: it would expect nothing without notice.
fn given<'de, T: Deserialize<'de>, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Option<T>, D::Error> {
    T::deserialize(deserializer).map(Some)
}

/// Parses `lift` or `hold`, perhaps with a reason behind it.
fn decision(text: &str) -> Result<(Action, Option<Reason>), String> {
    let (action, reason) = match text.split_once(' ') {
        Some((action, reason)) => (action, Some(reason_named(reason.trim())?)),
        None => (text, None),
    };
    let action = Action::ALL.iter().find(|known| known.as_str() == action);
    action
        .map(|action| (*action, reason))
        .ok_or_else(|| format!("'{text}': expected lift or hold, or like 'hold no_contact'"))
}

fn reason_named(word: &str) -> Result<Reason, String> {
    let words = || Reason::ALL.iter().map(|reason| reason.as_str());
    let known = Reason::ALL.iter().find(|reason| reason.as_str() == word);
    known.copied().ok_or_else(|| match did_you_mean(word, words()) {
        Some(hint) => format!("unknown reason '{word}'; {hint}"),
        None => format!("unknown reason '{word}'; reasons: {}", words().collect::<Vec<_>>().join(", ")),
    })
}

/// The text of a parser's error, with the known key that is most like an unknown one.
fn with_suggestion(error: &str) -> String {
    let unknown = error.split_once("unknown field `").and_then(|(_, rest)| rest.split_once('`'));
    let hint = unknown.and_then(|(key, _)| did_you_mean(key, KEYS.into_iter().chain(["absolute", "relative"])));
    let error = error.replace("unknown field `", "unknown key `");
    match hint {
        Some(hint) => format!("{error}; {hint}"),
        None => error,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_demanded() {
        let text = "version: 1\naccuracy_at_least: 0.9\nfalse_positives_at_most: 0\n\
                    decisions: {3: lift, 7: hold no_contact}\nreasons: {out_of_order: 2}\n\
                    tolerances:\n  /prediction: {absolute: 1e-12}\n";
        let found = Expectations::parse(text).expect("expectations");
        assert_eq!(found.accuracy_at_least, Some(0.9));
        assert_eq!(found.decisions[&3], (Action::Lift, None));
        assert_eq!(found.decisions[&7], (Action::Hold, Some(Reason::NoContact)));
        assert_eq!(found.tolerances["/prediction"], Tolerance { absolute: 1e-12, relative: 0.0 });
        assert!(found.has_demands());
        assert!(!Expectations::parse("version: 1\n").expect("nothing").has_demands());
        for key in ["accuracy_at_least", "false_positives_at_most", "dataflow"] {
            for nothing in ["", "~", "null"] {
                let text = format!("version: 1\n{key}: {nothing}\n");
                assert!(key == "dataflow" || Expectations::parse(&text).is_err(), "{text}");
            }
        }
    }

    #[test]
    fn params_are_kept_and_their_paths_are_those_of_the_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let recording = folder.path().join("run.mcap");
        let set = ["lift_arbiter.probe=none", "classifier.model=../models/mine.json"].map(String::from).to_vec();
        let text = Expectations { set, ..Expectations::default() }.to_yaml(&BTreeMap::new());
        std::fs::write(path_of(&recording), text).expect("written");
        let read = Expectations::of(&recording).expect("readable").expect("there");
        let model = folder.path().join("../models/mine.json");
        assert_eq!(read.set, ["lift_arbiter.probe=none".into(), format!("classifier.model={}", model.display())]);
    }

    #[test]
    fn mistakes_are_said_with_what_may_have_been_meant() {
        for (text, expected) in [
            ("version: 1\naccuracy_at_last: 0.9\n", "did you mean 'accuracy_at_least'?"),
            ("version: 1\ntolerances: {/prediction: {absolut: 1}}\n", "did you mean 'absolute'?"),
            ("version: 2\n", "version must be 1, found 2"),
            ("accuracy_at_least: 0.9\n", "version"),
            ("version: 1\naccuracy_at_least: 90\n", "accuracy_at_least must be from 0 to 1, found 90"),
            ("version: 1\nreasons: {out_of_odrer: 1}\n", "did you mean 'out_of_order'?"),
            ("version: 1\ndecisions: {3: lfit}\n", "grasp 3: 'lfit': expected lift or hold"),
            ("version: 1\ndecisions: {3: hold stabel}\n", "did you mean 'stable'?"),
            ("version: 1\ntolerances: {prediction: {absolute: 1}}\n", "expected one like /prediction"),
            ("version: 1\ntolerances: {/prediction: {absolute: -1}}\n", "expected numbers from 0 on"),
            ("version: 1\nlatency_ratio_at_most: 8\n", "unknown key `latency_ratio_at_most`"),
            ("[]", "expected"),
        ] {
            let error = Expectations::parse(text).expect_err(text);
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
