//! Both ends of a channel over a network that loses, delays, repeats and reorders frames, and goes away and comes back, in
//! one direction or in both. Both ends are killed and restarted meanwhile. The ends find and lose each other by what their
//! links say ([`Peer`](crate::peer::Peer)).

use std::collections::{BTreeSet, HashMap, VecDeque};

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::outgoing::{KeptSample, Outgoing, OutgoingOptions};
use crate::peer::tests::{Side, pair};
use crate::peer::{Change, Rejection};
use crate::wire::Body;
use blindgrasp_graph::link::config::KeyKind;
use blindgrasp_operator::link_status::PeerState;
use blindgrasp_operator::written::Written;

const MILLI: u64 = 1_000_000;

fn key(epoch: u64, seq: u64) -> SampleId {
    SampleId { epoch, seq }
}

#[derive(Debug, Clone)]
enum Frame {
    /// Of the links, with its number: a hello or a ping.
    Link(u64, Body<'static>),
    Resume(u32, Option<SampleId>),
    Sample {
        run: u32,
        index: u64,
        key: SampleId,
    },
    Ack(Progress),
    End(u32),
    Ended,
}

/// The faults that are simulated, and their probabilities.
#[derive(Debug, Clone, Copy, Default)]
struct Faults {
    loss: f64,
    repeat: f64,
    longest_delay_millis: u64,
    cut: f64,
    kill_sender: f64,
    kill_receiver: f64,
    most_kills: u32,
    new_epoch: f64,
}

#[derive(Debug, Clone, Copy)]
struct Setting {
    options: OutgoingOptions,
    n_samples: usize,
    /// Samples per millisecond.
    rate: f64,
    faults: Faults,
}

/// The process of one end of the channel.
struct EndProcess {
    link: Side,
    is_alive: bool,
    back_at_millis: u64,
}

impl EndProcess {
    /// A process of the sender or of the receiver.
    fn new(end: usize, instance: u64) -> Self {
        let [sender, receiver] = pair();
        let mut link = if end == SENDER { sender } else { receiver };
        link.own.instance = instance;
        EndProcess { link, is_alive: true, back_at_millis: 0 }
    }

    fn is_up(&self) -> bool {
        self.is_alive && self.link.peer.state == PeerState::Up
    }
}

struct World {
    setting: Setting,
    rng: ChaCha8Rng,
    now_millis: u64,
    /// All samples of the writer, in order.
    written: Vec<SampleId>,
    /// The position of each of them, from 1.
    places: HashMap<SampleId, usize>,
    /// Number of samples that the sender has taken.
    n_taken: usize,
    sender: Outgoing,
    committed: Option<SampleId>,
    /// What the sender has saved for its successor: samples, and the number of lost ones.
    spool: (Vec<KeptSample>, u64),
    receiver: Incoming,
    ends: [EndProcess; 2],
    /// Until when nothing of the sender and of the receiver passes.
    are_cut_until_millis: [u64; 2],
    /// Number of times that one end lost the other one, which still heard it.
    n_one_sided: u32,
    /// Numbers the frames of channels as they arrive: the order that links demand of each other's frames has tests of its own.
    n_arrived: u64,
    /// The frames from the sender and from the receiver: time of arrival, instance of the sender, frame.
    wires: [VecDeque<(u64, u64, Frame)>; 2],
    /// The samples that each process of the receiver has delivered.
    lives: Vec<Vec<SampleId>>,
    answered: Option<SampleId>,
    n_unanswered: usize,
    n_lost: u64,
    /// The longest time without a break for which the writer has waited while the sender was cut off.
    blocked_cut_off_millis: u64,
    longest_blocked_cut_off_millis: u64,
    n_kills: u32,
    has_faults: bool,
}

const SENDER: usize = 0;
const RECEIVER: usize = 1;

impl World {
    fn new(setting: Setting, seed: u64) -> Self {
        World {
            setting,
            rng: ChaCha8Rng::seed_from_u64(seed),
            now_millis: 1,
            written: Vec::new(),
            places: HashMap::new(),
            n_taken: 0,
            sender: Outgoing::new(setting.options, None, None),
            committed: None,
            spool: Default::default(),
            receiver: Incoming::new(setting.options.policy, seed, None),
            ends: [EndProcess::new(SENDER, 1000 * seed + 1), EndProcess::new(RECEIVER, 1000 * seed + 501)],
            are_cut_until_millis: [0; 2],
            n_one_sided: 0,
            n_arrived: 0,
            wires: Default::default(),
            lives: vec![Vec::new()],
            answered: None,
            n_unanswered: 0,
            n_lost: 0,
            blocked_cut_off_millis: 0,
            longest_blocked_cut_off_millis: 0,
            n_kills: 0,
            has_faults: true,
        }
    }

