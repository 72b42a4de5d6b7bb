//! The filter of incoming frames: it accepts readings and numbers them. Pure: no I/O, no clock.
//!
//! It accepts a reading that fits the hand, is in order, and is not late. A refused reading leaves a gap in the outgoing
//! numbers, and so does a new connection; the arbiter holds the grasp in which a gap falls.
//!
//! **Order.** The sender's `seq` and `stamp_nanos`, if it gives them, must grow. Its `grasp_id` must never go back: a grasp
//! is not decided twice.
//!
//! **Lateness.** The delay of a reading with a stamp is the time from its stamp, by the sender's clock, to its arrival, by
//! ours. The reading is late when its delay is more than `max_delay` above the least delay known. Clocks drift, so the
//! least delay grows by [`DRIFT_PPM`]. It is never forgotten: readings that were buffered during a pause must not look
//! fresh. A reading without a stamp, or before a delay is known, is late when it may have waited in the source's own input
//! for longer than `max_delay`.
//!
//! **A new clock.** A sender's clock or counter may be reset, set or replaced. Its readings then look like old ones that
//! come again. The filter accepts the new clock, after a gap, when readings by it have come for [`RESET_NANOS`] in order,
//! without a pause, and with a steady delay; a backlog has no steady delay. The same holds for the readings of a connection
//! of which only the first is in time: that one's stamp may be wrong.
//!
//! **A wrong number.** A line may change a digit of a frame. A frame whose `grasp_id` is not the last one or the next one
//! waits for the frame after it, which must have the same. If the `seq` or the stamp of a frame jumps, the filter keeps its
//! state from before for three frames. If one of them fits that state and not the jump, the filter goes back to it. A wrong
//! number leaves a gap, so that the grasp is held.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::cell_zeros::AllowedReadings;
use super::{Arrival, Place, Reading, Refusal, RefusalKind};
use blindgrasp_messages::{Phase, Sense};

/// Nanoseconds of steady readings by a new clock before it is accepted.
pub const RESET_NANOS: u64 = 2_000_000_000;
/// A longer pause between readings by a new clock starts that time anew.
const LONGEST_PAUSE_NANOS: u64 = 500_000_000;
/// The most that two clocks drift apart: each crystal is good to 100 ppm.
pub const DRIFT_PPM: u64 = 200;
/// If a new connection's delay is so far above the least one, its stamps may be by another clock: the bridge was restarted.
const OTHER_CLOCK_NANOS: i128 = 60_000_000_000;
/// A larger step of `grasp_id` is refused. A bridge may number grasps by a clock: this is two years in nanoseconds.
const MAX_GRASP_JUMP: u64 = 1 << 56;
/// A larger step of `seq` is refused: no bridge misses so many frames.
const MAX_JUMP: u64 = 1 << 32;

/// A jump is doubted for so many frames after it.
const N_DOUBTED: u32 = 3;
/// A larger step of `seq` is a jump. After a smaller one that was wrong, the sender's numbers soon reach it.
const SEQ_JUMP: u64 = 100;

/// The numbers of values in a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Shape {
    pub n_joints: usize,
    pub n_cells: usize,
}

/// Numbers of accepted and refused frames since the source began.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Accepted frames.
    pub frames: u64,
    /// Lines that are no frame of this hand: not JSON, a wrong length, a negative force.
    pub malformed: u64,
    /// Lines longer than any frame.
    pub oversized: u64,
    /// Lines of which a connection brought only a part.
    pub cut_off: u64,
    /// Frames that came too late.
    pub late: u64,
    /// Frames that come after a later one, and copies of frames.
    pub out_of_order: u64,
    /// Frames that never came, by the sender's numbers.
    pub missed: u64,
    pub connections: u64,
    /// Resets of the sender's counter or clock within a connection.
    pub resets: u64,
    /// Clients that were turned away because another one was sending.
    pub refused_clients: u64,
    /// Frames whose numbers the next ones showed to be wrong.
    pub disbelieved: u64,
}

impl Counts {
    pub fn by_name(&self) -> BTreeMap<String, u64> {
        let counts = [
            ("frames", self.frames),
            ("malformed", self.malformed),
            ("oversized", self.oversized),
            ("cut_off", self.cut_off),
            ("late", self.late),
            ("out_of_order", self.out_of_order),
            ("missed", self.missed),
            ("connections", self.connections),
            ("resets", self.resets),
            ("refused_clients", self.refused_clients),
            ("disbelieved", self.disbelieved),
        ];
        counts.map(|(name, count)| (name.to_string(), count)).into()
    }
}

