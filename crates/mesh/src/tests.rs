//! Tests of reading and writing whole and damaged files, and shapes for the other tests.

use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::read::read_mesh;
use crate::{Mesh, MeshError, write_off};

/// A box of 12 triangles that face outwards.
pub(crate) fn block(least: [f64; 3], most: [f64; 3]) -> Mesh {
    let vertices_m = (0..8)
        .map(|idx: usize| Point3::from(std::array::from_fn(|axis| [least, most][idx >> axis & 1][axis])))
        .collect();
    // Corner k is at the upper end of axis i where bit i of k is set.
    let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    Mesh { vertices_m, triangles: faces.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect() }
}

pub(crate) fn inside_out(mut mesh: Mesh) -> Mesh {
    mesh.triangles.iter_mut().for_each(|triangle| triangle.swap(0, 1));
    mesh
}

pub(crate) fn together(meshes: &[Mesh]) -> Mesh {
    let mut all = Mesh::default();
    meshes.iter().for_each(|mesh| all.append(mesh));
    all
}

/// A turn and a shift.
pub(crate) fn random_motion(random: &mut ChaCha8Rng) -> Isometry3<f64> {
    let mut vector = || Vector3::from_fn(|_, _| random.random_range(-1.0..1.0));
    Isometry3::from_parts(Translation3::from(vector()), UnitQuaternion::from_scaled_axis(vector() * 3.0))
}

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Folder {
        Folder(tempfile::tempdir().expect("a folder"))
    }

    fn file(&self, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::write(&path, bytes).expect("written");
        path
    }
}

fn read_text(name: &str, text: impl AsRef<[u8]>) -> Result<Mesh, MeshError> {
    read_mesh(&Folder::new().file(name, text), 1.0)
}

/// What a broken file is told, without the folder that it lies in.
fn error_of(name: &str, text: impl AsRef<[u8]>) -> String {
    let error = read_text(name, text).expect_err(name).to_string();
    let at = error.find(name).unwrap_or_else(|| panic!("no file in: {error}"));
    error[at..].to_string()
}

const TETRAHEDRON: [&str; 2] = ["0 0 0\n1 0 0\n0 1 0\n0 0 1\n", "3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"];

/// A mesh as a file of each format, in text where there is one and binary otherwise, coordinates in `f64` or for STL `f32`.
fn files_of(mesh: &Mesh) -> Vec<(&'static str, Vec<u8>)> {
    let folder = Folder::new();
    let path = folder.0.path().join("a.off");
    write_off(&path, mesh).expect("written");
    let mut obj = String::new();
    let (n_vertices, n_triangles) = (mesh.vertices_m.len(), mesh.triangles.len());
    let mut ply = format!(
        "ply\nformat ascii 1.0\nelement vertex {n_vertices}\nproperty double x\nproperty double y\n\
         property double z\nelement face {n_triangles}\nproperty list uchar uint vertex_indices\nend_header\n"
    );
    let mut binary_ply = ply.replace("ascii", "binary_little_endian").into_bytes();
    for vertex in &mesh.vertices_m {
        obj += &format!("v {} {} {}\n", vertex.x, vertex.y, vertex.z);
        ply += &format!("{} {} {}\n", vertex.x, vertex.y, vertex.z);
        vertex.iter().for_each(|coordinate| binary_ply.extend_from_slice(&coordinate.to_le_bytes()));
    }
    for [a, b, c] in &mesh.triangles {
        obj += &format!("f {} {} {}\n", a + 1, b + 1, c + 1);
        ply += &format!("3 {a} {b} {c}\n");
        binary_ply.push(3);
        [a, b, c].into_iter().for_each(|idx| binary_ply.extend_from_slice(&idx.to_le_bytes()));
    }
    let mut stl = "solid a\n".to_string();
    let mut binary_stl = [vec![b' '; 80], (n_triangles as u32).to_le_bytes().to_vec()].concat();
    for corners in mesh.corners() {
        stl += "facet normal 0 0 0\nouter loop\n";
        binary_stl.extend_from_slice(&[0; 12]);
        for corner in corners {
            stl += &format!("vertex {} {} {}\n", corner.x, corner.y, corner.z);
            corner.iter().for_each(|value| binary_stl.extend_from_slice(&(*value as f32).to_le_bytes()));
        }
        stl += "endloop\nendfacet\n";
        binary_stl.extend_from_slice(&[0; 2]);
    }
    stl += "endsolid a\n";
    vec![
        ("a.off", std::fs::read(&path).expect("readable")),
        ("a.OBJ", obj.into_bytes()),
        ("a.ply", ply.into_bytes()),
        ("b.ply", binary_ply),
        ("a.Stl", stl.into_bytes()),
        ("a.dae", dae_of(mesh)),
        ("a.glb", glb_of(mesh)),
        ("b.stl", binary_stl),
    ]
}

