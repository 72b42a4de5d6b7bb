//! Every short history of inputs to the lift arbiter, against a specification that reads the history from its end.

use std::collections::BTreeMap;

use blindgrasp_messages::{Action, Fault, Header, LiftDecision, Phase, Prediction, Reason};
use blindgrasp_stages::lift_arbiter::{ArbiterOptions, LiftArbiter, Probe};
use rayon::prelude::*;

const STEP_NANOS: u64 = 10_000_000;
/// The distance of the frames of a slow hand, more than the limit of others.
const SLOW_NANOS: u64 = 125_000_000;

/// How an input differs from the settled, stable prediction that comes next in the same grasp; [`Input::after`] says it of each
/// letter. The inputs of histories with a probe, and of those with a lift that is watched, are fewer so that they may be longer.
type Step = char;

const STEPS: &str = "+-?ceNnFM=~GBLRHEWo!iUZXd";
const STEPS_WITH_PROBE: &str = "+-?ceNM=LEo!ZqpltTd";
const STEPS_WHILE_LIFTING: &str = "+eNM~LEo!UZXdawv";
const STEPS_OF_SLOW_HANDS: &str = "+sSgG=NLEoX";

/// An input as the arbiter gets it. A silence and a cut link have the header and the grasp of the input before them.
#[derive(Debug, Clone)]
struct Input {
    step: Step,
    header: Header,
    prediction: Prediction,
    age_nanos: u64,
}

impl Input {
    /// The input after `last`, or the first one.
    fn after(last: Option<&Input>, step: Step, options: &ArbiterOptions) -> Input {
        let mut header = last.map_or_else(Header::default, |last| Header {
            seq: last.header.seq + 1,
            stamp_nanos: last.header.stamp_nanos + STEP_NANOS,
            ..last.header
        });
        let grasp_id = last.map_or(0, |last| last.prediction.grasp_id);
        let stable = Prediction {
            grasp_id,
            phase: Phase::Settled,
            stable: true,
            probability_stable: 0.9,
            ..Prediction::default()
        };
        let unstable = Prediction { stable: false, probability_stable: 0.1, ..stable };
        let mut age_nanos = options.max_age_nanos;
        let prediction = match step {
            '-' | '~' => unstable,
            '?' => Prediction { unsure: true, ..unstable },
            'c' | 's' => Prediction { phase: Phase::Closing, ..stable },
            'e' => Prediction { phase: Phase::Ended, ..stable },
            'q' => Prediction { phase: Phase::Squeezed, ..stable },
            'p' => Prediction { phase: Phase::Squeezed, ..unstable },
            'l' => Prediction { phase: Phase::TestLifting, ..stable },
            'd' => Prediction { phase: Phase::Dropped, ..stable },
            'a' => Prediction { phase: Phase::Lifting, ..stable },
            'w' => Prediction { phase: Phase::Lifting, unsure: true, ..unstable },
            'v' => Prediction { phase: Phase::Lifting, ..unstable },
            't' => Prediction { phase: Phase::TestLifted, ..stable },
            'T' => Prediction { phase: Phase::TestLifted, ..unstable },
            'N' => Prediction { grasp_id: grasp_id + 1, ..stable },
            'n' => Prediction { grasp_id: grasp_id + 1, phase: Phase::Closing, ..stable },
            'F' => Prediction { grasp_id: 0, ..stable },
            '!' => Prediction { fault: Fault::InvalidValue, ..stable },
            'i' => Prediction { probability_stable: options.min_probability_stable / 2.0, ..stable },
            _ => stable,
        };
        // While the arm lifts, they say that the object leaves the hand.
        let is_lifting = last.is_some_and(|last| last.prediction.phase == Phase::Lifting);
        let prediction = match step {
            'M' | '~' | 'L' | 'o' | '!' if is_lifting => {
                Prediction { phase: Phase::Lifting, stable: false, probability_stable: 0.1, ..prediction }
            }
            _ => prediction,
        };
        match step {
            'M' => header.made_by += 1,
            '=' | '~' => header.stamp_nanos = header.stamp_nanos.saturating_sub(STEP_NANOS),
            'G' => header.stamp_nanos += options.max_gap_nanos,
            's' | 'S' => header.stamp_nanos += SLOW_NANOS - STEP_NANOS,
            'g' => header.stamp_nanos += 3 * SLOW_NANOS,
            'B' => header.stamp_nanos = header.stamp_nanos.saturating_sub(2 * STEP_NANOS),
            'L' => header.seq += 1,
            'R' => header.seq = header.seq.saturating_sub(1),
            'H' => header.hand_id += 1,
            'E' => (header.epoch, header.seq) = (header.epoch + 1, 0),
            'W' => (header.epoch, header.seq) = (header.epoch + 1, header.seq.max(1)),
            'o' => age_nanos += 1,
            'Z' | 'X' => header = last.map_or_else(Header::default, |last| last.header),
            _ => {}
        }
        Input { step, header, prediction, age_nanos }
    }

