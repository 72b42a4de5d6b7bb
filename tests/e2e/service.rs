//! A graph as a service of systemd.

use std::os::unix::net::UnixDatagram;
use std::process::{Command, Stdio};

use crate::common::{Graph, blindgrasp, dataflow, program, project, run, skipped, text, unique_name};

/// systemd's scale goes from 0, safe, to 100.
const MAX_EXPOSURE: &str = "20";

#[test]
fn systemd_is_told_when_a_graph_runs_lives_and_stops() {
    let folder = tempfile::tempdir().expect("a folder");
    let place = folder.path().join("notify");
    let systemd = UnixDatagram::bind(&place).expect("bound");
    // The limit is there so that a failing test ends.
    systemd.set_read_timeout(Some(std::time::Duration::from_secs(60))).expect("set");
    let hear = || {
        let mut bytes = [0; 1024];
        let n = systemd.recv(&mut bytes).expect("told within a minute");
        text(&bytes[..n])
    };
    let mut command = blindgrasp();
    command.env("NOTIFY_SOCKET", &place).env("WATCHDOG_USEC", "300000");
    let flow = dataflow(folder.path(), &[("rate: 10", "rate: 1")]);
    let graph = Graph::launch_on(command, &unique_name(), &flow, &[]);
    while hear() != "READY=1\nSTATUS=running" {}
    while hear() != "WATCHDOG=1" {}
    // Its operators do not speak for it.
    let environment = std::fs::read(format!("/proc/{}/environ", graph.pid_of("contacts"))).expect("there");
    assert!(!text(&environment).contains("NOTIFY_SOCKET"));
    run(&["stop", &graph.name], 0);
    while hear() != "STOPPING=1\nSTATUS=stopping" {}
    assert_eq!(graph.finish().code, Some(0));
}

#[test]
fn the_unit_is_valid_and_has_few_rights() {
    let folder = tempfile::tempdir().expect("a folder");
    let unit = std::fs::read_to_string(project().join("packaging/blindgrasp@.service")).expect("the unit");
    let installed = "ExecStart=blindgrasp";
    assert!(unit.contains(installed), "{unit}");
    let path = folder.path().join("blindgrasp@robot7.service");
    let here = format!("ExecStart={}", program());
    std::fs::write(&path, unit.replace(installed, &here)).expect("written");
    let analyze = |arguments: &[&str]| {
        let mut command = Command::new("systemd-analyze");
        command.args(arguments).arg(&path).stdin(Stdio::null()).output()
    };
    if let Err(error) = analyze(&["--version"]) {
        return skipped(&format!("systemd-analyze: {error}"));
    }
    let verified = analyze(&["verify", "--man=no"]).expect("started");
    assert!(verified.status.success() && verified.stderr.is_empty(), "{}", text(&verified.stderr));
    let judged = analyze(&["security", "--no-pager", "--offline=true", "--threshold", MAX_EXPOSURE]).expect("started");
    assert!(judged.status.success(), "{}{}", text(&judged.stdout), text(&judged.stderr));
}