fn words(numbers: impl Iterator<Item = impl ToString>) -> String {
    numbers.map(|number| number.to_string()).collect::<Vec<_>>().join(" ")
}

/// A COLLADA file with normals between the indices.
fn dae_of(mesh: &Mesh) -> Vec<u8> {
    let positions = words(mesh.vertices_m.iter().flat_map(|vertex| vertex.iter()));
    let idxs = words(mesh.triangles.iter().flatten().flat_map(|idx| [*idx, 0]));
    format!(
        "<?xml version='1.0'?>\n<COLLADA xmlns='http://www.collada.org/2005/11/COLLADASchema' version='1.4.1'>\
         <asset><unit meter='1'/><up_axis>Z_UP</up_axis></asset><library_geometries><geometry id='g'><mesh>\
         <source id='p'><float_array id='pa' count='1'>{positions}</float_array></source>\
         <source id='n'><float_array id='na' count='3'>0 0 1</float_array></source>\
         <vertices id='v'><input semantic='POSITION' source='#p'/></vertices>\
         <triangles count='1'><input semantic='VERTEX' source='#v' offset='0'/>\
         <input semantic='NORMAL' source='#n' offset='1'/><p>{idxs}</p></triangles></mesh></geometry></library_geometries>\
         <library_visual_scenes><visual_scene id='s'><node><instance_geometry url='#g'/></node></visual_scene>\
         </library_visual_scenes><scene><instance_visual_scene url='#s'/></scene></COLLADA>"
    )
    .into_bytes()
}

fn glb_of(mesh: &Mesh) -> Vec<u8> {
    let (n_vertices, n_triangles) = (mesh.vertices_m.len(), mesh.triangles.len());
    let positions = mesh.vertices_m.iter().flat_map(|vertex| vertex.iter().map(|value| *value as f32));
    let mut binary: Vec<u8> = positions.flat_map(f32::to_le_bytes).collect();
    mesh.triangles.iter().flatten().for_each(|idx| binary.extend((*idx as u16).to_le_bytes()));
    let idxs_at = 12 * n_vertices;
    binary.resize(binary.len().next_multiple_of(4), 0);
    let json = format!(
        "{{\"scene\": 0, \"scenes\": [{{\"nodes\": [0]}}], \"nodes\": [{{\"children\": [1]}}, {{\"mesh\": 0}}], \
         \"meshes\": [{{\"primitives\": [{{\"attributes\": {{\"POSITION\": 0}}, \"indices\": 1}}]}}], \
         \"buffers\": [{{\"byteLength\": {}}}], \"bufferViews\": [{{\"buffer\": 0}}, {{\"buffer\": 0, \"byteOffset\": \
         {idxs_at}}}], \"accessors\": [{{\"bufferView\": 0, \"componentType\": 5126, \"count\": {n_vertices}}}, \
         {{\"bufferView\": 1, \"componentType\": 5123, \"count\": {}}}]}}",
        binary.len(),
        3 * n_triangles
    );
    let json = format!("{json:width$}", width = json.len().next_multiple_of(4)).into_bytes();
    let part = |kind: &[u8; 4], content: &[u8]| [&(content.len() as u32).to_le_bytes()[..], kind, content].concat();
    let parts = [part(b"JSON", &json), part(b"BIN\0", &binary)].concat();
    [b"glTF", &2_u32.to_le_bytes()[..], &(parts.len() as u32 + 12).to_le_bytes(), &parts].concat()
}