    fn is_sample(&self) -> bool {
        !matches!(self.step, 'Z' | 'X')
    }

    fn grasp(&self) -> (u64, u64) {
        (self.header.epoch, self.prediction.grasp_id)
    }

    fn is_settled(&self) -> bool {
        self.prediction.phase == Phase::Settled
    }

    /// Whether a LIFT may rest on it.
    fn decides(&self, options: &ArbiterOptions) -> bool {
        self.prediction.phase == if options.probe == Probe::None { Phase::Settled } else { Phase::TestLifted }
    }

    /// Whether this sample is the one right after `before`.
    fn follows(&self, before: &Input) -> bool {
        let (now, before) = (self.header, before.header);
        (now.epoch, now.hand_id, now.seq) == (before.epoch, before.hand_id, before.seq + 1)
            && now.stamp_nanos >= before.stamp_nanos
    }
}

/// How far apart the last input may be from the one before it in its grasp: the option, or, if that is more, three times a steady
/// pace, at most 1 s. The pace is the third smallest of the nine distances before, of inputs that followed each other in its
/// epoch.
fn gap_limit_nanos(before: &[Input], epoch: u64, options: &ArbiterOptions) -> u64 {
    let samples: Vec<&Input> = before.iter().filter(|input| input.is_sample()).collect();
    let mut distances = Vec::new();
    for pair in samples.windows(2).rev() {
        let nanos = pair[1].header.stamp_nanos.saturating_sub(pair[0].header.stamp_nanos);
        let [last, now] = [pair[0], pair[1]];
        if now.header.epoch == epoch && now.follows(last) && now.step != 'U' && nanos > 0 && distances.len() < 9 {
            distances.push(nanos);
        }
    }
    distances.sort_unstable();
    let of_source = if distances.len() == 9 { (3 * distances[2]).min(1_000_000_000) } else { 0 };
    options.max_gap_nanos.max(of_source)
}

fn is_plain_prediction(input: &Input, options: &ArbiterOptions) -> bool {
    input.is_sample()
        && input.step != 'U'
        && input.prediction.fault == Fault::None
        && input.age_nanos <= options.max_age_nanos
}

/// Whether a probe of the last input's grasp was asked for after it began, and after its hand last closed.
fn was_probed(history: &[Input], asked: &[(usize, u64)]) -> bool {
    let Some(last) = history.last() else {
        return false;
    };
    let is_other = |input: &Input| {
        input.is_sample() && (input.grasp() != last.grasp() || input.prediction.phase == Phase::Closing)
    };
    let before = history.iter().rposition(is_other);
    asked.iter().any(|(idx, _)| before.is_none_or(|before| *idx > before))
}

/// Whether a probe may be asked for after the last input: as many settled inputs as there are votes, none of them unstable
/// or at fault.
fn may_ask(history: &[Input], options: &ArbiterOptions) -> bool {
    let row = &history[history.len().saturating_sub(options.votes as usize)..];
    row.len() == options.votes as usize
        && row.iter().all(|input| {
            let Prediction { stable, unsure, .. } = input.prediction;
            input.is_settled() && (stable || unsure) && is_plain_prediction(input, options)
        })
}

/// Whether the last input may be answered with the test lift once more: it says that the source waits, and the one before was of
/// the tight hand of a grasp that was probed.
fn may_go_on(history: &[Input], asked: &[(usize, u64)]) -> bool {
    let [.., before, last] = history else { return false };
    let is_tight = before.is_sample() && before.prediction.phase == Phase::Squeezed;
    is_tight && last.prediction.phase == Phase::Ended && before.grasp() == last.grasp() && was_probed(history, asked)
}

