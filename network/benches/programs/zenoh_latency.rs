//! The latency of bare Zenoh between two machines, from a put to the callback, for `scripts/benchsuite machines`.
//!
//!     zenoh_latency receive CONFIG N            prints p50, p90, p99 in nanoseconds, and the number of messages
//!     zenoh_latency send CONFIG N RATE_HZ BYTES
//!
//! CONFIG is a Zenoh configuration in JSON5. Both sides must have the same CLOCK_BOOTTIME.

use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail};
use blindgrasp_operator::monotonic_nanos;
use zenoh::Wait;
use zenoh::qos::CongestionControl;

const KEY: &str = "bench/latency";
/// The receiver ends after this silence.
const SILENCE: Duration = Duration::from_secs(5);

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        ["receive", config, n] => receive(config, n.parse()?),
        ["send", config, n, rate_hz, n_bytes] => send(config, n.parse()?, rate_hz.parse()?, n_bytes.parse()?),
        _ => bail!("zenoh_latency receive CONFIG N | send CONFIG N RATE_HZ BYTES"),
    }
}

fn open(config: &str) -> anyhow::Result<zenoh::Session> {
    let config = zenoh::Config::from_json5(config).map_err(|error| anyhow!("{error}"))?;
    zenoh::open(config).wait().map_err(|error| anyhow!("{error}"))
}

fn receive(config: &str, n: usize) -> anyhow::Result<()> {
    let session = open(config)?;
    let (sender, ages) = channel();
    let callback = move |sample: zenoh::sample::Sample| {
        let now_nanos = monotonic_nanos();
        let bytes = sample.payload().to_bytes();
        if let Some(sent) = bytes.get(..8).and_then(|bytes| bytes.try_into().ok()) {
            let _ = sender.send(now_nanos.saturating_sub(u64::from_le_bytes(sent)));
        }
    };
    let _subscriber = session.declare_subscriber(KEY).callback(callback).wait().map_err(|error| anyhow!("{error}"))?;
    println!("listening");
    let mut found = vec![ages.recv().context("no message arrived")?];
    while found.len() < n
        && let Ok(age) = ages.recv_timeout(SILENCE)
    {
        found.push(age);
    }
    found.sort_unstable();
    let at = |share: f64| found[((found.len() - 1) as f64 * share) as usize];
    println!("{} {} {} {}", at(0.5), at(0.9), at(0.99), found.len());
    Ok(())
}

fn send(config: &str, n: usize, rate_hz: f64, n_bytes: usize) -> anyhow::Result<()> {
    let session = open(config)?;
    let publisher = session
        .declare_publisher(KEY)
        .congestion_control(CongestionControl::Block)
        .express(true)
        .wait()
        .map_err(|error| anyhow!("{error}"))?;
    while !publisher.matching_status().wait().map_err(|error| anyhow!("{error}"))?.matching() {
        std::thread::sleep(Duration::from_millis(10));
    }
    let mut payload = vec![0; n_bytes.max(8)];
    let start = Instant::now();
    for idx in 0..n {
        let due = start + Duration::from_secs_f64(idx as f64 / rate_hz);
        while let Some(left) = due.checked_duration_since(Instant::now()).filter(|left| !left.is_zero()) {
            if left > Duration::from_micros(200) {
                std::thread::sleep(left - Duration::from_micros(100))
            } else {
                std::thread::yield_now()
            }
        }
        payload[..8].copy_from_slice(&monotonic_nanos().to_le_bytes());
        publisher.put(payload.as_slice()).wait().map_err(|error| anyhow!("{error}"))?;
    }
    std::thread::sleep(Duration::from_millis(500));
    Ok(())
}
