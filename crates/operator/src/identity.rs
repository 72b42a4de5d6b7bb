//! The identity of an operator: its program, its parameters and the files that they name.
//!
//! Each sample carries the identities of all operators that it has passed, mixed into one number. A reader that counts several
//! samples together, as the arbiter counts votes, sees from it whether the same operators have made them. A restart does not
//! change it; another program, parameter or model does.

use std::collections::hash_map::DefaultHasher;
use std::hash::{Hash, Hasher};
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use serde_json::{Map, Value};

use crate::description::OperatorDescription;
use crate::host;
use crate::param::ParamKind;

/// The part of the identity that does not change while the process runs.
pub(crate) fn of_program(description: &OperatorDescription, params: &Map<String, Value>) -> u64 {
    let mut hasher = DefaultHasher::new();
    (&description.operator, &description.version).hash(&mut hasher);
    std::env::args_os().collect::<Vec<_>>().hash(&mut hasher);
    // A program that was built again is another one.
    let program = if description.hosted { host::program() } else { std::env::current_exe().ok() };
    if let Some(Ok(metadata)) = program.map(std::fs::metadata) {
        (metadata.len(), metadata.mtime(), metadata.mtime_nsec()).hash(&mut hasher);
    }
    // A source's samples are its own, whatever its recording is called.
    let is_stage = !description.inputs.is_empty();
    let paths = description.params.iter().filter(|param| is_stage && matches!(param.kind, ParamKind::Path { .. }));
    for param in paths {
        let path = params.get(&param.name).and_then(Value::as_str).map(Path::new);
        if let Some(content) = path.filter(|path| path.is_file()).and_then(|path| std::fs::read(path).ok()) {
            (&param.name, content).hash(&mut hasher);
        }
    }
    hasher.finish()
}

/// The identity of a program with these values of its parameters.
pub(crate) fn with_params(program: u64, params: &Map<String, Value>) -> u64 {
    let mut hasher = DefaultHasher::new();
    program.hash(&mut hasher);
    // The order of a map's keys is that of their names.
    Value::Object(params.clone()).to_string().hash(&mut hasher);
    hasher.finish()
}

/// The identity of the samples that an operator makes of samples that were `made_by` others.
pub(crate) fn after(made_by: u64, own: u64) -> u64 {
    let mut hasher = DefaultHasher::new();
    (made_by, own).hash(&mut hasher);
    // 0 says that nothing is known.
    hasher.finish().max(1)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn another_parameter_and_another_content_of_a_file_are_another_identity() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        let description = OperatorDescription::new("mine", "")
            .input("feature", "blindgrasp/GraspFeature/4", "")
            .param("model", ParamKind::Path { must_exist: true }, None, "")
            .live_param("threshold", ParamKind::Integer { min: None, max: None }, Some(1.into()), "");
        let identity = |threshold: u64| {
            let params = json!({"model": file.path(), "threshold": threshold});
            let params = params.as_object().expect("a map");
            with_params(of_program(&description, params), params)
        };
        std::fs::write(file.path(), "one").expect("written");
        let first = identity(1);
        assert_eq!(identity(1), first);
        assert_ne!(identity(2), first);
        std::fs::write(file.path(), "two").expect("written");
        assert_ne!(identity(1), first);
        assert_ne!(after(0, first), after(1, first));
    }
}
