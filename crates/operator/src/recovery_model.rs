//! A search through the histories of a chain of operators (docs/operators.md): a source, a stage without state, a stage with
//! state, a sink. Processes are killed between any two of their stores, nodes are swapped, connections come about late, dead
//! publishers take their samples with them, and the source changes its epoch.
//!
//! The decisions are those of the operators: [`Credit`], [`Sequencer`], [`Written`], [`Kept`] and [`Retained`] are called here
//! as there. Each fix of a loss can be left out; the search then finds the loss.

use std::collections::{HashSet, VecDeque};
use std::hash::{Hash, Hasher};
use std::time::{Duration, Instant};

use crate::credit::{Credit, Places};
use crate::cursors::SampleId;
use crate::outbox::{Kept, Keyed};
use crate::partner::Retained;
use crate::sequencer::{Placing, Sequencer};
use crate::wiring::{ConsumerWiring, InputCounts, ReaderWiring};
use crate::written::Written;

/// The samples of the source. The epochs are not in the order of their values.
const SAMPLES: [SampleId; 3] = [id(8, 0), id(3, 0), id(3, 1)];
/// The samples that a reader may leave unanswered, and that a publisher keeps.
const CAPACITY: usize = 2;
/// The answers that fit beside a state.
const N_SAVED: usize = 1;

const SOURCE: usize = 0;
const STATELESS: usize = 1;
const STATEFUL: usize = 2;
const SINK: usize = 3;

const fn id(epoch: u64, seq: u64) -> SampleId {
    SampleId { epoch, seq }
}

/// A fix that is left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Without {
    Nothing,
    /// A writer keeps the samples that the readers of its reader have not answered.
    KeepsForReadersBehind,
    /// A stage with state keeps its answers until its reader has answered them.
    KeepsAnswers,
    /// L1: a stage with state waits where its answers do not fit beside its state.
    WaitsForRoom,
    /// L2: epochs have an order.
    OrderOfEpochs,
    /// L3: an instance begins again if the one that has handed over to it ended too early.
    LostPredecessor,
    /// L4: a connection that could not be made is tried again.
    ConnectsAgain,
    /// L8: an instance says whether it has sent everything when it hands over.
    HasSentAll,
}

/// What may happen besides the work of the processes.
#[derive(Debug, Clone, Copy)]
struct Budget {
    n_kills: u8,
    n_swaps: u8,
    n_late: u8,
    /// The only node that is killed, swapped or connected late, if not all are.
    node: Option<usize>,
    /// A process is killed together with its reader.
    kills_pairs: bool,
    /// The reader of that node is killed as well, at any time.
    kills_reader: bool,
    /// The sample that the stage without state leaves unanswered.
    skipped: Option<SampleId>,
    /// The source has no sample twice: a new instance goes on with the next epoch.
    is_live: bool,
}

/// A sample on its way, with the process that has decided it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Sample {
    key: SampleId,
    decided_by: u8,
}

