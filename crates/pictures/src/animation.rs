//! Grasps as a moving picture: the hand closes, cells feel the object, the probability appears, and the decision comes.

use blindgrasp_messages::Action;
use blindgrasp_stages::hand::Hand;

use super::PictureError;
use super::grasp::{Placed, RecordedGrasp};
use super::grasp_picture::{style, title};
use super::svg::{Anchor, Svg, fit_text, px};
use super::view::{Surfaces, choose_cameras, draw_small_view};

const SIZE: [f64; 2] = [760.0, 316.0];
const VIEW: [f64; 2] = [330.0, 288.0];
const LEFT: f64 = 380.0;
/// The chart's upper left corner, and its size.
const CHART: [f64; 4] = [LEFT, 96.0, 350.0, 110.0];
/// Frames of a grasp; more are thinned out evenly.
const MOST_FRAMES: usize = 24;
const FRAME_SECS: f64 = 0.16;
/// The last frame of a grasp is shown longer.
const LAST_SECS: f64 = 2.6;

/// A grasp with its predictions.
#[derive(Debug)]
pub struct AnimatedGrasp {
    /// Its frames are shown in order, and its decision from `decided_at` on.
    pub grasp: RecordedGrasp,
    /// The probability of stable for each frame, if the frame has one.
    pub probabilities: Vec<Option<f64>>,
    /// The index of the frame at which the decision came.
    pub decided_at: Option<usize>,
    /// The model's threshold of stable.
    pub threshold: f64,
}

/// The grasps one after the other, as an SVG that moves by its style sheet. Where styles do not move, it shows the last frame.
///
/// # Errors
/// As [`grasp_svg`](super::grasp_svg).
pub fn animation_svg(hand: &Hand, grasps: &[AnimatedGrasp]) -> Result<String, PictureError> {
    let mut drawn: Vec<(Svg, f64)> = Vec::new();
    for animated in grasps {
        let whole = Placed::new(hand, &animated.grasp)?;
        let camera = &choose_cameras(&whole, &Surfaces::new(&whole), VIEW)[0];
        let n_frames = animated.grasp.frames.len();
        let step = n_frames.div_ceil(MOST_FRAMES).max(1);
        for idx in (0..n_frames).filter(|idx| (n_frames - 1 - idx) % step == 0) {
            let mut moment = animated.grasp.clone();
            moment.frames = vec![animated.grasp.frames[idx].clone()];
            let frame = &animated.grasp.frames[idx].message;
            // Contacts are those of the closed hand.
            let is_closed = frame.phase == whole.frame.phase;
            if let Some(scene) = moment.scene.as_mut()
                && !is_closed
            {
                scene.joints.clone_from(&frame.joints);
                scene.contacts.clear();
            }
            let mut placed = Placed::new(hand, &moment)?;
            placed.scale_newtons = whole.scale_newtons;
            let mut svg = Svg::default();
            draw_small_view(&mut svg, &placed, &Surfaces::new(&placed), camera, [14.0, 14.0], VIEW)?;
            draw_texts(&mut svg, animated, idx);
            drawn.push((svg, if idx + 1 == n_frames { LAST_SECS } else { FRAME_SECS }));
        }
    }
    let total: f64 = drawn.iter().map(|(_, secs)| secs).sum();
    let mut style = format!(
        "{}.moment{{visibility:hidden}}.moment:last-of-type{{visibility:visible}}.action{{font-size:44px;font-weight:750}}\
         .lift{{fill:#2b8a3e}}.hold{{fill:#c92a2a}}.wait{{fill:#9aa5b1}}",
        style()
    );
    let mut svg = Svg::default();
    let mut begin = 0.0;
    for (idx, (moment, secs)) in drawn.into_iter().enumerate() {
        let [from, to] = [begin, begin + secs].map(|secs| px(100.0 * secs / total));
        // Before and after its time it is hidden.
        style += &format!(
            "@keyframes m{idx}{{0%{{visibility:hidden}}{from}%{{visibility:visible}}{to}%{{visibility:{}}}}}\
             #m{idx}{{animation:m{idx} {}s step-end infinite}}",
            if to >= 100.0 { "visible" } else { "hidden" },
            px(total)
        );
        svg.start("g", &[("class", &"moment"), ("id", &format!("m{idx}"))]);
        svg.append(moment);
        svg.end("g");
        begin += secs;
    }
    style += "@media (prefers-reduced-motion:reduce){.moment{animation:none!important}}";
    let title = "Grasps: the hand closes, its cells feel the object, the probability appears, and the decision comes";
    Ok(svg.finish(SIZE[0], SIZE[1], title, &style))
}

fn draw_texts(svg: &mut Svg, animated: &AnimatedGrasp, idx: usize) {
    let grasp = &animated.grasp;
    let frame = &grasp.frames[idx].message;
    let start = grasp.frames[0].header.stamp_nanos;
    let millis = grasp.frames[idx].header.stamp_nanos.saturating_sub(start) as f64 / 1e6;
    svg.text([LEFT, 44.0], Anchor::Start, "title", &fit_text(&title(grasp), 25.0, 340.0));
    svg.text([LEFT, 68.0], Anchor::Start, "sub num", &format!("{}, {millis:.0} ms", frame.phase.as_str()));
    let [left, top, width, height] = CHART;
    let at = |idx: usize| left + width * idx as f64 / (grasp.frames.len() - 1).max(1) as f64;
    let y = |probability: f64| top + height * (1.0 - probability);
    for (probability, dashes) in [(0.0, "none"), (1.0, "none"), (animated.threshold, "5 4")] {
        let line: [(&str, &dyn std::fmt::Display); 6] = [
            ("class", &"axis"),
            ("stroke-dasharray", &dashes),
            ("x1", &px(left)),
            ("x2", &px(left + width)),
            ("y1", &px(y(probability))),
            ("y2", &px(y(probability))),
        ];
        svg.element("line", &line);
    }
    svg.text([left, top - 8.0], Anchor::Start, "note", "probability that the grasp is stable");
    for (before, probability) in animated.probabilities.iter().enumerate().take(idx + 1) {
        if let Some(probability) = probability {
            let disc: [(&str, &dyn std::fmt::Display); 4] =
                [("cx", &px(at(before))), ("cy", &px(y(*probability))), ("r", &4.5), ("fill", &"#1864ab")];
            svg.element("circle", &disc);
        }
    }
    let decision = if animated.decided_at.is_some_and(|at| at <= idx) { grasp.decision.as_ref() } else { None };
    let (text, class) = match decision.map(|decision| decision.action) {
        None => ("…".into(), "wait"),
        Some(Action::Lift) => ("LIFT".to_owned(), "lift"),
        Some(action) => (action.as_str().to_uppercase(), "hold"),
    };
    svg.text([LEFT, 262.0], Anchor::Start, &format!("action {class}"), &text);
    if let (Some(_), Some(truth)) = (decision, &grasp.truth) {
        let truth = if truth.stable { "The grasp is stable." } else { "The grasp is not stable." };
        svg.text([LEFT, 288.0], Anchor::Start, "sub", truth);
    }
}
