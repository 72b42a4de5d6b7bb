//! Decisions as ROS 2 has them: the message for programs that move an arm, and the service that waits for a decision.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::Context as _;
use blindgrasp_messages::{Action, LiftDecision};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_recording::cdr::encode;
use blindgrasp_ros::cdr;
use blindgrasp_ros::definition::Definition;
use blindgrasp_ros::standard;
use blindgrasp_ros_node::node::{MessageType, Request};
use serde::Serialize;

use super::publishing::unix_nanos;

/// The definition of decisions, made for programs that move an arm.
pub(super) const DECISION: &str = include_str!("Decision.msg");
const DECISION_SCHEMA: &str = "blindgrasp_msgs/msg/Decision";
/// The service that waits for a decision.
const DECIDE: &str = include_str!("Decide.srv");
const DECIDE_SCHEMA: &str = "blindgrasp_msgs/srv/Decide";
const MAX_TIMEOUT_SECS: f64 = 60.0;
/// Calls that wait at the same time.
const MAX_WAITING: usize = 64;

/// `blindgrasp_msgs/msg/Decision`.
#[derive(Serialize, Default)]
pub(super) struct Decision {
    stamp: Time,
    valid_until: Time,
    grasp_id: u64,
    action: u8,
    reason: String,
    probability_stable: f64,
}

#[derive(Serialize, Default)]
struct Time {
    sec: i32,
    nanosec: u32,
}

impl Time {
    fn of(nanos: u64) -> Time {
        Time { sec: i32::try_from(nanos / 1_000_000_000).unwrap_or(i32::MAX), nanosec: (nanos % 1_000_000_000) as u32 }
    }
}

impl Decision {
    /// As it is said now, of a decision that is valid until a time of this machine; without such a time it is not valid.
    pub(super) fn new(decision: &LiftDecision, until_nanos: Option<u64>) -> Decision {
        let (now, now_nanos) = (unix_nanos(), monotonic_nanos());
        let mut decision = decision.clone();
        decision.expire(until_nanos, now_nanos);
        Decision {
            stamp: Time::of(now),
            valid_until: Time::of(now + until_nanos.unwrap_or(0).saturating_sub(now_nanos)),
            grasp_id: decision.grasp_id,
            action: decision.action.code() as u8,
            reason: decision.reason.as_str().into(),
            probability_stable: decision.probability_stable,
        }
    }
}

/// The last decision, for calls that wait for one.
#[derive(Default)]
pub(super) struct LastDecision {
    calls: Mutex<Calls>,
    changes: Condvar,
}

#[derive(Default)]
struct Calls {
    /// The decision, and until when it is valid by the clock of this machine.
    decision: Option<(LiftDecision, Option<u64>)>,
    /// The calls that wait, the eldest first.
    waiting: VecDeque<u64>,
    n_calls: u64,
}

impl Calls {
    fn is_valid(&self) -> bool {
        let until_nanos = self.decision.as_ref().and_then(|(_, until_nanos)| *until_nanos);
        until_nanos.is_some_and(|until_nanos| until_nanos > monotonic_nanos())
    }
}

impl LastDecision {
    /// Keeps a decision. `go_on` does not take the place of `tighten`, which is said once.
    pub(super) fn set(&self, decision: &LiftDecision, until_nanos: Option<u64>) {
        let mut calls = self.calls();
        let is_told_to_tighten = calls.is_valid()
            && calls
                .decision
                .as_ref()
                .is_some_and(|(last, _)| (last.grasp_id, last.action) == (decision.grasp_id, Action::Tighten));
        if decision.action == Action::GoOn && is_told_to_tighten {
            return;
        }
        calls.decision = Some((decision.clone(), until_nanos));
        drop(calls);
        self.changes.notify_all();
    }

    fn calls(&self) -> MutexGuard<'_, Calls> {
        self.calls.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A place among the calls that wait. If there is none, the eldest call makes room: it is answered without a decision.
    fn enter(&self) -> u64 {
        let mut calls = self.calls();
        calls.n_calls += 1;
        let call = calls.n_calls;
        calls.waiting.push_back(call);
        if calls.waiting.len() > MAX_WAITING {
            calls.waiting.pop_front();
            self.changes.notify_all();
        }
        call
    }

    /// The last decision if it is valid, or else the next one that is, within the time and as long as the call has its place.
    fn wait(&self, call: u64, longest: Duration) -> Option<Decision> {
        let waited = self
            .changes
            .wait_timeout_while(self.calls(), longest, |calls| !calls.is_valid() && calls.waiting.contains(&call));
        let (mut calls, _) = waited.unwrap_or_else(PoisonError::into_inner);
        calls.waiting.retain(|waiting| *waiting != call);
        if !calls.is_valid() {
            return None;
        }
        let (decision, until_nanos) = calls.decision.as_ref()?;
        Some(Decision::new(decision, *until_nanos))
    }

    /// Answers a call whose request is of this definition, in a thread of its own, because it waits. A longer time than
    /// [`MAX_TIMEOUT_SECS`] is cut to that; without a number above 0, the call does not wait.
    pub(super) fn answer(self: &Arc<Self>, definition: &Definition, request: Request) {
        let last = Arc::clone(self);
        let read = cdr::read(definition, &request.bytes).ok().and_then(|value| value.at("timeout_secs")?.numbers());
        let timeout_secs = read.and_then(|numbers| numbers.first().copied()).filter(|secs| *secs > 0.0).unwrap_or(0.0);
        let longest = Duration::from_secs_f64(timeout_secs.min(MAX_TIMEOUT_SECS));
        let call = self.enter();
        let thread = std::thread::Builder::new().name("decide".into()).spawn(move || {
            let decision = last.wait(call, longest);
            let mut data = Vec::new();
            let answer = (decision.is_some(), decision.unwrap_or_default());
            if encode(&answer, &mut data).is_ok()
                && let Err(error) = request.answer(&data)
            {
                print_diagnostic(&format!("a call of decide is not answered: {error}"));
            }
        });
        if thread.is_err() {
            self.calls().waiting.retain(|waiting| *waiting != call);
        }
    }
}

