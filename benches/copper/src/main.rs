//! The stages in one process of Copper, beside a group of blindgrasp: five tasks call the functions that
//! `benches/programs/stage_times.rs` times.
//!
//! `copper-peer RECORDING MODEL RATE_HZ SECS` sends the frames of a simulated recording over and over in its rhythm: those
//! of a grasp at RATE_HZ, then a pause of ten frames' time; at the rate inf, it waits for nothing. It prints JSON.
//! `latency_nanos` is the time from the source's stamp to the decision, over the frames that bring one, without the first
//! 50. `frame_nanos` is the time of the whole loop a frame. `log_bytes` is the used part of Copper's log.
//!
//! The log is a temporary file with all payloads, keyframes and the lines of the monitor, cu-logmon 1.3.0: one a second.
//! Copper has one thread. It sleeps between the iterations, as with Copper's own `rate_target_hz`, which knows no pauses.

pub mod tasks;

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{anyhow, bail};
use blindgrasp_grasps::dataset::hand_of;
use blindgrasp_recording::{Record, RecordingReader};
use blindgrasp_stages::Model;
use cu29::prelude::*;
use serde_json::json;
use tasks::{LATENCIES_NANOS, N_GRASP_FRAMES, SETUP, Setup};

/// The distance to the next grasp's frames, in frames.
const N_PAUSE_FRAMES: u32 = 10;
/// The size of the log's files: `slab_size_mib` in `copperconfig.ron`.
const SLAB_BYTES: usize = 1024 * 1024 * 1024;

#[copper_runtime(config = "copperconfig.ron")]
struct PeerApp {}

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [recording, model, rate_hz, secs] = &arguments[..] else {
        bail!("expected RECORDING MODEL RATE_HZ SECS");
    };
    let period = Duration::try_from_secs_f64(1.0 / rate_hz.parse::<f64>()?)?;
    let limit = Duration::try_from_secs_f64(secs.parse()?)?;
    let setup = setup_of(Path::new(recording), Path::new(model))?;
    SETUP.get_or_init(|| setup);
    let folder = tempfile::tempdir()?;
    let log = folder.path().join("peer.copper");
    let app = PeerApp::builder().with_log_path(&log, Some(SLAB_BYTES))?.build()?;
    let mut app = app.start().map_err(|failed| failed.error)?;
    let begin = Instant::now();
    let mut due = begin;
    let mut n_frames = 0;
    while begin.elapsed() < limit {
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        app.run_one_iteration()?;
        n_frames += 1;
        due += if n_frames % N_GRASP_FRAMES == 0 { period * N_PAUSE_FRAMES } else { period };
    }
    let elapsed = begin.elapsed();
    drop(app.stop().map_err(|failed| failed.error)?);

    let latencies = LATENCIES_NANOS.lock().map_err(|_| anyhow!("the latencies are lost"))?;
    let mut warm: Vec<u64> = latencies.iter().skip(50).copied().collect();
    warm.sort_unstable();
    let quantile = |share: f64| warm.get((warm.len().saturating_sub(1) as f64 * share).round() as usize);
    let report = json!({
        "frames": n_frames,
        "decisions": latencies.len(),
        "latency_nanos": {"p50": quantile(0.5), "p90": quantile(0.9), "p99": quantile(0.99)},
        "frame_nanos": elapsed.as_nanos() as u64 / n_frames.max(1),
        "log_bytes": log_bytes(&log)?,
    });
    println!("{report}");
    Ok(())
}

fn setup_of(recording: &Path, model: &Path) -> anyhow::Result<Setup> {
    let (model, hand) = (Model::load(model)?, hand_of(recording, None)?);
    let mut frames = Vec::new();
    for record in RecordingReader::open(recording)? {
        if let (_, Record::Tactile(frame)) = record? {
            frames.push(frame);
        }
    }
    let mut grasps = frames.chunk_by(|one, next| one.message.grasp_id == next.message.grasp_id);
    if frames.is_empty() || grasps.any(|grasp| grasp.len() as u64 != N_GRASP_FRAMES) {
        bail!("{}: expected grasps of {N_GRASP_FRAMES} frames each, as simulated ones are", recording.display());
    }
    Ok(Setup { frames, hand, model, begin: Instant::now() })
}

/// The bytes that are used of the log: Copper allocates more ahead.
fn log_bytes(path: &Path) -> anyhow::Result<u64> {
    let mut log = UnifiedLoggerRead::new(path)?;
    let mut n_bytes = 0;
    while log.position().0 != 0 {
        n_bytes += u64::from(log.raw_skip_section()?.used);
    }
    Ok(n_bytes)
}
