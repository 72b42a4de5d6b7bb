//! A contact dictionary over the hand: the paper's Figure 1.

use nalgebra::{Point3, Vector3};
use serde::Serialize;

use super::PictureError;
use super::colour::{force_colour, hex};
use super::grasp::{ObjectSurface, Placed, RecordedGrasp};
use super::raster::Camera;
use super::svg::{Anchor, Svg, px};
use super::view::{Surfaces, draw_view};
use blindgrasp_messages::{Header, Phase, Stamped, TactileFrame};
use blindgrasp_stages::hand::Hand;

/// A word of the dictionary.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DrawnWord {
    /// Its place, metres in the palm frame.
    pub position_m: [f64; 3],
    /// The share of all contacts that are nearest to it, for its size; none = all alike.
    pub share_of_contacts: Option<f64>,
    /// The share of these contacts that are of stable grasps, for its colour; none = grey.
    pub share_stable: Option<f64>,
}

const VIEW: [f64; 2] = [378.0, 400.0];
const MARGIN: f64 = 24.0;
/// Where the views begin.
const TOP: f64 = 52.0;
/// Radius of the word that is used most.
const LARGEST: f64 = 13.0;
/// Even a word that is hardly used can be seen.
const SMALLEST: f64 = 2.5;
const UNUSED: &str = "#868e96";

const STYLE: &str = ".words text{font-family:Inter,'Segoe UI','Helvetica Neue',Helvetica,Arial,sans-serif;fill:#52606d;\
font-size:12px;font-weight:400;font-variant-numeric:tabular-nums}.words text.words-title{font-size:15px;font-weight:650;\
fill:#1f2933}.words text.tiny{font-size:10px;paint-order:stroke;stroke:#ffffff;stroke-opacity:.8;stroke-width:3px}\
.words .axis{stroke:#52606d;stroke-width:1.4;fill:none}.words .word{stroke:#ffffff;stroke-width:1;fill-opacity:.88}\
.words .size{fill:#ced4da;stroke:#868e96}";

/// The words of a dictionary over the hand in a posture, from two sides and from above the palm (SVG).
///
/// # Errors
/// Joint angles that are not the hand's.
pub fn dictionary_svg(hand: &Hand, joints: &[f64], words: &[DrawnWord]) -> Result<String, PictureError> {
    let posture = RecordedGrasp {
        grasp_id: 0,
        frames: vec![Stamped {
            header: Header::default(),
            message: TactileFrame {
                grasp_id: 0,
                phase: Phase::Settled,
                joints: joints.to_vec(),
                cells_newtons: vec![0.0; hand.n_cells()],
                ..TactileFrame::default()
            },
        }],
        truth: None,
        scene: None,
        object: ObjectSurface::Unknown(String::new()),
        prediction: None,
        decision: None,
        is_hand_alone: false,
    };
    let placed = Placed::new(hand, &posture)?;
    let surfaces = Surfaces::new(&placed);
    let mut points = surfaces.points(hand);
    points.extend(words.iter().map(|word| Point3::from(word.position_m)));
    let scales = Scales::of(words);
    let mut svg = Svg::default();
    svg.start("g", &[("class", &"words")]);
    let title = format!("The {} words of the contact dictionary over the hand", words.len());
    svg.text([MARGIN, 32.0], Anchor::Start, "words-title", &title);
    let views = [
        (Vector3::new(0.25, -1.0, 0.3), Vector3::z()),
        (Vector3::new(1.0, -0.25, 0.3), Vector3::z()),
        (Vector3::new(0.0, 0.0, 1.0), Vector3::y()),
    ];
    for (idx, (to_eye, up)) in views.into_iter().enumerate() {
        let camera = Camera::new(Point3::origin(), to_eye, up, VIEW).fit(&points, 20.0);
        let left = MARGIN + idx as f64 * (VIEW[0] + 8.0);
        draw_view(&mut svg, &placed, &surfaces, &camera, [left, TOP], VIEW)?;
        let transform = format!("translate({} {})", px(left), px(TOP));
        svg.start("g", &[("transform", &transform)]);
        draw_words(&mut svg, &camera, words, &scales);
        svg.end("g");
    }
    let width = 2.0 * MARGIN + 3.0 * VIEW[0] + 16.0;
    let below = TOP + VIEW[1] + 26.0;
    draw_legend(&mut svg, &scales, below);
    svg.end("g");
    Ok(svg.finish(width, below + 26.0, &title, STYLE))
}

