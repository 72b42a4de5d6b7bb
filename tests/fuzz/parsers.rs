//! Damages files of every kind that the program reads, and lines that bridges and launchers hear: each is read or refused, and
//! nothing panics or overflows its stack.

use std::path::Path;

use blindgrasp_graph::control::Request;
use blindgrasp_graph::dataflow;
use blindgrasp_mesh::read::read_mesh;
use blindgrasp_mesh::{Mesh, write_off};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::Model;
use blindgrasp_tactile::line_protocol;
use nalgebra::Point3;

use crate::damage::check;

fn project(file: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).expect("a file of the project")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn hands() {
    let (layout, urdf) = (project("hands/barrett-bh8-280.yaml"), project("hands/barrett-bh8-280.urdf"));
    let read =
        |layout: &[u8], urdf: &[u8]| Hand::parse(Path::new("hand.yaml"), &text(layout), |_| Ok(text(urdf))).is_ok();
    check(2000, &layout, |layout| read(layout, &urdf));
    check(2000, &urdf, |urdf| read(&layout, urdf));
}

#[test]
fn meshes() {
    let folder = tempfile::tempdir().expect("a folder");
    let vertices_m = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(Point3::from).to_vec();
    let mesh = Mesh { vertices_m, triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]] };
    let off = folder.path().join("tetrahedron.off");
    write_off(&off, &mesh).expect("written");
    let obj = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1//1 4//1 3//1\nf -3 -2 \\\n-1\n".to_vec();
    let ply = b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 4\n\
                property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
        .to_vec();
    let mut stl = vec![b' '; 80];
    stl.extend(4_u32.to_le_bytes());
    for triangle in &mesh.triangles {
        let corners = triangle.map(|idx| mesh.vertices_m[idx as usize]);
        let numbers =
            [0.0_f32; 3].into_iter().chain(corners.iter().flat_map(|corner| corner.iter().map(|&x| x as f32)));
        stl.extend(numbers.flat_map(f32::to_le_bytes));
        stl.extend([0; 2]);
    }
    let dae = b"<COLLADA><asset><unit meter='1'/><up_axis>Y_UP</up_axis></asset><geometry id='g'><mesh><source id='p'>\
                <float_array>0 0 0 1 0 0 0 1 0 0 0 1</float_array></source><vertices id='v'><input semantic='POSITION' \
                source='#p'/></vertices><polylist><input semantic='VERTEX' source='#v' offset='0'/><vcount>3 3 3 3</vcount>\
                <p>0 2 1 0 1 3 0 3 2 1 2 3</p></polylist></mesh></geometry><visual_scene id='s'><node><rotate>0 0 1 30</rotate>\
                <instance_geometry url='#g'/></node></visual_scene><scene><instance_visual_scene url='#s'/></scene></COLLADA>"
        .to_vec();
    let json = br#"{"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],"meshes":[{"primitives":[{"attributes":{"POSITION":0},
        "indices":1}]}],"buffers":[{}],"bufferViews":[{"buffer":0},{"buffer":0,"byteOffset":48}],"accessors":[{"bufferView":0,
        "componentType":5126,"count":4},{"bufferView":1,"componentType":5121,"count":12}]}"#;
    let mut binary: Vec<u8> =
        mesh.vertices_m.iter().flat_map(|point| point.iter().flat_map(|x| (*x as f32).to_le_bytes())).collect();
    binary.extend(mesh.triangles.iter().flatten().map(|idx| *idx as u8));
    let part = |kind: &[u8], content: &[u8]| [&(content.len() as u32).to_le_bytes(), kind, content].concat();
    let glb = [&b"glTF\x02\0\0\0\0\0\0\0"[..], &part(b"JSON", json), &part(b"BIN\0", &binary)].concat();
    for (name, original) in [
        ("a.off", std::fs::read(off).expect("read")),
        ("a.obj", obj),
        ("a.ply", ply),
        ("a.stl", stl),
        ("a.dae", dae),
        ("a.glb", glb),
    ] {
        let path = folder.path().join(name);
        check(3000, &original, |bytes| {
            std::fs::write(&path, bytes).expect("written");
            read_mesh(&path, 1.0).is_ok()
        });
    }
}

#[test]
fn models() {
    // The checksum refuses most damage.
    let original = text(&project("recordings/paper-recipe.json"));
    check(300, original.as_bytes(), |bytes| Model::parse(&text(bytes)).is_ok());
}

#[test]
fn texts_of_people_and_processes() {
    let flow = project("dataflow-machines.yaml");
    check(5000, &flow, |bytes| dataflow::parse(Path::new("/flow.yaml"), bytes).is_ok());
    let frame = br#"{"joints":[0.5],"cells_newtons":[0,1],"phase":"open","grasp_id":1,"seq":12,"stamp_nanos":7}"#;
    check(50_000, frame, |bytes| line_protocol::parse(bytes).is_ok());
    let request = br#"{"request":"set","node":"lift_arbiter","param":"votes","value":5}"#;
    check(50_000, request, |bytes| serde_json::from_slice::<Request>(bytes).is_ok());
}
