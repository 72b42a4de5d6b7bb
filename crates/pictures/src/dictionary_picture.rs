//! A contact dictionary over the hand: the paper's Figure 1.

use nalgebra::{Point3, Rotation3, Vector3};
use serde::Serialize;

use super::PictureError;
use super::colour::{force_colour, hex};
use super::geometry::link_mesh;
use blindgrasp_mesh::Mesh;
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
/// Smaller triangles are not drawn, square pixels: those of rounded edges would make the file six times as large.
const LEAST_AREA: f64 = 2.0;
const UNUSED: &str = "#868e96";

const STYLE: &str = "text{font-family:Inter,'Segoe UI','Helvetica Neue',Helvetica,Arial,sans-serif;fill:#52606d;\
font-size:12px;font-variant-numeric:tabular-nums}.title{font-size:15px;font-weight:650;fill:#1f2933}\
.tiny{font-size:10px;text-anchor:middle}.axis{stroke:#52606d;stroke-width:1.4;fill:none}\
.link{fill:#dfe3e8;stroke:#b8c0ca;stroke-width:.4;stroke-linejoin:round;fill-opacity:.75}\
.word{stroke:#ffffff;stroke-width:1;fill-opacity:.88}.size{fill:#ced4da;stroke:#868e96}";

/// The words of a dictionary over the hand in a posture, from two sides and from above the palm (SVG). The hand is drawn flat, in
/// parallel projection.
///
/// # Errors
/// Joint angles that are not the hand's.
pub fn dictionary_svg(hand: &Hand, joints: &[f64], words: &[DrawnWord]) -> Result<String, PictureError> {
    let poses = hand.palm_from_links(joints)?;
    let mut links: Vec<Mesh> = hand.links.iter().map(link_mesh).collect();
    for (link, palm_from_link) in links.iter_mut().zip(&poses) {
        link.transform(palm_from_link);
    }
    let mut points: Vec<Point3<f64>> = words.iter().map(|word| word.position_m.into()).collect();
    points.extend(links.iter().flat_map(|link| &link.vertices_m));
    let scales = Scales::of(words);
    let title = format!("The {} words of the contact dictionary over the hand", words.len());
    let mut body = format!("<text x=\"{MARGIN}\" y=\"32\" class=\"title\">{title}</text>\n");
    let views = [
        (Vector3::new(0.25, -1.0, 0.3), Vector3::z()),
        (Vector3::new(1.0, -0.25, 0.3), Vector3::z()),
        (Vector3::new(0.0, 0.0, 1.0), Vector3::y()),
    ];
    for (idx, (to_eye, up)) in views.into_iter().enumerate() {
        let view = View::new(to_eye, up, &points);
        let left = MARGIN + idx as f64 * (VIEW[0] + 8.0);
        body += &format!("<g transform=\"translate({left} {TOP})\">\n");
        draw_links(&mut body, &view, &links);
        draw_words(&mut body, &view, words, &scales);
        draw_axes(&mut body, &view);
        body += "</g>\n";
    }
    let width = 2.0 * MARGIN + 3.0 * VIEW[0] + 16.0;
    let below = TOP + VIEW[1] + 26.0;
    draw_legend(&mut body, &scales, below);
    let height = below + 26.0;
    Ok(format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
         role=\"img\">\n<title>{title}</title>\n<style>{STYLE}</style>\n\
         <rect width=\"{width}\" height=\"{height}\" rx=\"12\" fill=\"#ffffff\"/>\n{body}</svg>\n"
    ))
}

/// A parallel projection in which all points lie within the view.
struct View {
    /// The palm frame's axes in the view: x to the right, y up, z to the eye.
    view_from_palm: Rotation3<f64>,
    middle: Vector3<f64>,
    pixels_per_m: f64,
}

impl View {
    fn new(to_eye: Vector3<f64>, up: Vector3<f64>, points: &[Point3<f64>]) -> View {
        let view_from_palm = Rotation3::face_towards(&to_eye, &up).inverse();
        let mut least = Vector3::repeat(f64::MAX);
        let mut most = Vector3::repeat(f64::MIN);
        for point in points {
            let seen = view_from_palm * point.coords;
            least = least.inf(&seen);
            most = most.sup(&seen);
        }
        let size = (most - least).add_scalar(1e-9);
        let pixels_per_m = ((VIEW[0] - 40.0) / size.x).min((VIEW[1] - 40.0) / size.y);
        View { view_from_palm, middle: (least + most) / 2.0, pixels_per_m }
    }

    /// A place in the view, pixels from its left and upper edge, and how near it is.
    fn project(&self, point: &Point3<f64>) -> [f64; 3] {
        let seen = (self.view_from_palm * point.coords - self.middle) * self.pixels_per_m;
        [tenth(VIEW[0] / 2.0 + seen.x), tenth(VIEW[1] / 2.0 - seen.y), seen.z]
    }
}

/// To tenths of a pixel, so that a picture's bytes do not hang on the last digits of a sine.
fn tenth(pixels: f64) -> f64 {
    // Adding 0 turns -0 into 0.
    (pixels * 10.0).round() / 10.0 + 0.0
}