#[test]
fn a_scene_places_its_meshes() {
    let cube = block([0.0; 3], [1.0, 2.0, 3.0]);
    let bounds = |mesh: &Mesh| {
        let of = |axis: usize, pick: fn(f64, f64) -> f64, from: f64| {
            let value = mesh.vertices_m.iter().map(|vertex| vertex[axis]).fold(from, pick);
            (value * 1e6).round() / 1e6
        };
        [0, 1, 2].map(|axis| [of(axis, f64::min, f64::INFINITY), of(axis, f64::max, f64::NEG_INFINITY)])
    };
    let dae = String::from_utf8(dae_of(&cube)).expect("text");
    let instance = "<instance_geometry url='#g'/>";
    let polylist = "<polylist count='1'><input semantic='VERTEX' source='#v' offset='0'/><vcount>4 2 4</vcount>\
                    <p>0 2 3 1 0 1 4 5 7 6</p></polylist>";
    let triangles = &dae[dae.find("<triangles").expect("some")..dae.find("</mesh>").expect("an end")];
    for (from, to, expected) in [
        ("", "", [[0.0, 1.0], [0.0, 2.0], [0.0, 3.0]]),
        ("meter='1'", "name='millimeter' meter='0.001'", [[0.0, 0.001], [0.0, 0.002], [0.0, 0.003]]),
        ("Z_UP", "Y_UP", [[0.0, 1.0], [0.0, 2.0], [0.0, 3.0]]),
        (
            instance,
            "<translate>1 0 0</translate><rotate>0 0 1 90</rotate><scale>2 1 1</scale><node>\
                    <matrix>1 0 0 0 0 1 0 0 0 0 1 5 0 0 0 1</matrix><instance_geometry url='#g'/></node>",
            [[-1.0, 1.0], [0.0, 2.0], [5.0, 8.0]],
        ),
        (triangles, polylist, [[0.0, 1.0], [0.0, 2.0], [0.0, 3.0]]),
        ("<instance_visual_scene url='#s'/>", "", [[0.0, 1.0], [0.0, 2.0], [0.0, 3.0]]),
    ] {
        assert!(dae.contains(from), "{from}");
        let read = read_text("a.dae", dae.replacen(from, to, 1)).unwrap_or_else(|error| panic!("{to}: {error}"));
        assert_eq!(bounds(&read), expected, "{to}");
    }
    for (name, text, expected) in [
        ("a.dae", dae.replacen("'#g'", "'#h'", 1), "expected the id of an element of the file, found \"#h\""),
        ("a.dae", dae.replacen("meter='1'", "meter='0'", 1), "<unit meter> of more than 0"),
        ("a.dae", dae.replacen(instance, "", 1), "no triangles"),
        ("a.dae", dae[..300].to_owned(), "cut off"),
        ("a.dae", "<svg/>".to_owned(), "expected XML with one <COLLADA>, found <svg>"),
        ("a.glb", "gltf".to_owned(), "a binary glTF file of version 2"),
        ("a.obj", "version https://git-lfs.github.com/spec/v1\n".to_owned(), "git lfs pull"),
    ] {
        let error = error_of(name, &text);
        assert!(error.contains(expected), "{error}");
    }
    let offset = format!("offset='{}'", usize::MAX);
    assert!(error_of("a.dae", dae.replacen("offset='1'", &offset, 1)).contains("an offset below 256"));
    let many = dae.replacen(instance, &instance.repeat(20_000), 1);
    assert!(error_of("a.dae", many).contains("at most 10,000 nodes"), "a mesh as often as it likes");
    let own = dae.replacen(instance, "<instance_node url='#n'/>", 1).replacen("<node>", "<node id='n'>", 1);
    assert!(error_of("a.dae", own).contains("at most 10,000 nodes and surfaces"), "a node in itself");
}