/// Whether the last input may be answered with a LIFT of its grasp: `decided` names the inputs that were answered with a
/// decision, and the grasps decided.
fn may_lift(history: &[Input], decided: &[(usize, u64)], options: &ArbiterOptions) -> bool {
    let Some(last) = history.last() else {
        return false;
    };
    // The inputs of the grasp are the last ones, and nothing else lies between them.
    let n_of_grasp =
        history.iter().rev().take_while(|input| input.is_sample() && input.grasp() == last.grasp()).count();
    let (before, grasp) = history.split_at(history.len() - n_of_grasp);
    let is_heard_before = before.iter().any(|input| input.is_sample() && input.grasp() == last.grasp());
    let begins_in_order = match before.iter().rev().find(|input| input.is_sample()) {
        None => grasp.first().is_some_and(|first| first.header.seq == 0),
        Some(previous) if previous.header.epoch != last.header.epoch => {
            let is_decided = previous.prediction.grasp_id != last.prediction.grasp_id
                || decided.iter().any(|(idx, id)| *idx < before.len() && *id == last.prediction.grasp_id);
            is_decided && grasp.first().is_some_and(|first| first.header.seq == 0)
        }
        Some(previous) => previous.step != 'U' && grasp.first().is_some_and(|first| first.follows(previous)),
    };
    let is_unbroken = (1..grasp.len()).all(|idx| {
        let (last, now) = (&grasp[idx - 1], &grasp[idx]);
        let limit_nanos = gap_limit_nanos(&history[..before.len() + idx], now.header.epoch, options);
        now.follows(last) && now.header.stamp_nanos - last.header.stamp_nanos <= limit_nanos
    });
    // The row goes back to the first input of as many different times as there are votes.
    let mut times = Vec::new();
    let mut row = Vec::new();
    for idx in (0..history.len()).rev().take(grasp.len()) {
        let input = &history[idx];
        row.push(input);
        let is_new = idx == 0
            || history[idx - 1].header.epoch != input.header.epoch
            || history[idx - 1].header.stamp_nanos != input.header.stamp_nanos;
        if is_new {
            times.push(input.header.stamp_nanos);
        }
        if times.len() == options.votes as usize {
            break;
        }
    }
    let all_agree = row.iter().all(|input| {
        let Prediction { stable, unsure, probability_stable, .. } = input.prediction;
        let is_probable = probability_stable >= options.min_probability_stable;
        let is_stable = is_probable && (options.min_probability_stable > 0.0 || stable && !unsure);
        input.decides(options) && is_stable && input.header.made_by == last.header.made_by
    });
    !is_heard_before
        && begins_in_order
        && is_unbroken
        && grasp.iter().all(|input| is_plain_prediction(input, options))
        && times.len() == options.votes as usize
        && times.windows(2).all(|pair| pair[0] > pair[1])
        && all_agree
}

/// Whether the last input may be answered with what the arm should do while it lifts: `lifted` are the inputs that were
/// answered with LIFT, and their grasps.
fn may_react(history: &[Input], lifted: &[(usize, u64)], decision: &LiftDecision, options: &ArbiterOptions) -> bool {
    let (Some(last), Some((lift_idx, id))) = (history.last(), lifted.last()) else { return false };
    let grasp = history[*lift_idx].grasp();
    if grasp.1 != *id || decision.grasp_id != *id || last.grasp() != grasp || !last.is_sample() {
        return false;
    }
    let samples: Vec<&Input> = history.iter().filter(|input| input.is_sample()).collect();
    let readings = samples.windows(2).rev().filter(|pair| {
        let (before, now) = (pair[0].header, pair[1].header);
        let is_new = (now.epoch, now.stamp_nanos) != (before.epoch, before.stamp_nanos);
        let is_of_lift = pair[1].grasp() == grasp && pair[1].prediction.phase == Phase::Lifting && is_new;
        is_of_lift || pair[1].step == 'U'
    });
    // A frame after a lost one is judged all the same.
    let has_vote = |pair: &&[&Input]| {
        let (before, now) = (pair[0].header, pair[1].header);
        let is_later = (before.epoch, before.hand_id) == (now.epoch, now.hand_id)
            && (before.seq, before.stamp_nanos) < (now.seq, now.stamp_nanos)
            && before.stamp_nanos < now.stamp_nanos;
        (is_later || pair[1].follows(pair[0])) && is_plain_prediction(pair[1], options)
    };
    let votes = options.votes as usize;
    if decision.action == Action::GoOn {
        let mut latest = readings.take(votes);
        let are_stable = latest.all(|pair| pair[1].follows(pair[0]) && has_vote(&pair) && pair[1].prediction.stable);
        return last.prediction.phase == Phase::Ended && (decision.reason == Reason::NoAgreement || are_stable);
    }
    let is_slipping =
        |prediction: &Prediction| !prediction.stable && (!prediction.unsure || decision.action == Action::Tighten);
    let is_same = |pair: &&[&Input]| pair[1].header.made_by == last.header.made_by;
    let n_in_row =
        readings.filter(has_vote).take_while(|pair| is_same(pair) && is_slipping(&pair[1].prediction)).count();
    // Between two steps there are twice as many readings as votes.
    let is_time = decision.action == Action::SetDown || n_in_row % (2 * votes) == votes;
    n_in_row >= votes && is_time && last.prediction.phase == Phase::Lifting
}

