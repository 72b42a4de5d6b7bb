//! Pictures of simulated grasps.

use std::path::Path;

use super::*;
use crate::grasp::objects::select;
use crate::grasp::simulator::{SimulatorOptions, simulate};
use crate::hand::Hand;
use crate::message::{GraspScene, Header, SceneContact, Stamped};

/// A grasp of a built-in object, with a scene made of what the simulator knows.
pub(super) fn simulated(objects: &str, seed: u64) -> (Hand, RecordedGrasp) {
    let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
    let objects = select(objects).expect("built in");
    let options = SimulatorOptions { n_grasps: 1, seed, stable_fraction: Some(1.0), ..SimulatorOptions::default() };
    let mut found = None;
    simulate(&hand, &objects, &options, |_, _| {}, |grasp| {
        found = Some(grasp);
        Ok::<(), ()>(())
    })
    .expect("a grasp");
    let grasp = found.expect("a grasp");
    let object = &objects[grasp.object_idx];
    let contacts = grasp
        .contacts
        .iter()
        .map(|contact| SceneContact {
            link: contact.point.link_idx as u32,
            other_link: -1,
            point_m: contact.point.point_in_palm_m.into(),
            inward_normal: (-contact.point.object_normal_in_palm.into_inner()).into(),
            tangent: contact.first_tangent.into_inner().into(),
            force_newtons: options.soft_finger.normal_force_newtons
                / grasp.contacts.iter().filter(|other| other.point.link_idx == contact.point.link_idx).count() as f64,
            felt_newtons: contact.cells_newtons.iter().map(|(_, newtons)| newtons).sum(),
            torsion_m: contact.patch.torsion_m(),
        })
        .collect();
    let scene = GraspScene {
        grasp_id: grasp.truth.grasp_id,
        candidate: grasp.candidate,
        object_position_m: grasp.palm_from_object.translation.vector.into(),
        object_rotation_xyzw: grasp.palm_from_object.rotation.coords.into(),
        centre_of_mass_m: (grasp.palm_from_object * object.centre_of_mass_m).into(),
        max_radius_m: object.max_radius_m,
        mass_kg: object.mass_kg,
        friction: options.friction,
        joints_rad: grasp.joints_rad.clone(),
        self_collision: false,
        contacts,
    };
    let frames = grasp
        .frames
        .into_iter()
        .map(|timed| Stamped {
            header: Header { stamp_nanos: timed.offset_nanos, ..Header::default() },
            message: timed.frame,
        })
        .collect();
    let object = ObjectSurface::Known(mesh_of_shape(&object.shape).expect("a surface"));
    let recorded = RecordedGrasp {
        grasp_id: grasp.truth.grasp_id,
        frames,
        truth: Some(grasp.truth),
        scene: Some(scene),
        object,
        prediction: None,
        decision: None,
    };
    (hand, recorded)
}

#[test]
fn try_out() {
    for (objects, seed) in [("can", 1), ("box", 2), ("cup", 3), ("ball", 5)] {
        let (hand, mut grasp) = simulated(objects, seed);
        std::fs::write(format!("/tmp/picture/{objects}.svg"), grasp_svg(&hand, &grasp).expect("a picture")).expect("written");
        grasp.scene = None;
        std::fs::write(format!("/tmp/picture/{objects}-no-scene.svg"), grasp_svg(&hand, &grasp).expect("a picture")).expect("written");
    }
}
