//! Events of `tracing` in an operator go to the launcher, with their level and fields, and so to the graph's log.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde_json::{Map, Value};
use tracing::field::{Field, Visit};
use tracing::level_filters::LevelFilter;
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::{Context, Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;

use crate::wiring::{LogEntry, LogLevel};

/// The levels that are logged: `info`, `debug`, or by module, as in `info,my_operator=trace`.
const FILTER_VARIABLE: &str = "RUST_LOG";
/// Zenoh, whose targets begin like this, logs its own progress at `info` and repeats its warnings with each retry.
const ZENOH: &str = "zenoh";
/// Zenoh logs here at `info` that a certificate's name has no rights.
const ACCESS_CONTROL: &str = "zenoh::net::routing::interceptor::access_control";
/// Zenoh logs here why it cannot connect, but at `debug`, among other lines.
const ORCHESTRATOR: &str = "zenoh::net::runtime::orchestrator";
const CANNOT_CONNECT: &str = "Unable to connect";
/// Zenoh logs this at `warn` and returns it as well, so that the program says it.
const ANSWERED_BY_NONE: &str = "Unable to connect to any of";
/// An attempt to connect to a port at which nothing listens.
const REFUSED: &str = "Connection refused";
/// A line of Zenoh is logged once in this time.
const INTERVAL: Duration = Duration::from_secs(60);
/// The most lines that are remembered.
const MAX_LINES: usize = 256;

/// Sends this process's events to `say`. An operator that has a subscriber of its own keeps it. `tells_refused` is for an
/// operator that does not tell by itself that nothing listens at an endpoint of Zenoh.
pub(super) fn install(tells_refused: bool, say: impl Fn(LogEntry) + Send + Sync + 'static) {
    let asked_for = std::env::var(FILTER_VARIABLE).ok();
    let (filter, unreadable) = match asked_for.as_deref().map(levels_in) {
        None => (None, None),
        Some(Ok(filter)) => (Some(filter), None),
        Some(Err(error)) => (None, Some(error)),
    };
    // A user who asks for certain levels gets every line of them.
    let repeats = filter.is_none().then(|| Repeats { tells_refused, ..Repeats::default() });
    let filter = filter.unwrap_or_else(|| {
        let levels =
            [(ZENOH, LevelFilter::WARN), (ACCESS_CONTROL, LevelFilter::INFO), (ORCHESTRATOR, LevelFilter::DEBUG)];
        Targets::new().with_default(LevelFilter::INFO).with_targets(levels)
    });
    let _ = tracing_subscriber::registry().with(Sayer { say, repeats }.with_filter(filter)).try_init();
    if let Some(error) = unreadable {
        tracing::warn!("{FILTER_VARIABLE} is not read: {error}");
    }
}

/// The levels that a variable asks for. The library takes any other word for a module, and then logs nothing else.
fn levels_in(text: &str) -> Result<Targets, String> {
    for word in text.split(',').map(str::trim) {
        if !word.is_empty() && !word.contains('=') && word.parse::<LevelFilter>().is_err() {
            return Err(format!(
                "'{word}' is no level: expected off, error, warn, info, debug or trace, or MODULE=LEVEL for one module"
            ));
        }
    }
    text.parse::<Targets>().map_err(|error| error.to_string())
}

struct Sayer<F> {
    say: F,
    repeats: Option<Repeats>,
}

impl<S: Subscriber, F: Fn(LogEntry) + 'static> Layer<S> for Sayer<F> {
    fn on_event(&self, event: &Event<'_>, _context: Context<'_, S>) {
        let mut entry = entry(event);
        if event.metadata().target().starts_with(ZENOH) {
            entry.text = without_places(&entry.text);
        }
        let (target, repeats) = (event.metadata().target(), self.repeats.as_ref());
        let is_held_back = repeats.is_some_and(|repeats| repeats.holds_back(target, &entry, Instant::now()));
        if !is_held_back {
            if self.repeats.is_some() && event.metadata().target() == ORCHESTRATOR {
                // People want to see why a link does not come up.
                entry.level = entry.level.min(Some(LogLevel::Info));
            }
            (self.say)(entry);
        }
    }
}