/// Each grasp that was heard of is decided once. A grasp that goes on while its source starts anew, even several times,
/// may have one decision for these epochs.
fn check_decisions(history: &[Input], decided: &[(usize, u64)]) {
    let mut n_decisions: BTreeMap<(u64, u64), usize> = BTreeMap::new();
    for input in history.iter().filter(|input| input.is_sample()) {
        n_decisions.entry(input.grasp()).or_default();
    }
    for (idx, id) in decided {
        let of = history[..(idx + 1).min(history.len())].iter().rev();
        let heard = of.clone().find(|input| input.is_sample() && input.prediction.grasp_id == *id);
        let grasp = heard.map(Input::grasp).unwrap_or_else(|| panic!("grasp {id} is decided unheard: {history:?}"));
        *n_decisions.entry(grasp).or_default() += 1;
    }
    for ((epoch, id), n) in &n_decisions {
        let of_epoch = |epoch: u64| n_decisions.get(&(epoch, *id)).copied();
        let earlier = (0..*epoch).rev().map_while(of_epoch);
        let shared: usize = earlier.chain((*epoch + 1..).map_while(of_epoch)).sum();
        assert!(*n <= 1, "grasp {id} of epoch {epoch} is decided {n} times: {history:?}");
        assert!(*n + shared > 0, "grasp {id} of epoch {epoch} is not decided: {history:?}");
    }
}

struct Explorer {
    options: ArbiterOptions,
    history: Vec<Input>,
    decided: Vec<(usize, u64)>,
    /// The inputs that were answered with a probe, and their grasps.
    asked: Vec<(usize, u64)>,
    /// Those that were answered with LIFT.
    lifted: Vec<(usize, u64)>,
    steps: &'static str,
    n_histories: u64,
    n_lifts: u64,
    n_reactions: u64,
}

impl Explorer {
    /// Gives the arbiter one more input, and returns it with what it then knows.
    fn step(&mut self, arbiter: &LiftArbiter, step: Step) -> LiftArbiter {
        let mut next = LiftArbiter::new(self.options);
        next.restore(arbiter.state().clone());
        let input = Input::after(self.history.last(), step, &self.options);
        let mut decisions: Vec<LiftDecision> = Vec::new();
        match step {
            'Z' => decisions.extend(next.on_silence()),
            'X' => decisions.extend(next.on_cut_off()),
            'U' => next.on_unreadable(&input.header, input.prediction.grasp_id, &mut decisions),
            _ => next.on_prediction(&input.header, &input.prediction, input.age_nanos, &mut decisions),
        }
        let grasp_id = input.prediction.grasp_id;
        self.history.push(input);
        let idx = self.history.len() - 1;
        for decision in decisions
            .extract_if(.., |decision| matches!(decision.action, Action::Tighten | Action::SetDown | Action::GoOn))
        {
            assert!(
                may_react(&self.history, &self.lifted, &decision, &self.options),
                "{decision:?} after {:#?}",
                self.history
            );
            self.n_reactions += 1;
        }
        for decision in decisions.extract_if(.., |decision| !decision.action.decides()) {
            let asks = may_ask(&self.history, &self.options) && !was_probed(&self.history, &self.asked);
            assert!(asks || may_go_on(&self.history, &self.asked), "{decision:?} after {:#?}", self.history);
            self.asked.push((idx, decision.grasp_id));
        }
        for decision in &decisions {
            if decision.action == Action::Lift {
                self.n_lifts += 1;
                self.lifted.push((idx, grasp_id));
                assert!(
                    decision.grasp_id == grasp_id
                        && !arbiter.state().promise().is_withdrawn()
                        && may_lift(&self.history, &self.decided, &self.options)
                        && (self.options.probe == Probe::None || was_probed(&self.history, &self.asked)),
                    "{decision:?} after {:#?}",
                    self.history
                );
            }
        }
        self.decided.extend(decisions.iter().map(|decision| (idx, decision.grasp_id)));
        next
    }

