use std::collections::{BTreeSet, HashMap};
use std::sync::LazyLock;

use nalgebra::Vector3;

use super::*;
use parry3d_f64::shape::TypedShape;

/// Built once: that takes longer than most tests.
static CATALOGUE: LazyLock<Vec<(Object, Mesh)>> = LazyLock::new(all);

fn all() -> Vec<(Object, Mesh)> {
    let objects = select("all").expect("the catalogue builds");
    objects.into_iter().map(|object| (object.to_mesh(), object)).map(|(mesh, object)| (object, mesh)).collect()
}

/// Triangles of each part that hangs together by its corners.
fn components(mesh: &Mesh) -> Vec<Mesh> {
    let mut root: Vec<u32> = (0..mesh.vertices_m.len() as u32).collect();
    fn find(root: &mut [u32], mut idx: u32) -> u32 {
        while root[idx as usize] != idx {
            root[idx as usize] = root[root[idx as usize] as usize];
            idx = root[idx as usize];
        }
        idx
    }
    for [a, b, c] in &mesh.triangles {
        for other in [b, c] {
            let (one, other) = (find(&mut root, *a), find(&mut root, *other));
            root[one as usize] = other;
        }
    }
    let mut parts: Vec<(u32, Mesh)> = Vec::new();
    for triangle in &mesh.triangles {
        let own = find(&mut root, triangle[0]);
        let place = parts.iter().position(|(root, _)| *root == own).unwrap_or_else(|| {
            parts.push((own, Mesh { vertices_m: mesh.vertices_m.clone(), triangles: Vec::new() }));
            parts.len() - 1
        });
        parts[place].1.triangles.push(*triangle);
    }
    parts.into_iter().map(|(_, part)| part).collect()
}

/// Signed crossings of a ray with a mesh: outwards counts one, inwards minus one.
fn crossings(mesh: &Mesh, from: Point3<f64>, direction: Vector3<f64>) -> Vec<(f64, i32)> {
    let mut found = Vec::new();
    for [a, b, c] in mesh.corners() {
        let (edge1, edge2) = (b - a, c - a);
        let p = direction.cross(&edge2);
        let determinant = edge1.dot(&p);
        let s = from - a;
        let q = s.cross(&edge1);
        let (u, v, t) = (s.dot(&p) / determinant, direction.dot(&q) / determinant, edge2.dot(&q) / determinant);
        if determinant.abs() > 1e-18 && u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0 {
            found.push((t, if determinant < 0.0 { -1 } else { 1 }));
        }
    }
    found
}

/// Neither inside a wall nor nearer to the surface than `radius_m`.
fn ball_fits(mesh: &Mesh, centre: Point3<f64>, radius_m: f64) -> bool {
    let query = Vector::new(centre.x, centre.y, centre.z);
    let corners = mesh.vertices_m.iter().map(|corner| Vector::new(corner.x, corner.y, corner.z)).collect();
    let shape = SharedShape::trimesh(corners, mesh.triangles.clone()).expect("a mesh");
    let off_axis = Vector3::new(0.123, 0.0456, 0.99).normalize();
    let winding: i32 = crossings(mesh, centre, off_axis).iter().map(|(_, sign)| sign).sum();
    winding == 0 && shape.distance_to_local_point(query, false) >= radius_m
}

#[test]
fn the_catalogue_is_complete_and_a_third_is_held_out() {
    let specs: Vec<ObjectSpec> = catalogue_specs().collect();
    assert_eq!(specs.len(), 720);
    for class in &CLASSES {
        let own: Vec<_> = specs.iter().filter(|spec| spec.class() == class.name).collect();
        assert_eq!(own.len(), 30);
        assert_eq!(own.iter().filter(|spec| spec.held_out()).count(), 10, "{}", class.name);
        // Every three in a row are of one kind, one of them held out.
        assert!(own.iter().enumerate().all(|(idx, spec)| spec.held_out() == (idx % 3 == 2)), "{}", class.name);
    }
}

