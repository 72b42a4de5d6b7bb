//! A hand, a thing and the post on which it stood, moment by moment, all seen by one camera.

use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use parry3d_f64::shape::SharedShape;
use rayon::prelude::*;

use super::PictureError;
use super::colour::{HAND, OBJECT, Rgb, lit};
use super::geometry::link_mesh;
use super::png_image::{Image, data_uri};
use super::raster::{Camera, SAMPLES_PER_SIDE, Samples};
use blindgrasp_mesh::Mesh;
use blindgrasp_mesh::shape::mesh_of_shape;
use blindgrasp_stages::hand::{Hand, JointError};

/// The place of everything at one moment. The post's top is z = 0 of the world.
#[derive(Debug, Clone, PartialEq)]
pub struct PosedScene {
    /// The palm.
    pub world_from_palm: Isometry3<f64>,
    /// The hand's joints.
    pub joints: Vec<f64>,
    /// The thing.
    pub world_from_thing: Isometry3<f64>,
}

const POST: Rgb = [0.902, 0.878, 0.835];
/// So much of the post is drawn, from its top.
const POST_M: f64 = 0.10;
/// Numbers of the surfaces; the hand's links follow.
const POST_SURFACE: u16 = 1;
const THING_SURFACE: u16 = 2;
const MARGIN: f64 = 4.0;
/// Parts that are lower than this below the post's top do not make the picture larger.
const DEEPEST_M: f64 = -0.02;

/// Each scene as an image (an address that holds a PNG) of that many pixels, with a round post of this radius.
///
/// # Errors
/// Joints that are not this hand's.
pub fn posed_scene_images(
    hand: &Hand,
    thing: &Mesh,
    post_radius_m: f64,
    scenes: &[PosedScene],
    size: [usize; 2],
) -> Result<Vec<String>, PictureError> {
    let link_meshes: Vec<Mesh> = hand.links.iter().map(link_mesh).collect();
    let post = post(post_radius_m);
    let placed: Vec<Vec<Mesh>> = scenes
        .iter()
        .map(|scene| surfaces(hand, &link_meshes, &post, thing, scene))
        .collect::<Result<_, _>>()
        .map_err(|source| PictureError::Joints { grasp_id: 0, source })?;
    let corners = placed.iter().flatten().flat_map(|mesh| &mesh.vertices_m);
    let points: Vec<Point3<f64>> = corners.filter(|corner| corner.z > DEEPEST_M).copied().collect();
    let to_eye = Vector3::new(0.55, -0.75, 0.30);
    let [width, height] = size.map(|n| n as f64);
    let camera = Camera::new(Point3::origin(), to_eye, Vector3::z(), [width, height]).fit(&points, MARGIN);
    placed.par_iter().map(|meshes| Ok(data_uri(&image(meshes, &camera, size).to_small_png()?))).collect()
}

/// The top of a post whose axis is z.
fn post(radius_m: f64) -> Mesh {
    let mut mesh = mesh_of_shape(&SharedShape::cylinder(POST_M / 2.0, radius_m));
    // A cylinder's axis is y.
    let upright = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
    mesh.transform(&Isometry3::from_parts([0.0, 0.0, -POST_M / 2.0].into(), upright));
    mesh
}

/// Post, thing and links, as they are numbered, in the world.
fn surfaces(
    hand: &Hand,
    links: &[Mesh],
    post: &Mesh,
    thing: &Mesh,
    scene: &PosedScene,
) -> Result<Vec<Mesh>, JointError> {
    let moved = |mesh: &Mesh, world_from_mesh: &Isometry3<f64>| {
        let mut mesh = mesh.clone();
        mesh.transform(world_from_mesh);
        mesh
    };
    let mut meshes = vec![post.clone(), moved(thing, &scene.world_from_thing)];
    let palm_from_links = hand.palm_from_links(&scene.joints)?;
    meshes.extend(
        links
            .iter()
            .zip(palm_from_links)
            .map(|(link, palm_from_link)| moved(link, &(scene.world_from_palm * palm_from_link))),
    );
    Ok(meshes)
}

fn image(meshes: &[Mesh], camera: &Camera, [width, height]: [usize; 2]) -> Image {
    let [n_x, n_y] = [width, height].map(|n| n * SAMPLES_PER_SIDE);
    let camera = camera.scaled(SAMPLES_PER_SIDE as f64);
    let mut samples = Samples::new(n_x, n_y);
    for (mesh, surface) in meshes.iter().zip(POST_SURFACE..) {
        samples.draw_mesh(&camera, mesh, surface);
    }
    Image::from_samples(width, height, SAMPLES_PER_SIDE, |x, y| {
        let idx = y * n_x + x;
        let colour = match samples.surface[idx] {
            0 => return ([1.0; 3], 0.0),
            POST_SURFACE => POST,
            THING_SURFACE => OBJECT,
            _ => HAND,
        };
        let edge = if samples.is_edge(x, y, 1) { 0.6 } else { 1.0 };
        (lit(colour, f64::from(samples.light[idx])).map(|channel| channel * edge), 1.0)
    })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn scene(hand: &Hand, height_m: f64) -> PosedScene {
        let down = nalgebra::UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        PosedScene {
            world_from_palm: Isometry3::from_parts([0.0, 0.0, 0.2 + height_m].into(), down),
            joints: vec![0.0; hand.joints.len()],
            world_from_thing: Isometry3::translation(0.0, 0.0, height_m),
        }
    }

    #[test]
    fn each_moment_is_a_small_image_of_its_own() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("a hand");
        let thing = mesh_of_shape(&SharedShape::cylinder(0.04, 0.05));
        let scenes = [0.0, 0.0, 0.15].map(|height_m| scene(&hand, height_m));
        let images = posed_scene_images(&hand, &thing, 0.04, &scenes, [120, 150]).expect("images");
        assert_eq!(images.len(), 3);
        assert_eq!(images[0], images[1]);
        assert_ne!(images[0], images[2]);
        assert!(images.iter().all(|image| image.starts_with("data:image/png;base64,") && image.len() < 20_000));
    }

    #[test]
    fn joints_of_another_hand_are_refused() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("a hand");
        let wrong = PosedScene { joints: vec![0.0; 2], ..scene(&hand, 0.0) };
        posed_scene_images(&hand, &Mesh::default(), 0.04, &[wrong], [10, 10]).expect_err("two joints");
    }
}
