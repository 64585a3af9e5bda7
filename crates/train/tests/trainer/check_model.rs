//! `hrn-train check-model`: what the daemon would refuse in a model file, all at once.

use std::path::Path;

use prost::Message as _;

use crate::hrn_train_in;

fn check(path: &Path) -> (Option<i32>, String) {
    let output = hrn_train_in(Path::new("."), &format!("check-model {}", path.display()));
    let lines = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8(lines).unwrap())
}

#[test]
fn the_built_in_models_pass() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models");
    for name in ["hrn.onnx", "course.onnx"] {
        let (code, lines) = check(&models.join(name));
        assert!(
            code == Some(0) && lines.contains("a model that hardnessd loads"),
            "{lines}"
        );
    }
}

#[test]
fn all_errors_of_a_file_are_said_at_once() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("m.onnx");
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models");
    let bytes = std::fs::read(models.join("hrn.onnx")).unwrap();
    let mut model = tract_onnx::pb::ModelProto::decode(&*bytes).unwrap();
    model
        .metadata_props
        .retain(|entry| entry.key != "hrn.pitch_mm");
    for entry in &mut model.metadata_props {
        if entry.key == "hrn.range" {
            entry.value = "four".to_owned();
        }
    }
    let graph = model.graph.as_mut().unwrap();
    graph.input[0].name = "image".to_owned();
    graph.output[0].name = "result".to_owned();
    std::fs::write(&path, model.encode_to_vec()).unwrap();
    let (code, lines) = check(&path);
    assert_eq!((code, lines.lines().count()), (Some(78), 1), "{lines}");
    for part in [
        "pitch_mm",
        "hrn.range",
        "image",
        "result",
        "hardnessd.adopt",
    ] {
        assert!(lines.contains(part), "no {part} in\n{lines}");
    }

    std::fs::write(&path, "not a model").unwrap();
    assert_eq!(check(&path).0, Some(78));
    assert_eq!(check(&directory.path().join("none.onnx")).0, Some(66));
}