/// The type of the service, and the definition of its requests.
pub(super) fn decide_type() -> anyhow::Result<(MessageType, Definition)> {
    let (request, response) = DECIDE.split_once("---").context("Decide.srv has no line ---")?;
    let parts = format!("{}\nMSG: blindgrasp_msgs/Decision\n{DECISION}\n", "=".repeat(80));
    let hash = standard::service(DECIDE_SCHEMA, request, response, &parts)?.hash();
    let request = Definition::parse("blindgrasp_msgs/srv/Decide_Request", request)?;
    Ok((MessageType { name: DECIDE_SCHEMA.into(), hash }, request))
}

/// The type of [`Decision`].
pub(super) fn decision_type() -> anyhow::Result<MessageType> {
    let text = standard::with_parts(DECISION, &["builtin_interfaces/Time"]);
    let hash = Definition::parse(DECISION_SCHEMA, &text)?.hash();
    Ok(MessageType { name: DECISION_SCHEMA.into(), hash })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use blindgrasp_messages::Reason;

    use super::*;

    /// The hashes that the generators of ROS 2 Kilted give the package of messages.
    #[test]
    fn hashes_are_those_of_ros_2() {
        let decide = decide_type().expect("a type").0.hash;
        assert_eq!(decide, "RIHS01_3a3db401d17c9a9d5bf44c9dc831b8f557b00d92376b56e7cc7a0943bb8187ef");
        let decision = decision_type().expect("a type").hash;
        assert_eq!(decision, "RIHS01_ee09b7459ecfa1dff2e058e5677af62831667101a87eed055c5b2ecfb91b3bf7");
    }

    #[test]
    fn a_call_gets_the_valid_decision_or_waits_for_the_next_or_gets_none() {
        let last = Arc::new(LastDecision::default());
        let decision = |grasp_id| LiftDecision { grasp_id, ..LiftDecision::default() };
        let wait = |longest| last.wait(last.enter(), longest);
        assert!(wait(Duration::ZERO).is_none());
        // One that is no longer valid is not told.
        last.set(&decision(1), Some(monotonic_nanos() - 1));
        assert!(wait(Duration::from_millis(20)).is_none());
        last.set(&decision(2), Some(monotonic_nanos() + 60_000_000_000));
        assert_eq!(wait(Duration::ZERO).map(|decision| decision.grasp_id), Some(2));
        // The answer to a robot that asks while it lifts does not hide the advice before it.
        let while_lifting = |action| LiftDecision { action, ..decision(2) };
        let until_nanos = Some(monotonic_nanos() + 60_000_000_000);
        last.set(&while_lifting(Action::Tighten), until_nanos);
        last.set(&while_lifting(Action::GoOn), until_nanos);
        assert_eq!(wait(Duration::ZERO).map(|decision| decision.action), Some(Action::Tighten.code() as u8));
        last.set(&decision(3), None);
        let other = Arc::clone(&last);
        let waiting =
            std::thread::spawn(move || other.wait(other.enter(), Duration::from_secs(60)).map(|found| found.grasp_id));
        std::thread::sleep(Duration::from_millis(20));
        last.set(&decision(4), Some(monotonic_nanos() + 60_000_000_000));
        assert_eq!(waiting.join().expect("ended"), Some(4));
    }

    /// Calls of others that wait for long do not keep a new one out: the eldest is answered without a decision.
    #[test]
    fn a_new_call_always_waits() {
        let last = Arc::new(LastDecision::default());
        let call = |longest| {
            let (other, call) = (Arc::clone(&last), last.enter());
            std::thread::spawn(move || other.wait(call, longest).map(|found| found.grasp_id))
        };
        let eldest = call(Duration::from_secs(60));
        let others: Vec<_> = (0..MAX_WAITING).map(|_| call(Duration::from_secs(60))).collect();
        assert_eq!(eldest.join().expect("ended"), None);
        last.set(&LiftDecision { grasp_id: 9, ..LiftDecision::default() }, Some(monotonic_nanos() + 60_000_000_000));
        for other in others {
            assert_eq!(other.join().expect("ended"), Some(9));
        }
    }

    #[test]
    fn a_lift_whose_time_is_over_is_said_as_a_hold() {
        let lift = LiftDecision { action: Action::Lift, reason: Reason::Stable, ..LiftDecision::default() };
        let said = |until_nanos| Decision::new(&lift, Some(until_nanos));
        let late = said(monotonic_nanos() - 1);
        assert_eq!((late.action, late.reason.as_str()), (Action::Hold.code() as u8, Reason::Stale.as_str()));
        assert_eq!(said(monotonic_nanos() + 60_000_000_000).action, Action::Lift.code() as u8);
    }

    /// The file of the service.
    #[test]
    fn the_package_has_the_service_of_this_version() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/blindgrasp_msgs/srv/Decide.srv");
        if std::env::var_os("BLINDGRASP_REMAKE").is_some() {
            std::fs::write(&path, DECIDE).expect("written");
        }
        assert_eq!(std::fs::read_to_string(&path).expect("readable"), DECIDE);
    }
}
