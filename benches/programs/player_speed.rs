//! How fast the recorded source's player alone hands out frames, in the form in which they go into shared memory.
//!
//! `player_speed RECORDING N_REPETITIONS` prints JSON: the time until the player is open, and frames per second from then
//! on. Nobody receives the frames.

use std::time::Instant;

use anyhow::bail;
use blindgrasp_messages::TactileFrame;
use blindgrasp_replay::player::{Player, Playing, Program};
use blindgrasp_replay::selection::Selection;
use serde_json::json;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [recording, n_repetitions] = &arguments[..] else {
        bail!("expected RECORDING N_REPETITIONS");
    };
    let program = Program {
        recording: recording.into(),
        selection: Selection::default(),
        topic: None,
        n_repetitions: n_repetitions.parse()?,
    };
    let start = Instant::now();
    let mut player = Player::<TactileFrame>::open(program)?;
    let opened = Instant::now();
    player.resume(None, None, &mut || true)?;
    let (mut n_frames, mut sum) = (0_u64, 0.0);
    loop {
        player.advance()?;
        match player.current() {
            Playing::Frame { head, items, .. } => {
                n_frames += 1;
                sum += items.last().copied().unwrap_or_default() + f64::from(head.day);
            }
            Playing::Truth { head, .. } => sum += head.epsilon,
            Playing::Nothing => {}
            Playing::End => break,
        }
    }
    let secs = opened.elapsed().as_secs_f64();
    println!(
        "{}",
        json!({
            "open_millis": opened.duration_since(start).as_secs_f64() * 1e3,
            "n_frames": n_frames,
            "frames_per_sec": n_frames as f64 / secs,
            // The compiler cannot leave out what makes up the sum.
            "sum": sum,
        })
    );
    Ok(())
}
