//! Opening TCP connections and serial devices, so that no call on them waits.

use std::io;
use std::net::{TcpStream, ToSocketAddrs};
use std::os::fd::OwnedFd;
use std::path::Path;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use rustix::fs::{Mode, OFlags};
use rustix::net::sockopt;
use rustix::termios::{ControlModes, OptionalActions, QueueSelector};

/// A connection that is silent for this time is probed by the system. With the two constants below, a peer without power
/// is noticed after about five seconds.
const KEEPALIVE_AFTER: Duration = Duration::from_secs(2);
const KEEPALIVE_EVERY: Duration = Duration::from_secs(1);
const N_KEEPALIVES: u32 = 3;
/// The limit, milliseconds, for a peer to acknowledge bytes that were sent.
const UNACKNOWLEDGED_LIMIT_MILLIS: u32 = 5000;
/// The limit of one try to connect.
const CONNECT_LIMIT: Duration = Duration::from_secs(5);

/// Sets a connection so that no call waits and a dead peer is noticed.
pub(super) fn prepare(stream: TcpStream) -> io::Result<OwnedFd> {
    stream.set_nonblocking(true)?;
    stream.set_nodelay(true)?;
    sockopt::set_socket_keepalive(&stream, true)?;
    sockopt::set_tcp_keepidle(&stream, KEEPALIVE_AFTER)?;
    sockopt::set_tcp_keepintvl(&stream, KEEPALIVE_EVERY)?;
    sockopt::set_tcp_keepcnt(&stream, N_KEEPALIVES)?;
    // The system sends no probes while bytes are not acknowledged.
    sockopt::set_tcp_user_timeout(&stream, UNACKNOWLEDGED_LIMIT_MILLIS)?;
    Ok(stream.into())
}

/// Connects on a thread of its own: looking up a name may take long.
pub(super) fn connect(address: &str) -> Receiver<io::Result<TcpStream>> {
    let (sender, outcome) = channel();
    let address = address.to_string();
    std::thread::spawn(move || {
        // If the source was stopped meanwhile, sending fails and the connection closes.
        let _ = sender.send(try_to_connect(&address));
    });
    outcome
}

fn try_to_connect(address: &str) -> io::Result<TcpStream> {
    let mut last = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
    for address in address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, CONNECT_LIMIT) {
            Ok(stream) => return Ok(stream),
            Err(error) => last = error,
        }
    }
    Err(last)
}

/// Opens a serial device: raw, at this speed, for this process alone, with an empty input.
pub(super) fn open_serial(device: &Path, baud: u32) -> io::Result<OwnedFd> {
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let fd = rustix::fs::open(device, flags, Mode::empty())?;
    let mut settings = rustix::termios::tcgetattr(&fd)?;
    settings.make_raw();
    settings.control_modes |= ControlModes::CLOCAL | ControlModes::CREAD;
    settings.set_speed(baud)?;
    rustix::termios::tcsetattr(&fd, OptionalActions::Now, &settings)?;
    rustix::termios::ioctl_tiocexcl(&fd)?;
    rustix::termios::tcflush(&fd, QueueSelector::IFlush)?;
    Ok(fd)
}
