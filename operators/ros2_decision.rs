//! Decisions as ROS 2 has them: the message for programs that move an arm, and the service that waits for a decision.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use anyhow::Context as _;
use blindgrasp_messages::LiftDecision;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_recording::cdr::encode;
use blindgrasp_ros::cdr;
use blindgrasp_ros::definition::Definition;
use blindgrasp_ros::node::{MessageType, Request};
use blindgrasp_ros::standard;
use serde::Serialize;

use super::publishing::unix_nanos;

/// The definition of decisions, made for programs that move an arm.
pub(super) const DECISION: &str = include_str!("Decision.msg");
const DECISION_SCHEMA: &str = "blindgrasp_msgs/msg/Decision";
/// The service that waits for a decision.
const DECIDE: &str = include_str!("Decide.srv");
const DECIDE_SCHEMA: &str = "blindgrasp_msgs/srv/Decide";
const MAX_TIMEOUT_SECS: f64 = 60.0;
/// Calls that wait at the same time; others are answered at once, without a decision.
const MAX_WAITING: usize = 16;

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

impl Decision {
    /// As it is said now, of a decision that is valid until a time of this machine.
    pub(super) fn new(decision: &LiftDecision, until_nanos: u64) -> Decision {
        let time = |nanos: u64| Time {
            sec: i32::try_from(nanos / 1_000_000_000).unwrap_or(i32::MAX),
            nanosec: (nanos % 1_000_000_000) as u32,
        };
        let now = unix_nanos();
        Decision {
            stamp: time(now),
            valid_until: time(now + until_nanos.saturating_sub(monotonic_nanos())),
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
    /// The decision, and until when it is valid by the clock of this machine.
    decision: Mutex<Option<(LiftDecision, u64)>>,
    comes: Condvar,
    n_waiting: AtomicUsize,
}

impl LastDecision {
    pub(super) fn set(&self, decision: &LiftDecision, until_nanos: u64) {
        *self.decision.lock().unwrap_or_else(PoisonError::into_inner) = Some((decision.clone(), until_nanos));
        self.comes.notify_all();
    }

    /// The last decision if it is valid, or else the next one that is, within the time.
    fn wait(&self, longest: Duration) -> Option<Decision> {
        let is_too_old = |decision: &mut Option<(LiftDecision, u64)>| {
            decision.as_ref().is_none_or(|(_, until_nanos)| *until_nanos <= monotonic_nanos())
        };
        let decision = self.decision.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.comes.wait_timeout_while(decision, longest, is_too_old);
        let (decision, timeout) = waited.unwrap_or_else(PoisonError::into_inner);
        if timeout.timed_out() {
            return None;
        }
        let (decision, until_nanos) = decision.as_ref()?;
        Some(Decision::new(decision, *until_nanos))
    }

    /// Answers a call whose request is of this definition, in a thread of its own, because it waits. A longer time than
    /// [`MAX_TIMEOUT_SECS`] is cut to that; without a number above 0, the call does not wait.
    pub(super) fn answer(self: &Arc<Self>, definition: &Definition, request: Request) {
        let last = Arc::clone(self);
        let read = cdr::read(definition, &request.bytes).ok().and_then(|value| value.at("timeout_secs")?.numbers());
        let timeout_secs = read.and_then(|numbers| numbers.first().copied()).filter(|secs| *secs > 0.0).unwrap_or(0.0);
        let timeout_secs = timeout_secs.min(MAX_TIMEOUT_SECS);
        let has_room = self.n_waiting.fetch_add(1, Ordering::Relaxed) < MAX_WAITING;
        let longest = Duration::from_secs_f64(if has_room { timeout_secs } else { 0.0 });
        let answering = move || {
            let decision = last.wait(longest);
            let mut data = Vec::new();
            let answer = (decision.is_some(), decision.unwrap_or_default());
            if encode(&answer, &mut data).is_ok()
                && let Err(error) = request.answer(&data)
            {
                print_diagnostic(&format!("a call of decide is not answered: {error}"));
            }
            last.n_waiting.fetch_sub(1, Ordering::Relaxed);
        };
        if std::thread::Builder::new().name("decide".into()).spawn(answering).is_err() {
            self.n_waiting.fetch_sub(1, Ordering::Relaxed);
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

    use super::*;

    #[test]
    fn a_call_gets_the_valid_decision_or_waits_for_the_next_or_gets_none() {
        let last = Arc::new(LastDecision::default());
        let decision = |grasp_id| LiftDecision { grasp_id, ..LiftDecision::default() };
        assert!(last.wait(Duration::ZERO).is_none());
        // One that is no longer valid is not told.
        last.set(&decision(1), monotonic_nanos() - 1);
        assert!(last.wait(Duration::from_millis(20)).is_none());
        last.set(&decision(2), monotonic_nanos() + 60_000_000_000);
        assert_eq!(last.wait(Duration::ZERO).map(|decision| decision.grasp_id), Some(2));
        last.set(&decision(3), 0);
        let other = Arc::clone(&last);
        let waiting = std::thread::spawn(move || other.wait(Duration::from_secs(60)).map(|found| found.grasp_id));
        std::thread::sleep(Duration::from_millis(20));
        last.set(&decision(4), monotonic_nanos() + 60_000_000_000);
        assert_eq!(waiting.join().expect("ended"), Some(4));
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