/// The numbers of an accepted reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Accepted {
    pub seq: u64,
    pub grasp_id: u64,
    /// By the sender's clock, or the time of arrival by the wall clock.
    pub stamp_nanos: u64,
}

/// Accepts or refuses readings, one after the other.
#[derive(Debug, Clone, Default)]
pub struct FrameFilter {
    shape: Shape,
    /// Forces where it is absent.
    allowed: Option<Arc<AllowedReadings>>,
    max_delay_nanos: u64,
    /// The wall clock's time less CLOCK_BOOTTIME's, to stamp readings that have none.
    wall_offset_nanos: u64,
    counts: Counts,
    place: Place,
    /// The last outgoing number.
    last_seq: Option<u64>,
    /// The numbers that the next accepted reading leaves out.
    n_skipped: u64,
    /// Refused lines since the last reading with a known number. If the sender counts them, they are not missed as well.
    n_unnumbered: u64,
    connection: Connection,
    delay: Option<Delay>,
    /// The last stamp of this connection or the one before.
    stamp_nanos: Option<u64>,
    /// Readings that may be by a new clock of the sender.
    new_clock: Option<NewClock>,
    doubt: Option<Doubt>,
    /// A frame of a grasp far from the last one, which waits for the next frame.
    waiting: Option<(Reading, Arrival)>,
    /// The frame that waited, once it is accepted.
    released: Option<(Reading, Accepted)>,
}

/// The state before a frame whose number jumped.
#[derive(Debug, Clone)]
struct Doubt {
    before: Box<FrameFilter>,
    /// So many more frames may show that the number was wrong.
    n_left: u32,
}

/// Readings that are wrong by the known clock, but in order by another one.
#[derive(Debug, Clone, Copy)]
struct NewClock {
    since_nanos: u64,
    at_nanos: u64,
    seq: Option<u64>,
    stamp_nanos: Option<u64>,
    /// The least and the greatest delay by it.
    delay_nanos: Option<(i128, i128)>,
}

/// The state of a connection.
#[derive(Debug, Clone, Copy, Default)]
struct Connection {
    /// The optional keys of its first reading.
    keys: Option<Keys>,
    seq: Option<u64>,
    phase: Option<Phase>,
    n_accepted: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Keys {
    grasp_id: bool,
    seq: bool,
    stamp_nanos: bool,
    senses: [bool; Sense::ALL.len()],
}

/// The least delay known, and the time when it was measured.
#[derive(Debug, Clone, Copy)]
struct Delay {
    least_nanos: i128,
    at_nanos: u64,
}

impl FrameFilter {
    /// A filter that continues after `place`; `last_seq` is the last outgoing number.
    pub fn new(
        shape: Shape,
        max_delay_nanos: u64,
        wall_offset_nanos: u64,
        place: Place,
        last_seq: Option<u64>,
    ) -> Self {
        FrameFilter {
            shape,
            max_delay_nanos,
            wall_offset_nanos,
            place,
            last_seq,
            delay: place.delay_nanos.map(|(least_nanos, at_nanos)| Delay { least_nanos, at_nanos }),
            stamp_nanos: place.stamp_nanos,
            ..FrameFilter::default()
        }
    }

    /// Continues where another instance stopped, with its own counts and allowed readings.
    pub fn resume(&mut self, place: Place, last_seq: Option<u64>) {
        let (counts, allowed) = (self.counts, self.allowed.take());
        *self = FrameFilter {
            counts,
            allowed,
            ..FrameFilter::new(self.shape, self.max_delay_nanos, self.wall_offset_nanos, place, last_seq)
        };
    }

    /// Takes these readings of the cells.
    pub fn with_allowed(self, allowed: AllowedReadings) -> Self {
        FrameFilter { allowed: Some(allowed.into()), ..self }
    }

    pub fn set_max_delay_nanos(&mut self, max_delay_nanos: u64) {
        self.max_delay_nanos = max_delay_nanos;
    }

    pub fn place(&self) -> &Place {
        &self.place
    }

    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// Counts a new connection.
    pub fn began(&mut self) {
        if self.waiting.is_some() {
            self.disbelieve_waiting();
        }
        self.counts.connections += 1;
        self.begin_anew();
    }

