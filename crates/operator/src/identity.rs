//! The identity of an operator: its program, its parameters and the files that they name.
//!
//! Each sample carries the identities of all operators that it has passed, mixed into one number. A reader that counts several
//! samples together, as the arbiter counts votes, sees from it whether the same operators have made them. A restart does not
//! change it; another program, parameter or model does.

use std::os::unix::ffi::OsStringExt;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use serde_json::{Map, Value};
use twox_hash::XxHash3_64;

use crate::description::OperatorDescription;
use crate::host;
use crate::param::ParamKind;

/// The part of the identity that does not change while the process runs.
pub(crate) fn of_program(description: &OperatorDescription, params: &Map<String, Value>) -> u64 {
    let mut parts = vec![description.operator.clone().into_bytes(), description.version.clone().into_bytes()];
    parts.extend(std::env::args_os().map(OsStringExt::into_vec));
    // A program that was built again is another one.
    let program = if description.hosted { host::program() } else { std::env::current_exe().ok() };
    if let Some(Ok(metadata)) = program.map(std::fs::metadata) {
        parts.push(format!("{} {} {}", metadata.len(), metadata.mtime(), metadata.mtime_nsec()).into_bytes());
    }
    // A source's samples are its own, whatever its recording is called.
    let is_stage = !description.inputs.is_empty();
    let paths = description.params.iter().filter(|param| is_stage && matches!(param.kind, ParamKind::Path { .. }));
    for param in paths {
        let path = params.get(&param.name).and_then(Value::as_str).map(Path::new);
        if let Some(content) = path.filter(|path| path.is_file()).and_then(|path| std::fs::read(path).ok()) {
            parts.extend([param.name.clone().into_bytes(), content]);
        }
    }
    stable_hash(&parts)
}

/// The identity of a program with these values of its parameters.
pub(crate) fn with_params(program: u64, params: &Map<String, Value>) -> u64 {
    // The order of a map's keys is that of their names.
    let params = Value::Object(params.clone()).to_string();
    stable_hash(&[&program.to_le_bytes()[..], params.as_bytes()])
}

/// The identity of the samples that an operator makes of samples that were `made_by` others.
pub(crate) fn after(made_by: u64, own: u64) -> u64 {
    let bytes = [made_by, own].map(u64::to_le_bytes);
    // 0 says that nothing is known.
    XxHash3_64::oneshot(bytes.as_flattened()).max(1)
}

/// A hash that another build computes alike, as the standard library's does not promise. Samples and saved states carry it
/// from one process to the next. The length before each part tells the parts apart.
pub(crate) fn stable_hash(parts: &[impl AsRef<[u8]>]) -> u64 {
    let mut bytes = Vec::new();
    for part in parts {
        bytes.extend((part.as_ref().len() as u64).to_le_bytes());
        bytes.extend(part.as_ref());
    }
    XxHash3_64::oneshot(&bytes)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// The numbers are those of `XXH3_64bits` of libxxhash 0.8.1.
    #[test]
    fn every_build_finds_the_same_hashes() {
        assert_eq!(stable_hash(&["feature"]), 0x5466_11c3_7684_0943);
        assert_eq!(after(1, 2), 0x07ee_86c2_8144_6bef);
        assert_ne!(stable_hash(&["ab", "c"]), stable_hash(&["a", "bc"]));
    }

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