/// The lines of Zenoh that were logged lately. All other lines pass.
#[derive(Default)]
struct Repeats {
    tells_refused: bool,
    logged: Mutex<BTreeMap<String, Instant>>,
}

impl Repeats {
    fn holds_back(&self, target: &str, entry: &LogEntry, now: Instant) -> bool {
        // Zenoh itself repeats what its TLS library logs.
        let library = entry.fields.get("log.target").and_then(Value::as_str);
        if library.is_some_and(|library| library.starts_with("rustls")) {
            return true;
        }
        if !target.starts_with(ZENOH) {
            return false;
        }
        if entry.level > Some(LogLevel::Info) && !entry.text.starts_with(CANNOT_CONNECT) {
            return true;
        }
        if entry.text.starts_with(ANSWERED_BY_NONE) {
            return true;
        }
        if !self.tells_refused && entry.text.starts_with(CANNOT_CONNECT) && entry.text.contains(REFUSED) {
            return true;
        }
        // Ports and times differ from one line to the next.
        let key: String = entry.text.chars().filter(|char| !char.is_ascii_digit()).collect();
        let mut logged = self.logged.lock().unwrap_or_else(PoisonError::into_inner);
        if logged.get(&key).is_some_and(|before| now.saturating_duration_since(*before) < INTERVAL) {
            return true;
        }
        if logged.len() >= MAX_LINES {
            logged.clear();
        }
        logged.insert(key, now);
        false
    }
}

/// A text of Zenoh without the places in its source code, such as ` at /home/me/.cargo/…/tcp.rs:105.`
fn without_places(text: &str) -> String {
    let (mut kept, mut rest) = (String::new(), text);
    while let Some(at) = rest.find(" at /") {
        let place = &rest[at + 1..];
        let Some(line) = place.find(".rs:").map(|end| &place[end + 4..]) else { break };
        kept += &rest[..at];
        let behind = line.trim_start_matches(|char: char| char.is_ascii_digit());
        rest = behind.strip_prefix('.').unwrap_or(behind);
    }
    kept + rest
}

fn entry(event: &Event<'_>) -> LogEntry {
    let level = match *event.metadata().level() {
        Level::ERROR => LogLevel::Error,
        Level::WARN => LogLevel::Warn,
        Level::INFO => LogLevel::Info,
        Level::DEBUG => LogLevel::Debug,
        Level::TRACE => LogLevel::Trace,
    };
    let mut collected = Collected::default();
    event.record(&mut collected);
    LogEntry { level: Some(level), text: collected.message, fields: collected.fields }
}

#[derive(Default)]
struct Collected {
    message: String,
    fields: Map<String, Value>,
}

impl Collected {
    fn add(&mut self, field: &Field, value: Value) {
        match (field.name(), value) {
            ("message", Value::String(text)) => self.message = text,
            (name, value) => drop(self.fields.insert(name.into(), value)),
        }
    }
}

impl Visit for Collected {
    fn record_f64(&mut self, field: &Field, value: f64) {
        // NaN and infinity are no numbers in JSON.
        self.add(field, if value.is_finite() { value.into() } else { value.to_string().into() });
    }

    fn record_i64(&mut self, field: &Field, value: i64) {
        self.add(field, value.into());
    }

    fn record_u64(&mut self, field: &Field, value: u64) {
        self.add(field, value.into());
    }