    fn begin_anew(&mut self) {
        self.connection = Connection::default();
        (self.new_clock, self.doubt) = (None, None);
    }

    /// Counts a client that was turned away.
    pub fn turned_away(&mut self) {
        self.counts.refused_clients += 1;
    }

    /// Counts a refused line.
    pub fn refused(&mut self, kind: RefusalKind) {
        let count = match kind {
            RefusalKind::Malformed => &mut self.counts.malformed,
            RefusalKind::Oversized => &mut self.counts.oversized,
            RefusalKind::CutOff => &mut self.counts.cut_off,
            RefusalKind::Late => &mut self.counts.late,
            RefusalKind::OutOfOrder => &mut self.counts.out_of_order,
        };
        *count += 1;
        // The number of a late reading is known, so it was counted with the readings before it.
        match kind {
            RefusalKind::Late => self.n_skipped += 1,
            _ => self.n_unnumbered += 1,
        }
    }

    /// Numbers a reading and counts it; `None` if it waits for the next one. Ask for [`FrameFilter::released`] first of all
    /// after each call.
    ///
    /// # Errors
    /// The reading is refused.
    pub fn take(&mut self, reading: &Reading, arrival: &Arrival) -> Result<Option<Accepted>, Refusal> {
        // It is no part of the state to which the filter may go back.
        let mut released = None;
        if let Some((waiting, waiting_arrival)) = self.waiting.take() {
            if waiting.grasp_id == reading.grasp_id {
                let outcome = self.count(|filter| filter.judge(&waiting, &waiting_arrival));
                released = outcome.ok().map(|accepted| (waiting, accepted));
            } else {
                self.disbelieve_waiting();
            }
        }
        let last = self.place.grasp_id;
        if let Some(id) = reading.grasp_id
            && last.is_none_or(|last| id > last.saturating_add(1) && id - last <= MAX_GRASP_JUMP)
            && check_values(reading, self.shape, self.allowed.as_deref()).is_ok()
        {
            self.waiting = Some((reading.clone(), *arrival));
            return Ok(None);
        }
        let outcome = self.count(|filter| filter.judge(reading, arrival));
        self.released = released;
        outcome.map(Some)
    }

    /// The frame before the last one, if it waited for that one and is accepted.
    pub fn released(&mut self) -> Option<(Reading, Accepted)> {
        self.released.take()
    }

    fn disbelieve_waiting(&mut self) {
        self.waiting = None;
        self.counts.disbelieved += 1;
        self.refused(RefusalKind::OutOfOrder);
    }

    fn count(&mut self, judge: impl FnOnce(&mut Self) -> Result<Accepted, Refusal>) -> Result<Accepted, Refusal> {
        let outcome = judge(self);
        match &outcome {
            Ok(_) => self.counts.frames += 1,
            Err(refusal) => self.refused(refusal.kind),
        }
        outcome
    }

    fn judge(&mut self, reading: &Reading, arrival: &Arrival) -> Result<Accepted, Refusal> {
        let doubt = self.doubt.take().filter(|doubt| doubt.n_left > 0);
        let before = self.clone();
        let outcome = self.judge_next(reading, arrival);
        let doubt = doubt.map(|Doubt { before, n_left }| Doubt { before, n_left: n_left - 1 });
        match (&outcome, doubt) {
            (Ok(_), doubt) => {
                let has_jumped = self.has_jumped_since(&before);
                self.doubt =
                    if has_jumped { Some(Doubt { before: Box::new(before), n_left: N_DOUBTED }) } else { doubt };
            }
            (Err(refusal), Some(doubt)) if before.may_show_wrong(&doubt.before, refusal, reading) => {
                // The frame with the jump counts as one that was refused.
                let mut again = FrameFilter {
                    counts: Counts { missed: doubt.before.counts.missed, ..before.counts },
                    last_seq: before.last_seq,
                    n_skipped: before.n_skipped,
                    n_unnumbered: before.n_unnumbered + 1,
                    ..(*doubt.before).clone()
                };
                if let Ok(accepted) = again.judge_next(reading, arrival) {
                    again.counts.disbelieved += 1;
                    *self = again;
                    return Ok(accepted);
                }
                self.doubt = Some(doubt);
            }
            (Err(_), doubt) => self.doubt = doubt,
        }
        outcome
    }

