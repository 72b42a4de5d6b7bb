//! Options of trials from a file, and those that trials have in common with the simulator of the training data.

use std::path::Path;

use crate::simulator::{OptionError, SimulatorOptions};
use crate::trial::{TrialError, TrialOptions};

impl TrialOptions {
    /// Reads options from a YAML or JSON file. What it leaves out has its default.
    ///
    /// # Errors
    /// A file that cannot be read, an option that there is not, or one that can't be; with the file's name.
    pub fn load(path: &Path) -> Result<TrialOptions, TrialError> {
        let refuse = |reason: String| TrialError::OptionsFile { path: path.into(), reason };
        let text = std::fs::read_to_string(path).map_err(|error| refuse(error.to_string()))?;
        let options: TrialOptions = serde_saphyr::from_str(&text).map_err(|error| refuse(error.to_string()))?;
        options.check().map_err(|error| refuse(error.to_string()))?;
        Ok(options)
    }

    /// Whether the options of the rubber, its contacts and its cells can be.
    pub(super) fn check_shared(&self) -> Result<(), OptionError> {
        SimulatorOptions {
            contacts: self.physics.contacts.clone(),
            soft_finger: self.physics.soft_finger.clone(),
            sensor: self.sensor.clone(),
            ..SimulatorOptions::default()
        }
        .check()
    }
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;

    fn loaded(text: &str) -> Result<TrialOptions, String> {
        let file = tempfile::NamedTempFile::new().expect("a file");
        std::fs::write(file.path(), text).expect("written");
        TrialOptions::load(file.path()).map_err(|error| {
            let error = error.to_string();
            assert!(error.starts_with(&format!("options {}: ", file.path().display())), "{error}");
            error
        })
    }

    #[test]
    fn a_file_says_what_is_not_the_default() {
        let options =
            loaded("protocol: {lift_m: 0.1}\nphysics:\n  contacts: {contacts_per_link: 1}\n").expect("options");
        assert_eq!((options.protocol.lift_m, options.physics.contacts.contacts_per_link), (0.1, 1));
        assert_eq!(options.sensor, TrialOptions::default().sensor);
        let json = serde_json::to_string_pretty(&options).expect("JSON");
        assert_eq!(loaded(&json), Ok(options));
    }

    #[test]
    fn what_cannot_be_is_refused_by_its_name() {
        for (text, expected) in [
            ("physics: {stand_friction: 1.5}", "option physics.stand_friction is 1.5, expected a number from 0 to 1"),
            ("physics: {stand_fricton: 0.5}", "stand_fricton"),
            ("protocol: {hold_secs: 1e9}", "option protocol.hold_secs is 1000000000, expected"),
            ("protocol: {frame_nanos: 1}", "option protocol.frame_nanos is 1, expected"),
            ("physics: {step_secs: 1}", "option physics.step_secs is 1, expected"),
            ("sensor: {dead_fraction: 2}", "option dead_fraction is 2, expected"),
            ("physics: {contacts: {contacts_per_link: 0}}", "option contacts_per_link is 0, expected"),
        ] {
            let error = loaded(text).expect_err(text);
            assert!(error.contains(expected), "{text}: {error}");
        }
        let missing = TrialOptions::load(Path::new("nosuch.yaml")).expect_err("no file").to_string();
        assert!(missing.starts_with("options nosuch.yaml: "), "{missing}");
    }

    /// Each option with its default, as a line of the table begins.
    fn flattened(name: &str, value: &Value, into: &mut Vec<String>) {
        match value.as_object() {
            Some(object) => {
                for (key, value) in object {
                    let name = if name.is_empty() { key.clone() } else { format!("{name}.{key}") };
                    flattened(&name, value, into);
                }
            }
            None => {
                let text = value.to_string();
                let text = text.trim_matches('"');
                into.push(format!("| `{name}` | {} |", text.strip_suffix(".0").unwrap_or(text)));
            }
        }
    }

    #[test]
    fn the_documentation_lists_every_option_with_its_default() {
        let docs = include_str!("../../../../docs/trials.md");
        let mut lines = Vec::new();
        flattened("", &serde_json::to_value(TrialOptions::default()).expect("JSON"), &mut lines);
        for line in lines {
            assert!(docs.contains(&line), "docs/trials.md has no line '{line} …' among the options of trials");
        }
    }
}
