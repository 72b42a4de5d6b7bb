//! Attacks on a machine over the network, for `machines/security.rs` and `machines/fleet.rs`.
//!
//!     link_attacker zenoh CONFIG PREFIX KINDS PAUSE_MICROS SECS   a session that breaks the rules sends these kinds of frames
//!                                                                 under the keys of robot and brain, in both directions
//!     link_attacker garbage HOST:PORT SECS                        connections that send random bytes
//!     link_attacker half-open HOST:PORT N SECS                    connections that begin a TLS handshake and stay open
//!     link_attacker flood HOST:PORT SECS                          connections that are closed at once
//!     link_attacker router FILE                                   a Zenoh router with zenohd's configuration; it runs until it is killed
//!
//! KINDS: foreign, malformed, oversized, replay, version, refusal, with commas between. Each command ends with a line of JSON.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::{anyhow, bail};
use blindgrasp_bridge::wire::{Body, Frame, MAX_FRAME_BYTES, PROTOCOL, WireError, encode_refusal};
use serde_json::json;
use zenoh::qos::CongestionControl;
use zenoh::sample::{Locality, Sample};
use zenoh::{Session, Wait};

/// Number of received frames that are kept for replays.
const N_REMEMBERED: usize = 256;
/// The beginning of a TLS record with a ClientHello of 512 bytes; the rest is never sent.
const HALF_A_HELLO: [u8; 11] = [0x16, 0x03, 0x01, 0x02, 0x00, 0x01, 0x00, 0x01, 0xfc, 0x03, 0x03];

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let report = match arguments[..] {
        ["zenoh", config, prefix, kinds, pause_micros, secs] => {
            let pause = Duration::from_micros(pause_micros.parse()?);
            attack(&open(config)?, prefix, &kinds.split(',').collect::<Vec<_>>(), pause, until(secs)?)?
        }
        ["garbage", address, secs] => garbage(address, until(secs)?),
        ["half-open", address, n, secs] => half_open(address, n.parse()?, until(secs)?),
        ["flood", address, secs] => flood(address, until(secs)?),
        ["router", file] => {
            let _session = open(&std::fs::read_to_string(file)?)?;
            println!("{}", json!({"router": "ready"}));
            loop {
                std::thread::park();
            }
        }
        _ => bail!("see the top of this program"),
    };
    println!("{report}");
    Ok(())
}

fn until(secs: &str) -> anyhow::Result<Instant> {
    Ok(Instant::now() + Duration::from_secs_f64(secs.parse()?))
}

fn open(config: &str) -> anyhow::Result<Session> {
    let config = zenoh::Config::from_json5(config).map_err(|error| anyhow!("{error}"))?;
    zenoh::open(config).wait().map_err(|error| anyhow!("{error}"))
}

#[derive(Default)]
struct Heard {
    n_frames: u64,
    refusals: Vec<String>,
    frames: Vec<(String, Vec<u8>)>,
}

fn attack(
    session: &Session,
    prefix: &str,
    kinds: &[&str],
    pause: Duration,
    until: Instant,
) -> anyhow::Result<serde_json::Value> {
    let heard = Arc::<Mutex<Heard>>::default();
    let into = Arc::clone(&heard);
    let hear = move |sample: Sample| {
        let Ok(mut heard) = into.lock() else { return };
        let bytes = sample.payload().to_bytes();
        heard.n_frames += 1;
        if let Err(WireError::Refused(reason)) = Frame::decode(&bytes) {
            heard.refusals.push(reason);
            heard.refusals.dedup();
        }
        if heard.frames.len() == N_REMEMBERED {
            heard.frames.remove(0);
        }
        heard.frames.push((sample.key_expr().to_string(), bytes.into_owned()));
    };
    let _subscriber = session
        .declare_subscriber(format!("{prefix}/**"))
        .allowed_origin(Locality::Remote)
        .callback(hear)
        .wait()
        .map_err(|error| anyhow!("{error}"))?;
    let keys: Vec<String> = [("robot", "brain"), ("brain", "robot")]
        .iter()
        .flat_map(|(from, to)| ["link", "data", "ask"].map(|kind| format!("{prefix}/{from}/{to}/{kind}")))
        .collect();
    let mut n_put = 0_u64;
    let mut n_connected = 0;
    while Instant::now() < until {
        for kind in kinds {
            let put = |key: &str, payload: Vec<u8>| {
                let put = session.put(key, payload).congestion_control(CongestionControl::Drop).wait();
                put.map_err(|error| anyhow!("{error}"))
            };
            if *kind == "replay" {
                let frames = heard.lock().map(|heard| heard.frames.clone()).unwrap_or_default();
                for (key, payload) in frames {
                    put(&key, payload)?;
                    n_put += 1;
                    std::thread::sleep(pause);
                }
                continue;
            }
            for key in &keys {
                put(key, frame(kind, n_put)?)?;
                n_put += 1;
                if !pause.is_zero() {
                    std::thread::sleep(pause);
                }
            }
        }
        n_connected = n_connected.max(session.info().peers_zid().wait().count());
        n_connected = n_connected.max(session.info().routers_zid().wait().count());
    }
    let heard = heard.lock().map_err(|error| anyhow!("{error}"))?;
    Ok(json!({"put": n_put, "heard": heard.n_frames, "refusals": heard.refusals, "connected": n_connected}))
}