/// The sides of each link that face the eye; the far links first.
fn draw_links(body: &mut String, view: &View, links: &[Mesh]) {
    let mut drawn: Vec<(f64, String)> = Vec::new();
    for link in links {
        let seen: Vec<[f64; 3]> = link.vertices_m.iter().map(|vertex| view.project(vertex)).collect();
        let mut path = String::new();
        for triangle in &link.triangles {
            let [a, b, c] = triangle.map(|idx| seen[idx as usize]);
            // The picture's y points down.
            let twice_area = (b[1] - a[1]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[1] - a[1]);
            if twice_area > 2.0 * LEAST_AREA {
                path += &format!("M{} {}L{} {}L{} {}Z", a[0], a[1], b[0], b[1], c[0], c[1]);
            }
        }
        let nearest = seen.iter().map(|vertex| vertex[2]).fold(f64::MIN, f64::max);
        drawn.push((nearest, path));
    }
    drawn.sort_by(|(left, _), (right, _)| left.total_cmp(right));
    for (_, path) in drawn {
        *body += &format!("<path class=\"link\" d=\"{path}\"/>\n");
    }
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
fn draw_words(body: &mut String, view: &View, words: &[DrawnWord], scales: &Scales) {
    let mut seen: Vec<_> = words.iter().map(|word| (view.project(&word.position_m.into()), word)).collect();
    seen.sort_by(|(left, _), (right, _)| left[2].total_cmp(&right[2]));
    for ([x, y, _], word) in seen {
        let radius = tenth(scales.radius(word.share_of_contacts));
        let colour = scales.colour(word.share_stable);
        *body += &format!("<circle cx=\"{x}\" cy=\"{y}\" r=\"{radius}\" class=\"word\" fill=\"{colour}\"/>\n");
    }
}

/// The palm frame's axes, and a bar of 50 mm.
fn draw_axes(body: &mut String, view: &View) {
    let (left, y) = (34.0, VIEW[1] - 14.0);
    for (name, axis) in [("x", Vector3::x()), ("y", Vector3::y()), ("z", Vector3::z())] {
        let seen = view.view_from_palm * axis;
        // An axis that points to the eye has no place for its name.
        if seen.xy().norm() > 0.3 {
            let [right, down] = [20.0 * seen.x, -20.0 * seen.y].map(tenth);
            let [name_x, name_y] = [left + 1.4 * right, y - 16.5 + 1.4 * down].map(tenth);
            *body += &format!("<path class=\"axis\" d=\"M{left} {}l{right} {down}\"/>\n", y - 20.0);
            *body += &format!("<text x=\"{name_x}\" y=\"{name_y}\" class=\"tiny\">{name}</text>\n");
        }
    }
    let length = tenth(0.05 * view.pixels_per_m);
    let right = VIEW[0] - 14.0;
    *body += &format!("<path class=\"axis\" d=\"M{} {}v5h{length}v-5\"/>\n", tenth(right - length), y - 5.0);
    *body += &format!("<text x=\"{}\" y=\"{}\" class=\"tiny\">50 mm</text>\n", tenth(right - length / 2.0), y - 7.0);
}

fn draw_legend(body: &mut String, scales: &Scales, y: f64) {
    let mut x = MARGIN;
    let [least, most] = scales.stable;
    if least <= most {
        *body += &legend_text(x, y, "stable grasps among those that use the word:");
        *body += &legend_text(x + 268.0, y, &percent(least));
        x += 316.0;
        for step in 0..40 {
            let fill = hex(force_colour((f64::from(step) + 0.5) / 40.0));
            let left = x + 3.0 * f64::from(step);
            *body += &format!("<rect x=\"{left}\" y=\"{}\" width=\"3.2\" height=\"12\" fill=\"{fill}\"/>\n", y - 6.0);
        }
        *body += &legend_text(x + 128.0, y, &percent(most));
        x += 218.0;
    }
    if scales.most_used > 0.0 {
        *body += &legend_text(x, y, "share of the contacts:");
        x += 140.0;
        for part in [0.1, 0.5, 1.0] {
            let share = part * scales.most_used;
            let radius = tenth(scales.radius(Some(share)));
            *body += &format!("<circle cx=\"{}\" cy=\"{y}\" r=\"{radius}\" class=\"size\"/>\n", tenth(x + radius));
            *body += &legend_text(x + 2.0 * radius + 6.0, y, &percent(share));
            x += 2.0 * radius + 64.0;
        }
    }
}

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

fn legend_text(x: f64, y: f64, text: &str) -> String {
    format!("<text x=\"{}\" y=\"{}\">{text}</text>\n", tenth(x), y + 4.0)
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
        assert!(svg.len() < 500_000, "{} bytes", svg.len());
        // The hand is behind the words.
        assert_eq!(svg.matches("<path class=\"link\"").count(), 3 * hand.links.len());
        assert!(svg.find("class=\"link\"") < svg.find("class=\"word\""));
        for expected in ["The 3 words", "40.0 %", "60.0 %", UNUSED, "50 mm"] {
            assert!(svg.contains(expected), "{expected}");
        }
        assert!(dictionary_svg(&hand, &joints[1..], &words).is_err());
        let all_alike = words.map(|word| DrawnWord { share_of_contacts: None, share_stable: None, ..word });
        assert!(!dictionary_svg(&hand, &joints, &all_alike).expect("a picture").contains("share of the contacts"));
    }
}