    fn explore(&mut self, arbiter: &LiftArbiter, n_left: usize) {
        self.n_histories += 1;
        if n_left == 0 {
            let mut last = LiftArbiter::new(self.options);
            last.restore(arbiter.state().clone());
            let n_decided = self.decided.len();
            self.decided.extend(last.on_end().map(|decision| (self.history.len(), decision.grasp_id)));
            check_decisions(&self.history, &self.decided);
            self.decided.truncate(n_decided);
            return;
        }
        for step in self.steps.chars() {
            let (n_decided, n_asked, n_lifted) = (self.decided.len(), self.asked.len(), self.lifted.len());
            let next = self.step(arbiter, step);
            self.explore(&next, n_left - 1);
            self.history.pop();
            self.decided.truncate(n_decided);
            self.asked.truncate(n_asked);
            self.lifted.truncate(n_lifted);
        }
    }
}

/// All histories of up to `n_steps` more inputs after each of some beginnings.
fn explore(options: ArbiterOptions, steps: &'static str, beginnings: &[String], n_steps: usize) -> u64 {
    let jobs: Vec<(&String, Step)> =
        beginnings.iter().flat_map(|beginning| steps.chars().map(move |step| (beginning, step))).collect();
    let (n_histories, n_lifts, n_reactions) = jobs
        .into_par_iter()
        .map(|(beginning, first)| {
            let (history, decided, asked, lifted) = (vec![], vec![], vec![], vec![]);
            let (n_histories, n_lifts, n_reactions) = (0, 0, 0);
            let mut explorer =
                Explorer { options, history, decided, asked, lifted, steps, n_histories, n_lifts, n_reactions };
            let mut arbiter = LiftArbiter::new(options);
            for step in beginning.chars().chain([first]) {
                arbiter = explorer.step(&arbiter, step);
            }
            explorer.explore(&arbiter, n_steps - 1);
            (explorer.n_histories, explorer.n_lifts, explorer.n_reactions)
        })
        .reduce(|| (0, 0, 0), |a, b| (a.0 + b.0, a.1 + b.1, a.2 + b.2));
    println!("{options:?}: {n_histories} histories, {n_lifts} lifts, {n_reactions} reactions");
    assert!(n_lifts > 1000, "{n_lifts} lifts show nothing");
    n_reactions
}

#[test]
fn no_history_lifts_against_the_specification_and_each_grasp_is_decided_once() {
    for votes in [2, 3] {
        // One drop withdraws the promise.
        let (promised_drops, min_probability_stable) = (0.0, 0.6);
        let options = ArbiterOptions { votes, min_probability_stable, promised_drops, ..ArbiterOptions::default() };
        // Nothing; a grasp with one vote less than it needs; a grasp that is decided.
        let beginnings = [0, votes as usize - 1, votes as usize].map(|n_stable| "+".repeat(n_stable));
        explore(options, STEPS, &beginnings, 5);
    }
}

#[test]
fn no_history_of_a_slow_hand_lifts_after_a_gap_that_is_long_for_this_hand() {
    for votes in [1, 2] {
        let options = ArbiterOptions { votes, ..ArbiterOptions::default() };
        // Its pace is not known yet; it is known; it was known, and the hand is faster now.
        let beginnings = ["ssssss", "ssssssssss", "scccccssssscc"].map(String::from);
        explore(options, STEPS_OF_SLOW_HANDS, &beginnings, 5);
    }
}

#[test]
fn no_history_with_a_probe_lifts_before_the_probe_was_asked_for_and_felt() {
    for votes in [1, 2] {
        let options = ArbiterOptions {
            votes,
            probe: Probe::TestLift,
            min_probability_stable: 0.6,
            promised_drops: 0.0,
            ..ArbiterOptions::default()
        };
        let n = votes as usize;
        // Nothing; a grasp of which a probe was asked for; one vote less than it needs after that.
        let asked = "?".repeat(n);
        let felt = format!("{asked}l{}", "t".repeat(n - 1));
        explore(options, STEPS_WITH_PROBE, &[String::new(), asked, felt], 5);
    }
}

#[test]
fn no_history_lifts_while_a_lift_is_watched_and_reactions_follow_votes_of_the_lift_alone() {
    for votes in [1, 2] {
        let options = ArbiterOptions { votes, promised_drops: 0.0, ..ArbiterOptions::default() };
        let lifted = "+".repeat(votes as usize);
        let beginnings = [lifted.clone(), lifted + &"v".repeat(votes as usize - 1)];
        let n_reactions = explore(options, STEPS_WHILE_LIFTING, &beginnings, 5);
        assert!(n_reactions > 1000, "{n_reactions} reactions show nothing");
    }
}
