//! The launcher's connections to commands.

use std::collections::VecDeque;
use std::sync::mpsc::SyncSender;

use crate::control::Reply;
use crate::launcher::attached::AttachedReader;
use crate::launcher::server::{Ask, Server};
use crate::plan::N_ATTACHED;

#[derive(Default)]
pub(super) struct Clients {
    pub(super) server: Option<Server>,
    /// The client whose swap is being begun: the launcher listens meanwhile. `None` if it has gone.
    pub(super) begins_swap: Option<u64>,
    /// Requests that came while the launcher was busy.
    pub(super) waiting: VecDeque<Box<Ask>>,
    /// The clients that asked the graph to stop. The end of their connection says that it has ended.
    pub(super) stoppers: Vec<SyncSender<Reply>>,
    pub(super) is_asked_to_stop: bool,
    /// Clients that read edges, each with the slots of its place.
    pub(super) attached: [Option<AttachedReader>; N_ATTACHED],
}