/// How shares become sizes and colours.
struct Scales {
    most_used: f64,
    stable: [f64; 2],
}

impl Scales {
    fn of(words: &[DrawnWord]) -> Self {
        let most_used = words.iter().filter_map(|word| word.share_of_contacts).fold(0.0, f64::max);
        let stable = words.iter().filter_map(|word| word.share_stable);
        let [least, most] = stable.fold([f64::MAX, f64::MIN], |[a, b], share| [a.min(share), b.max(share)]);
        Scales { most_used, stable: [least, most] }
    }

    /// Areas are as the shares.
    fn radius(&self, share: Option<f64>) -> f64 {
        match share {
            Some(share) if self.most_used > 0.0 => (LARGEST * (share / self.most_used).sqrt()).max(SMALLEST),
            _ => LARGEST / 2.0,
        }
    }

    fn colour(&self, share: Option<f64>) -> String {
        let [least, most] = self.stable;
        share.map_or(UNUSED.into(), |share| hex(force_colour((share - least) / (most - least).max(1e-9))))
    }
}

/// The far ones first.
fn draw_words(svg: &mut Svg, camera: &Camera, words: &[DrawnWord], scales: &Scales) {
    let mut seen: Vec<_> = words.iter().map(|word| (camera.project(&Point3::from(word.position_m)), word)).collect();
    seen.sort_by(|(left, _), (right, _)| left.nearness.total_cmp(&right.nearness));
    for (at, word) in seen {
        let radius = px(scales.radius(word.share_of_contacts));
        let colour = scales.colour(word.share_stable);
        svg.element(
            "circle",
            &[("cx", &px(at.x)), ("cy", &px(at.y)), ("r", &radius), ("class", &"word"), ("fill", &colour)],
        );
    }
}

fn draw_legend(svg: &mut Svg, scales: &Scales, y: f64) {
    let percent = |share: f64| format!("{:.1} %", 100.0 * share);
    let mut x = MARGIN;
    let [least, most] = scales.stable;
    if least <= most {
        svg.text([x, y + 4.0], Anchor::Start, "", "stable grasps among those that use the word:");
        x += 268.0;
        svg.text([x, y + 4.0], Anchor::Start, "", &percent(least));
        x += 48.0;
        for step in 0..40 {
            let fill = hex(force_colour((f64::from(step) + 0.5) / 40.0));
            let left = px(x + 3.0 * f64::from(step));
            svg.element(
                "rect",
                &[("x", &left), ("y", &px(y - 6.0)), ("width", &3.2), ("height", &12), ("fill", &fill)],
            );
        }
        x += 128.0;
        svg.text([x, y + 4.0], Anchor::Start, "", &percent(most));
        x += 90.0;
    }
    if scales.most_used > 0.0 {
        svg.text([x, y + 4.0], Anchor::Start, "", "share of the contacts:");
        x += 140.0;
        for part in [0.1, 0.5, 1.0] {
            let share = part * scales.most_used;
            let radius = scales.radius(Some(share));
            svg.element("circle", &[("cx", &px(x + radius)), ("cy", &px(y)), ("r", &px(radius)), ("class", &"size")]);
            x += 2.0 * radius + 6.0;
            svg.text([x, y + 4.0], Anchor::Start, "", &percent(share));
            x += 58.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn every_word_is_in_every_view() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let joints: Vec<f64> = hand.joints.iter().map(|joint| (joint.lower + joint.upper) / 4.0).collect();
        let word = |x: f64, share_stable| DrawnWord {
            position_m: [x, 0.0, 0.05],
            share_of_contacts: Some(0.5 - x),
            share_stable,
        };
        let words = [word(0.0, Some(0.4)), word(0.1, Some(0.6)), word(-0.1, None)];
        let svg = dictionary_svg(&hand, &joints, &words).expect("a picture");
        assert_eq!(svg.matches("class=\"word\"").count(), 9);
        assert_eq!(svg.matches("<image").count(), 3);
        for expected in ["The 3 words", "40.0 %", "60.0 %", UNUSED, "50 mm"] {
            assert!(svg.contains(expected), "{expected}");
        }
        assert!(dictionary_svg(&hand, &joints[1..], &words).is_err());
        let all_alike = words.map(|word| DrawnWord { share_of_contacts: None, share_stable: None, ..word });
        assert!(!dictionary_svg(&hand, &joints, &all_alike).expect("a picture").contains("share of the contacts"));
    }
}
