//! Messages to systemd about a graph that it has started as a service of `Type=notify`: sd_notify(3), without its library.

use std::ffi::{OsStr, OsString};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::time::{Duration, Instant};

/// The address of systemd's socket. Operators do not get it.
pub(super) const SOCKET_VARIABLE: &str = "NOTIFY_SOCKET";
const WATCHDOG_VARIABLE: &str = "WATCHDOG_USEC";
const WATCHDOG_PID_VARIABLE: &str = "WATCHDOG_PID";

/// The service manager that waits for signs of this process, if there is one.
pub(super) struct Service {
    systemd: Option<(UnixDatagram, SocketAddr)>,
    /// The pause between two signs of life.
    pause: Option<Duration>,
    last_sign: Instant,
}

impl Service {
    pub(super) fn of_this_process() -> Service {
        let variable = |name: &str| std::env::var_os(name);
        let is_meant =
            variable(WATCHDOG_PID_VARIABLE).is_none_or(|pid| pid == OsString::from(std::process::id().to_string()));
        let watchdog = if is_meant { variable(WATCHDOG_VARIABLE) } else { None };
        Service::new(variable(SOCKET_VARIABLE).as_deref(), watchdog.as_deref())
    }

    fn new(socket: Option<&OsStr>, watchdog: Option<&OsStr>) -> Service {
        let micros = watchdog.and_then(|micros| micros.to_str()?.parse::<u64>().ok());
        Service {
            systemd: socket.and_then(|socket| Some((UnixDatagram::unbound().ok()?, address(socket)?))),
            // Three signs in the time after which systemd ends the process.
            pause: micros.map(|micros| Duration::from_micros(micros / 3)),
            last_sign: Instant::now(),
        }
    }

    /// All operators of this machine are ready.
    pub(super) fn is_ready(&self, status: &str) {
        self.tell(&format!("READY=1\nSTATUS={status}"));
    }

    pub(super) fn has_status(&self, status: &str) {
        self.tell(&format!("STATUS={status}"));
    }

    pub(super) fn is_stopping(&self) {
        self.tell("STOPPING=1\nSTATUS=stopping");
    }

    /// Gives a sign of life if it is time for one. To be called several times a second.
    pub(super) fn beat(&mut self) {
        if self.pause.is_some_and(|pause| self.last_sign.elapsed() >= pause) {
            self.last_sign = Instant::now();
            self.tell("WATCHDOG=1");
        }
    }

    /// Does not wait: a manager that does not listen must not stop the graph.
    fn tell(&self, message: &str) {
        if let Some((socket, systemd)) = &self.systemd {
            let _ = socket.set_nonblocking(true).and_then(|()| socket.send_to_addr(message.as_bytes(), systemd));
        }
    }
}

/// A path, or an abstract name after an `@`.
fn address(socket: &OsStr) -> Option<SocketAddr> {
    match socket.as_bytes() {
        [b'@', name @ ..] => SocketAddr::from_abstract_name(name).ok(),
        _ => SocketAddr::from_pathname(socket).ok(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn systemd_is_told_at_a_path_and_at_an_abstract_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("notify");
        let name = format!("@blindgrasp-notify-{}", std::process::id());
        for place in [path.as_os_str(), OsStr::new(&name)] {
            let systemd = UnixDatagram::bind_addr(&address(place).expect("an address")).expect("bound");
            let hear = || {
                let mut bytes = [0; 256];
                let n = systemd.recv(&mut bytes).expect("told");
                String::from_utf8_lossy(&bytes[..n]).into_owned()
            };
            let mut service = Service::new(Some(place), Some(OsStr::new("3")));
            service.is_ready("running");
            assert_eq!(hear(), "READY=1\nSTATUS=running");
            std::thread::sleep(Duration::from_millis(1));
            service.beat();
            assert_eq!(hear(), "WATCHDOG=1");
            service.is_stopping();
            assert_eq!(hear(), "STOPPING=1\nSTATUS=stopping");
        }
        // Without systemd nothing happens.
        let mut service = Service::new(None, None);
        service.beat();
        service.is_ready("running");
    }
}