#[test]
fn every_format_is_read_without_loss() {
    let mut mesh = block([-0.1, 0.1 / 3.0, 0.0], [0.2, 0.3, 1e-7]);
    mesh.transform(&random_motion(&mut ChaCha8Rng::seed_from_u64(1)));
    for (name, bytes) in files_of(&mesh) {
        let read = read_text(name, bytes).expect(name);
        assert_eq!((read.vertices_m.len(), read.triangles.len()), (8, 12), "{name}: equal corners are merged");
        for (read, written) in read.corners().flatten().zip(mesh.corners().flatten()) {
            match name {
                "b.stl" | "a.glb" => assert_eq!(read.map(|x| x as f32), written.map(|x| x as f32)),
                _ => assert_eq!(read, written, "{name}"),
            }
        }
    }
}

#[test]
fn scale_multiplies() {
    let path = Folder::new();
    let path = path.file("a.off", format!("OFF\n4 4 6\n{}{}", TETRAHEDRON[0], TETRAHEDRON[1]));
    let mesh = read_mesh(&path, 0.001).expect("a tetrahedron");
    assert!((mesh.signed_volume_m3() - 1e-9 / 6.0).abs() < 1e-24);
    for scale in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(read_mesh(&path, scale), Err(MeshError::Scale { .. })));
    }
}

#[test]
fn off_as_it_is_found() {
    let [vertices, faces] = TETRAHEDRON;
    let whole = read_text("a.off", format!("OFF\n4 4 6\n{vertices}{faces}")).expect("a tetrahedron");
    assert!((whole.signed_volume_m3() - 1.0 / 6.0).abs() < 1e-15);
    let variants = [
        format!("OFF4 4 6\n{vertices}{faces}"),
        format!("OFF 4 4\r\n{}{faces}", vertices.replace('\n', "\r\n")),
        format!("\u{feff}# a comment\n\nOFF # more\n# 1 2 3\n4 4 6\n\n{vertices}# half\n{faces}\n\n# end"),
        format!("COFF\n4 4 6\n{}{}", vertices.replace('\n', " 255 0 0 255\n"), faces.replace('\n', " 0.5 0.5 0.5\n")),
        format!("NOFF\n4 4 6\n{}{faces}", vertices.replace('\n', " 0 0 1\n")),
        format!("OFF\n4 5 6\n{vertices}{faces}2 0 1\n"),
    ];
    for text in variants {
        assert_eq!(read_text("a.off", &text).expect(&text), whole, "{text}");
    }
    let fan = read_text("a.off", "OFF\n5 1 0\n0 0 0\n1 0 0\n2 1 0\n1 2 0\n0 1 0\n5 0 1 2 3 4").expect("a pentagon");
    assert_eq!(fan.triangles, [[0, 1, 2], [0, 2, 3], [0, 3, 4]]);
}

#[test]
fn obj_as_it_is_found() {
    let text = "# made by hand\nmtllib a.mtl\no thing\nv 0 0 0\nv 1 0 0 1.0\nv 1 1 0 0.5 0.5 0.5\nv 0 1 0\nvt 0 0\nvn 0 0 1\n\
                usemtl red\ns off\nl 1 2\nf 1/1/1 2//1 \\\n 3/1 -1\nxyzzy";
    let square = read_text("a.obj", text).expect("a square");
    assert_eq!((square.vertices_m.len(), square.triangles), (4, vec![[0, 1, 2], [0, 2, 3]]));
    let late = read_text("a.obj", "f 1 2 3\nv 0 0 0\nv 1 0 0\nv 0 1 0\n").expect("vertices after their face");
    assert_eq!(late.triangles.len(), 1);
}

