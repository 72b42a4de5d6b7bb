//! Frames of a hand as a page draws them: its surfaces once, and its posture and cells frame by frame.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use parry3d_f64::shape::SharedShape;
use serde::Serialize;

use super::PictureError;
use super::colour::{OBJECT, Rgb};
use super::grasp::Placed;
use super::scene::{HandScene, Surface, rounded, rows};
use blindgrasp_mesh::Mesh;
use blindgrasp_mesh::shape::mesh_of_shape;
use blindgrasp_stages::hand::Hand;

const POST: Rgb = [0.902, 0.878, 0.835];
/// So much of the post is drawn, from its top.
const POST_M: f64 = 0.03;

/// The frames, as the page's script draws them.
#[derive(Serialize)]
pub struct DrawnFrames {
    #[serde(flatten)]
    scene: HandScene,
    frames: Vec<DrawnFrame>,
    /// The end of the scale of forces, for all frames.
    scale_newtons: f64,
}

#[derive(Serialize)]
struct DrawnFrame {
    title: String,
    /// The pose of each surface; none where it is not in this frame.
    links: Vec<Option<Vec<f64>>>,
    cells: Vec<Option<f64>>,
}

/// The place of everything at one moment. The top of the post on which the thing stood is z = 0 of the world.
#[derive(Debug, Clone, PartialEq)]
pub struct PosedScene {
    /// Seconds since the first moment of all.
    pub secs: f64,
    /// The palm.
    pub world_from_palm: Isometry3<f64>,
    /// The hand's joints.
    pub joints: Vec<f64>,
    /// The thing.
    pub world_from_thing: Isometry3<f64>,
}

impl DrawnFrames {
    /// The frames of one grasp, at these places.
    pub(super) fn of_grasp(placed: &Placed<'_>, chosen: &[usize]) -> Result<DrawnFrames, PictureError> {
        let scene = HandScene::new(placed.hand);
        let mut drawn = DrawnFrames { scene, frames: Vec::new(), scale_newtons: placed.scale_newtons };
        let all = &placed.grasp.frames;
        for idx in chosen {
            let frame = &all[*idx];
            let since_start_nanos = frame.header.stamp_nanos.saturating_sub(all[0].header.stamp_nanos);
            let title = format!("{}, {:.0} ms", frame.message.phase.as_str(), since_start_nanos as f64 / 1e6);
            let poses = placed.hand.palm_from_links(&frame.message.joints)?;
            let cells = frame.message.cells_newtons.iter();
            drawn.frames.push(DrawnFrame {
                title,
                links: poses.iter().map(|pose| Some(rows(pose))).collect(),
                cells: cells.map(|force| force.is_finite().then(|| rounded(*force))).collect(),
            });
        }
        Ok(drawn)
    }

    /// The moments of each thing, one thing after the other, with a round post of this radius, in the frame of the world.
    ///
    /// # Errors
    /// Joints that are not this hand's.
    pub fn of_scenes(
        hand: &Hand,
        post_radius_m: f64,
        things: &[(&Mesh, &[PosedScene])],
    ) -> Result<DrawnFrames, PictureError> {
        let mut scene = HandScene::new(hand);
        scene.links.push(Surface::coloured(&post(post_radius_m), POST));
        let first_thing = scene.links.len();
        for (mesh, _) in things {
            scene.links.push(Surface::coloured(mesh, OBJECT));
        }
        let n_surfaces = scene.links.len();
        let mut drawn = DrawnFrames { scene, frames: Vec::new(), scale_newtons: 1.0 };
        for (thing_idx, (_, moments)) in things.iter().enumerate() {
            for moment in *moments {
                let mut links = Vec::new();
                for palm_from_link in hand.palm_from_links(&moment.joints)? {
                    links.push(Some(rows(&(moment.world_from_palm * palm_from_link))));
                }
                links.push(Some(rows(&Isometry3::identity())));
                links.resize(n_surfaces, None);
                links[first_thing + thing_idx] = Some(rows(&moment.world_from_thing));
                drawn.frames.push(DrawnFrame {
                    title: format!("After {:.2} s", moment.secs),
                    links,
                    cells: vec![None; hand.n_cells()],
                });
            }
        }
        Ok(drawn)
    }
}

/// The top of a post whose axis is z.
fn post(radius_m: f64) -> Mesh {
    let mut mesh = mesh_of_shape(&SharedShape::cylinder(POST_M / 2.0, radius_m));
    // A cylinder's axis is y.
    let upright = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
    mesh.transform(&Isometry3::from_parts([0.0, 0.0, -POST_M / 2.0].into(), upright));
    mesh
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn moment(hand: &Hand, height_m: f64) -> PosedScene {
        let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        PosedScene {
            secs: height_m,
            world_from_palm: Isometry3::from_parts([0.0, 0.0, 0.2 + height_m].into(), down),
            joints: vec![0.0; hand.joints.len()],
            world_from_thing: Isometry3::translation(0.0, 0.0, height_m),
        }
    }

    #[test]
    fn each_moment_shows_its_own_thing_where_it_is() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("a hand");
        let thing = mesh_of_shape(&SharedShape::cylinder(0.04, 0.05));
        let [low, high] = [0.0, 0.15].map(|height_m| [moment(&hand, height_m)]);
        let drawn = DrawnFrames::of_scenes(&hand, 0.04, &[(&thing, &low), (&thing, &high)]).expect("frames");
        let [first, second] = &drawn.frames[..] else { panic!("expected two frames") };
        let n_links = hand.links.len();
        assert_eq!((drawn.scene.links.len(), first.links.len()), (n_links + 3, n_links + 3));
        assert!(first.links[n_links + 2].is_none() && second.links[n_links + 1].is_none());
        let height = |frame: &DrawnFrame, idx: usize| frame.links[idx].as_ref().expect("a pose")[11];
        assert_eq!((height(first, n_links + 1), height(second, n_links + 2)), (0.0, 0.15));
        assert_eq!((height(first, n_links), height(second, n_links)), (0.0, 0.0), "the post stays");
        assert_eq!(second.title, "After 0.15 s");
        // The palm looks down on the thing.
        assert!((height(second, 0) - height(first, 0) - 0.15).abs() < 1e-9);
    }

    #[test]
    fn joints_of_another_hand_are_refused() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("a hand");
        let wrong = [PosedScene { joints: vec![0.0; 2], ..moment(&hand, 0.0) }];
        assert!(DrawnFrames::of_scenes(&hand, 0.04, &[(&Mesh::default(), &wrong)]).is_err(), "two joints");
    }
}