#[test]
fn sizes_and_masses_are_of_everyday_things_and_all_differ() {
    for class in CATALOGUE.chunks(N_PER_CLASS) {
        let mut sizes_mm: Vec<[f64; 3]> = Vec::new();
        for (object, mesh) in class {
            let [least, most] = mesh.bounds();
            let size_mm = (most - least) * 1000.0;
            assert!((30.0..400.0).contains(&size_mm.max()), "{object:?}: {size_mm:?}");
            assert!((0.005..3.0).contains(&object.mass_kg), "{object:?}: {} kg", object.mass_kg);
            let in_box = (0..3).all(|axis| (least[axis]..most[axis]).contains(&object.centre_of_mass_m[axis]));
            assert!(in_box, "{object:?}: {}", object.centre_of_mass_m);
            let size_mm: [f64; 3] = size_mm.into();
            let same = sizes_mm.iter().any(|other| (0..3).all(|axis| (other[axis] - size_mm[axis]).abs() < 0.05));
            assert!(!same, "{object:?} is as large as another of its class: {size_mm:?}");
            sizes_mm.push(size_mm);
        }
    }
}

#[test]
fn objects_stand_on_the_ground_or_have_their_centre_at_the_origin() {
    let mut odd = Vec::new();
    for (object, mesh) in CATALOGUE.iter() {
        let [least, most] = mesh.bounds();
        let centred = (least + most.coords).coords.norm() < 1e-9;
        let exact = !matches!(object.shape.as_typed_shape(), TypedShape::TriMesh(_));
        if !(if exact { centred } else { least.z == 0.0 }) {
            odd.push(format!("{object:?}: {least}"));
        }
    }
    assert!(odd.is_empty(), "{odd:#?}");
}

#[test]
fn surfaces_are_closed_and_face_outwards() {
    let mut large = Vec::new();
    for (object, mesh) in CATALOGUE.iter() {
        if matches!(object.shape.as_typed_shape(), TypedShape::TriMesh(_)) && mesh.triangles.len() > 6000 {
            large.push(format!("{object:?}: {} triangles", mesh.triangles.len()));
        }
        let (_, survey) = blindgrasp_mesh::check::repair(mesh.clone());
        assert!(survey.is_closed() && survey.warnings().is_empty(), "{object:?}: {survey:?}");
        for [a, b, c] in mesh.corners() {
            let area_mm2 = (b - a).cross(&(c - a)).norm() / 2.0 * 1e6;
            let longest_mm =
                [(a, b), (b, c), (c, a)].map(|(p, q)| (q - p).norm()).into_iter().fold(0.0, f64::max) * 1e3;
            // No thinner than a micrometre.
            assert!(area_mm2 > 1e-3 * longest_mm / 2.0, "{object:?}: {area_mm2} mm² at {a}");
        }
        for part in components(mesh) {
            assert!(part.signed_volume_m3() > 1e-10, "{object:?}: {} m³", part.signed_volume_m3());
        }
    }
    assert!(large.is_empty(), "{large:#?}");
}

/// Two triangles of a curved surface that meet at a small angle θ stand for an arc. With heights h over their common
/// edge it bends by θ over h, and its sagitta over either triangle is about θh/8.
#[test]
fn triangles_follow_curved_surfaces() {
    let mut odd = Vec::new();
    for (object, mesh) in CATALOGUE.iter() {
        let (mut worst_m, mut place) = (0.0, Point3::origin());
        let top_m = mesh.bounds()[1].z;
        let mut apex: HashMap<(u32, u32), usize> = HashMap::new();
        for (triangle_idx, &[a, b, c]) in mesh.triangles.iter().enumerate() {
            for edge in [(a, b), (b, c), (c, a)] {
                apex.insert(edge, triangle_idx);
            }
        }
        for (&(a, b), &one) in &apex {
            let other = apex[&(b, a)];
            let angle_rad = mesh.normal(one).angle(&mesh.normal(other));
            let length_m = (mesh.vertices_m[b as usize] - mesh.vertices_m[a as usize]).norm();
            let height_m = |triangle_idx: usize| {
                let [a, b, c] = mesh.triangles[triangle_idx].map(|idx| mesh.vertices_m[idx as usize]);
                (b - a).cross(&(c - a)).norm() / length_m
            };
            let sagitta_m = angle_rad * height_m(one).min(height_m(other)) / 8.0;
            // Deep inside a vessel and inside a lampshade triangles are coarser.
            let corner = mesh.vertices_m[a as usize];
            let inside = [one, other].iter().any(|idx| mesh.normal(*idx).xy().dot(&corner.coords.xy()) < 0.0);
            let hidden = match object.class.as_str() {
                "mug" | "cup" | "bowl" | "vase" | "teapot" | "jar" => corner.z < top_m - 0.024,
                "lamp" => true,
                _ => false,
            };
            if inside && hidden {
                continue;
            }
            // Sharper ones are edges of the thing itself.
            if angle_rad < 0.45 && sagitta_m > worst_m {
                worst_m = sagitta_m;
                place = mesh.vertices_m[a as usize] * 1e3;
            }
        }
        if worst_m > 0.2e-3 {
            odd.push(format!("{object:?}: {:.3} mm at {place}", worst_m * 1e3));
        }
    }
    assert!(odd.is_empty(), "{odd:#?}");
}

