//! The audit log: the requests to change a running graph or to record it, with client and outcome.
//!
//! Each request leaves one line in `audit.log` beside the operators' logs. A client is known by its user and process.

use std::collections::VecDeque;

use crate::control::{Reply, Request, SwapRequest};
use crate::launcher::log_writer::Log;
use blindgrasp_operator::wiring::{LogEntry, LogLevel};

/// The most characters of a request or of its outcome in a line.
const MAX_CHARS: usize = 300;

/// The requests of one connection.
#[derive(Clone)]
pub(super) struct Trail {
    log: Log,
    client: String,
    /// Requests without an outcome yet.
    pending: VecDeque<String>,
}

impl Trail {
    pub(super) fn new(log: Log, client: String) -> Trail {
        Trail { log, client, pending: VecDeque::new() }
    }

    /// Takes a request.
    pub(super) fn asked(&mut self, request: &Request) {
        if request.is_control() || matches!(request, Request::Attach { .. }) {
            self.pending.push_back(summary(request));
        }
    }

    /// Takes a reply, which may be the outcome of the oldest request.
    pub(super) fn answered(&mut self, reply: &Reply) {
        if let Some((outcome, level)) = outcome(reply)
            && let Some(what) = self.pending.pop_front()
        {
            self.write(&what, &outcome, level);
        }
    }

    /// The client has gone.
    pub(super) fn ended(&mut self) {
        while let Some(what) = self.pending.pop_front() {
            self.write(&what, "the client left before the answer", LogLevel::Warn);
        }
    }

    fn write(&self, what: &str, outcome: &str, level: LogLevel) {
        let text = format!("{}: {}: {}", self.client, short(what), short(outcome));
        self.log.write_patiently(LogEntry { level: Some(level), ..LogEntry::plain(text) });
    }
}

fn short(text: &str) -> String {
    let beginning: String = text.replace('\n', " ").chars().take(MAX_CHARS).collect();
    if beginning.len() < text.len() { beginning + " …" } else { beginning }
}

/// A request in words, like the command that makes it.
pub fn summary(request: &Request) -> String {
    match request {
        Request::Set { node, param, value } => format!("set {node}.{param}={value}"),
        Request::Attach { ports, .. } if ports.is_empty() => "attach to all ports".into(),
        Request::Attach { ports, .. } => format!("attach to {}", ports.join(" ")),
        Request::Swap(SwapRequest { nodes, program, args, set, allow_mismatch, .. }) => {
            let mut words = format!("swap {}", nodes.join(","));
            if let Some(program) = program {
                words += &format!(" --run {}", program.display());
            }
            words.extend(args.iter().flatten().map(|arg| format!(" {arg}")));
            words.extend(set.iter().map(|(param, value)| format!(" --set {param}={value}")));
            if *allow_mismatch {
                words += " --allow-mismatch";
            }
            words
        }
        request => request.word().into(),
    }
}

/// The outcome of a request; `None` if more replies follow.
fn outcome(reply: &Reply) -> Option<(String, LogLevel)> {
    let accepted = match reply {
        Reply::Stopping | Reply::Attached(_) | Reply::Abandoned => "accepted".to_owned(),
        Reply::Set { old, new, .. } => format!("accepted: {old} became {new}"),
        Reply::Shadowing { .. } => "accepted: it computes beside the running operator".to_owned(),
        Reply::Swapped { nodes } => {
            let pids = nodes.iter().map(|node| format!("{} {} became {}", node.node, node.old_pid, node.new_pid));
            format!("accepted: process {}", pids.collect::<Vec<_>>().join(", "))
        }
        Reply::Error { message, rolled_back } => {
            let word = if *rolled_back { "rolled back" } else { "refused" };
            return Some((format!("{word}: {message}"), LogLevel::Warn));
        }
        Reply::Status(_) | Reply::Drained | Reply::Keep | Reply::Asked { .. } | Reply::Progress { .. } => return None,
    };
    Some((accepted, LogLevel::Info))
}

