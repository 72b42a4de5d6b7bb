//! Reads files from before the shipped operator `histogram` was renamed to `encoder`, and its output to `feature`.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use super::file::DataflowFile;
use super::node::NodeEntry;
use crate::operators::Operators;
use blindgrasp_operator::diagnostics::print_diagnostic;

const OLD_OPERATOR: &str = "histogram";
const NEW_OPERATOR: &str = "encoder";
const OLD_PORT: &str = "histogram";
const NEW_PORT: &str = "feature";
/// The shipped operators whose input was renamed.
const READERS: [&str; 2] = ["classifier", "regrasp"];

/// The file with the new names in the place of the old; `None` if it has no old names. A note is printed once a file.
pub(super) fn with_new_names(file: &DataflowFile, operators: &Operators) -> Option<DataflowFile> {
    static TOLD: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());
    // An operator of one's own may have the old name.
    if operators.get(OLD_OPERATOR).is_some() || operators.get(NEW_OPERATOR).is_none() {
        return None;
    }
    let mut renamed = file.clone();
    if !rename(&mut renamed.nodes) {
        return None;
    }
    if TOLD.lock().unwrap_or_else(PoisonError::into_inner).insert(file.absolute_path.clone()) {
        print_diagnostic(&format!(
            "{}: the operator '{OLD_OPERATOR}' is now called '{NEW_OPERATOR}', and its output and topic '{NEW_PORT}'; the \
             file is read with the new names",
            file.path().display()
        ));
    }
    Some(renamed)
}

/// Whether there was anything to rename.
fn rename(nodes: &mut [NodeEntry]) -> bool {
    let mut has_renamed = false;
    for run in nodes.iter_mut().filter_map(|node| node.run.as_mut()).filter(|run| run.text == OLD_OPERATOR) {
        run.text = NEW_OPERATOR.into();
        has_renamed = true;
    }
    let runs =
        |node: &NodeEntry, names: &[&str]| node.run.as_ref().is_some_and(|run| names.contains(&run.text.as_str()));
    let encoders: BTreeSet<String> =
        nodes.iter().filter(|node| runs(node, &[NEW_OPERATOR])).map(|node| node.id.text.clone()).collect();
    for node in nodes {
        let is_reader = runs(node, &READERS) && !node.inputs.iter().any(|input| input.port.text == NEW_PORT);
        for input in &mut node.inputs {
            if is_reader && input.port.text == OLD_PORT {
                input.port.text = NEW_PORT.into();
                has_renamed = true;
            }
            if let Some(source) = &mut input.source
                && source.port == OLD_PORT
                && encoders.contains(&source.node)
            {
                source.port = NEW_PORT.into();
                has_renamed = true;
            }
        }
    }
    has_renamed
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use blindgrasp_operator::description::OperatorDescription;

    use super::super::{Graph, Scope, check, parse};
    use crate::operators::Operators;

    fn describe(program: &Path, _: &[String]) -> Result<OperatorDescription, String> {
        let json = match program.file_name().and_then(|name| name.to_str()) {
            Some("encoder") => {
                r#"{"protocol": 3, "operator": "encoder", "version": "1", "outputs": [{"name": "feature", "type": "F"}]}"#
            }
            Some("classifier") => {
                r#"{"protocol": 3, "operator": "classifier", "version": "1", "inputs": [{"name": "feature", "type": "F"}]}"#
            }
            _ => {
                r#"{"protocol": 3, "operator": "own", "version": "1", "inputs": [{"name": "histogram", "type": "F"}],
                "outputs": [{"name": "histogram", "type": "F"}]}"#
            }
        };
        OperatorDescription::from_json(json).map_err(|error| error.to_string())
    }

    fn checked(nodes: &str, shipped: &[&str]) -> Result<Graph, String> {
        let yaml = format!("version: 1\nname: g\noperators:\n{nodes}");
        let file = parse(Path::new("/tmp/dataflow.yaml"), yaml.as_bytes()).expect("form");
        let operators = Operators::in_folder(Path::new("/bin"), shipped);
        check(&file, &operators, &[], Scope::Everything, describe).map_err(|error| error.to_string())
    }

    fn edges(nodes: &str) -> Vec<String> {
        let graph = checked(nodes, &["encoder", "classifier", "own"]).expect("good");
        let edge = |edge: super::super::Edge<'_>| {
            format!("{}/{} -> {}/{}", edge.from_node, edge.from_port, edge.to_node, edge.to_port)
        };
        graph.edges().map(edge).collect()
    }

    #[test]
    fn old_names_of_shipped_operators_are_read() {
        let expected = ["histogram/feature -> classifier/feature"];
        assert_eq!(edges("  histogram: {}\n  classifier: {inputs: {histogram: histogram/histogram}}\n"), expected);
        // Old and new names may be mixed.
        assert_eq!(
            edges("  histogram: {}\n  classifier: {inputs: {feature: {from: histogram/histogram}}}\n"),
            expected
        );
        assert_eq!(
            edges("  histogram: {run: encoder}\n  classifier: {inputs: {histogram: histogram/feature}}\n"),
            expected
        );
        let by_run = "  a: {run: histogram}\n  b: {run: classifier, inputs: {histogram: a/histogram}}\n";
        assert_eq!(edges(by_run), ["a/feature -> b/feature"]);
        // A reader of one's own keeps its port.
        let own = "  histogram: {}\n  own: {inputs: {histogram: histogram/histogram}}\n";
        assert_eq!(edges(own), ["histogram/feature -> own/histogram"]);
    }

    #[test]
    fn operators_of_ones_own_keep_their_names() {
        let own = "  a: {run: own, inputs: {histogram: b/histogram}}\n  b: {run: own, inputs: {histogram: c/feature}}\n  \
                   c: {run: encoder}\n";
        assert_eq!(edges(own), ["c/feature -> b/histogram", "b/histogram -> a/histogram"]);
        let shipped = ["histogram", "encoder", "classifier"];
        let error = checked("  histogram: {}\n", &shipped).expect_err("its input is missing");
        assert!(error.contains("node 'histogram' lacks the input 'histogram'"), "{error}");
        let error = checked("  a: {run: ./histogram}\n", &["encoder"]).expect_err("no such program");
        assert!(error.contains("/tmp/histogram' cannot be used"), "{error}");
        let both = "  encoder: {}\n  classifier: {inputs: {histogram: encoder/feature, feature: encoder/feature}}\n";
        let error = checked(both, &["encoder", "classifier"]).expect_err("one of them is unknown");
        assert!(error.contains("unknown input 'histogram' of node 'classifier'"), "{error}");
    }
}
