//! Attached readers: clients that read a running graph's edges and must miss nothing, like a recorder.
//!
//! The plan has slots for them in every writer's list, given up until a reader takes them. The launcher only assigns
//! the slots. The reader begins by itself once its ports are open, and a writer gives up a reader that keeps it waiting
//! ([`ATTACHED_LIMIT_MILLIS`](crate::plan::ATTACHED_LIMIT_MILLIS)), so that no reader can stop the graph. The end of a
//! reader's connection frees its slots.

use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use crate::control::{AttachedEdge, Attachment, GraphState, Reply};
use crate::dataflow::Node;
use crate::launcher::Launcher;
use crate::launcher::lifecycle::Surroundings;
use crate::plan::{N_ATTACHED, Port};
use crate::recorded_graph::describe_graph;
use blindgrasp_operator::text::did_you_mean;

/// A graph that ends waits this long until its attached readers have read all samples.
const RETIRE_LIMIT: Duration = Duration::from_secs(2);

pub(super) struct AttachedReader {
    client: u64,
    reply: SyncSender<Reply>,
    is_flight_recorder: bool,
}

impl Launcher {
    /// Attaches a client, and tells it how to read the edges.
    pub(super) fn attach(
        &mut self,
        ports: &[String],
        is_flight_recorder: bool,
        client: u64,
        reply: &SyncSender<Reply>,
    ) {
        let attached = self.free_place(client).and_then(|place| Ok((place, self.attachment(ports, place)?)));
        let answer = match attached {
            Ok((place, attachment)) => {
                self.attached[place] = Some(AttachedReader { client, reply: reply.clone(), is_flight_recorder });
                Reply::Attached(attachment)
            }
            Err(message) => Reply::refusal(message),
        };
        let _ = reply.try_send(answer);
    }

    /// Asks the flight recorders for a file.
    pub(super) fn ask_flight_recorders(&self) -> Reply {
        let recorders = self.attached.iter().flatten().filter(|reader| reader.is_flight_recorder);
        let n_flight_recorders = recorders.filter(|reader| reader.reply.try_send(Reply::Keep).is_ok()).count();
        Reply::Asked { n_flight_recorders }
    }

    fn free_place(&self, client: u64) -> Result<usize, String> {
        if self.life.state == GraphState::Stopping {
            return Err(format!("graph '{}' is stopping", self.life.name));
        }
        if self.attached.iter().flatten().any(|reader| reader.client == client) {
            return Err("this connection is attached already".into());
        }
        self.attached.iter().position(Option::is_none).ok_or_else(|| {
            format!(
                "graph '{}' is being recorded by {N_ATTACHED} already, which is the most: wait until one of them has ended",
                self.life.name
            )
        })
    }

    fn attachment(&self, wanted: &[String], place: usize) -> Result<Attachment, String> {
        let nodes = self.life.members.iter().map(|member| &member.node);
        let plan = &self.life.site.plan;
        let all: Vec<Port> = nodes.clone().flat_map(Node::output_ports).map(|(port, _)| port).collect();
        // NODE/PORT, the topic of a recording, with or without its '/', or a node with all its outputs.
        let is_named = |port: &Port, wanted: &str| {
            let wanted = wanted.trim_start_matches('/');
            name_of(port) == wanted || plan.topic(port).trim_start_matches('/') == wanted || port.0 == wanted
        };
        if let Some(unknown) = wanted.iter().find(|wanted| !all.iter().any(|port| is_named(port, wanted))) {
            let known: Vec<String> = all.iter().map(name_of).collect();
            let alike = did_you_mean(unknown, known.iter().map(String::as_str));
            let alike = alike.map(|alike| format!("; {alike}")).unwrap_or_default();
            let known = known.join(", ");
            return Err(format!("graph '{}' has no edge from '{unknown}'; it has: {known}{alike}", self.life.name));
        }
        let is_at_start = all.iter().all(|port| self.life.site.last_sent_at(port).is_none());
        let mut edges = Vec::new();
        for port in &all {
            if (wanted.is_empty() || wanted.iter().any(|wanted| is_named(port, wanted)))
                && let Some(input) = plan.attached_input(port, place)
            {
                let answered_slots = plan.input_slots(&port.0).collect();
                edges.push(AttachedEdge { port: name_of(port), topic: plan.topic(port), input, answered_slots });
            }
        }
        Ok(Attachment {
            domain: plan.domain().clone(),
            edges,
            graph: describe_graph(&self.life.name, nodes),
            is_at_start,
        })
    }

    /// Frees the slots of a client that has gone.
    pub(super) fn release_attached(&mut self, client: u64) {
        for idx in 0..N_ATTACHED {
            if self.attached[idx].take_if(|reader| reader.client == client).is_some() {
                self.life
                    .site
                    .plan
                    .attached_slots(idx)
                    .into_iter()
                    .for_each(|slot| self.life.site.cursors.input(slot).give_up(true));
                // It may have been killed.
                self.life.site.reap();
            }
        }
    }

    /// Tells the attached readers that all has been sent, and waits a little until they have read it and gone.
    pub(super) fn retire_attached(&mut self, should_hurry: &dyn Fn() -> bool) {
        for reader in self.attached.iter().flatten() {
            let _ = reader.reply.try_send(Reply::Drained);
        }
        let start = Instant::now();
        while self.attached.iter().any(Option::is_some) && start.elapsed() < RETIRE_LIMIT && !should_hurry() {
            // All are drained, and what happens to them now is seen when they exit.
            let _ = self.turn();
        }
    }
}

fn name_of(port: &Port) -> String {
    format!("{}/{}", port.0, port.1)
}
