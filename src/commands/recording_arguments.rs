//! The options of a command that records.

use std::time::Duration;

use clap::Args;

use blindgrasp_cli::secs_in;
use blindgrasp_recording::LiveOptions;

#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Recording")]
pub(super) struct RecordingArguments {
    /// Begin another file at this size (500MB, 2GiB)
    ///
    /// The files are FILE-00000.mcap, FILE-00001.mcap and so on, split between grasps.
    #[arg(long, value_name = "SIZE", value_parser = bytes)]
    rotate_size: Option<u64>,
    /// Begin another file after this time (90s, 10m, 1h)
    #[arg(long, value_name = "TIME", value_parser = |text: &str| secs_in(text, 0.1..=1e8).map(Duration::from_secs_f64))]
    rotate_every: Option<Duration>,
    /// Replace existing files
    #[arg(long)]
    overwrite: bool,
}

impl RecordingArguments {
    pub(super) fn options(&self) -> LiveOptions {
        let RecordingArguments { rotate_size, rotate_every, overwrite } = *self;
        LiveOptions { rotate_bytes: rotate_size, rotate_after: rotate_every, overwrite, ..LiveOptions::default() }
    }
}

/// A size with its unit: `500MB`, `2GiB`.
fn bytes(text: &str) -> Result<u64, String> {
    bytes_of(text).ok_or("expected a size of at least 1MB like 500MB, 1GB or 2GiB".into())
}

fn bytes_of(text: &str) -> Option<u64> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let number: f64 = digits.trim().parse().ok()?;
    let unit = match text[digits.len()..].to_ascii_lowercase().as_str() {
        "mb" => 1e6,
        "gb" => 1e9,
        "tb" => 1e12,
        "mib" => f64::from(1 << 20),
        "gib" => f64::from(1 << 30),
        "tib" => 1024.0 * f64::from(1 << 30),
        _ => return None,
    };
    let n_bytes = number * unit;
    if (1e6..=1e15).contains(&n_bytes) { Some(n_bytes as u64) } else { None }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_a_unit() {
        assert_eq!(bytes("1GB"), Ok(1_000_000_000));
        assert_eq!(bytes("1.5 MiB"), Ok(1_572_864));
        assert_eq!(bytes("2gib"), Ok(2_147_483_648));
        for text in ["", "1000000", "GB", "-1GB", "1kB", "1XB", "NaNMB", "1e99GB"] {
            assert!(bytes(text).is_err(), "{text}");
        }
    }
}