    fn record_bool(&mut self, field: &Field, value: bool) {
        self.add(field, value.into());
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.add(field, value.into());
    }

    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        self.add(field, format!("{value:?}").into());
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn an_event_keeps_its_level_and_fields() {
        let said = Arc::new(Mutex::new(Vec::new()));
        let say = {
            let said = Arc::clone(&said);
            move |entry| said.lock().expect("not poisoned").push(entry)
        };
        let filter = Targets::new().with_default(LevelFilter::INFO);
        let subscriber = tracing_subscriber::registry().with(Sayer { say, repeats: None }.with_filter(filter));
        tracing::subscriber::with_default(subscriber, || {
            tracing::warn!(cell = 7, force_newtons = -0.5, unit = "N", "negative force on {}", "finger_1");
            tracing::debug!("not heard");
            tracing::info!(ratio = f64::NAN, "plain");
        });
        let said = said.lock().expect("not poisoned");
        let texts: Vec<String> = said.iter().map(ToString::to_string).collect();
        assert_eq!(
            texts,
            [r#"WARN negative force on finger_1 cell=7 force_newtons=-0.5 unit="N""#, r#"INFO plain ratio="NaN""#]
        );
        let json = serde_json::to_value(&said[0]).expect("JSON");
        assert_eq!(json["level"], "warn");
        assert_eq!(json["fields"]["cell"], 7);
    }

    #[test]
    fn a_word_that_is_no_level_is_told() {
        for text in ["info", "debug,", "info, my_operator=trace", "OFF", ""] {
            assert!(levels_in(text).is_ok(), "{text}");
        }
        for (text, expected) in [("everything", "'everything' is no level"), ("info,mine=loud", "level filter")] {
            let error = levels_in(text).expect_err(text);
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn lines_of_zenoh_name_no_places_in_its_source_code() {
        let line = "Can not create a link: [127.0.0.1:7447: Connection refused (os error 111) at \
                    /cargo/registry/zenoh-link-commons-1.10.2/src/tcp.rs:105.] at \
                    /cargo/registry/zenoh-link-commons-1.10.2/src/tcp.rs:133. at /cargo/unicast.rs:287.. Retry.";
        assert_eq!(
            without_places(line),
            "Can not create a link: [127.0.0.1:7447: Connection refused (os error 111)]. Retry."
        );
        for plain in ["", "a file at /tmp/x is open", "at 5 Hz"] {
            assert_eq!(without_places(plain), plain);
        }
    }

    #[test]
    fn that_nothing_listens_is_logged_where_the_program_does_not_say_it() {
        let refused = "Unable to connect to configured peer tcp/localhost:7447! [127.0.0.1:7447: Connection refused]";
        let forged = "Unable to connect to configured peer tls/robot:7447! invalid peer certificate";
        let is_logged = |repeats: &Repeats, level: LogLevel, text: &str| {
            let entry = LogEntry { level: Some(level), ..LogEntry::plain(text) };
            !repeats.holds_back(ORCHESTRATOR, &entry, Instant::now())
        };
        let (node, link) = (Repeats::default(), Repeats { tells_refused: true, ..Repeats::default() });
        assert!(!is_logged(&node, LogLevel::Debug, refused));
        assert!(is_logged(&node, LogLevel::Debug, forged));
        assert!(is_logged(&link, LogLevel::Debug, refused));
        let returned = "Unable to connect to any of [Single(tcp/localhost:7447)]. Timeout!";
        assert!(!is_logged(&node, LogLevel::Warn, returned) && !is_logged(&link, LogLevel::Warn, returned));
    }

    #[test]
    fn a_line_of_zenoh_comes_once_a_minute() {
        let (repeats, start) = (Repeats::default(), Instant::now());
        let is_logged = |target: &str, level: LogLevel, text: &str, after_secs: u64| {
            let entry = LogEntry { level: Some(level), ..LogEntry::plain(text) };
            !repeats.holds_back(target, &entry, start + Duration::from_secs(after_secs))
        };
        let link = "zenoh_link_tls::unicast";
        assert!(is_logged(link, LogLevel::Warn, "peer sent no certificates on port 1", 0));
        assert!(!is_logged(link, LogLevel::Warn, "peer sent no certificates on port 2", 59));
        assert!(is_logged(link, LogLevel::Warn, "peer sent no certificates on port 3", 60));
        assert!(is_logged(ORCHESTRATOR, LogLevel::Debug, "Unable to connect to configured peer", 0));
        assert!(!is_logged(ORCHESTRATOR, LogLevel::Debug, "Try to connect", 0));
        assert!(
            is_logged("my_operator", LogLevel::Info, "hello", 0)
                && is_logged("my_operator", LogLevel::Info, "hello", 1)
        );
    }
}
