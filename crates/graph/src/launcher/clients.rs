//! The launcher's connections to commands.

use std::collections::{BTreeMap, VecDeque};
use std::os::unix::net::UnixListener;
use std::sync::mpsc::SyncSender;

use crate::control::Reply;
use crate::dataflow::pins::Pins;
use crate::launcher::Event;
use crate::launcher::attached::AttachedReader;
use crate::launcher::log_writer::Log;
use crate::launcher::server::{self, Ask, Server};
use crate::plan::N_ATTACHED;

#[derive(Default)]
pub(super) struct Clients {
    server: Option<Server>,
    /// Requests that came while the launcher was busy.
    pub(super) waiting: VecDeque<Box<Ask>>,
    /// The clients that asked the graph to stop. The end of their connection says that it has ended.
    pub(super) stoppers: Vec<SyncSender<Reply>>,
    pub(super) is_asked_to_stop: bool,
    /// Clients that read edges, each with the slots of its place.
    pub(super) attached: [Option<AttachedReader>; N_ATTACHED],
}

impl Clients {
    /// Answers commands on a socket from now on.
    ///
    /// # Errors
    /// The socket cannot be used.
    pub(super) fn serve(
        &mut self,
        control: &UnixListener,
        pins: BTreeMap<String, Pins>,
        events: &SyncSender<Event>,
        audit: Log,
    ) -> std::io::Result<()> {
        self.server = Some(server::serve(control, pins, events, audit)?);
        Ok(())
    }
}
