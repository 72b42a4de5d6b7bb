//! Times what keys cost a link: encryption per frame, signatures per hello. One thread.
//!
//! `cargo bench -p blindgrasp-network --bench link_keys` prints the least of five times for each.

use std::sync::Arc;
use std::time::Instant;

use blindgrasp_bridge::agreement::{Agreement, PairKeys};
use blindgrasp_bridge::identity::Identity;
use blindgrasp_bridge::keys::{KeyRequest, make};
use blindgrasp_bridge::protection::Protection;
use blindgrasp_bridge::wire::{Body, Frame, Hello};
use blindgrasp_graph::link::config::{KeyKind, LinkConfig, key_files};
use time::OffsetDateTime;

/// The least of these times counts; the rest is other programs'.
const N_REPEATS: usize = 5;

fn main() -> anyhow::Result<()> {
    let [sender, receiver] = pair()?;
    for n_bytes in [64, 1000, 2000] {
        let plain = [b"bg\x04\0".as_slice(), &vec![7; n_bytes]].concat();
        let mut frame = Vec::with_capacity(2 * plain.len());
        let encrypt = nanos(10_000, || {
            frame.clear();
            frame.extend_from_slice(&plain);
            sender.encrypt(KeyKind::Data, &mut frame);
        });
        let decrypt = nanos(10_000, || assert!(receiver.decrypt(KeyKind::Data, &frame).is_ok()));
        println!("frame of {n_bytes} bytes: encrypt {encrypt:.0} ns, decrypt {decrypt:.0} ns");
    }
    let folder = tempfile::tempdir()?;
    let machines = ["robot", "brain"];
    let request = KeyRequest {
        folder: folder.path().into(),
        machines: machines.map(Into::into).into(),
        days: 90,
        ..KeyRequest::default()
    };
    make(&request, OffsetDateTime::now_utc())?;
    let protection = |machine: &str, peer: &str| -> anyhow::Result<Protection> {
        let config = LinkConfig {
            graph: "g".into(),
            machine: machine.into(),
            keys: Some(key_files(folder.path(), machine)),
            ..LinkConfig::default()
        };
        let identity = Identity::load(&config, OffsetDateTime::now_utc())?.map(Arc::new);
        let agreement = Agreement::new(&config.key_prefix(), machine, peer, 1)?;
        Ok(identity.map(|identity| Protection::new(identity, peer, &agreement)).unwrap_or_default())
    };
    let [robot, brain] = [protection("robot", "brain")?, protection("brain", "robot")?];
    let mut plain = Vec::new();
    Frame { instance: 1, counter: 1, body: Body::Hello(hello()) }.encode_into(&mut plain)?;
    let mut signed = Vec::new();
    let sign = nanos(200, || {
        signed.clone_from(&plain);
        assert!(robot.sign(&mut signed).is_ok());
    });
    let verify = nanos(200, || assert!(brain.open(KeyKind::Link, &signed).is_ok()));
    println!("hello of {} bytes: sign {:.0} µs, verify {:.0} µs", signed.len(), sign / 1000.0, verify / 1000.0);
    Ok(())
}

fn hello() -> Hello {
    Hello {
        version: env!("CARGO_PKG_VERSION").into(),
        machine: "robot".into(),
        heard: Some(1),
        key: Some([7; 32]),
        heard_key: Some([7; 32]),
        fingerprint: 1,
        run: 1,
        is_ready: true,
        ..Hello::default()
    }
}

fn pair() -> anyhow::Result<[Arc<PairKeys>; 2]> {
    let mut robot = Agreement::new("blindgrasp/_/g", "robot", "brain", 1)?;
    let mut brain = Agreement::new("blindgrasp/_/g", "brain", "robot", 2)?;
    let keys = [robot.for_hello(None).0, brain.for_hello(None).0];
    robot.settle(2, keys[1])?;
    brain.settle(1, keys[0])?;
    let pair = robot.pair().zip(brain.pair()).ok_or_else(|| anyhow::anyhow!("no keys"))?;
    Ok([pair.0, pair.1])
}

fn nanos(n: u32, mut run: impl FnMut()) -> f64 {
    let times = (0..N_REPEATS).map(|_| {
        let start = Instant::now();
        (0..n).for_each(|_| run());
        start.elapsed().as_secs_f64() * 1e9 / f64::from(n)
    });
    times.fold(f64::INFINITY, f64::min)
}
