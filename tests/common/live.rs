//! The live graph and a bridge that sends it frames.

use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use blindgrasp_messages::{Stamped, TactileFrame};
use blindgrasp_recording::{Record, RecordingReader};
use serde_json::{Value, json};

use super::{Graph, RECORDING, project, shared_folder, unique_name, wait_until};

/// Limits that a busy machine does not reach.
pub(crate) const PATIENT: &str = "max_delay_ms: 20000";

/// The project's live graph, its source with these parameters.
pub(crate) fn live_dataflow(folder: &Path, params: &str) -> PathBuf {
    let text = std::fs::read_to_string(project().join("dataflow-live.yaml")).expect("dataflow-live.yaml");
    let source = format!("  tactile_source:\n    params:\n      {params}\n");
    let mut text = text.clone();
    for (what, by) in [
        ("  source:\n", source.as_str()),
        ("    run: ${SOURCE:-tactile_source}\n", ""),
        ("source/tactile}", "tactile_source/tactile}"),
        // The recordings were decided by the model of dataflow.yaml.
        ("${MODEL:-models/barrett-bh8-280-lifts.json}", "models/barrett-bh8-280.json"),
        ("${PROBE:-test_lift}", "none"),
        ("${MAX_AGE_MS:-200}", "20000\n      max_gap_ms: 1000"),
    ] {
        assert!(text.contains(what), "dataflow-live.yaml has no '{what}'");
        text = text.replace(what, by);
    }
    for shared in ["models", "hands"] {
        text = text.replace(&format!(" {shared}/"), &format!(" {}/{shared}/", project().display()));
    }
    let path = folder.join("live.yaml");
    std::fs::write(&path, text).expect("written");
    path
}

/// A free port of this machine.
pub(crate) fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr()).expect("a port").port()
}

/// The frames of the first grasps of the project's recording.
pub(crate) fn grasps(n: u64) -> Vec<Stamped<TactileFrame>> {
    let records = RecordingReader::open(&project().join(RECORDING)).expect("a recording");
    let frames = records.filter_map(|record| match record.expect("readable").1 {
        Record::Tactile(frame) => Some(frame),
        _ => None,
    });
    frames.take_while(|frame| frame.message.grasp_id < n).collect()
}

pub(crate) fn line(frame: &Stamped<TactileFrame>) -> Value {
    json!({
        "joints": frame.message.joints,
        "cells_newtons": frame.message.cells_newtons,
        "phase": frame.message.phase,
        "grasp_id": frame.message.grasp_id,
        "seq": frame.header.seq,
        "stamp_nanos": frame.header.stamp_nanos,
    })
}

/// A live graph whose source listens, with more parameters of the source and arguments of `run`, and a bridge of it.
pub(crate) fn listening(params: &[&str], arguments: &[&str]) -> (Graph, Bridge) {
    let (port, name) = (free_port(), unique_name());
    let params = format!("driver: listen\n      address: 127.0.0.1:{port}\n      {}", params.join("\n      "));
    let graph = Graph::launch(&name, &live_dataflow(&shared_folder(&name), &params), arguments);
    wait_until(|| graph.said().contains("listening on"), || graph.said());
    (graph, Bridge::connect(port))
}

/// A connection to a source.
pub(crate) struct Bridge {
    pub(crate) port: u16,
    pub(crate) stream: TcpStream,
    pub(crate) answers: BufReader<TcpStream>,
    pub(crate) greeting: Value,
}

impl Bridge {
    pub(crate) fn connect(port: u16) -> Bridge {
        let start = Instant::now();
        loop {
            if let Ok(stream) = TcpStream::connect(("127.0.0.1", port)) {
                let mut answers = BufReader::new(stream.try_clone().expect("cloned"));
                let mut first = String::new();
                if matches!(answers.read_line(&mut first), Ok(1..)) {
                    let greeting = serde_json::from_str(&first).expect("a line of JSON");
                    return Bridge { port, stream, answers, greeting };
                }
            }
            assert!(start.elapsed() < Duration::from_secs(60), "nobody listens on {port}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    pub(crate) fn send(&mut self, bytes: &[u8]) {
        self.stream.write_all(bytes).expect("sent");
    }

    pub(crate) fn send_frame(&mut self, frame: &Stamped<TactileFrame>) {
        self.send(format!("{}\n", line(frame)).as_bytes());
    }

    pub(crate) fn answer(&mut self) -> Value {
        let mut answer = String::new();
        self.answers.read_line(&mut answer).expect("read");
        serde_json::from_str(&answer).expect("a line of JSON")
    }
}

pub(crate) fn changed(frame: &Stamped<TactileFrame>, change: impl FnOnce(&mut Value)) -> Vec<u8> {
    let mut line = line(frame);
    change(&mut line);
    format!("{line}\n").into_bytes()
}