    fn now_nanos(&self) -> u64 {
        self.now_millis * MILLI
    }

    fn happens(&mut self, probability: f64) -> bool {
        self.has_faults && self.rng.random_bool(probability)
    }

    fn send(&mut self, from: usize, frame: Frame) {
        let faults = self.setting.faults;
        let is_cut = self.now_millis < self.are_cut_until_millis[from];
        let n_copies = if self.happens(faults.repeat) { 2 } else { 1 };
        for _ in 0..n_copies {
            if is_cut || self.happens(faults.loss) {
                continue;
            }
            let at_millis = self.now_millis + self.rng.random_range(1..=1 + faults.longest_delay_millis);
            self.wires[from].push_back((at_millis, self.ends[from].link.own.instance, frame.clone()));
        }
    }

    fn place_of(&self, key: Option<SampleId>) -> usize {
        key.map_or(0, |key| self.places[&key])
    }

    /// The last sample that the sender has committed. A restarted sender begins after it.
    fn commit_point(&mut self) -> Option<SampleId> {
        let now_nanos = self.now_nanos();
        if self.ends[SENDER].is_alive {
            while let Some(sample) = self.sender.next_to_save(now_nanos) {
                if self.sender.committed().len() == 0 {
                    self.spool.0.clear();
                }
                self.spool.0.push(sample.clone());
                self.sender.saved();
            }
            if self.happens(0.001) {
                self.spool.0 = self.sender.committed().cloned().collect();
            }
            self.spool.1 = self.sender.n_lost_to_save();
            // It may be killed between the two.
            if !self.happens(0.05) {
                self.committed = self.sender.commit_point();
            }
        }
        self.committed
    }

    fn break_things(&mut self) {
        let faults = self.setting.faults;
        if self.happens(faults.cut) {
            let until_millis = self.now_millis + self.rng.random_range(1..=600);
            let cut: &[usize] = [&[SENDER, RECEIVER][..], &[SENDER], &[RECEIVER]][self.rng.random_range(0..3)];
            cut.iter().for_each(|from| self.are_cut_until_millis[*from] = until_millis);
        }
        for (end, probability) in [(SENDER, faults.kill_sender), (RECEIVER, faults.kill_receiver)] {
            // A loss before the receiver has any sample is not counted, because another receiver may have had the
            // samples.
            let is_enough = self.n_kills == faults.most_kills || self.answered.is_none();
            if self.ends[end].is_alive && !is_enough && self.happens(probability) {
                self.n_kills += 1;
                let place = &mut self.ends[end];
                place.is_alive = false;
                place.back_at_millis = self.now_millis + self.rng.random_range(5..=100);
            }
        }
    }

    /// Restarts processes.
    fn mend_things(&mut self) {
        let now_millis = self.now_millis;
        if !self.ends[SENDER].is_alive && now_millis >= self.ends[SENDER].back_at_millis {
            self.ends[SENDER] = EndProcess::new(SENDER, self.ends[SENDER].link.own.instance + 1);
            let begun_after = self.committed;
            let written = self.written.iter().fold(None, |written, key| Written::with(written, *key));
            self.sender = Outgoing::new(self.setting.options, begun_after, written);
            self.sender.restore(std::mem::take(&mut self.spool.0), self.spool.1);
            self.spool.0 = self.sender.committed().cloned().collect();
            self.n_taken = self.place_of(begun_after);
        }
        if !self.ends[RECEIVER].is_alive && now_millis >= self.ends[RECEIVER].back_at_millis {
            let instance = self.ends[RECEIVER].link.own.instance + 1;
            self.ends[RECEIVER] = EndProcess::new(RECEIVER, instance);
            self.n_lost += self.receiver.status("").n_lost;
            self.receiver = Incoming::new(self.setting.options.policy, instance, self.answered);
            self.lives.push(Vec::new());
            self.n_unanswered = 0;
        }
    }

    /// The links send the hellos and pings that are due, and notice silence.
    fn run_links(&mut self) {
        let now_nanos = self.now_nanos();
        for end in [SENDER, RECEIVER] {
            if !self.ends[end].is_alive {
                continue;
            }
            let Side { own, peer } = &mut self.ends[end].link;
            let change = peer.check_deadline(now_nanos);
            let mut bodies = Vec::new();
            peer.due(own, now_nanos, &mut bodies);
            self.apply(end, change);
            bodies.into_iter().for_each(|body| self.say(end, body));
        }
    }

