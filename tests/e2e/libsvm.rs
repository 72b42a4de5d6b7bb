//! A model is exported to LIBSVM's file and imported again, by the commands.

use std::path::Path;
use std::process::{Command, Output};

use blindgrasp_stages::classifier::Predictor;
use blindgrasp_stages::classifier::svm::PreparedSvm;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::recipe::Learner;

use crate::common::paper_model;

fn svm(model: &Model) -> &PreparedSvm {
    match &model.classifier.predictor {
        Predictor::Svm(svm) => svm,
        other => panic!("no SVM but {}", other.summary()),
    }
}

fn blindgrasp(arguments: &[&Path]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_blindgrasp")).arg("model").args(arguments).output().expect("blindgrasp starts")
}

fn import(file: &Path, like: &Path, out: &Path, more: &[&Path]) -> Output {
    let fixed = ["import", "--overwrite", "--like"].map(Path::new);
    let arguments = [&fixed[..], &[like, Path::new("--out"), out, file]].concat();
    blindgrasp(&[arguments.as_slice(), more].concat())
}

#[test]
fn an_exported_model_decides_the_same_when_it_is_imported() {
    let folder = tempfile::tempdir().expect("a folder");
    let (exported, imported) = (folder.path().join("svm.model"), folder.path().join("new.json"));
    let built = paper_model();
    let output = blindgrasp(&[Path::new("export"), built, Path::new("--out"), &exported]);
    assert!(output.status.success(), "{output:?}");
    let output = import(&exported, built, &imported, &[]);
    assert!(output.status.success(), "{output:?}");
    let (before, after) = (Model::load(built).expect("a model"), Model::load(&imported).expect("a model"));
    assert_eq!(after.dictionary_id(), before.dictionary_id());
    assert_eq!(after.classifier.calibration, before.classifier.calibration);
    for case in 0..50 {
        let feature: Vec<f64> =
            (0..svm(&before).n_features).map(|idx| (0.5 + 0.5 * ((idx * (case + 3)) as f64).sin()) / 4.0).collect();
        let plain = svm(&before).decision_value(&feature).expect("a value");
        let (before, after) = (before.classifier.classify(&feature), after.classifier.classify(&feature));
        let (before, after) = (before.expect("a verdict"), after.expect("a verdict"));
        // The support vectors have another order, and so their sum differs in the last digits.
        assert!((after.decision_value - before.decision_value).abs() < 1e-9, "{before:?} {after:?}");
        assert!((before.decision_value - plain).abs() < 1e-9, "{before:?} {plain}");
    }
}

#[test]
fn an_svm_without_probabilities_needs_a_decision() {
    let folder = tempfile::tempdir().expect("a folder");
    let (file, out) = (folder.path().join("svm.model"), folder.path().join("new.json"));
    let text = "svm_type c_svc\nkernel_type rbf\ngamma 0.5\nnr_class 2\ntotal_sv 2\nrho 0.25\nlabel 1 -1\nnr_sv 1 1\n\
                SV\n1 2:3 \n-1 1:1 64:-1e-3 \n";
    std::fs::write(&file, text).expect("a file");
    let like = paper_model();
    let output = import(&file, like, &out, &[]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("--keep-calibration"), "{output:?}");
    assert!(!out.exists());
    let output = import(&file, like, &out, &[Path::new("--keep-calibration")]);
    assert!(output.status.success(), "{output:?}");
    let model = Model::load(&out).expect("a model");
    let Learner::Svm(params) = &model.training.recipe.learner else { panic!("a recipe without an SVM") };
    assert_eq!((svm(&model).gamma, params.gamma), (0.5, 0.5));

    std::fs::write(&file, text.replace("64:", "65:")).expect("a file");
    let output = import(&file, like, &out, &[Path::new("--keep-calibration")]);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(errors.contains("line 11: index 65, but samples have 64 features here"), "{errors}");
}
