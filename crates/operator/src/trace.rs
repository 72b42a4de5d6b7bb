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
/// A line of Zenoh is logged once in this time.
const INTERVAL: Duration = Duration::from_secs(60);
/// The most lines that are remembered.
const MAX_LINES: usize = 256;

/// Sends this process's events to `say`. An operator that has a subscriber of its own keeps it.
pub(super) fn install(say: impl Fn(LogEntry) + Send + Sync + 'static) {
    let asked_for = std::env::var(FILTER_VARIABLE).ok();
    let filter = asked_for.as_deref().map(str::parse::<Targets>);
    let unreadable = filter.as_ref().and_then(|filter| filter.as_ref().err().map(ToString::to_string));
    let filter = filter.and_then(Result::ok);
    // A user who asks for certain levels gets every line of them.
    let repeats = filter.is_none().then(Repeats::default);
    let usual = || {
        let levels =
            [(ZENOH, LevelFilter::WARN), (ACCESS_CONTROL, LevelFilter::INFO), (ORCHESTRATOR, LevelFilter::DEBUG)];
        Targets::new().with_default(LevelFilter::INFO).with_targets(levels)
    };
    let filter = filter.unwrap_or_else(usual);
    let _ = tracing_subscriber::registry().with(Sayer { say, repeats }.with_filter(filter)).try_init();
    if let Some(error) = unreadable {
        tracing::warn!("{FILTER_VARIABLE} is not read: {error}");
    }
}

struct Sayer<F> {
    say: F,
    repeats: Option<Repeats>,
}

impl<S: Subscriber, F: Fn(LogEntry) + 'static> Layer<S> for Sayer<F> {
    fn on_event(&self, event: &Event<'_>, _context: Context<'_, S>) {
        let mut entry = entry(event);
        let is_held_back = self
            .repeats
            .as_ref()
            .is_some_and(|repeats| repeats.holds_back(event.metadata().target(), &entry, Instant::now()));
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