#[test]
fn stl_as_it_is_found() {
    let facet = |a: &str, b: &str, c: &str| {
        format!("facet normal nan nan nan\nouter loop\nvertex {a}\nvertex {b}\nvertex {c}\nendloop\nendfacet\n")
    };
    let (a, b, c, d) = ("0 0 0", "1 0 0", "0 1 0", "0 0 -0.0e1");
    let two =
        format!("solid\n{}endsolid\nSOLID two\n{}endsolid two", facet(a, b, c), facet(c, b, "1 1 0").to_uppercase());
    let mesh = read_text("a.stl", two).expect("two solids");
    assert_eq!((mesh.vertices_m.len(), mesh.triangles), (4, vec![[0, 1, 2], [2, 1, 3]]));
    let merged = read_text("a.stl", format!("solid x y\n{}endsolid", facet(a, b, d))).expect("one facet");
    assert_eq!(merged.vertices_m.len(), 2, "minus zero is zero");

    let (_, mut bytes) = files_of(&block([0.0; 3], [1.0; 3])).pop().expect("the binary one");
    bytes[..6].copy_from_slice(b"solid ");
    bytes.push(b'\n');
    assert_eq!(read_text("a.stl", &bytes).expect("a line break at the end").triangles.len(), 12);
    bytes.pop();
    assert_eq!(read_text("a.stl", &bytes).expect("binary, whatever it begins with").triangles.len(), 12);
}

#[test]
fn ply_as_it_is_found() {
    let text = "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 4\nproperty float nx\nproperty float x\nproperty int y\n\
                property double z\nelement face 1\nproperty uchar red\nproperty list uchar int vertex_index\n\
                element edge 1\nproperty int vertex1\nend_header\n\
                9 0 0 0\n9 1 0 0\n9 1.5 1 0\n9 0 1 0\n255 4 0 1 2 3\n7\n";
    let mesh = read_text("a.ply", text).expect("a quad");
    assert_eq!(mesh.vertices_m[2], Point3::new(1.5, 1.0, 0.0));
    assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3]]);
    let mut big_endian = b"ply\nformat binary_big_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
        property float z\nelement face 1\nproperty list uchar short vertex_indices\nend_header\n"
        .to_vec();
    for coordinate in [0.0_f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0] {
        big_endian.extend_from_slice(&coordinate.to_be_bytes());
    }
    big_endian.extend_from_slice(&[3, 0, 0, 0, 1, 0, 2]);
    assert_eq!(read_text("a.ply", big_endian).expect("a triangle").triangles, [[0, 1, 2]]);
}

