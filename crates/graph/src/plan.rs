//! The readers and writers of a running graph: services, their settings, and their cursor slots.

use std::collections::{BTreeMap, BTreeSet};

use crate::control::{EdgeStatus, ShadowOutput};
use crate::dataflow::{DEFAULT_PARTNER_WAIT_MILLIS, DEFAULT_TOLERANCE_MILLIS, EdgeOptions, Graph, Node};
use blindgrasp_messages::{GraspTruth, LiftDecision, LiftOutcome, Recorded};
use blindgrasp_operator::cursors::{COMPARE_BELL, CursorsError, N_AGE_SLOTS, N_COMMAND_BELLS, RUN_BELL, SharedCursors};
use blindgrasp_operator::wiring::EdgePolicy;
use blindgrasp_operator::wiring::{
    Clock, ConsumerWiring, InputWiring, MAX_BORROWED, NamespaceWiring, OnLate, OutputWiring, ReaderWiring,
    ServiceWiring, Wiring,
};

/// An output port, as `node` and `port`.
pub type Port = (String, String);

/// Instances of a node that may be alive at a time: the active one, one that stands by, and some on their way out.
pub(super) const N_INSTANCES: usize = 4;
/// Readers of a service beyond those that the graph names: tools that attach later.
const N_SPARE_SUBSCRIBERS: usize = 4;
/// Readers of one instance of a consumer: its own, and the reader of a standby.
const N_SUBSCRIBERS_PER_INSTANCE: usize = 2;
/// The slots of an input: its own, and the histogram of its samples' ages.
const N_INPUT_SLOTS: usize = 1 + N_AGE_SLOTS;
/// This many samples may wait for the launching command, which prints and records, and for an attached reader.
const OBSERVER_CAPACITY: usize = 256;
/// This many readers, such as recorders, may be attached to a graph at a time without missing a sample.
pub const N_ATTACHED: usize = 2;

/// A writer waits this long for an attached reader that is a whole capacity behind. That is well below the 100 ms after
/// which a live hand's frames are late, so that recording a graph cannot disturb it.
pub const ATTACHED_LIMIT_MILLIS: u64 = 20;
/// A writer waits this long for the launching command, whose disk may be slow, but not for one that was stopped.
const OBSERVER_LIMIT_MILLIS: u64 = 1000;

/// The slots of a graph's nodes and ports.
pub struct Plan {
    name: String,
    domain: NamespaceWiring,
    options: PlanOptions,
    services: BTreeMap<Port, ServiceWiring>,
    output_slots: BTreeMap<Port, usize>,
    /// By the consuming node and its port.
    input_slots: BTreeMap<Port, usize>,
    observer_slots: BTreeMap<Port, usize>,
    attached_slots: BTreeMap<Port, [usize; N_ATTACHED]>,
    instance_slots: BTreeMap<String, usize>,
    /// The first node of each node's process.
    leaders: BTreeMap<String, String>,
    state_regions: BTreeMap<String, usize>,
    /// The nodes that answer each sample under the same number.
    answer_each: BTreeSet<String>,
    n_slots: usize,
    edges: Vec<PlannedEdge>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PlanOptions {
    /// How long a writer waits for a reader on a lossless edge before it fails.
    pub wait_limit_millis: u64,
    pub clock: Clock,
}

struct PlannedEdge {
    from: Port,
    /// `None` for the launching command.
    to: Option<Port>,
    options: EdgeOptions,
    feedback: bool,
    partner: bool,
}

impl Plan {
    /// Lays out a graph. `observed` are the ports that the launching command reads.
    pub fn new(
        graph: &Graph,
        name: &str,
        domain: &NamespaceWiring,
        observed: &BTreeSet<Port>,
        options: PlanOptions,
    ) -> Plan {
        let mut plan = Plan {
            name: name.into(),
            domain: domain.clone(),
            options,
            services: BTreeMap::new(),
            output_slots: BTreeMap::new(),
            input_slots: BTreeMap::new(),
            observer_slots: BTreeMap::new(),
            attached_slots: BTreeMap::new(),
            instance_slots: BTreeMap::new(),
            leaders: graph.nodes.iter().map(|node| (node.id.clone(), graph.leader(node).id.clone())).collect(),
            state_regions: BTreeMap::new(),
            answer_each: graph
                .nodes
                .iter()
                .filter(|node| node.description.answers_each)
                .map(|node| node.id.clone())
                .collect(),
            n_slots: N_COMMAND_BELLS,
            edges: Vec::new(),
        };
        for (idx, node) in graph.nodes.iter().enumerate() {
            let first = plan.take_slots(N_INSTANCES);
            plan.instance_slots.insert(node.id.clone(), first);
            plan.state_regions.insert(node.id.clone(), idx);
            for input in &node.inputs {
                let slot = plan.take_slots(N_INPUT_SLOTS);
                plan.input_slots.insert((node.id.clone(), input.port.clone()), slot);
            }
            for (from, output) in node.output_ports() {
                let slot = plan.take_slots(1);
                plan.output_slots.insert(from.clone(), slot);
                plan.add_edges(&from, &graph.nodes);
                if observed.contains(&from) {
                    let slot = plan.take_slots(N_INPUT_SLOTS);
                    plan.observer_slots.insert(from.clone(), slot);
                    let options = EdgeOptions { capacity: OBSERVER_CAPACITY, ..EdgeOptions::default() };
                    plan.edges.push(PlannedEdge {
                        from: from.clone(),
                        to: None,
                        options,
                        feedback: false,
                        partner: false,
                    });
                }
                let slots = std::array::from_fn(|_| plan.take_slots(N_INPUT_SLOTS));
                plan.attached_slots.insert(from.clone(), slots);
                let service = plan.service(&from, &output.type_name);
                plan.services.insert(from, service);
            }
        }
        plan
    }