    /// Whether a refused reading may show that the numbers of the last one were wrong, which had `before` before it.
    fn may_show_wrong(&self, before: &FrameFilter, refusal: &Refusal, reading: &Reading) -> bool {
        let is_by_number = reading.seq.zip(self.connection.seq).is_some_and(|(now, last)| now <= last);
        let is_far = reading.seq.zip(self.connection.seq).is_some_and(|(now, last)| last.abs_diff(now) > SEQ_JUMP / 2);
        // Without a known delay nothing shows which of two stamps is wrong.
        let is_by_stamp = reading.stamp_nanos.is_some() && before.delay.is_some();
        match refusal.kind {
            _ if self.is_of_an_old_grasp(reading) => false,
            RefusalKind::OutOfOrder if is_by_number => is_far,
            RefusalKind::OutOfOrder | RefusalKind::Late => is_by_stamp,
            _ => false,
        }
    }

    /// Whether the last reading was far from the one before: later ones show whether its numbers were right.
    fn has_jumped_since(&self, before: &FrameFilter) -> bool {
        let (seqs, delays) = (self.connection.seq.zip(before.connection.seq), self.delay.zip(before.delay));
        let limit_nanos = i128::from(self.max_delay_nanos);
        before.connection.n_accepted == 0
            || seqs.is_some_and(|(now, last)| now > last.saturating_add(SEQ_JUMP))
            || delays.is_some_and(|(now, before)| now.least_nanos < before.least_nanos - limit_nanos)
    }

    fn judge_next(&mut self, reading: &Reading, arrival: &Arrival) -> Result<Accepted, Refusal> {
        check_values(reading, self.shape, self.allowed.as_deref()).map_err(Refusal::malformed)?;
        let keys = Keys {
            grasp_id: reading.grasp_id.is_some(),
            seq: reading.seq.is_some(),
            stamp_nanos: reading.stamp_nanos.is_some(),
            senses: Sense::ALL.map(|sense| !reading.senses.get(sense).is_empty()),
        };
        if let Some(first) = self.connection.keys {
            check_keys(first, keys).map_err(Refusal::malformed)?;
        }
        if let Err(why) = self.check_order(reading) {
            let goes_back = match (reading.stamp_nanos, self.stamp_nanos) {
                (Some(stamp), Some(last)) => stamp < last,
                _ => matches!((reading.seq, self.connection.seq), (Some(seq), Some(last)) if seq < last),
            };
            if !(goes_back && !self.is_of_an_old_grasp(reading) && self.is_by_a_new_clock(reading, arrival)) {
                return Err(Refusal { kind: RefusalKind::OutOfOrder, why });
            }
            self.believe_new_clock(arrival);
        }
        let is_first = self.last_seq.is_none() && self.n_skipped == 0 && self.n_unnumbered == 0;
        let mut delay = self.delay_with(reading, arrival);
        if let Err((nanos, _)) = &delay
            && (*nanos >= OTHER_CLOCK_NANOS && self.connection.n_accepted == 0 || self.connection.n_accepted == 1)
            && self.is_by_a_new_clock(reading, arrival)
        {
            self.believe_new_clock(arrival);
            delay = self.delay_with(reading, arrival);
        }
        self.advance(reading, keys);
        match delay {
            Ok(delay) => self.delay = delay.or(self.delay),
            Err((_, why)) => return Err(Refusal { kind: RefusalKind::Late, why }),
        }
        self.place.delay_nanos = self.delay.map(|delay| (delay.least_nanos, delay.at_nanos));
        self.new_clock = None;
        self.connection.n_accepted = self.connection.n_accepted.saturating_add(1);
        // The frames before it were missed if the first reading is amid a grasp.
        if is_first && reading.phase != Phase::Open && reading.seq != Some(0) {
            self.n_skipped += 1;
        }
        let seq = self.last_seq.map_or(0, |last| last + 1) + std::mem::take(&mut self.n_skipped);
        self.last_seq = Some(seq);
        let stamp_nanos = reading.stamp_nanos.unwrap_or(arrival.at_nanos.saturating_add(self.wall_offset_nanos));
        Ok(Accepted { seq, grasp_id: self.place.grasp_id.unwrap_or(0), stamp_nanos })
    }

    fn is_of_an_old_grasp(&self, reading: &Reading) -> bool {
        matches!((reading.grasp_id, self.place.grasp_id), (Some(id), Some(last)) if id < last)
    }