#[test]
fn broken_files_are_told_where() {
    let [vertices, faces] = TETRAHEDRON;
    let ply = |counts: [&str; 2], rows: &str| {
        format!(
            "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
             element face {}\nproperty list uchar int vertex_indices\nend_header\n{rows}",
            counts[0], counts[1]
        )
    };
    let solid = "solid x\nfacet normal 0 0 1\nouter loop\n";
    let cases: [(&str, String, &str); 32] = [
        ("a.off", String::new(), "a.off: the file is empty"),
        ("a.off", "\n# nothing\n".into(), "a.off:3: expected OFF, found the end of the file"),
        ("a.off", "ply\n".into(), "a.off:1: expected OFF (or COFF, NOFF, STOFF), found \"ply\""),
        ("a.off", "4OFF\n".into(), "a.off:1: expected OFF (or"),
        ("a.off", "OFF BINARY\n".into(), "a.off:1: expected OFF as text"),
        ("a.off", "OFF\n3 x 0\n".into(), "a.off:2: expected the number of faces, found \"x\""),
        ("a.off", "OFF\n-3 1 0\n".into(), "a.off:2: expected the number of vertices, found \"-3\""),
        ("a.off", format!("OFF\n4 0 0\n{vertices}"), "a.off: no triangles: expected a surface, found 4 vertices only"),
        ("a.off", format!("OFF\n4 4 0\n{}", &vertices[..12]), "a.off:5: expected vertex 2 of 4 (line 2 says how many)"),
        ("a.off", format!("OFF\n4 5 0\n{vertices}{faces}"), "a.off:11: expected face 4 of 5 (line 2 says how many)"),
        ("a.off", format!("OFF\n4 3 0\n{vertices}{faces}"), "a.off:10: expected the end after 3 faces (line 2 says"),
        (
            "a.off",
            format!("OFF\n4 1 0\n{vertices}3 0 1 4"),
            "a.off:7: expected the index of a vertex (0 to 3), found 4",
        ),
        (
            "a.off",
            format!("OFF\n4 1 0\n{vertices}3 0 -1 2"),
            "a.off:7: expected the index of a vertex (0 to 3), found -1",
        ),
        (
            "a.off",
            format!("OFF\n4 1 0\n{vertices}4 0 1 2"),
            "a.off:7: expected index 3 of a face of 4 vertices, found the end",
        ),
        (
            "a.off",
            "OFF\n3 1 0\n0 0 0\n0 nan 0\n1 0 0\n3 0 1 2".into(),
            "a.off:4: expected finite coordinates, found (0, NaN, 0)",
        ),
        ("a.off", "OFF\n3 1 0\n0 0 0\n0,5 1 0".into(), "a.off:4: expected a vertex' x coordinate, found \"0,5\""),
        ("a.off", "OFF\n3 1 0\n0 0".into(), "a.off:3: expected a vertex' z coordinate, found the end of the line"),
        (
            "a.obj",
            "v 0 0 0\nv 1 0 0\nv 0 1 0\n\nf 1 2 4".into(),
            "a.obj:5: expected the index of a vertex (1 to 3), found 4",
        ),
        ("a.obj", "v 0 0 0\nf 1 0 1".into(), "a.obj:2: expected the index of a vertex (1 to 1, or -1 to -1), found 0"),
        ("a.obj", "v 0 0 0\nf 1 -2 1".into(), "a.obj:2: expected the index of a vertex"),
        ("a.obj", "v 0 0 0\nf 1 1".into(), "a.obj:2: expected a face of at least 3 vertices, found 2"),
        ("a.obj", "v 0 0 0\nf 1 x/1 1".into(), "a.obj:2: expected a vertex' index, like 7 or 7/2/5, found \"x/1\""),
        ("a.obj", "v 0 0 inf\nf 1 1 1".into(), "a.obj:1: expected finite coordinates"),
        ("a.obj", "no OBJ at all".into(), "a.obj: no triangles"),
        (
            "a.stl",
            "not an STL file".into(),
            "a.stl: expected 'solid' (text) or a binary header of 84 bytes, found 15 bytes",
        ),
        ("a.stl", format!("{solid}vertex 0 0\n"), "a.stl:4: expected a vertex' z coordinate"),
        (
            "a.stl",
            format!("{solid}vertex 0 0 0\nendloop\nendfacet\n"),
            "a.stl:6: expected a face of at least 3 vertices, found 1",
        ),
        ("a.stl", solid.into(), "a.stl:4: expected vertex or endfacet, found the end of the file (is it cut off?)"),
        (
            "a.stl",
            "solid\nvertex 1 2 3\nendsolid".into(),
            "a.stl:2: expected facet or endsolid, found \"vertex 1 2 3\"",
        ),
        ("a.ply", "OFF\n".into(), "a.ply:1: expected a PLY header, found"),
        (
            "a.ply",
            ply(["3", "1"], "0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n"),
            "a.ply:13: expected the index of a vertex (0 to 2), found 3",
        ),
        (
            "a.ply",
            ply(["3", "1"], "0 0 0\n1 0 0\n0 x 0\n3 0 1 2\n"),
            "a.ply:12: expected rows as the header announces them, found",
        ),
    ];
    for (name, text, expected) in cases {
        let error = error_of(name, &text);
        assert!(error.starts_with(expected), "{text}\nexpected {expected}\nfound    {error}");
    }
    let path = Path::new("a.step");
    assert!(matches!(read_mesh(path, 1.0), Err(MeshError::UnknownFormat { .. })));
    assert!(matches!(read_mesh(Path::new("/nowhere/a.off"), 1.0), Err(MeshError::Read { .. })));
    let folder = Folder::new();
    std::fs::create_dir(folder.0.path().join("b.off")).expect("a folder");
    let error = read_mesh(&folder.0.path().join("b.off"), 1.0).expect_err("a folder").to_string();
    assert!(error.ends_with("not a file"), "{error}");
}

#[test]
fn a_file_that_is_too_large_is_refused() {
    let folder = Folder::new();
    let path = folder.file("scan.stl", "");
    // A sparse file, which takes no room on the disk.
    std::fs::File::options().write(true).open(&path).expect("opened").set_len((256 << 20) + 1).expect("long");
    let error = read_mesh(&path, 1.0).expect_err("too large").to_string();
    assert!(error.contains("scan.stl: more than 256 MiB"), "{error}");
}