#[test]
fn vessels_are_hollow_and_what_is_joined_to_them_stays_out_of_the_hollow() {
    for (object, mesh) in CATALOGUE.iter() {
        let vessel = matches!(object.class.as_str(), "mug" | "cup" | "bowl" | "vase");
        let jug = object.class == "teapot" && object.name[7..].parse::<usize>().expect("a number") / 3 % 3 == 2;
        if !vessel && !jug {
            continue;
        }
        let parts = components(mesh);
        // The wall is the one with a floor, under a plumb line.
        let plumb = |part: &&Mesh| !crossings(part, Point3::new(1e-4, 2e-4, 1.0), -Vector3::z()).is_empty();
        let wall =
            parts.iter().filter(plumb).max_by(|a, b| a.bounds()[1].z.total_cmp(&b.bounds()[1].z)).expect("a floor");
        let [least, most] = wall.bounds();
        let middle = Point3::new(1e-4, 2e-4, most.z - 0.35 * (most.z - least.z));
        let above = crossings(mesh, middle, Vector3::z());
        assert!(above.is_empty(), "{object:?} is closed above");
        let winding: i32 = crossings(mesh, middle, Vector3::new(0.9, 0.1, 0.05)).iter().map(|(_, sign)| sign).sum();
        assert_eq!(winding, 0, "{object:?} is not hollow");
        let points: Vec<_> = mesh.vertices_m.iter().map(|corner| Vector::new(corner.x, corner.y, corner.z)).collect();
        let hull = SharedShape::convex_hull(&points).expect("a hull");
        let share = mesh.signed_volume_m3() / hull.mass_properties(1.0).mass();
        assert!(share < 0.55, "{object:?}: {share} of its hull is solid");
        for part in &parts {
            if std::ptr::eq(part, wall) {
                continue;
            }
            for idx in part.triangles.iter().flatten().copied().collect::<BTreeSet<u32>>() {
                let corner = part.vertices_m[idx as usize];
                // Outwards there is at most one way out of the wall; from the hollow there is also one in.
                // A little beside the corner, so as not to meet an edge.
                let from = corner + Vector3::new(1.1e-6, 2.3e-6, 1.7e-6);
                let n = crossings(wall, from, Vector3::new(from.x, from.y, 0.0).normalize()).len();
                assert!(n <= 1, "{object:?}: a part reaches the hollow at {corner}");
            }
        }
    }
}

#[test]
fn a_finger_goes_through_a_mugs_handle() {
    let mugs = select("mug").expect("mugs");
    let n_wide = mugs
        .iter()
        .filter(|mug| {
            let mesh = mug.to_mesh();
            let [_, most] = mesh.bounds();
            // Between wall and handle, at half the height: the middle of the gap that a ray from outside crosses.
            let from = Point3::new(most.x + 0.01, 1e-5, 0.52 * most.z);
            let mut hits: Vec<f64> = crossings(&mesh, from, -Vector3::x()).iter().map(|(t, _)| *t).collect();
            hits.sort_by(f64::total_cmp);
            // Into the handle, out of it, into the wall.
            let centre = from - Vector3::x() * ((hits[1] + hits[2]) / 2.0);
            (-3..=3).all(|step| ball_fits(&mesh, centre + Vector3::y() * (f64::from(step) * 0.01), 0.010))
        })
        .count();
    assert!(n_wide >= 25, "{n_wide} of {}", mugs.len());
}

