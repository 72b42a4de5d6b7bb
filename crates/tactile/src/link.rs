//! Opening sockets and serial devices, so that no call on them waits.

use std::fs::Permissions;
use std::io;
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use blindgrasp_operator::peer::peer_of;
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

/// The start of an address that is the path of a socket on this machine.
const UNIX: &str = "unix:";

/// Listens for bridges.
pub(super) enum Listener {
    Tcp(TcpListener),
    Unix(UnixListener),
}

impl Listener {
    /// Listens at `HOST:PORT` or `unix:PATH`. Only this user and root may use the socket at a path; one that a dead process
    /// of this user has left is replaced.
    pub(super) fn bind(address: &str) -> io::Result<Listener> {
        let listener = match address.strip_prefix(UNIX) {
            // std sets SO_REUSEADDR: another instance may have listened there a moment ago.
            None => Listener::Tcp(TcpListener::bind(address)?),
            Some(path) => Listener::Unix(bind_path(Path::new(path))?),
        };
        match &listener {
            Listener::Tcp(listener) => listener.set_nonblocking(true)?,
            Listener::Unix(listener) => listener.set_nonblocking(true)?,
        }
        Ok(listener)
    }

    /// A client that may send, and its name for messages.
    ///
    /// # Errors
    /// [`io::ErrorKind::WouldBlock`] without a client, [`io::ErrorKind::PermissionDenied`] if it is of another user.
    pub(super) fn accept(&self) -> io::Result<(OwnedFd, String)> {
        match self {
            Listener::Tcp(listener) => {
                let (stream, peer) = listener.accept()?;
                Ok((prepare(stream)?, peer.to_string()))
            }
            Listener::Unix(listener) => {
                let (stream, _) = listener.accept()?;
                let pid = check_user(&stream)?;
                stream.set_nonblocking(true)?;
                Ok((stream.into(), format!("process {pid}")))
            }
        }
    }

    /// The address of a TCP listener.
    pub(super) fn local_address(&self) -> Option<SocketAddr> {
        match self {
            Listener::Tcp(listener) => listener.local_addr().ok(),
            Listener::Unix(_) => None,
        }
    }
}

impl AsFd for Listener {
    fn as_fd(&self) -> BorrowedFd<'_> {
        match self {
            Listener::Tcp(listener) => listener.as_fd(),
            Listener::Unix(listener) => listener.as_fd(),
        }
    }
}

/// A socket's file goes with it: another graph may never take its name again.
impl Drop for Listener {
    fn drop(&mut self) {
        if let Listener::Unix(listener) = self
            && let Ok(address) = listener.local_addr()
            && let Some(path) = address.as_pathname()
        {
            let _ = std::fs::remove_file(path);
        }
    }
}

fn bind_path(path: &Path) -> io::Result<UnixListener> {
    let listener = match UnixListener::bind(path) {
        Err(error) if error.kind() == io::ErrorKind::AddrInUse && is_left_over(path) => {
            std::fs::remove_file(path)?;
            UnixListener::bind(path)?
        }
        bound => bound?,
    };
    std::fs::set_permissions(path, Permissions::from_mode(0o600))?;
    Ok(listener)
}

/// Whether a path is a socket of this user at which nobody listens.
fn is_left_over(path: &Path) -> bool {
    let is_own = std::fs::symlink_metadata(path)
        .is_ok_and(|found| found.file_type().is_socket() && found.uid() == rustix::process::getuid().as_raw());
    is_own && UnixStream::connect(path).is_err_and(|error| error.kind() == io::ErrorKind::ConnectionRefused)
}

/// The process at the other end, if it is of this user or of root.
fn check_user(stream: &UnixStream) -> io::Result<i32> {
    let peer = peer_of(stream)?;
    // 0 for a process in another PID namespace.
    let pid = peer.pid.unwrap_or(0);
    if peer.uid != rustix::process::getuid().as_raw() && peer.uid != 0 {
        let message = format!("process {pid} belongs to user {}", peer.uid);
        return Err(io::Error::new(io::ErrorKind::PermissionDenied, message));
    }
    Ok(pid)
}

/// Sets a connection so that no call waits and a dead peer is noticed.
fn prepare(stream: TcpStream) -> io::Result<OwnedFd> {
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

/// Connects to `HOST:PORT` or `unix:PATH`, on a thread of its own: looking up a name may take long.
pub(super) fn connect(address: &str) -> Receiver<io::Result<OwnedFd>> {
    let (sender, outcome) = channel();
    let address = address.to_string();
    std::thread::spawn(move || {
        // If the source was stopped meanwhile, sending fails and the connection closes.
        let _ = sender.send(try_to_connect(&address));
    });
    outcome
}

fn try_to_connect(address: &str) -> io::Result<OwnedFd> {
    if let Some(path) = address.strip_prefix(UNIX) {
        let stream = UnixStream::connect(path)?;
        check_user(&stream)?;
        stream.set_nonblocking(true)?;
        return Ok(stream.into());
    }
    let mut last = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
    for address in address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, CONNECT_LIMIT) {
            Ok(stream) => return prepare(stream),
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