    fn take_slots(&mut self, n: usize) -> usize {
        let first = self.n_slots;
        self.n_slots += n;
        first
    }

    /// The edges from an output to the nodes that read it.
    fn add_edges(&mut self, from: &Port, nodes: &[Node]) {
        for consumer in nodes {
            for input in &consumer.inputs {
                if (&input.from_node, &input.from_port) == (&from.0, &from.1) {
                    self.edges.push(PlannedEdge {
                        from: from.clone(),
                        to: Some((consumer.id.clone(), input.port.clone())),
                        options: input.edge,
                        feedback: input.feedback,
                        partner: input.partner,
                    });
                }
            }
        }
    }

    fn service(&self, from: &Port, type_name: &str) -> ServiceWiring {
        let edges = || self.edges.iter().filter(|edge| edge.from == *from);
        let lossless = edges().filter(|edge| edge.options.policy == EdgePolicy::Lossless);
        // At least that of an attached reader.
        let history = lossless.map(|edge| edge.options.capacity).fold(OBSERVER_CAPACITY, usize::max);
        let max_capacity = edges().map(|edge| edge.options.capacity).max().unwrap_or(1).max(history);
        let n_readers = edges().filter(|edge| edge.to.is_some()).count() * N_INSTANCES * N_SUBSCRIBERS_PER_INSTANCE;
        let n_observers = edges().filter(|edge| edge.to.is_none()).count();
        let max_subscribers = n_readers + n_observers + N_ATTACHED + N_SPARE_SUBSCRIBERS;
        ServiceWiring {
            name: format!("{}/{}/{}", self.name, from.0, from.1),
            type_name: type_name.into(),
            history,
            max_capacity,
            max_borrowed: MAX_BORROWED,
            // A dead instance's publisher counts until it is cleaned up.
            max_publishers: 2 * N_INSTANCES,
            max_subscribers,
            max_nodes: max_subscribers + 2 * N_INSTANCES,
        }
    }

    /// Makes the cursors.
    ///
    /// # Errors
    /// See [`SharedCursors::create`].
    pub fn create_cursors(&self) -> Result<SharedCursors, CursorsError> {
        let cursors = SharedCursors::create(&self.domain.cursors(), self.n_slots, self.state_regions.len())?;
        // No writer waits for a reader that is not there.
        self.attached_slots.values().flatten().for_each(|slot| cursors.input(*slot).give_up(true));
        Ok(cursors)
    }

    pub fn domain(&self) -> &NamespaceWiring {
        &self.domain
    }