    /// Adds a reading that is wrong by the known clock. Returns whether it and the ones before it prove a new clock.
    fn is_by_a_new_clock(&mut self, reading: &Reading, arrival: &Arrival) -> bool {
        let delay_nanos = reading.stamp_nanos.map(|stamp| i128::from(arrival.at_nanos) - i128::from(stamp));
        let (seq, stamp_nanos, at_nanos) = (reading.seq, reading.stamp_nanos, arrival.at_nanos);
        let mut since_nanos = at_nanos;
        let mut range_nanos = delay_nanos.map(|delay| (delay, delay));
        if let Some(clock) = self.new_clock
            && at_nanos.saturating_sub(clock.at_nanos) <= LONGEST_PAUSE_NANOS
            && grows(seq, clock.seq)
            && grows(stamp_nanos, clock.stamp_nanos)
        {
            let (least, most) = match (clock.delay_nanos, delay_nanos) {
                (Some((least, most)), Some(delay)) => (least.min(delay), most.max(delay)),
                _ => (0, 0),
            };
            if most - least <= i128::from(self.max_delay_nanos) {
                since_nanos = clock.since_nanos;
                range_nanos = delay_nanos.map(|_| (least, most));
            }
        }
        self.new_clock = Some(NewClock { since_nanos, at_nanos, seq, stamp_nanos, delay_nanos: range_nanos });
        at_nanos.saturating_sub(since_nanos) >= RESET_NANOS
    }

    fn believe_new_clock(&mut self, arrival: &Arrival) {
        self.counts.resets += 1;
        let least = self.new_clock.and_then(|clock| clock.delay_nanos).map(|(least, _)| least);
        self.delay = least.map(|least_nanos| Delay { least_nanos, at_nanos: arrival.at_nanos });
        self.stamp_nanos = None;
        self.begin_anew();
    }

    fn check_order(&self, reading: &Reading) -> Result<(), String> {
        if let (Some(grasp_id), Some(last)) = (reading.grasp_id, self.place.grasp_id)
            && grasp_id < last
        {
            return Err(format!(
                "grasp_id {grasp_id} after {last}: a grasp that was decided is not decided again; go on from {}, as \
                 last_grasp_id of the greeting says",
                last.saturating_add(1)
            ));
        }
        if let (Some(grasp_id), Some(last)) = (reading.grasp_id, self.place.grasp_id)
            && grasp_id - last > MAX_GRASP_JUMP
        {
            return Err(format!("grasp_id {grasp_id} after {last}: too far ahead to be one"));
        }
        if let (Some(seq), Some(last)) = (reading.seq, self.connection.seq) {
            if seq <= last {
                return Err(format!("seq {seq} after {last}: expected {}", last.saturating_add(1)));
            }
            if seq - last > MAX_JUMP {
                return Err(format!("seq {seq} after {last}: too far ahead to be one"));
            }
        }
        match (reading.stamp_nanos, self.stamp_nanos) {
            (Some(stamp), Some(last)) if stamp < last => {
                let secs = (last - stamp) as f64 / 1e9;
                Err(format!(
                    "stamp_nanos {stamp} is {secs} s before the last one's: has the sender's clock been set back?"
                ))
            }
            _ => Ok(()),
        }
    }

    /// Makes a reading the last one, whether it is accepted or not.
    fn advance(&mut self, reading: &Reading, keys: Keys) {
        let before = if self.connection.keys.is_none() { self.place.seq } else { None };
        let last = self.connection.seq.or(before);
        let jump = match (reading.seq, last) {
            (Some(seq), Some(last)) if seq > last && seq - last <= MAX_JUMP => seq - last - 1,
            _ => 0,
        };
        let n_unnumbered = std::mem::take(&mut self.n_unnumbered);
        self.counts.missed += jump.saturating_sub(n_unnumbered);
        self.n_skipped += jump.max(n_unnumbered);
        // A new connection may have missed frames.
        if self.connection.keys.is_none() && self.last_seq.is_some() {
            self.n_skipped = self.n_skipped.max(1);
        }
        let begins_grasp = self.connection.phase.is_none_or(|last| reading.phase.is_before(last));
        self.place.grasp_id = match (reading.grasp_id, self.place.grasp_id) {
            (Some(given), _) => Some(given),
            (None, None) => Some(0),
            (None, Some(last)) => Some(last.saturating_add(u64::from(begins_grasp))),
        };
        self.place.seq = reading.seq;
        self.stamp_nanos = reading.stamp_nanos;
        self.place.stamp_nanos = reading.stamp_nanos;
        (self.connection.seq, self.connection.phase) = (reading.seq, Some(reading.phase));
        self.connection.keys.get_or_insert(keys);
    }