    fn say(&mut self, from: usize, body: Body<'static>) {
        let number = self.ends[from].link.peer.next_counter(KeyKind::Link);
        self.send(from, Frame::Link(number, body));
    }

    /// As the link's operator does.
    fn apply(&mut self, end: usize, change: Option<Change>) {
        match (end, change) {
            (_, None) | (SENDER, Some(Change::Asked)) => return,
            (SENDER, Some(_)) => self.sender.cut_off(),
            (_, Some(Change::CutOff)) => self.receiver.cut_off(),
            (_, Some(Change::Found | Change::Asked)) => self.receiver.reconnected(),
            (_, Some(Change::FoundAnew)) => panic!("it is one run"),
        }
        let is_heard = self.now_millis >= self.are_cut_until_millis[end] && self.ends[1 - end].is_up();
        let is_one_sided = change == Some(Change::CutOff) && is_heard;
        self.n_one_sided += u32::from(is_one_sided);
    }

    fn write(&mut self) {
        let setting = self.setting;
        let commit_place = self.commit_point();
        let commit_place = self.place_of(commit_place);
        let mut is_blocked = false;
        let mut due = setting.rate;
        while due > 0.0 && self.written.len() < setting.n_samples {
            if due < 1.0 && !self.rng.random_bool(due) {
                break;
            }
            due -= 1.0;
            let is_lossless = setting.options.policy == EdgePolicy::Lossless;
            if is_lossless && self.written.len() - commit_place >= setting.options.capacity {
                is_blocked = true;
                break;
            }
            let last = self.written.last().copied();
            // A new epoch begins when the old one is answered.
            let may_change = !is_lossless || commit_place == self.written.len();
            let next = match last {
                Some(_) if may_change && self.happens(setting.faults.new_epoch) => {
                    // The values of epochs are in no order.
                    key(self.rng.random_range(1..u64::MAX), 0)
                }
                Some(last) => key(last.epoch, last.seq + 1),
                None => key(1 << 32, 0),
            };
            self.written.push(next);
            self.places.insert(next, self.written.len());
        }
        let is_cut_off = self.ends[SENDER].is_alive && !self.ends[SENDER].is_up();
        self.blocked_cut_off_millis = if is_blocked && is_cut_off { self.blocked_cut_off_millis + 1 } else { 0 };
        self.longest_blocked_cut_off_millis = self.longest_blocked_cut_off_millis.max(self.blocked_cut_off_millis);
    }

    fn run_sender(&mut self) {
        if !self.ends[SENDER].is_alive {
            return;
        }
        let now_nanos = self.now_nanos();
        let is_up = self.ends[SENDER].is_up();
        while self.n_taken < self.written.len() && self.sender.wants_more(is_up, now_nanos) {
            let next = self.written[self.n_taken];
            self.sender.push(next, next.seq.to_le_bytes().to_vec(), 1, now_nanos);
            self.n_taken += 1;
        }
        while let Some(next) = self.sender.next(now_nanos) {
            assert_eq!(next.message, next.key.seq.to_le_bytes());
            let frame = Frame::Sample { run: next.run, index: next.index, key: next.key };
            self.send(SENDER, frame);
        }
        if self.written.len() == self.setting.n_samples && self.n_taken == self.written.len() {
            self.sender.end(self.written.last().copied());
        }
        if let Some((run, last)) = self.sender.end_to_send(now_nanos) {
            assert_eq!(last, self.written.last().copied());
            self.send(SENDER, Frame::End(run));
        }
    }

    fn run_receiver(&mut self) {
        if !self.ends[RECEIVER].is_alive {
            return;
        }
        let now_nanos = self.now_nanos();
        // The readers answer with breaks.
        if self.n_unanswered > 0 && self.rng.random_bool(0.7) {
            let n_answered = self.rng.random_range(1..=self.n_unanswered);
            self.n_unanswered -= n_answered;
            let life = self.lives.last().expect("one");
            self.answered = life.get(life.len() - self.n_unanswered - 1).copied();
        }
        if let Some((run, after)) = self.receiver.resume_to_send(now_nanos) {
            self.send(RECEIVER, Frame::Resume(run, after));
        }
        if let Some(progress) = self.receiver.ack_to_send(self.answered, now_nanos) {
            self.send(RECEIVER, Frame::Ack(progress));
        }
    }

