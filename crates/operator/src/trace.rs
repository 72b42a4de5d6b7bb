//! What an operator says with `tracing` goes to the launcher, with its level and fields, and so to the graph's log.

use std::fmt;
use std::time::Instant;

use serde_json::{Map, Value};
use tracing::field::{Field, Visit};
use tracing::level_filters::LevelFilter;
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::{Context, Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;

use crate::wiring::{LogEntry, LogLevel};
use crate::zenoh_log::{ORCHESTRATOR, ZenohLog};

/// What is said at all: `info`, `debug`, or by module, as `info,my_operator=trace`.
const FILTER_VARIABLE: &str = "RUST_LOG";

/// Sends this process's events to `say`. An operator that has a subscriber of its own keeps it.
pub(crate) fn install(say: impl Fn(LogEntry) + Send + Sync + 'static) {
    let asked_for = std::env::var(FILTER_VARIABLE).ok();
    let filter = asked_for.as_deref().map(str::parse::<Targets>);
    let unreadable = filter.as_ref().and_then(|filter| filter.as_ref().err().map(ToString::to_string));
    let filter = filter.and_then(Result::ok);
    // Who asks for something gets it as it is.
    let zenoh = filter.is_none().then(ZenohLog::default);
    let usual = || Targets::new().with_default(LevelFilter::INFO).with_target(ORCHESTRATOR, LevelFilter::DEBUG);
    let filter = filter.unwrap_or_else(usual);
    let _ = tracing_subscriber::registry().with(Sayer { say, zenoh }.with_filter(filter)).try_init();
    if let Some(error) = unreadable {
        tracing::warn!("{FILTER_VARIABLE} is not read: {error}");
    }
}

struct Sayer<F> {
    say: F,
    zenoh: Option<ZenohLog>,
}

impl<S: Subscriber, F: Fn(LogEntry) + 'static> Layer<S> for Sayer<F> {
    fn on_event(&self, event: &Event<'_>, _context: Context<'_, S>) {
        let entry = entry(event);
        let entry = match &self.zenoh {
            Some(zenoh) => zenoh.shaped(event.metadata().target(), entry, Instant::now()),
            None => Some(entry),
        };
        if let Some(entry) = entry {
            (self.say)(entry);
        }
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
    use std::sync::{Arc, Mutex};

    use super::*;

    #[test]
    fn an_event_keeps_its_level_and_fields() {
        let said = Arc::new(Mutex::new(Vec::new()));
        let say = {
            let said = Arc::clone(&said);
            move |entry| said.lock().expect("not poisoned").push(entry)
        };
        let filter = Targets::new().with_default(LevelFilter::INFO);
        let subscriber = tracing_subscriber::registry().with(Sayer { say, zenoh: None }.with_filter(filter));
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
}