    /// The least delay with this reading; `None` if it has no stamp.
    ///
    /// # Errors
    /// By how many nanoseconds it is late, and a text that says so.
    fn delay_with(&self, reading: &Reading, arrival: &Arrival) -> Result<Option<Delay>, (i128, String)> {
        let limit_nanos = i128::from(self.max_delay_nanos);
        let late = |nanos: i128, how: &str| {
            let limit_ms = limit_nanos as f64 / 1e6;
            Err((nanos, format!("late by {:.1} ms {how}; max_delay_ms is {limit_ms}", nanos as f64 / 1e6)))
        };
        let waited_nanos = i128::from(arrival.waited_nanos);
        let stood_still = "at most: the source, or the graph behind it, stood still meanwhile";
        let Some(stamp_nanos) = reading.stamp_nanos else {
            return if waited_nanos > limit_nanos { late(waited_nanos, stood_still) } else { Ok(None) };
        };
        let delay_nanos = i128::from(arrival.at_nanos) - i128::from(stamp_nanos);
        let known_nanos = self.delay.map(|delay| {
            let since_nanos = arrival.at_nanos.saturating_sub(delay.at_nanos);
            delay.least_nanos + i128::from(since_nanos) * i128::from(DRIFT_PPM) / 1_000_000
        });
        let least_nanos = match known_nanos {
            Some(least) if delay_nanos - least > limit_nanos => {
                return late(delay_nanos - least, "by its stamp, above the least delay");
            }
            Some(least) => least.min(delay_nanos),
            None if waited_nanos > limit_nanos => return late(waited_nanos, stood_still),
            None => delay_nanos,
        };
        Ok(Some(Delay { least_nanos, at_nanos: arrival.at_nanos }))
    }
}

fn grows(now: Option<u64>, last: Option<u64>) -> bool {
    now.zip(last).is_none_or(|(now, last)| now > last)
}

fn check_values(reading: &Reading, shape: Shape, allowed: Option<&AllowedReadings>) -> Result<(), String> {
    let Reading { joints, cells_newtons, .. } = reading;
    for (name, found, expected) in
        [("joints", joints.len(), shape.n_joints), ("cells_newtons", cells_newtons.len(), shape.n_cells)]
    {
        if found != expected {
            return Err(format!("{name} has {found} numbers, the hand {expected}"));
        }
    }
    if let Some(grasp_id) = reading.grasp_id.filter(|grasp_id| *grasp_id > i64::MAX as u64) {
        return Err(format!("grasp_id is {grasp_id}: expected at most {}", i64::MAX));
    }
    if let Some((idx, angle)) = joints.iter().enumerate().find(|(_, angle)| !angle.is_finite()) {
        return Err(format!("joints[{idx}] is {angle}: expected an angle in radians"));
    }
    AllowedReadings::check(allowed, cells_newtons)?;
    for (sense, values) in reading.senses.view().iter() {
        let (name, expected) = (sense.name(), sense.len(shape.n_joints));
        if !values.is_empty() && values.len() != expected {
            return Err(format!("{name} has {} numbers: expected {expected}, or none at all", values.len()));
        }
        if let Some((idx, number)) = values.iter().enumerate().find(|(_, number)| !number.is_finite()) {
            return Err(format!("{name}[{idx}] is {number}: expected a finite number"));
        }
    }
    Ok(())
}

/// Optional keys must be in all frames of a connection or in none: a frame without one would go unchecked.
fn check_keys(first: Keys, found: Keys) -> Result<(), String> {
    let numbers = [
        ("grasp_id", first.grasp_id, found.grasp_id),
        ("seq", first.seq, found.seq),
        ("stamp_nanos", first.stamp_nanos, found.stamp_nanos),
    ];
    let senses = Sense::ALL.map(|sense| (sense.name(), first.senses[sense as usize], found.senses[sense as usize]));
    for (key, was_given, is_given) in numbers.into_iter().chain(senses) {
        if was_given && !is_given {
            return Err(format!("{key} is missing, which the connection's first frame had"));
        }
        if is_given && !was_given {
            return Err(format!("{key} is given, which the connection's first frame did not have"));
        }
    }
    Ok(())
}