    fn arrive(&mut self) {
        let now_nanos = self.now_nanos();
        for from in [SENDER, RECEIVER] {
            let arrived: Vec<_> = {
                let now_millis = self.now_millis;
                let (due, later) = self.wires[from].drain(..).partition(|(at_millis, ..)| *at_millis <= now_millis);
                self.wires[from] = later;
                VecDeque::into(due)
            };
            for (_, instance, frame) in arrived {
                let to = 1 - from;
                if !self.ends[to].is_alive {
                    continue;
                }
                self.n_arrived += 1;
                let Side { own, peer } = &mut self.ends[to].link;
                let taken = match &frame {
                    Frame::Link(number, Body::Hello(hello)) => peer.on_hello(own, instance, *number, hello, now_nanos),
                    Frame::Link(number, _) => {
                        peer.on_frame(KeyKind::Link, instance, *number, now_nanos).map(|change| (change, false))
                    }
                    _ => {
                        peer.on_frame(KeyKind::Data, instance, self.n_arrived, now_nanos).map(|change| (change, false))
                    }
                };
                let (change, is_to_answer) = match taken {
                    Ok(taken) => taken,
                    Err(Rejection::Refused(reason)) => panic!("{reason}"),
                    // A frame of another instance, or an old one.
                    Err(_) => continue,
                };
                self.apply(to, change);
                match frame {
                    Frame::Link(..) if is_to_answer => {
                        let Side { own, peer } = &mut self.ends[to].link;
                        let hello = peer.hello(own, now_nanos);
                        self.say(to, hello);
                    }
                    Frame::Link(..) => {}
                    Frame::Resume(run, after) => {
                        self.sender.on_resume(run, after);
                        if self.sender.has_request() {
                            self.ends[SENDER].link.peer.on_requests();
                        }
                    }
                    Frame::Ack(progress) => {
                        let Progress { run, n_received, answered } = progress;
                        self.sender.on_ack(run, n_received, answered, now_nanos);
                    }
                    Frame::Ended => self.sender.on_ended(),
                    Frame::End(run) => {
                        if self.receiver.on_end(run) {
                            self.send(RECEIVER, Frame::Ended);
                        }
                    }
                    Frame::Sample { run, index, key } => {
                        if self.receiver.on_sample(run, index, key) == Admission::Deliver {
                            self.lives.last_mut().expect("one").push(key);
                            self.n_unanswered += 1;
                        }
                    }
                }
            }
        }
    }

    fn tick(&mut self) {
        self.break_things();
        self.mend_things();
        self.run_links();
        self.write();
        self.run_sender();
        self.run_receiver();
        self.arrive();
        self.now_millis += 1;
    }

    /// Runs until the end of the channel is known on both sides.
    fn run(&mut self) {
        while self.written.len() < self.setting.n_samples {
            self.tick();
            assert!(self.now_millis < 10_000_000, "the writer is stuck at {}", self.written.len());
        }
        self.has_faults = false;
        let since_millis = self.now_millis;
        while !(self.sender.is_done() && self.receiver.has_ended()) {
            self.tick();
            assert!(self.now_millis < since_millis + 600_000, "{:?} {:?}", self.sender, self.receiver);
        }
        self.n_lost += self.sender.status("", 0).n_lost + self.receiver.status("").n_lost;
        assert_eq!(self.sender.n_waiting(), 0);
    }

    /// Checks that each process of the receiver delivers in order and each sample once; returns the positions of all
    /// delivered samples.
    fn delivered(&self) -> BTreeSet<usize> {
        let mut all = BTreeSet::new();
        for life in &self.lives {
            let places: Vec<usize> = life.iter().map(|key| self.place_of(Some(*key))).collect();
            let wrong = places.windows(2).zip(life.windows(2)).find(|(places, _)| places[0] >= places[1]);
            assert!(wrong.is_none(), "not in order: {wrong:?}");
            all.extend(places);
        }
        all
    }