impl Keyed for Sample {
    fn key(&self) -> SampleId {
        self.key
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Process {
    id: u8,
    credit: Credit,
    /// The newest samples that it has sent.
    history: VecDeque<Sample>,
    /// The samples that have come and were not taken, by publisher.
    queues: Vec<(u8, VecDeque<Sample>)>,
    /// A publisher to which no connection came about yet.
    unconnected: Option<u8>,
    sequencer: Sequencer<Sample>,
    /// It has done nothing yet.
    is_new: bool,
    /// Its place between two stores.
    place: u8,
    /// The sample that it works on.
    sample: Option<Sample>,
    /// Of a source: the next of its samples.
    next: usize,
    /// Of a stage with state.
    kept: Kept<Sample>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
struct Node {
    active: Option<Process>,
    /// The one that has handed over, until its samples are answered.
    old: Option<Process>,
}

/// The cursors, by node.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
struct Slots {
    /// The last sample that a reader has answered.
    answered: [Option<SampleId>; 4],
    written: [Option<Written>; 3],
}

impl Places for Slots {
    fn answered(&self, slot: usize) -> Option<SampleId> {
        self.answered[slot]
    }

    fn sent(&self, slot: usize) -> Option<SampleId> {
        self.written[slot].map(|written| written.last)
    }

    /// No source of these worlds repeats a number.
    fn n_repeated(&self, _: usize) -> u64 {
        0
    }

    fn is_given_up(&self, _: usize) -> bool {
        false
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct World {
    nodes: [Node; 4],
    slots: Slots,
    counts: [InputCounts; 4],
    /// The saved state of the stage with state: the last sample that it includes, its counts, and its answers.
    saved: Option<(Option<SampleId>, InputCounts, VecDeque<Sample>)>,
    heard: Vec<Sample>,
    decided: Vec<Sample>,
    /// The processes that each node has had.
    n_processes: [u8; 4],
    n_kills: u8,
    n_swaps: u8,
    n_late: u8,
    broken: Option<String>,
}

/// A hash of 128 bits: worlds are known by it, so that millions of them take little memory.
struct Fingerprint(u64, u64);

impl Hasher for Fingerprint {
    fn write(&mut self, bytes: &[u8]) {
        for chunk in bytes.chunks(8) {
            let mut word = [0; 8];
            word[..chunk.len()].copy_from_slice(chunk);
            self.write_u64(u64::from_ne_bytes(word));
        }
    }

    fn write_u64(&mut self, word: u64) {
        self.0 = (self.0.rotate_left(5) ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.1 = (self.1 ^ word).wrapping_mul(0xc2b2_ae3d_27d4_eb4f).rotate_left(31);
    }

    fn finish(&self) -> u64 {
        self.0
    }
}

fn fingerprint(world: &World) -> (u64, u64) {
    let mut hasher = Fingerprint(1, 2);
    world.hash(&mut hasher);
    (hasher.0, hasher.1)
}

/// The rules and the time of a search.
struct Search {
    without: Without,
    budget: Budget,
    now: Instant,
}

impl Search {
    fn new(without: Without, budget: Budget) -> Search {
        Search { without, budget, now: Instant::now() }
    }

    fn credit(&self, node: usize) -> Credit {
        let is_chained = node == SOURCE && self.without != Without::KeepsForReadersBehind;
        let behind = if is_chained {
            vec![ReaderWiring { slot: STATEFUL, writer_slot: STATELESS, behind: vec![] }]
        } else {
            vec![]
        };
        let reader = ConsumerWiring {
            slot: node + 1,
            capacity: CAPACITY,
            attached_slots: vec![],
            attached_limit_millis: 0,
            behind,
        };
        Credit::new(if node == SINK { &[] } else { std::slice::from_ref(&reader) }, CAPACITY)
    }

    /// How far the writer before a node has come, as far as its reader knows.
    fn known_to_reader(&self, world: &World, node: usize) -> Option<Written> {
        if self.without == Without::OrderOfEpochs { None } else { world.slots.written[node - 1] }
    }

    fn begin(&self) -> World {
        let mut world = World {
            nodes: Default::default(),
            slots: Slots::default(),
            counts: Default::default(),
            saved: None,
            heard: Vec::new(),
            decided: Vec::new(),
            n_processes: [0; 4],
            n_kills: 0,
            n_swaps: 0,
            n_late: 0,
            broken: None,
        };
        for node in 0..4 {
            self.start(&mut world, node, false);
        }
        world
    }

    /// Starts a process in place of the active one, which is gone or has handed over.
    fn start(&self, world: &mut World, node: usize, is_handed_over: bool) {
        let mut process = Process {
            id: node as u8 * 16 + world.n_processes[node],
            credit: self.credit(node),
            history: VecDeque::new(),
            queues: Vec::new(),
            unconnected: None,
            is_new: self.budget.n_late > 0,
            sequencer: Sequencer::onlooker(),
            place: 0,
            sample: None,
            next: 0,
            kept: Kept::default(),
        };
        world.n_processes[node] += 1;
        if node > SOURCE {
            let writer = &world.nodes[node - 1];
            for publisher in writer.old.iter().chain(&writer.active) {
                process.queues.push((publisher.id, publisher.history.clone()));
            }
        }
        self.take_over(world, node, &mut process, is_handed_over);
        // Its readers connect to it.
        if node < SINK {
            let readers = &mut world.nodes[node + 1];
            for reader in readers.old.iter_mut().chain(&mut readers.active) {
                reader.queues.push((process.id, VecDeque::new()));
            }
        }
        world.nodes[node].active = Some(process);
    }

    /// As a stage, a source or a sink takes over.
    fn take_over(&self, world: &mut World, node: usize, process: &mut Process, is_handed_over: bool) {
        let taken = process.sample.take();
        process.place = 0;
        let known = if node == SINK {
            world.slots.answered[SINK]
        } else {
            process.credit.begin(is_handed_over, &world.slots, world.slots.written[node])
        };
        let counts = world.counts[node];
        let sequencer = match node {
            SOURCE => {
                let known = match world.slots.written[SOURCE] {
                    Some(written) if self.budget.is_live && !is_handed_over => {
                        SAMPLES.iter().rposition(|key| key.epoch == written.last.epoch)
                    }
                    _ => known.and_then(|known| SAMPLES.iter().position(|key| *key == known)),
                };
                process.next = known.map_or(0, |known| known + 1);
                return;
            }
            STATEFUL => {
                let (last, counts, answers) = world.saved.clone().unwrap_or_default();
                (world.slots.answered[node], world.counts[node]) = (last, counts);
                process.kept = Kept::restored(answers, known);
                process.place = 1;
                Sequencer::resume(last, last, counts)
            }
            _ => Sequencer::resume(known, world.slots.answered[node], counts),
        };
        let written = self.known_to_reader(world, node);
        let sequencer = sequencer.beginning_at(self.now, written.map(|written| written.last));
        let before = std::mem::replace(&mut process.sequencer, sequencer);
        let put_back = taken.map(|sample| (sample.key, sample));
        process.sequencer.hold_again(before, put_back, written.as_ref(), self.now);
    }

    /// The first of two steps of sending.
    fn count(&self, world: &mut World, node: usize, key: SampleId) {
        let next = Written::with(world.slots.written[node], key);
        let is_broken = self.without == Without::OrderOfEpochs
            && world.slots.written[node].is_some_and(|written| written.last.epoch != key.epoch);
        if is_broken {
            world.slots.written[node] = Some(Written { last: key, first_seq: 0, before: None });
        } else {
            world.slots.written[node] = next.or(world.slots.written[node]);
        }
    }

    /// The second step.
    fn push(&self, world: &mut World, node: usize, sample: Sample) {
        if node == STATEFUL && !world.decided.contains(&sample) {
            world.decided.push(sample);
            world.decided.sort_by_key(|sample| (sample.key.epoch, sample.key.seq, sample.decided_by));
        }
        let Some(process) = &mut world.nodes[node].active else { return };
        process.history.push_back(sample);
        if process.history.len() > CAPACITY {
            process.history.pop_front();
        }
        process.credit.has_sent(sample.key);
        let publisher = process.id;
        let readers = &mut world.nodes[node + 1];
        for reader in readers.old.iter_mut().chain(&mut readers.active) {
            let queue = reader.queues.iter_mut().find(|(id, _)| *id == publisher && reader.unconnected != Some(*id));
            if let Some((_, queue)) = queue {
                queue.push_back(sample);
            }
        }
    }

    /// The worlds after a node has tried to take a sample.
    fn take(&self, world: &World, node: usize) -> Vec<World> {
        let mut worlds = Vec::new();
        let Some(process) = &world.nodes[node].active else { return worlds };
        let mut next = world.clone();
        if let Some(active) = &mut next.nodes[node].active
            && let Some(sample) = active.sequencer.next_in_order()
        {
            active.sample = Some(sample);
            return vec![next];
        }
        let written = self.known_to_reader(world, node);
        let has_others = world.nodes[node - 1].active.is_some() && world.nodes[node - 1].old.is_some();
        for (at, (publisher, queue)) in process.queues.iter().enumerate() {
            if queue.is_empty() {
                continue;
            }
            let mut next = world.clone();
            let Some(active) = &mut next.nodes[node].active else { continue };
            let Some(sample) = active.queues[at].1.pop_front() else { continue };
            let publisher = u128::from(*publisher);
            let placing =
                active.sequencer.push(sample, sample.key, publisher, written.as_ref(), || has_others, || self.now);
            if let Placing::Deliver(sample) = placing {
                active.sample = Some(sample);
            }
            worlds.push(next);
        }
        worlds
    }

    /// The worlds after one step of a node's active process.
    fn step(&self, world: &World, node: usize) -> Vec<World> {
        let Some(process) = &world.nodes[node].active else { return Vec::new() };
        let mut next = world.clone();
        match (node, process.place, process.sample) {
            (SOURCE, 0, _) => {
                let Some(key) = SAMPLES.get(process.next) else { return Vec::new() };
                if !self.has_room(&mut next, node, *key) {
                    return self.wait_long(world, node).into_iter().collect();
                }
                self.count(&mut next, node, *key);
                self.move_on(&mut next, node, 1);
            }
            (SOURCE, ..) => {
                self.push(&mut next, node, Sample { key: SAMPLES[process.next], decided_by: 0 });
                self.move_on(&mut next, node, 0);
                next.nodes[node].active.iter_mut().for_each(|process| process.next += 1);
            }
            (STATELESS | SINK, 0, None) => return self.take(world, node),
            (SINK, _, Some(sample)) => {
                next.heard.push(sample);
                self.commit(&mut next, node, sample.key);
            }
            (STATELESS, 0, Some(sample)) if self.budget.skipped == Some(sample.key) => {
                self.commit(&mut next, node, sample.key);
            }
            (STATELESS, 0, Some(sample)) => {
                if !self.has_room(&mut next, node, sample.key) {
                    return self.wait_long(world, node).into_iter().collect();
                }
                self.count(&mut next, node, sample.key);
                self.move_on(&mut next, node, 1);
            }
            (STATELESS, 1, Some(sample)) => {
                self.push(&mut next, node, sample);
                self.move_on(&mut next, node, 2);
            }
            (STATELESS, _, Some(sample)) => self.commit(&mut next, node, sample.key),
            (STATEFUL, 0, None) => return self.take(world, node),
            (STATEFUL, 0, Some(sample)) => return self.save(world, sample).into_iter().collect(),
            // It sends its answers, each in two steps, and then commits the sample.
            (STATEFUL, 1, _) => {
                let Some(answer) = process.kept.next().copied() else {
                    match process.sample {
                        Some(sample) => self.commit(&mut next, node, sample.key),
                        None => self.move_on(&mut next, node, 0),
                    }
                    return vec![next];
                };
                if !self.has_room(&mut next, node, answer.key) {
                    return self.wait_long(world, node).into_iter().collect();
                }
                self.count(&mut next, node, answer.key);
                self.move_on(&mut next, node, 2);
            }
            (STATEFUL, ..) => {
                let Some(answer) = process.kept.next().copied() else { return Vec::new() };
                self.push(&mut next, node, answer);
                self.move_on(&mut next, node, 1);
                next.nodes[node].active.iter_mut().for_each(|process| process.kept.has_sent_next());
            }
            _ => return Vec::new(),
        }
        vec![next]
    }

    /// Computes an answer and saves it; `None` while there is no room.
    fn save(&self, world: &World, sample: Sample) -> Option<World> {
        let mut next = world.clone();
        let written = world.slots.written[STATEFUL];
        let process = next.nodes[STATEFUL].active.as_mut()?;
        let answered = process.credit.answered_by_readers(&world.slots, written);
        drop(process.kept.forget(true, answered));
        process.kept.push(Sample { decided_by: process.id, ..sample });
        if self.without == Without::KeepsAnswers {
            process.kept = Kept::default();
            process.kept.push(Sample { decided_by: process.id, ..sample });
        }
        if process.kept.entries().len() > N_SAVED {
            if self.without == Without::WaitsForRoom {
                next.broken = Some("a stage with state fails: its answers do not fit".into());
                return Some(next);
            }
            return None;
        }
        process.place = 1;
        next.saved = Some((Some(sample.key), process.sequencer.counts(), process.kept.entries().clone()));
        Some(next)
    }

    fn has_room(&self, world: &mut World, node: usize, key: SampleId) -> bool {
        let written = world.slots.written[node];
        let (nodes, slots) = (&mut world.nodes, &world.slots);
        let active = nodes[node].active.as_mut();
        active.is_some_and(|process| process.credit.first_without_room(slots, written, key).is_none())
    }

    fn move_on(&self, world: &mut World, node: usize, place: u8) {
        world.nodes[node].active.iter_mut().for_each(|process| process.place = place);
    }

    /// Marks a sample as answered.
    fn commit(&self, world: &mut World, node: usize, key: SampleId) {
        let is_ahead = Written::is_after(self.known_to_reader(world, node), key, world.slots.answered[node]);
        if let Some(process) = &mut world.nodes[node].active {
            world.counts[node] = process.sequencer.counts();
            (process.place, process.sample) = (0, None);
        }
        if is_ahead {
            world.slots.answered[node] = Some(key);
        }
    }

    /// The worlds after the active or the old process of a node has ended; its samples stay with the readers or vanish.
    fn end(&self, world: &World, node: usize, is_old: bool) -> [World; 2] {
        let mut stays = world.clone();
        let place = if is_old { &mut stays.nodes[node].old } else { &mut stays.nodes[node].active };
        let ended = place.take().map(|process| process.id);
        let mut vanish = stays.clone();
        if node < SINK {
            for next in [&mut stays, &mut vanish] {
                let readers = &mut next.nodes[node + 1];
                for reader in readers.old.iter_mut().chain(&mut readers.active) {
                    reader.unconnected = reader.unconnected.filter(|id| Some(*id) != ended);
                }
            }
            let readers = &mut vanish.nodes[node + 1];
            for reader in readers.old.iter_mut().chain(&mut readers.active) {
                reader.queues.retain(|(publisher, _)| Some(*publisher) != ended);
            }
        }
        [stays, vanish]
    }

    /// The restart of a node whose active process has ended, or the return to the old one.
    fn restart(&self, world: &World, node: usize) -> Vec<World> {
        let mut worlds = Vec::new();
        let mut next = world.clone();
        self.start(&mut next, node, false);
        worlds.push(next);
        let mut next = world.clone();
        if let Some(mut old) = next.nodes[node].old.take() {
            self.take_over(&mut next, node, &mut old, false);
            next.nodes[node].active = Some(old);
            worlds.push(next);
        }
        worlds
    }

    fn swap(&self, world: &World, node: usize) -> Option<World> {
        let mut next = world.clone();
        let old = next.nodes[node].active.take()?;
        next.n_swaps += 1;
        let has_sent_all = node == SINK || old.credit.has_sent_all(world.slots.written[node]);
        next.nodes[node].old = Some(old);
        // The old one stands by until what it has sent is answered: see `may_leave`.
        self.start(&mut next, node, has_sent_all || self.without == Without::HasSentAll);
        Some(next)
    }

    /// Whether the samples of an old instance are answered.
    fn may_leave(&self, world: &World, node: usize) -> bool {
        let Some(old) = &world.nodes[node].old else { return false };
        let Some(last) = old.history.back() else { return true };
        let Some(written) = world.slots.written.get(node).copied().flatten() else { return true };
        let readers = if node == SOURCE { node + 1..STATEFUL + 1 } else { node + 1..node + 2 };
        readers.into_iter().all(|slot| world.slots.answered[slot].is_some_and(|key| written.is_past(key, last.key)))
    }

    /// All worlds that may come next, and whether something moves by itself in one of them.
    fn next(&self, world: &World) -> (Vec<World>, bool) {
        let mut worlds = Vec::new();
        for node in 0..4 {
            if world.nodes[node].active.is_none() {
                worlds.extend(self.restart(world, node));
                continue;
            }
            worlds.extend(self.step(world, node).into_iter().map(|mut next| {
                next.nodes[node].active.iter_mut().for_each(|process| process.is_new = false);
                next
            }));
            worlds.extend(self.look(world, node));
            if self.may_leave(world, node) {
                worlds.extend(self.end(world, node, true));
            }
            worlds.extend(self.connect_again(world, node));
        }
        let mut moves = !worlds.is_empty();
        if !moves {
            // Time passes: early samples are delivered, and those before them are missing.
            let later = self.now + Duration::from_secs(3600);
            for node in 1..4 {
                let mut next = world.clone();
                if let Some(process) = &mut next.nodes[node].active
                    && process.sample.is_none()
                    && let Some(sample) = process.sequencer.next_overdue(later)
                {
                    process.sample = Some(sample);
                    worlds.push(next);
                    moves = true;
                }
            }
        }
        for node in 0..4 {
            let is_meant = self.budget.node.is_none_or(|only| only == node);
            let is_its_reader = self.budget.node.is_some_and(|only| only + 1 == node);
            if !(is_meant || self.budget.kills_reader && is_its_reader) {
                continue;
            }
            let is_alive = [world.nodes[node].old.is_some(), world.nodes[node].active.is_some()];
            if world.n_kills < self.budget.n_kills {
                for is_old in [true, false].into_iter().filter(|is_old| is_alive[usize::from(!is_old)]) {
                    if self.budget.kills_pairs {
                        // Of a swap, the old instance.
                        if is_old || self.budget.n_swaps == 0 {
                            let [_, next] = self.end(world, node, is_old);
                            let [_, next] = self.end(&next, node + 1, false);
                            worlds.push(World { n_kills: self.budget.n_kills, ..next });
                        }
                        continue;
                    }
                    let [stays, vanish] = self.end(world, node, is_old);
                    // Samples of the dead that stay for a while only add copies: they are tried with one kill and no swap.
                    let are_many = self.budget.n_kills > 1 || self.budget.n_swaps > 0;
                    let ends = if are_many { vec![vanish] } else { vec![stays, vanish] };
                    worlds.extend(ends.into_iter().map(|next| World { n_kills: world.n_kills + 1, ..next }));
                }
            }
            // A node is swapped between two samples, or while it waits for room.
            let is_idle = world.nodes[node]
                .active
                .as_ref()
                .is_some_and(|process| process.place == 0 || (node == STATEFUL && process.place == 1));
            if world.n_swaps < self.budget.n_swaps && is_meant && is_idle && !is_alive[0] {
                worlds.extend(self.swap(world, node));
            }
            if world.n_late < self.budget.n_late && node > SOURCE {
                worlds.extend(self.lose_connection(world, node));
            }
        }
        (worlds, moves)
    }

    /// The active process has waited for its readers for seconds.
    fn wait_long(&self, world: &World, node: usize) -> Option<World> {
        let mut next = world.clone();
        let written = *world.slots.written.get(node)?;
        let n_publishers = 1 + usize::from(world.nodes[node].old.is_some());
        next.nodes[node].active.as_mut()?.credit.has_waited_long(&world.slots, written, n_publishers);
        (next.nodes[node] != world.nodes[node]).then_some(next)
    }

    /// The active process ends if its readers lack samples that only its predecessor had.
    fn look(&self, world: &World, node: usize) -> Option<World> {
        if node == SINK {
            return None;
        }
        let process = world.nodes[node].active.as_ref()?;
        // It also finds, later and with a restart, what was not sent when an instance handed over.
        if matches!(self.without, Without::LostPredecessor | Without::HasSentAll) {
            return None;
        }
        let n_publishers = 1 + usize::from(world.nodes[node].old.is_some());
        process.credit.lost_predecessor(&world.slots, world.slots.written[node], n_publishers)?;
        let [_, next] = self.end(world, node, false);
        Some(next)
    }

    /// The connection of a reader that has just begun to its writer has failed.
    fn lose_connection(&self, world: &World, node: usize) -> Option<World> {
        let writer = world.nodes[node - 1].active.as_ref()?;
        let mut next = world.clone();
        next.n_late += 1;
        let reader = next.nodes[node].active.as_mut()?;
        if !(reader.is_new || writer.is_new) || reader.unconnected.is_some() {
            return None;
        }
        let writer = writer.id;
        reader.unconnected = Some(writer);
        reader.queues.iter_mut().filter(|(id, _)| *id == writer).for_each(|(_, queue)| queue.clear());
        Some(next)
    }

    fn connect_again(&self, world: &World, node: usize) -> Option<World> {
        let writer = world.nodes[node].active.as_ref()?.unconnected?;
        if self.without == Without::ConnectsAgain {
            return None;
        }
        let mut next = world.clone();
        let before = &world.nodes[node - 1];
        let history = before.active.iter().chain(&before.old).find(|publisher| publisher.id == writer)?.history.clone();
        let reader = next.nodes[node].active.as_mut()?;
        reader.unconnected = None;
        reader.sequencer.has_reconnected();
        reader.queues.iter_mut().filter(|(id, _)| *id == writer).for_each(|(_, queue)| *queue = history.clone());
        Some(next)
    }

    /// Prints the worlds on a path of choices.
    fn print(&self, path: &[usize]) {
        let key = |key: Option<SampleId>| key.map_or("-".into(), |key| format!("{}.{}", key.epoch, key.seq));
        let process = |process: &Process| {
            let queues = process.queues.iter().map(|(id, queue)| {
                let keys: Vec<String> = queue.iter().map(|sample| key(Some(sample.key))).collect();
                format!("from {id}: {}", keys.join(" "))
            });
            let queues: Vec<String> = queues.collect();
            let at = key(process.sample.map(|sample| sample.key));
            format!("process {} in place {} at {at}, {}", process.id, process.place, queues.join(", "))
        };
        let mut world = self.begin();
        for choice in path {
            world = self.next(&world).0.swap_remove(*choice);
            println!();
            for (idx, node) in world.nodes.iter().enumerate() {
                let processes: Vec<String> = node.active.iter().chain(&node.old).map(process).collect();
                let written = world.slots.written.get(idx).copied().flatten().map(|written| written.last);
                let (answered, counts) = (key(world.slots.answered[idx]), world.counts[idx]);
                println!("{idx}: {}; answered {answered}, sent {}, {counts:?}", processes.join("; "), key(written));
            }
        }
    }

    /// The broken promise of a world, if there is one.
    fn broken(&self, world: &World) -> Option<String> {
        let numbers: Vec<SampleId> = world.heard.iter().map(|sample| sample.key).collect();
        let mut expected = self.answered_samples();
        let is_right = if self.budget.is_live {
            numbers.iter().all(|key| expected.any(|expected| expected == *key))
        } else {
            numbers.iter().all(|key| expected.next() == Some(*key))
        };
        if !is_right {
            return Some(format!("the sink has heard {numbers:?}"));
        }
        if world.decided.windows(2).any(|pair| pair[0].key == pair[1].key) {
            return Some(format!("a sample was decided twice: {:?}", world.decided));
        }
        let n_missing = if self.budget.is_live { u64::MAX } else { self.budget.skipped.is_some().into() };
        if let Some(node) = (1..4).find(|node| world.counts[*node].n_missing > n_missing) {
            return Some(format!("node {node} counts samples as missing: {:?}", world.counts[node]));
        }
        if let Some(node) = (1..4).find(|node| world.counts[*node].n_received > SAMPLES.len() as u64) {
            return Some(format!("node {node} counts samples twice: {:?}", world.counts[node]));
        }
        world.broken.clone()
    }

    /// The samples that the stage without state answers.
    fn answered_samples(&self) -> impl Iterator<Item = SampleId> {
        SAMPLES.into_iter().filter(|key| self.budget.skipped != Some(*key))
    }

    /// Whether everything was heard that is to be heard.
    fn is_done(&self, world: &World) -> bool {
        if !self.budget.is_live {
            return world.heard.len() == self.answered_samples().count();
        }
        let last = SAMPLES[SAMPLES.len() - 1];
        let source = world.nodes[SOURCE].active.as_ref();
        let was_sent = source.and_then(|source| source.history.back()).is_some_and(|sample| sample.key == last);
        let was_heard = world.heard.last().is_some_and(|sample| sample.key == last);
        source.is_some_and(|source| source.next == SAMPLES.len()) && was_heard >= was_sent
    }

    /// The number of worlds that can be reached.
    ///
    /// # Errors
    /// A promise is broken in one of them: how, and the choices that lead there.
    fn run(&self) -> Result<usize, (String, Vec<usize>)> {
        let begin = self.begin();
        let mut found = HashSet::from([fingerprint(&begin)]);
        let mut open = vec![(begin, Vec::<usize>::new())];
        while let Some((world, path)) = open.pop() {
            if let Some(broken) = self.broken(&world) {
                return Err((broken, path));
            }
            let (next, moves) = self.next(&world);
            if !moves && !self.is_done(&world) {
                return Err((format!("stuck after {:?}", world.heard), path));
            }
            for (idx, next) in next.into_iter().enumerate() {
                if found.insert(fingerprint(&next)) {
                    open.push((next, [&path[..], &[idx]].concat()));
                }
            }
        }
        Ok(found.len())
    }
}

const KILLS: Budget = Budget {
    n_kills: 2,
    n_swaps: 0,
    n_late: 0,
    node: None,
    kills_pairs: false,
    kills_reader: false,
    skipped: None,
    is_live: false,
};
const SWAP: Budget = Budget { n_kills: 1, n_swaps: 1, ..KILLS };
const LATE: Budget = Budget { n_kills: 1, n_late: 1, ..KILLS };
const ALL_OF_ONE: Budget = Budget { n_swaps: 1, node: Some(STATELESS), ..LATE };
const PAIR_OF_SWAP: Budget = Budget { n_swaps: 1, kills_pairs: true, node: Some(STATELESS), ..KILLS };
const LIVE: Budget = Budget { n_kills: 1, kills_pairs: true, node: Some(SOURCE), is_live: true, ..KILLS };

fn assert_whole(budgets: &[Budget]) {
    for budget in budgets {
        let (begin, search) = (Instant::now(), Search::new(Without::Nothing, *budget));
        match search.run() {
            Ok(n_worlds) => println!("{budget:?}: {n_worlds} worlds in {:?}", begin.elapsed()),
            Err((broken, path)) => {
                search.print(&path);
                panic!("{budget:?}: {broken}");
            }
        }
    }
}

#[test]
fn kills_swaps_and_late_connections_lose_and_repeat_nothing() {
    let swap_of = |node| Budget { node: Some(node), ..SWAP };
    assert_whole(&[Budget { n_kills: 1, ..KILLS }, swap_of(SOURCE), swap_of(STATELESS), swap_of(STATEFUL), LATE]);
}

/// F1, F3: the only instance that has samples ends together with their reader, and a sample is left without an answer.
#[test]
fn an_old_instance_may_end_with_its_reader_and_an_epoch_may_lack_its_end() {
    let skips = SAMPLES.map(|key| Budget { n_kills: 1, skipped: Some(key), ..KILLS });
    assert_whole(&[LIVE, PAIR_OF_SWAP, skips[0], skips[1]]);
}

/// Minutes: two kills of any nodes, a swap of any node with a kill of any other, and a swap of a node with two kills of it and
/// its reader.
#[test]
#[ignore = "takes minutes: cargo test --release --workspace --lib recovery_model -- --ignored"]
fn more_kills_and_swaps_of_all_nodes_lose_and_repeat_nothing() {
    let two_kills_and_a_swap = Budget { kills_pairs: false, kills_reader: true, ..PAIR_OF_SWAP };
    assert_whole(&[KILLS, SWAP, ALL_OF_ONE, two_kills_and_a_swap]);
}

#[test]
fn the_search_finds_each_loss_whose_fix_is_left_out() {
    for (without, budget) in [
        (Without::KeepsForReadersBehind, KILLS),
        (Without::KeepsAnswers, KILLS),
        (Without::WaitsForRoom, KILLS),
        (Without::OrderOfEpochs, KILLS),
        (Without::LostPredecessor, PAIR_OF_SWAP),
        (Without::ConnectsAgain, LATE),
        (Without::HasSentAll, ALL_OF_ONE),
    ] {
        let (broken, path) = Search::new(without, budget).run().expect_err("a loss");
        println!("{without:?}: {broken} after {} steps", path.len());
    }
}

/// L5: the writer of a partner input dies together with the reader, at any time.
#[test]
fn a_partner_is_kept_by_its_writer_until_the_main_sample_is_answered_for_good() {
    let counts = InputCounts::default();
    let mut retained = Retained::new(8);
    for seq in 0..4 {
        retained.receive(id(1, seq), counts, 100 + seq);
    }
    // Main sample 0 is answered with partner 1: partner 0 has left. Main sample 1 is answered with partner 3.
    retained.leave(1);
    retained.answer(id(7, 0));
    assert_eq!(retained.commit_point(None, 0), None, "the answer may be lost with this process");
    retained.leave(2);
    retained.answer(id(7, 1));
    assert_eq!(retained.commit_point(Some(id(7, 0)), 0), Some((id(1, 0), counts)));
    assert_eq!(retained.commit_point(Some(id(7, 0)), 0), None);
    assert_eq!(retained.commit_point(Some(id(7, 1)), 0), Some((id(1, 2), counts)));
    // A main input that stands still does not hold up the writer for ever.
    assert_eq!(retained.commit_point(None, 104), Some((id(1, 3), counts)));
    for seq in 4..20 {
        retained.receive(id(1, seq), counts, 200);
    }
    assert_eq!(retained.commit_point(None, 0), Some((id(1, 11), counts)));
    assert_eq!(retained.commit_all(), Some((id(1, 19), counts)));
}

/// L9: a publisher whose reader, or one behind it, runs in the same process knows that waiting is in vain.
#[test]
fn a_publisher_does_not_wait_for_a_reader_that_runs_in_its_own_turn() {
    let behind = vec![ReaderWiring { slot: 2, writer_slot: 1, behind: vec![] }];
    let reader = ConsumerWiring { slot: 1, capacity: 1, attached_slots: vec![], attached_limit_millis: 0, behind };
    let mut credit = Credit::new(&[reader], 1);
    let places = Slots::default();
    credit.begin(false, &places, None);
    credit.has_sent(id(1, 0));
    let written = Written::with(None, id(1, 0));
    for (slots, is_in_vain) in [([1], true), ([2], true), ([3], false)] {
        assert_eq!(credit.waits_for_one_of(&slots, &places, written, id(1, 1)), is_in_vain, "{slots:?}");
    }
}