#[test]
fn a_line_of_obj_goes_on_over_any_number_of_lines() {
    // Each line was copied for every line that continues it: 300,000 took minutes.
    let text = format!("v 0 0 \\\n0\nv 1 0 0\nv 0 1 0\nf 1 2 3{}\n", " \\\n 1 2 3".repeat(300_000));
    let mesh = read_text("long.obj", text).expect("a mesh");
    assert_eq!((mesh.vertices_m.len(), mesh.triangles.len()), (3, 3 * 300_000 + 1));
}

#[test]
fn counts_are_not_believed() {
    let huge = u64::MAX;
    let ply = |encoding: &str, elements: &str| format!("ply\nformat {encoding} 1.0\n{elements}end_header\n");
    let xyz = "property float x\nproperty float y\nproperty float z\n";
    let face = "element face 1\nproperty list uint int vertex_indices\n";
    let mut stl = vec![0; 80];
    stl.extend_from_slice(&u32::MAX.to_le_bytes());
    let mut list = ply("binary_little_endian", &format!("element vertex 0\n{xyz}{face}")).into_bytes();
    list.extend_from_slice(&u32::MAX.to_le_bytes());
    let cases = [
        ("a.off", format!("OFF\n{huge} {huge} 0\n0 0 0\n").into_bytes()),
        ("a.off", format!("OFF\n1 1 0\n0 0 0\n{huge} 0 0 0\n").into_bytes()),
        ("a.off", b"OFF\n99999999999999999999999 1 0\n".to_vec()),
        ("a.obj", format!("v 0 0 0\nf {huge} {} {}", i64::MIN, i64::MAX).into_bytes()),
        ("a.stl", stl),
        ("a.ply", ply("ascii", &format!("element vertex {huge}\n{xyz}{face}")).into_bytes()),
        ("a.ply", ply("binary_little_endian", &format!("element vertex {huge}\n{xyz}{face}")).into_bytes()),
        (
            "a.ply",
            ply("binary_little_endian", &format!("element none {huge}\nelement vertex 1\n{xyz}{face}")).into_bytes(),
        ),
        ("a.ply", list),
    ];
    for (name, bytes) in cases {
        let shown = String::from_utf8_lossy(&bytes).into_owned();
        assert!(read_text(name, &bytes).is_err(), "{shown}");
    }
}

/// A file cut off or changed anywhere is an error or a mesh, and a mesh that is returned is sound.
#[test]
fn damaged_files_do_not_panic() {
    let folder = Folder::new();
    let mut mesh = block([0.0; 3], [1.0, 2.0, 3.0]);
    mesh.triangles.truncate(7);
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let check = |name: &str, bytes: &[u8]| match read_mesh(&folder.file(name, bytes), 1.0) {
        Ok(mesh) => {
            assert!(mesh.triangles.iter().flatten().all(|idx| (*idx as usize) < mesh.vertices_m.len()));
            let (mesh, _) = crate::check::repair(mesh);
            let _ = crate::mass::solid_properties(&mesh);
            true
        }
        Err(error) => {
            assert!(error.to_string().contains(name), "{error}");
            false
        }
    };
    for (name, bytes) in files_of(&mesh) {
        assert!(check(name, &bytes), "{name}");
        let n_read = (0..bytes.len()).filter(|len| check(name, &bytes[..*len])).count();
        // OBJ has no end, the others miss a line break or the last digits of a number at most.
        assert!(name == "a.OBJ" || n_read < 4, "{n_read} beginnings of {name} were read");
        for _ in 0..250 {
            let mut damaged = bytes.clone();
            for _ in 0..random.random_range(1..4) {
                let at = random.random_range(0..damaged.len());
                damaged[at] = if random.random_bool(0.5) {
                    random.random()
                } else {
                    damaged[at] ^ 1 << random.random_range(0..8)
                };
            }
            check(name, &damaged);
        }
    }
}
