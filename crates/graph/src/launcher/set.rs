//! Values of live parameters on their way to a node's process.
//!
//! A process that does not answer in time may be stopped, and takes the value when it goes on. So its late answer counts as well:
//! the node's params are always those by which its process works.

use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use serde_json::{Map, Value};

use crate::control::Reply;
use crate::launcher::Launcher;
use crate::launcher::lifecycle::Surroundings;
use blindgrasp_operator::wiring::Command;

/// An operator must apply a parameter within this time.
const SET_LIMIT: Duration = Duration::from_secs(5);

/// A value that a process was told, and has not answered.
pub(super) struct PendingSet {
    /// Of the command.
    id: u64,
    /// The index of the node among the members, and the id of its instance.
    idx: usize,
    instance: u64,
    param: String,
    old: Value,
    new: Value,
    /// The node's params with the new value.
    params: Map<String, Value>,
    since: Instant,
    /// `None` once the client was told that it takes too long.
    reply: Option<SyncSender<Reply>>,
}

impl Launcher {
    /// Whether a command waits for the answer of an operator.
    pub(super) fn is_setting(&self) -> bool {
        self.settings.iter().any(|setting| setting.reply.is_some())
    }

    /// Tells a node's process a value.
    pub(super) fn set(
        &mut self,
        id: &str,
        param: String,
        value: &Value,
        reply: &SyncSender<Reply>,
    ) -> Result<(), String> {
        let idx = self.life.member_idx(id)?;
        if self.life.swap.as_ref().is_some_and(|swap| swap.concerns(id)) {
            return Err(format!("node '{id}' is being swapped; try again when that is over"));
        }
        let member = &self.life.members[idx];
        let description = &member.node.description;
        crate::dataflow::live_param(description, &param)?;
        let new = crate::dataflow::accept_param_value(description, &param, value, self.life.folder())?;
        let Some(active) = member.active.as_ref().filter(|active| active.is_ready()) else {
            return Err(format!("node '{id}' is not running at the moment"));
        };
        if let Some(earlier) = self.settings.iter().find(|setting| setting.instance == active.id) {
            return Err(format!(
                "node '{id}' has not answered 'set {id}.{}={}' yet: its process is stopped or hangs",
                earlier.param, earlier.new
            ));
        }
        let mut params = member.node.params.clone();
        let old = params.insert(param.clone(), new.clone()).unwrap_or(Value::Null);
        self.n_sets += 1;
        self.life.site.tell(active.id, &Command::Set { id: self.n_sets, params: params.clone() });
        self.settings.push(PendingSet {
            id: self.n_sets,
            idx,
            instance: active.id,
            param,
            old,
            new,
            params,
            since: Instant::now(),
            reply: Some(reply.clone()),
        });
        Ok(())
    }

    /// Takes in the answer of a process, however late it is.
    pub(super) fn on_set(&mut self, id: u64, from_seq: Option<u64>, error: Option<String>) {
        let Some(at) = self.settings.iter().position(|setting| setting.id == id) else {
            return;
        };
        let PendingSet { idx, param, old, new, params, since, reply, .. } = self.settings.remove(at);
        let node = self.life.members[idx].node.id.clone();
        let answer = match error {
            Some(error) => Reply::refusal(format!("node '{node}' does not take it: {error}")),
            None => {
                self.life.members[idx].node.params = params;
                let from = from_seq.map_or("the first sample".into(), |seq| format!("sample {seq}"));
                let late = match &reply {
                    Some(_) => String::new(),
                    None => format!(", {:.1} s after it was asked", since.elapsed().as_secs_f64()),
                };
                self.life.site.say(&format!("blindgrasp: {node}.{param}: {old} -> {new}, from {from} on{late}"));
                Reply::Set { old, new, from_seq }
            }
        };
        if let Some(reply) = reply {
            let _ = reply.try_send(answer);
        }
    }

    /// Answers the commands whose process has ended, or takes too long.
    pub(super) fn look_at_settings(&mut self) {
        let mut settings = std::mem::take(&mut self.settings);
        settings.retain_mut(|setting| {
            let member = &self.life.members[setting.idx];
            let mut is_there = false;
            for instance in member.instances() {
                is_there |= instance.id == setting.instance && instance.is_running();
            }
            let id = &member.node.id;
            let message = if !is_there {
                format!("node '{id}' ended before it took the value")
            } else if setting.since.elapsed() > SET_LIMIT {
                let limit = SET_LIMIT.as_secs();
                format!(
                    "node '{id}' did not take the value within {limit} s; if it does so later, ps and the log say it"
                )
            } else {
                return true;
            };
            if let Some(reply) = setting.reply.take() {
                let _ = reply.try_send(Reply::refusal(message));
            }
            is_there
        });
        self.settings = settings;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Request;
    use crate::launcher::tests::{STUB, ask, launched, work_until};

    #[test]
    fn a_value_that_a_process_takes_after_the_limit_is_its_value() {
        let folder = tempfile::tempdir().expect("a folder");
        let goes_on = folder.path().join("goes-on");
        let script = "read -r set; while [ ! -e \"$0\" ]; do sleep 0.01; done
            echo '{\"report\":\"set\",\"id\":1,\"from_seq\":7}' >&3; exec cat > /dev/null";
        let mut graph = launched("late-set", script, goes_on.to_str().expect("UTF-8"));
        let launcher = &mut graph.launcher;
        let set = |votes: u32| ask(Request::Set { node: STUB.into(), param: "votes".into(), value: votes.into() });
        let (asked, refused) = set(9);
        launcher.on_ask(asked);
        work_until(launcher, Launcher::is_setting);
        launcher.settings[0].since -= 2 * SET_LIMIT;
        work_until(launcher, |launcher| !launcher.is_setting());
        let refused = format!("{:?}", refused.try_recv());
        assert!(refused.contains("did not take the value within 5 s"), "{refused}");
        assert_eq!(launcher.status().nodes[0].params["votes"], 3);
        let (asked, next) = set(5);
        launcher.on_ask(asked);
        launcher.turn().expect("supervised");
        let next = format!("{:?}", next.try_recv());
        assert!(next.contains("has not answered 'set stub.votes=9' yet"), "{next}");
        std::fs::write(&goes_on, "").expect("written");
        work_until(launcher, |launcher| launcher.settings.is_empty());
        assert_eq!(launcher.status().nodes[0].params["votes"], 9, "a restart gives it to the next process");
    }
}