    /// How the launching command reads a port; `None` if it does not.
    pub fn observer_input(&self, port: &Port) -> Option<InputWiring> {
        Some(InputWiring {
            policy: EdgePolicy::Lossless,
            capacity: OBSERVER_CAPACITY,
            slot: Some(*self.observer_slots.get(port)?),
            ..self.tool_input(port)?
        })
    }

    /// The input of an attached reader, which misses nothing once it has begun.
    pub fn attached_input(&self, port: &Port, reader: usize) -> Option<InputWiring> {
        let slot = *self.attached_slots.get(port)?.get(reader)?;
        Some(InputWiring {
            policy: EdgePolicy::Lossless,
            capacity: OBSERVER_CAPACITY,
            slot: Some(slot),
            ..self.tool_input(port)?
        })
    }

    /// The slots of an attached reader, one an edge.
    pub fn attached_slots(&self, reader: usize) -> Vec<usize> {
        self.attached_slots.values().filter_map(|slots| slots.get(reader).copied()).collect()
    }

    /// The topic of a port where a graph is recorded.
    pub fn topic(&self, port: &Port) -> String {
        topic_of(port, self.services.keys())
    }

    /// The input of a tool for which no writer waits.
    fn tool_input(&self, port: &Port) -> Option<InputWiring> {
        let service = self.services.get(port)?.clone();
        Some(InputWiring {
            policy: EdgePolicy::Latest,
            capacity: service.max_capacity,
            service,
            deadline_nanos: None,
            on_late: OnLate::Count,
            tolerance_nanos: 0,
            partner_wait_nanos: 0,
            slot: None,
            writer_slot: *self.output_slots.get(port)?,
        })
    }

    /// The outputs to compare while a replacement of a node runs in the shadow.
    pub fn shadow_outputs(&self, node: &str) -> Vec<ShadowOutput> {
        let ports = self.services.keys().filter(|(id, _)| id == node);
        ports
            .filter_map(|port| {
                let active = self.tool_input(port)?;
                let shadow = InputWiring { service: shadow_of(&active.service), ..active.clone() };
                Some(ShadowOutput { node: port.0.clone(), port: port.1.clone(), active, shadow })
            })
            .collect()
    }

    pub fn clock(&self) -> Clock {
        self.options.clock
    }

    /// The wiring of an instance of a node; `n_before` instances of it were started before.
    pub fn wiring(&self, node: &Node, n_before: usize, standby: bool) -> Option<Wiring> {
        let mut inputs = BTreeMap::new();
        for input in &node.inputs {
            let from = (input.from_node.clone(), input.from_port.clone());
            let wiring = InputWiring {
                service: self.services.get(&from)?.clone(),
                policy: input.edge.policy,
                capacity: input.edge.capacity,
                deadline_nanos: input.edge.deadline_millis.map(nanos),
                on_late: input.edge.on_late,
                tolerance_nanos: nanos(input.edge.tolerance_millis.unwrap_or(DEFAULT_TOLERANCE_MILLIS)),
                partner_wait_nanos: nanos(input.edge.partner_wait_millis.unwrap_or(DEFAULT_PARTNER_WAIT_MILLIS)),
                slot: Some(self.input_slot(&node.id, &input.port)?),
                writer_slot: *self.output_slots.get(&from)?,
            };
            inputs.insert(input.port.clone(), wiring);
        }
        let mut outputs = BTreeMap::new();
        for (from, output) in node.output_ports() {
            let service = self.services.get(&from)?.clone();
            let wiring = OutputWiring {
                shadow: shadow_of(&service),
                service,
                slot: *self.output_slots.get(&from)?,
                consumers: self.consumers(&from),
                bells: self.bells(&from),
                wait_limit_millis: self.options.wait_limit_millis,
            };
            outputs.insert(output.name.clone(), wiring);
        }
        Some(Wiring {
            graph: self.name.clone(),
            node: node.id.clone(),
            domain: self.domain.clone(),
            inputs,
            outputs,
            params: node.params.clone(),
            clock: self.options.clock,
            standby,
            instance_slot: self.instance_slot(&node.id, n_before)?,
            bell_slot: self.instance_slot(self.leaders.get(&node.id)?, n_before)?,
            wait: node.process.wait,
            lock_memory: node.process.lock_memory,
            state_region: *self.state_regions.get(&node.id)?,
            answers_each: self.relies_on_each_answer(&node.id),
            skip: Vec::new(),
            suspect: None,
            sandbox: node.sandbox,
            hosted: node.description.hosted.then(|| node.description.clone()),
        })
    }

