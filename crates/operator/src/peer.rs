//! The process at the other end of a Unix socket.

use std::os::fd::{AsFd, AsRawFd};

/// The user and the process at the other end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Peer {
    pub uid: u32,
    /// `None` for a process that this one's PID namespace does not show, as that of a container's host.
    pub pid: Option<i32>,
}

/// The process at the other end of a connected Unix socket.
///
/// # Errors
/// The socket is no such socket.
pub fn peer_of(socket: impl AsFd) -> std::io::Result<Peer> {
    // rustix takes a process's number for one that is never 0, but the kernel gives 0 for a process out of sight.
    let mut found = libc::ucred { pid: 0, uid: libc::uid_t::MAX, gid: libc::gid_t::MAX };
    let mut n_bytes = size_of::<libc::ucred>() as libc::socklen_t;
    // SAFETY: the descriptor is open, and the kernel writes at most `n_bytes` into `found`, of which any bytes are valid.
    let outcome = unsafe {
        libc::getsockopt(
            socket.as_fd().as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_PEERCRED,
            (&raw mut found).cast(),
            &raw mut n_bytes,
        )
    };
    if outcome != 0 {
        return Err(std::io::Error::last_os_error());
    }
    Ok(Peer { uid: found.uid, pid: (found.pid > 0).then_some(found.pid) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::net::UnixStream;

    #[test]
    fn the_other_end_of_a_pair_is_this_process() {
        let (here, _there) = UnixStream::pair().expect("a pair");
        let peer = peer_of(&here).expect("a peer");
        assert_eq!((peer.uid, peer.pid), (rustix::process::getuid().as_raw(), Some(std::process::id() as i32)));
    }
}