#[cfg(test)]
mod tests {
    use std::os::unix::net::{UnixListener, UnixStream};
    use std::sync::mpsc::sync_channel;

    use serde_json::json;

    use std::collections::BTreeMap;

    use super::*;
    use crate::launcher::Event;
    use crate::launcher::log_writer::LogWriter;
    use crate::log::{AUDIT, LogFolder, LogFormat, LogReader};

    #[test]
    fn each_request_for_a_change_leaves_a_line_with_its_client_and_its_outcome() {
        use std::io::{BufRead, BufReader, Write};

        let temporary = tempfile::tempdir().expect("a folder");
        let folder = LogFolder::at(temporary.path().join("graph"));
        let writer = LogWriter::new(folder.clone(), LogFormat::Text);
        let listener = UnixListener::bind(temporary.path().join("socket")).expect("bound");
        let (events, asked) = sync_channel(8);
        let server = crate::launcher::server::serve(&listener, BTreeMap::new(), &events, writer.log_if_written(AUDIT))
            .expect("served");
        // The launcher: it refuses a second vote.
        let launcher = std::thread::spawn(move || {
            while let Ok(event) = asked.recv() {
                let Event::Ask(ask) = event else { return };
                let reply = match &ask.request {
                    Request::Set { value, .. } if *value == 5 => {
                        Reply::Set { old: json!(3), new: json!(5), from_seq: None }
                    }
                    Request::Set { .. } => Reply::Error { message: "out of\nrange".into(), rolled_back: false },
                    Request::Swap(_) => continue,
                    _ => Reply::Stopping,
                };
                ask.reply.send(reply).expect("heard");
            }
        });
        let mut client = UnixStream::connect(temporary.path().join("socket")).expect("connected");
        let mut replies = BufReader::new(client.try_clone().expect("cloned")).lines();
        let mut say = |request: &Request, has_reply: bool| {
            writeln!(client, "{}", serde_json::to_string(request).expect("JSON")).expect("sent");
            if has_reply {
                replies.next().expect("a reply").expect("read");
            }
        };
        let set = |value| Request::Set { node: "arbiter".into(), param: "votes".into(), value };
        say(&set(json!(5)), true);
        say(&set(json!("x".repeat(1000))), true);
        say(&Request::Stop, true);
        let swap = SwapRequest {
            nodes: vec!["a".into(), "b".into()],
            program: Some("/bin/other".into()),
            args: Some(vec!["-x".into()]),
            set: [("model".to_owned(), "m.json".to_owned())].into(),
            folder: "/".into(),
            shadow_limit_millis: 0,
            ready_limit_millis: 1,
            probation_millis: 1,
            allow_mismatch: false,
        };
        say(&Request::Swap(swap), false);
        client.shutdown(std::net::Shutdown::Both).expect("closed");
        launcher.join().expect("ended");
        drop(server);
        drop(writer);

        let lines = LogReader::new(&folder, AUDIT).read().expect("readable");
        let who = format!("uid {} pid {}", rustix::process::getuid().as_raw(), std::process::id());
        let texts: Vec<&str> = lines[1..].iter().map(|line| line.text.as_str()).collect();
        assert_eq!(texts.len(), 4, "{texts:?}");
        assert_eq!(texts[0], format!("{who}: set arbiter.votes=5: accepted: 3 became 5"));
        assert!(texts[1].starts_with(&format!("{who}: set arbiter.votes=\"xxx")) && texts[1].len() < 500);
        assert!(texts[1].ends_with(": refused: out of range"), "{}", texts[1]);
        assert_eq!(texts[2], format!("{who}: stop: accepted"));
        let swap = "swap a,b --run /bin/other -x --set model=m.json: the client left before the answer";
        assert_eq!(texts[3], format!("{who}: {swap}"));
        assert!(lines[1..].iter().all(|line| line.level.is_some() && !line.time.is_empty()), "{lines:?}");
    }
}
