//! Pictures of hands: the shapes of the links, and the cells with their normals.

use std::path::Path;

use super::super::{Outcome, check_output, print_line, write_out};
use super::grasp::check_html;
use blindgrasp_messages::files::read_regular;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_pictures::{RecordedGrasp, grasp_html};
use blindgrasp_stages::hand::Hand;

/// Postures on the page, from the open hand to the closed one.
const N_POSTURES: usize = 60;

/// Whether the argument is a pad layout or the name of a built-in hand.
pub(super) fn is_hand(path: &Path) -> bool {
    if !path.exists() {
        return path.extension().is_none() && Hand::load(path).is_ok();
    }
    let text = read_regular(path).unwrap_or_default();
    text.lines().any(|line| line.starts_with("format: blindgrasp-hand"))
}

/// Draws the hand in a posture, and how it closes from there.
pub(super) fn draw(path: &Path, out: &Path, joints: &[(String, f64)]) -> anyhow::Result<Outcome> {
    check_output(out, &[path.to_owned()])?;
    check_html(out)?;
    let hand = Hand::load(path)?;
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    let posture = hand.posture(joints.iter().map(|(name, value)| (name.as_str(), *value)))?;
    let mut postures = hand.closing_postures(&posture, N_POSTURES);
    // Links that touch in the given posture leave nothing to close.
    postures.truncate(n_apart(&hand, &postures)?.max(1));
    write_out(out, &grasp_html(&hand, &RecordedGrasp::hand_alone(&hand, &postures))?)?;
    print_line(&format!("hand {} drawn to {}", hand.name, out.display()))?;
    Ok(Outcome::Done)
}

/// How many of the postures come before the first one in which links of the hand touch each other.
fn n_apart(hand: &Hand, postures: &[Vec<f64>]) -> anyhow::Result<usize> {
    for (idx, posture) in postures.iter().enumerate() {
        if hand.self_collides(posture)? {
            return Ok(idx);
        }
    }
    Ok(postures.len())
}
