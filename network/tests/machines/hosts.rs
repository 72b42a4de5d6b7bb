//! Several machines on one: network namespaces on one bridge, each with its own shared memory.
//!
//! A host is a process that waits for the end of its stdin. It ends with the test in any case, and its namespaces and
//! links end with it. Nothing outside sees them.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

use crate::common::{program, project, skipped};

/// Needs root, and a kernel with network namespaces, veth pairs and bridges.
pub(crate) struct Network {
    switch: Host,
    pub(crate) hosts: Vec<Host>,
}

/// A machine.
pub(crate) struct Host {
    unshare: Child,
    /// The process whose namespaces are the host's.
    pid: u32,
    /// Its address on the bridge.
    pub(crate) address: String,
    has_own_clock: bool,
}

impl Network {
    /// Makes a machine for each number, which says by how many seconds its CLOCK_BOOTTIME is ahead of the real one.
    /// Returns `None` and counts the test as skipped where rights or tools are missing.
    #[track_caller]
    pub(crate) fn new(clocks_secs: &[u32]) -> Option<Network> {
        match Self::try_new(clocks_secs) {
            Ok(network) => Some(network),
            Err(reason) => {
                skipped(&format!("several machines on one need root, iproute2 and util-linux: {reason}"));
                None
            }
        }
    }

    fn try_new(clocks_secs: &[u32]) -> Result<Network, String> {
        let switch = Host::start(0, String::new())?;
        switch.ip("link add br0 type bridge")?;
        switch.ip("link set br0 up")?;
        let mut hosts = Vec::new();
        for (idx, clock_secs) in clocks_secs.iter().enumerate() {
            let host = Host::start(*clock_secs, format!("10.77.0.{}", idx + 1))?;
            switch.ip(&format!("link add p{idx} type veth peer name eth0 netns {}", host.pid))?;
            switch.ip(&format!("link set p{idx} master br0"))?;
            switch.ip(&format!("link set p{idx} up"))?;
            host.ip(&format!("addr add {}/24 dev eth0", host.address))?;
            host.ip("link set eth0 up")?;
            hosts.push(host);
        }
        Ok(Network { switch, hosts })
    }

    /// Pulls a host's cable, or puts it in again. The host itself sees nothing of it, as with a switch between.
    pub(crate) fn cable(&self, host: usize, is_in: bool) {
        let state = if is_in { "up" } else { "down" };
        self.switch.ip(&format!("link set p{host} {state}")).expect("the cable");
    }
}

impl Host {
    fn start(clock_secs: u32, address: String) -> Result<Host, String> {
        let clock = clock_secs.to_string();
        let mut command = Command::new("unshare");
        command.args(["--net", "--mount", "--kill-child", "--fork"]);
        if clock_secs > 0 {
            command.args(["--time", "--boottime", &clock]);
        }
        let prepare = "mount -t tmpfs tmpfs /dev/shm && mkdir /dev/shm/t && ip link set lo up && echo $$ && exec cat";
        command.args(["sh", "-c", prepare]).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut unshare = command.spawn().map_err(|error| format!("unshare: {error}"))?;
        let mut line = String::new();
        let stdout = unshare.stdout.take().ok_or("no stdout")?;
        let read = BufReader::new(stdout).read_line(&mut line);
        let pid = line.trim().parse();
        match (read, pid) {
            (Ok(_), Ok(pid)) => Ok(Host { unshare, pid, address, has_own_clock: clock_secs > 0 }),
            _ => {
                drop(unshare.stdin.take());
                let output = unshare.wait_with_output().map_err(|error| error.to_string())?;
                Err(String::from_utf8_lossy(&output.stderr).trim().to_owned())
            }
        }
    }

    fn ip(&self, arguments: &str) -> Result<(), String> {
        let output = self.enter("ip").args(arguments.split(' ')).output().map_err(|error| error.to_string())?;
        if output.status.success() {
            Ok(())
        } else {
            Err(format!("ip {arguments}: {}", String::from_utf8_lossy(&output.stderr).trim()))
        }
    }

    /// A program on this host.
    pub(crate) fn enter(&self, program: &str) -> Command {
        let mut command = Command::new("nsenter");
        command.args(["--target", &self.pid.to_string(), "--net", "--mount"]);
        if self.has_own_clock {
            command.arg("--time");
        }
        command.arg(program).stdin(Stdio::null()).env("TMPDIR", "/dev/shm/t");
        command
    }

    /// The `blindgrasp` of this build on this host, in the project's folder.
    pub(crate) fn blindgrasp(&self) -> Command {
        Self::at_home(self.enter(program()))
    }

    /// As [`Host::blindgrasp`], where no process can have more descriptors than these.
    pub(crate) fn blindgrasp_with_descriptors(&self, n: u32) -> Command {
        let mut command = self.enter("prlimit");
        command.args([&format!("--nofile={n}:{n}"), program()]);
        Self::at_home(command)
    }

    fn at_home(mut command: Command) -> Command {
        command.current_dir(project()).env("XDG_STATE_HOME", "/dev/shm/state");
        command
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        // Its namespaces, and all processes in them, are the test's own to end.
        drop(self.unshare.stdin.take());
        let _ = self.unshare.kill();
        let _ = self.unshare.wait();
    }
}