    pub fn input_slot(&self, node: &str, port: &str) -> Option<usize> {
        self.input_slots.get(&(node.to_string(), port.to_string())).copied()
    }

    pub fn output_slot(&self, port: &Port) -> Option<usize> {
        self.output_slots.get(port).copied()
    }

    /// The slot of the `n_before + 1`th instance of a node.
    pub fn instance_slot(&self, node: &str, n_before: usize) -> Option<usize> {
        self.instance_slots.get(node).map(|first| first + n_before % N_INSTANCES)
    }

    pub fn input_slots<'a>(&'a self, node: &'a str) -> impl Iterator<Item = usize> + 'a {
        self.input_slots.iter().filter(move |((id, _), _)| id == node).map(|(_, slot)| *slot)
    }

    /// The readers that a port's writer waits for.
    pub fn consumers(&self, port: &Port) -> Vec<ConsumerWiring> {
        let edges = self.edges.iter();
        let lossless = edges.filter(|edge| edge.from == *port && edge.options.policy == EdgePolicy::Lossless);
        let own = lossless.filter_map(|edge| {
            let slot = self.reader_slot(edge)?;
            let (attached_slots, attached_limit_millis) = match edge.to {
                Some(_) => (Vec::new(), 0),
                None => (self.observer_slots.values().copied().collect(), OBSERVER_LIMIT_MILLIS),
            };
            let (capacity, behind) = (edge.options.capacity, self.behind(edge));
            Some(ConsumerWiring { slot, capacity, attached_slots, attached_limit_millis, behind })
        });
        let attached =
            self.attached_slots.get(port).into_iter().flatten().enumerate().map(|(reader, slot)| ConsumerWiring {
                slot: *slot,
                capacity: OBSERVER_CAPACITY,
                attached_slots: self.attached_slots(reader),
                attached_limit_millis: ATTACHED_LIMIT_MILLIS,
                behind: Vec::new(),
            });
        own.chain(attached).collect()
    }

    /// The slots whose bells a port's writer rings: those of all instances of its readers' processes, and of commands that read
    /// it. A bell may let its reader run at once, before the next one is rung. So lossless readers come first, then the
    /// launching command, then readers with `latest`, such as those that publish to a network and take longer. The bell of an
    /// instance that is not there stays rung, and costs nothing.
    fn bells(&self, port: &Port) -> Vec<usize> {
        let slots_of = |nodes: &BTreeSet<&String>| -> Vec<usize> {
            let firsts = nodes.iter().filter_map(|node| self.instance_slots.get(*node));
            firsts.flat_map(|first| *first..first + N_INSTANCES).collect()
        };
        let readers = |policy: EdgePolicy| {
            let edges = self.edges.iter().filter(move |edge| edge.from == *port && edge.options.policy == policy);
            edges.filter_map(|edge| self.leaders.get(&edge.to.as_ref()?.0))
        };
        let lossless: BTreeSet<&String> = readers(EdgePolicy::Lossless).collect();
        let latest: BTreeSet<&String> = readers(EdgePolicy::Latest).filter(|node| !lossless.contains(node)).collect();
        let is_run_waiting = self.observer_slots.contains_key(port)
            && self.services.get(port).is_some_and(|service| is_needed(&service.type_name));
        let run = if is_run_waiting { vec![RUN_BELL] } else { Vec::new() };
        [slots_of(&lossless), run, slots_of(&latest), vec![COMPARE_BELL]].concat()
    }

    /// The slots of a port's lossless readers and of those behind them.
    pub fn reader_slots(&self, port: &Port) -> Vec<usize> {
        fn collect(readers: &[ReaderWiring], slots: &mut Vec<usize>) {
            for reader in readers {
                slots.push(reader.slot);
                collect(&reader.behind, slots);
            }
        }
        let mut slots = Vec::new();
        for consumer in self.consumers(port) {
            slots.push(consumer.slot);
            collect(&consumer.behind, &mut slots);
        }
        slots
    }