#[test]
fn the_same_catalogue_twice() {
    for (one, other) in CATALOGUE.iter().zip(all()) {
        assert_eq!(one.0.name, other.0.name);
        assert_eq!(one.1, other.1, "{}", one.0.name);
        assert_eq!(one.0.mass_kg.to_bits(), other.0.mass_kg.to_bits());
    }
}

#[test]
fn centre_and_radius_by_hand() {
    // A cone's centre of mass is a quarter of its height above its base, parry's origin half of it.
    let cone = Object::new("c".into(), "c".into(), SharedShape::cone(0.05, 0.04), 1.0, false);
    assert!((cone.centre_of_mass_m - Point3::new(0.0, -0.025, 0.0)).norm() < 1e-12);
    assert!((cone.max_radius_m - 0.075).abs() < 1e-9, "to the tip: {}", cone.max_radius_m);
    let block = Object::new("b".into(), "b".into(), SharedShape::cuboid(0.03, 0.04, 0.12), 1000.0, false);
    assert!((block.max_radius_m - 0.13).abs() < 1e-12);
    assert!((block.mass_kg - 8.0 * 0.03 * 0.04 * 0.12 * 1000.0).abs() < 1e-9);
    let mesh = block.to_mesh();
    let solid = solid_properties(&mesh).expect("closed");
    let as_mesh = Object::from_mesh("m".into(), "m".into(), &mesh, &solid, 0.2, true).expect("closed");
    assert!(as_mesh.centre_of_mass_m.coords.norm() < 1e-12);
    assert!((as_mesh.max_radius_m - 0.13).abs() < 1e-12);
    assert_eq!((as_mesh.mass_kg, as_mesh.held_out), (0.2, true));
    assert_eq!(as_mesh.to_mesh(), block.to_mesh());
}

#[test]
fn convex_shapes_become_closed_meshes_of_their_volume() {
    let shapes = [
        (SharedShape::ball(0.03), 4.0 / 3.0 * std::f64::consts::PI * 0.03_f64.powi(3)),
        (SharedShape::cylinder(0.05, 0.03), 0.1 * std::f64::consts::PI * 0.03 * 0.03),
        (SharedShape::cone(0.05, 0.03), 0.1 / 3.0 * std::f64::consts::PI * 0.03 * 0.03),
        (SharedShape::cuboid(0.01, 0.02, 0.03), 8.0 * 0.01 * 0.02 * 0.03),
    ];
    for (shape, volume_m3) in shapes {
        let mesh = Object::new("s".into(), "s".into(), shape, 1.0, false).to_mesh();
        assert!((mesh.signed_volume_m3() / volume_m3 - 1.0).abs() < 0.01, "{}", mesh.signed_volume_m3() / volume_m3);
    }
}

#[test]
fn what_is_no_mesh_is_refused() {
    let block = Object::new("b".into(), "b".into(), SharedShape::cuboid(0.03, 0.04, 0.12), 1000.0, false).to_mesh();
    let solid = solid_properties(&block).expect("closed");
    let refuse = |mesh: &Mesh| {
        Object::from_mesh("odd".into(), "odd".into(), mesh, &solid, 1.0, false).expect_err("no object").to_string()
    };
    assert!(refuse(&Mesh::default()).contains("odd"));
    let triangle = vec![Point3::origin(), Point3::new(0.1, 0.0, 0.0), Point3::new(0.0, 0.1, 0.0)];
    let missing = Mesh { vertices_m: triangle, triangles: vec![[0, 1, 3]] };
    assert!(refuse(&missing).contains("corner 3 of 3"), "{}", refuse(&missing));
}

#[test]
fn selections() {
    let n = |text: &str| select_specs(text).expect("known").len();
    assert_eq!((n("all"), n("builtin"), n("train"), n("held-out")), (720, 720, 480, 240));
    let names: Vec<_> = select("mug, box-07").expect("known").into_iter().map(|object| object.name).collect();
    assert_eq!((names.len(), names[0].as_str(), names[30].as_str()), (31, "box-07", "mug-29"));
    let error = select("bxo-07").expect_err("unknown").to_string();
    assert!(error.contains("did you mean 'box-07'?") && error.contains("bottle"), "{error}");
    assert!(select("").is_err());
}
