//! The other machines of a graph as one machine sees them: the link reports this, and `ps` shows it.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// The links of a machine to the others of its graph.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LinkStatus {
    pub machine: String,
    pub namespace: Option<String>,
    pub peers: Vec<PeerStatus>,
    /// Messages that were dropped unread, by reason: `foreign`, `malformed`, `oversized`, `replayed`, `version`.
    pub rejected: BTreeMap<String, u64>,
}

/// Another machine, as seen from this one.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct PeerStatus {
    pub machine: String,
    pub state: PeerState,
    /// Why the machine is refused, or cut off although it is not silent.
    pub reason: Option<String>,
    /// The version of blindgrasp that it runs.
    pub version: Option<String>,
    /// How often the machine was found.
    pub n_times_up: u64,
    /// The time since its last message.
    pub silent_millis: Option<u64>,
    /// Its clock (CLOCK_BOOTTIME) minus this machine's.
    pub offset_nanos: Option<i64>,
    /// The largest error of the offset in either direction.
    pub uncertainty_nanos: Option<u64>,
    /// The median time of the latest messages there and back.
    pub round_trip_nanos: Option<u64>,
    pub bytes_sent: u64,
    pub bytes_received: u64,
    /// The edges that cross.
    pub channels: Vec<ChannelStatus>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PeerState {
    /// The machine has not been found yet.
    #[default]
    Waiting,
    Up,
    /// The machine has been silent for longer than the deadline, or answers no samples.
    Down,
    /// The graph was stopped on that machine.
    Left,
    /// The machine runs another graph or version.
    Refused,
}

/// An edge that crosses to another machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelStatus {
    /// `NODE/PORT`.
    pub port: String,
    /// Whether this machine sends it.
    pub is_sent: bool,
    /// Samples that went over it, each counted once.
    pub n_samples: u64,
    /// Samples that were sent again, or came again, after a loss on the way or a reconnection.
    pub n_repeated: u64,
    /// Samples that wait here for the other machine.
    pub n_waiting: u64,
    /// Samples given up, because the buffer was full (lossless) or for newer ones (latest).
    pub n_lost: u64,
    /// The time for which the channel kept its writer waiting, because the other machine's readers were behind.
    pub blocked_nanos: u64,
}

impl LinkStatus {
    /// This status with the counts of an earlier process of the link added, which has ended.
    #[must_use]
    pub fn with_counts_of(mut self, before: &LinkStatus) -> LinkStatus {
        for (why, count) in &before.rejected {
            *self.rejected.entry(why.clone()).or_default() += count;
        }
        for peer in &mut self.peers {
            let Some(before) = before.peers.iter().find(|before| before.machine == peer.machine) else { continue };
            peer.n_times_up += before.n_times_up;
            peer.bytes_sent += before.bytes_sent;
            peer.bytes_received += before.bytes_received;
            for channel in &mut peer.channels {
                let is_same =
                    |before: &&ChannelStatus| before.port == channel.port && before.is_sent == channel.is_sent;
                if let Some(before) = before.channels.iter().find(is_same) {
                    channel.n_samples += before.n_samples;
                    channel.n_repeated += before.n_repeated;
                    channel.n_lost += before.n_lost;
                    channel.blocked_nanos += before.blocked_nanos;
                }
            }
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_link_has_counted_outlives_its_process() {
        let status = |n: u64| LinkStatus {
            machine: "robot".into(),
            peers: vec![PeerStatus {
                machine: "brain".into(),
                n_times_up: n,
                channels: vec![ChannelStatus {
                    port: "a/b".into(),
                    is_sent: true,
                    n_samples: n,
                    n_repeated: n,
                    n_waiting: n,
                    n_lost: n,
                    blocked_nanos: n,
                }],
                ..PeerStatus::default()
            }],
            rejected: [("foreign".to_owned(), n)].into(),
            ..LinkStatus::default()
        };
        let together = status(3).with_counts_of(&status(4));
        let peer = &together.peers[0];
        let channel = &peer.channels[0];
        assert_eq!((together.rejected["foreign"], peer.n_times_up), (7, 7));
        assert_eq!((channel.n_samples, channel.n_repeated, channel.n_lost, channel.blocked_nanos), (7, 7, 7, 7));
        // What waits, waits in the process that is there.
        assert_eq!(channel.n_waiting, 3);
    }
}