    /// Whether the nodes before this one count on its answering each sample under the same number.
    pub fn relies_on_each_answer(&self, node: &str) -> bool {
        self.answer_each.contains(node)
    }

    /// The readers of the answers of an edge's reader, if it answers each sample under the same number.
    fn behind(&self, edge: &PlannedEdge) -> Vec<ReaderWiring> {
        // Answers have the numbers of the main input, and not those of a partner.
        let to = if edge.partner { None } else { edge.to.as_ref() };
        let Some((node, _)) = to.filter(|(node, _)| self.answer_each.contains(node)) else {
            return Vec::new();
        };
        // The launching command is given up like an attached reader: no source waits for it.
        let next = self.edges.iter().filter(|next| {
            let is_waited_for = next.options.policy == EdgePolicy::Lossless && !next.feedback && next.to.is_some();
            next.from.0 == *node && is_waited_for
        });
        let readers = next.filter_map(|next| {
            let (slot, writer_slot) = (self.reader_slot(next)?, *self.output_slots.get(&next.from)?);
            Some(ReaderWiring { slot, writer_slot, behind: self.behind(next) })
        });
        readers.collect()
    }

    fn reader_slot(&self, edge: &PlannedEdge) -> Option<usize> {
        match &edge.to {
            Some(to) => self.input_slots.get(to).copied(),
            None => self.observer_slots.get(&edge.from).copied(),
        }
    }

    /// The counts of each edge; `has_ended` when no sample is on its way any more.
    pub fn edges(&self, cursors: &SharedCursors, has_ended: bool) -> Vec<EdgeStatus> {
        let statuses = self.edges.iter().filter_map(|edge| {
            let output = cursors.output(*self.output_slots.get(&edge.from)?);
            let reader_slot = self.reader_slot(edge)?;
            let slot = cursors.input(reader_slot);
            // The reader first: what it has received was sent before.
            let (received, key) = (slot.counts(), slot.key());
            let (sent, sent_key) = (output.n_sent(), output.key());
            // While samples are on their way only missing numbers tell of a loss; at the end, the difference does.
            // Feedback may come after its reader has finished.
            let is_at_rest = (has_ended && !edge.feedback) || key == sent_key || slot.is_given_up();
            let dropped = if is_at_rest { sent.saturating_sub(received.n_received) } else { 0 };
            Some(EdgeStatus {
                from: format!("{}/{}", edge.from.0, edge.from.1),
                to: edge.to.as_ref().map_or("run".into(), |(node, port)| format!("{node}/{port}")),
                policy: edge.options.policy,
                capacity: edge.options.capacity,
                sent,
                received: received.n_received,
                dropped,
                missing: received.n_missing,
                repeated: received.n_repeated,
                reordered: received.n_reordered,
                late: received.n_late,
                blocked_nanos: output.blocked_nanos(),
                ages: cursors.ages(reader_slot).read(),
            })
        });
        statuses.collect()
    }
}

/// The topic of a port among all output ports of its graph: its own name, with its node's before it where another one
/// bears the same.
pub fn topic_of<'a>(port: &Port, all: impl IntoIterator<Item = &'a Port>) -> String {
    let n_of_that_name = all.into_iter().filter(|other| other.1 == port.1).count();
    if n_of_that_name == 1 { format!("/{}", port.1) } else { format!("/{}/{}", port.0, port.1) }
}

fn nanos(millis: f64) -> u64 {
    (millis * 1e6) as u64
}

/// The service on which a standby publishes its answers while another instance is active.
fn shadow_of(service: &ServiceWiring) -> ServiceWiring {
    ServiceWiring { name: format!("{}~shadow", service.name), ..service.clone() }
}

/// Whether every run reads edges of this type: decisions and the summary come from them.
pub fn is_needed(type_name: &str) -> bool {
    [LiftDecision::TYPE_NAME, GraspTruth::TYPE_NAME, LiftOutcome::TYPE_NAME].contains(&type_name)
}