    fn n_missing(&self) -> u64 {
        (self.written.len() - self.delivered().len()) as u64
    }
}

const LOSSLESS: OutgoingOptions = OutgoingOptions {
    policy: EdgePolicy::Lossless,
    window: 32,
    capacity: 64,
    buffer: 100_000,
    stall_limit_nanos: 3000 * MILLI,
};
const LATEST: OutgoingOptions = OutgoingOptions { policy: EdgePolicy::Latest, ..LOSSLESS };
const BAD_NETWORK: Faults = Faults {
    loss: 0.05,
    repeat: 0.03,
    longest_delay_millis: 5,
    cut: 0.002,
    kill_sender: 0.0,
    kill_receiver: 0.0,
    most_kills: u32::MAX,
    new_epoch: 0.003,
};

fn worlds(setting: Setting) -> impl Iterator<Item = World> {
    (0..40).map(move |seed| {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut options = setting.options;
        options.window = [1, 2, 7, 32, 100][rng.random_range(0..5)];
        options.capacity = [1, 2, 8, 64, 300][rng.random_range(0..5)];
        let mut faults = setting.faults;
        faults.loss *= f64::from(rng.next_u32() % 4);
        faults.longest_delay_millis *= u64::from(rng.next_u32() % 3);
        let mut world = World::new(Setting { options, faults, ..setting }, seed);
        world.run();
        world
    })
}

fn setting(options: OutgoingOptions, faults: Faults) -> Setting {
    Setting { options, n_samples: 1500, rate: 1.0, faults }
}

#[test]
fn over_a_bad_network_nothing_is_lost_or_comes_twice() {
    let mut n_one_sided = 0;
    for world in worlds(setting(LOSSLESS, BAD_NETWORK)) {
        assert_eq!((world.n_missing(), world.n_lost), (0, 0));
        let n_delivered: usize = world.lives.iter().map(Vec::len).sum();
        assert_eq!(n_delivered, world.written.len());
        // A machine that is away does not block the writer: a new epoch waits for 50 ms, twice.
        assert!(world.longest_blocked_cut_off_millis < 110, "{}", world.longest_blocked_cut_off_millis);
        n_one_sided += world.n_one_sided;
    }
    assert!(n_one_sided > 20, "{n_one_sided}");
}

#[test]
fn a_receiver_that_is_killed_again_and_again_misses_nothing() {
    let faults = Faults { kill_receiver: 0.004, ..BAD_NETWORK };
    let mut n_lives = 0;
    for world in worlds(setting(LOSSLESS, faults)) {
        assert_eq!((world.n_missing(), world.n_lost), (0, 0));
        n_lives += world.lives.len();
    }
    assert!(n_lives > 100, "{n_lives}");
}

/// The sender is killed while it is cut off as well. Its successor sends the samples that the file holds.
#[test]
fn a_sender_that_is_killed_again_and_again_loses_nothing() {
    let faults = Faults { kill_sender: 0.004, ..BAD_NETWORK };
    let mut n_kills = 0;
    for world in worlds(setting(LOSSLESS, faults)) {
        assert_eq!((world.n_missing(), world.n_lost), (0, 0));
        n_kills += world.n_kills;
    }
    assert!(n_kills > 100, "{n_kills}");
}

#[test]
fn a_sender_that_is_killed_while_it_is_connected_loses_nothing() {
    // There are no cuts, so that the writer's history holds all samples that are not answered.
    let options = OutgoingOptions { capacity: 1_000_000, ..LOSSLESS };
    let faults = Faults { cut: 0.0, loss: 0.0, kill_sender: 0.004, kill_receiver: 0.0, ..BAD_NETWORK };
    for seed in 0..40 {
        let mut world = World::new(setting(options, faults), seed);
        world.run();
        assert_eq!((world.n_missing(), world.n_lost), (0, 0), "{seed}");
    }
}

#[test]
fn with_a_small_buffer_exactly_the_counted_samples_are_missing() {
    let options = OutgoingOptions { buffer: 60, ..LOSSLESS };
    let mut n_lost = 0;
    for world in worlds(setting(options, BAD_NETWORK)) {
        assert_eq!(world.n_missing(), world.n_lost);
        n_lost += world.n_lost;
    }
    assert!(n_lost > 1000, "{n_lost}");
}

/// Samples that a killed receiver had delivered without an answer are counted as lost if they cannot be sent again.
#[test]
fn all_missing_samples_are_counted_whatever_breaks() {
    let options = OutgoingOptions { buffer: 60, ..LOSSLESS };
    let faults = Faults { kill_sender: 0.002, kill_receiver: 0.002, new_epoch: 0.0, ..BAD_NETWORK };
    for world in worlds(setting(options, faults)) {
        assert!(world.n_missing() <= world.n_lost, "{} missing, {} lost", world.n_missing(), world.n_lost);
    }
}

#[test]
fn a_latest_channel_delivers_or_counts_each_sample_and_delivers_the_newest() {
    let faults = Faults { new_epoch: 0.003, ..BAD_NETWORK };
    for rate in [0.02, 0.5, 8.0] {
        let n_samples = if rate < 0.1 { 100 } else { 1500 };
        for world in worlds(Setting { rate, n_samples, ..setting(LATEST, faults) }) {
            assert_eq!(world.n_missing(), world.n_lost);
            assert_eq!(world.lives[0].last(), world.written.last());
        }
    }
}

#[test]
fn a_latest_channel_delivers_the_newest_when_either_end_is_killed() {
    let faults = Faults { kill_sender: 0.003, kill_receiver: 0.003, ..BAD_NETWORK };
    for world in worlds(setting(LATEST, faults)) {
        world.delivered();
        assert_eq!(world.lives.iter().flatten().last(), world.written.last());
    }
}

#[test]
fn a_request_is_repeated_until_it_is_answered() {
    let mut incoming = Incoming::new(EdgePolicy::Lossless, 10, Some(key(1, 4)));
    assert_eq!(incoming.resume_to_send(0), None);
    incoming.reconnected();
    let (run, after) = incoming.resume_to_send(0).expect("asked");
    assert_eq!(after, Some(key(1, 4)));
    assert_eq!(incoming.resume_to_send(FIRST_RESUME_PAUSE_NANOS - 1), None);
    assert_eq!(incoming.resume_to_send(FIRST_RESUME_PAUSE_NANOS), Some((run, after)));
    assert_eq!(incoming.on_sample(run, 0, key(1, 5)), Admission::Deliver);
    assert_eq!(incoming.resume_to_send(u64::MAX), None);
    // A repetition, a sample of an earlier request, and one after a gap.
    assert_eq!(incoming.on_sample(run, 0, key(1, 5)), Admission::Repeated);
    assert_eq!(incoming.on_sample(run - 1, 1, key(1, 6)), Admission::Stale);
    assert_eq!(incoming.on_sample(run, 2, key(1, 7)), Admission::Gap);
    assert_eq!(incoming.resume_to_send(0), Some((run + 1, Some(key(1, 5)))));
    assert_eq!(incoming.on_sample(run, 1, key(1, 6)), Admission::Stale);
    assert!(!incoming.on_end(run) && !incoming.has_ended());
    assert!(incoming.on_end(run + 1) && incoming.has_ended());
    incoming.cut_off();
    assert_eq!(incoming.on_sample(run + 1, 0, key(1, 6)), Admission::Stale);
    let status = incoming.status("a/b");
    assert_eq!((status.n_samples, status.n_repeated, status.n_lost, incoming.n_stale()), (1, 1, 0, 3));
}

#[test]
fn a_restarted_receiver_rejects_samples_for_an_earlier_process() {
    let mut first = Incoming::new(EdgePolicy::Lossless, 0xdead_beef_0000_0001, None);
    first.reconnected();
    let (run, _) = first.resume_to_send(0).expect("asked");
    let mut second = Incoming::new(EdgePolicy::Lossless, 0xdead_beef_1234_5678, None);
    second.reconnected();
    assert_eq!(second.on_sample(run, 0, key(1, 0)), Admission::Stale);
}

#[test]
fn progress_is_acknowledged_at_once_and_repeated_at_intervals() {
    let mut incoming = Incoming::new(EdgePolicy::Lossless, 10, None);
    incoming.reconnected();
    let (run, _) = incoming.resume_to_send(0).expect("asked");
    assert_eq!(incoming.ack_to_send(None, 1), None);
    incoming.on_sample(run, 0, key(1, 0));
    let progress = Progress { run, n_received: 1, answered: None };
    assert_eq!(incoming.ack_to_send(None, 1), Some(progress));
    let progress = Progress { answered: Some(key(1, 0)), ..progress };
    assert_eq!(incoming.ack_to_send(progress.answered, 2), None);
    assert_eq!(incoming.ack_to_send(progress.answered, 1 + ACK_PAUSE_NANOS), Some(progress));
    assert_eq!(incoming.ack_to_send(progress.answered, 1 + 2 * ACK_PAUSE_NANOS), None);
    assert_eq!(incoming.ack_to_send(progress.answered, 1 + ACK_PAUSE_NANOS + ACK_REPEAT_NANOS), Some(progress));
    incoming.cut_off();
    assert_eq!(incoming.ack_to_send(progress.answered, u64::MAX), None);
}