fn frame(kind: &str, n: u64) -> anyhow::Result<Vec<u8>> {
    let mut whole = Vec::new();
    Frame { instance: 1 + n % 7, counter: n, body: Body::Ping { sent_nanos: n } }.encode_into(&mut whole)?;
    Ok(match kind {
        "foreign" => [Vec::new(), b"b".to_vec(), b"GET / HTTP/1.1".to_vec(), vec![0; 4096]][n as usize % 4].clone(),
        "malformed" => match n % 3 {
            0 => whole[..whole.len() - 1].to_vec(),
            1 => [&whole[..], b"more"].concat(),
            _ => [&whole[..3], &[0xff; 64]].concat(),
        },
        "oversized" => [&whole[..3], &vec![0; MAX_FRAME_BYTES][..]].concat(),
        "version" => [&whole[..2], &[PROTOCOL + 1], &whole[3..]].concat(),
        "refusal" => encode_refusal("this machine runs a version that is not even made"),
        _ => bail!("no such kind of frame: {kind}"),
    })
}

fn garbage(address: &str, until: Instant) -> serde_json::Value {
    let (mut n_connections, mut state) = (0_u64, 0x9e37_79b9_7f4a_7c15_u64);
    while Instant::now() < until {
        let Ok(mut stream) = TcpStream::connect(address) else {
            std::thread::sleep(Duration::from_millis(10));
            continue;
        };
        n_connections += 1;
        let mut bytes = vec![0; 1 << (n_connections % 14)];
        for byte in &mut bytes {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            *byte = state as u8;
        }
        if n_connections.is_multiple_of(3) {
            // The length that Zenoh writes before a message.
            bytes.splice(0..0, [0xff, 0xff]);
        }
        let _ = stream.write_all(&bytes);
        let _ = stream.set_read_timeout(Some(Duration::from_millis(5)));
        let _ = stream.read(&mut [0; 64]);
    }
    json!({"connections": n_connections})
}

fn half_open(address: &str, n: usize, until: Instant) -> serde_json::Value {
    let mut streams = Vec::new();
    let mut n_connections = 0_u64;
    while Instant::now() < until {
        while streams.len() < n {
            let Ok(mut stream) = TcpStream::connect(address) else { break };
            let _ = stream.write_all(&HALF_A_HELLO);
            let _ = stream.set_nonblocking(true);
            n_connections += 1;
            streams.push(stream);
        }
        std::thread::sleep(Duration::from_millis(50));
        streams.retain_mut(|stream| !matches!(stream.read(&mut [0; 64]), Ok(0)));
    }
    json!({"connections": n_connections})
}

fn flood(address: &str, until: Instant) -> serde_json::Value {
    let mut n_connections = 0_u64;
    while Instant::now() < until {
        match TcpStream::connect(address) {
            Ok(_) => n_connections += 1,
            Err(_) => std::thread::sleep(Duration::from_millis(1)),
        }
    }
    json!({"connections": n_connections})
}
