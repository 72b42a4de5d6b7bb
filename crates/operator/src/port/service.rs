//! The iceoryx2 service of a port.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use iceoryx2::port::{DegradationAction, DegradationCause, DegradationInfo};
use iceoryx2::prelude::{Node, ServiceName};
use iceoryx2::service::port_factory::publish_subscribe;

use super::bytes::{Envelope, Word};
use super::{BoxedError, PortError};
use crate::private_service::PrivateService;
use crate::wiring::ServiceWiring;

/// Opening a service is tried so often, with this pause between tries.
const N_OPENINGS: u32 = 20;
const OPENING_PAUSE: Duration = Duration::from_millis(10);

pub(super) type PubSub = publish_subscribe::PortFactory<PrivateService, [Word], Envelope>;

/// The first process to come creates the service, and the others must ask for the same: the wiring decides for all.
pub(super) fn pub_sub(
    node: &Node<PrivateService>,
    wiring: &ServiceWiring,
    type_name: &'static str,
) -> Result<PubSub, PortError> {
    if wiring.type_name != type_name {
        let what = format!("carries {}, expected {type_name}", wiring.type_name);
        return Err(PortError::new(&wiring.name, what, None));
    }
    let name = service_name(wiring)?;
    let opened = open_with_retries(|| {
        node.service_builder(&name)
            .publish_subscribe::<[Word]>()
            .user_header::<Envelope>()
            .enable_safe_overflow(true)
            .subscriber_max_buffer_size(wiring.max_capacity)
            .subscriber_max_borrowed_samples(wiring.max_borrowed)
            .history_size(wiring.history)
            .max_publishers(wiring.max_publishers)
            .max_subscribers(wiring.max_subscribers)
            .max_nodes(wiring.max_nodes)
            .open_or_create()
    });
    opened.map_err(|error| open_failed(wiring, error))
}

/// On a busy machine, two processes that open a service at once can each take the other for its maker, and iceoryx2 0.10
/// then says that the service does not exist.
fn open_with_retries<T, E>(mut open: impl FnMut() -> Result<T, E>) -> Result<T, E> {
    for _ in 1..N_OPENINGS {
        if let Ok(opened) = open() {
            return Ok(opened);
        }
        std::thread::sleep(OPENING_PAUSE);
    }
    open()
}

/// A connection that could not be made is tried again after this pause, for so long.
const CONNECT_PAUSE: Duration = Duration::from_millis(50);
const CONNECT_LIMIT: Duration = Duration::from_secs(3);

/// Notices connections that iceoryx2 could not make, for want of a descriptor or of memory or because the other process stood
/// still. iceoryx2 0.10 passes over them, and tries them again only when another port comes or goes.
#[derive(Debug, Default)]
pub(super) struct Connections {
    has_failed: Arc<AtomicBool>,
    /// Since when connections have failed at each try, and when they were tried last.
    failing: Option<(Instant, Instant)>,
}

/// A connection could not be made.
#[derive(Debug, thiserror::Error)]
#[error(
    "a connection could not be made within {} s: the process may have too few descriptors ('ulimit -n'), or shared memory may \
     be full",
    CONNECT_LIMIT.as_secs()
)]
pub(super) struct NotConnected;

impl Connections {
    /// The handler of a port.
    pub(super) fn handler(&self) -> impl Fn(DegradationCause, &DegradationInfo) -> DegradationAction + Send + 'static {
        let has_failed = Arc::clone(&self.has_failed);
        move |cause, _| {
            if matches!(cause, DegradationCause::FailedToEstablishConnection) {
                has_failed.store(true, Ordering::Relaxed);
                return DegradationAction::Ignore;
            }
            DegradationAction::Warn
        }
    }

    /// Whether all connections are made.
    pub(super) fn are_made(&self) -> bool {
        !self.has_failed.load(Ordering::Relaxed)
    }

    /// Lets `try_again` look for all partners anew if a connection has failed; it returns false if it could not.
    ///
    /// # Errors
    /// Connections have failed for too long.
    pub(super) fn mend(&mut self, try_again: impl FnOnce() -> bool) -> Result<(), NotConnected> {
        if self.are_made() {
            self.failing = None;
            return Ok(());
        }
        let now = Instant::now();
        let (since, last_try) = *self.failing.get_or_insert((now, now));
        if now.duration_since(since) > CONNECT_LIMIT {
            return Err(NotConnected);
        }
        if last_try == since || now.duration_since(last_try) >= CONNECT_PAUSE {
            self.failing = Some((since, now));
            self.has_failed.store(false, Ordering::Relaxed);
            if !try_again() {
                self.has_failed.store(true, Ordering::Relaxed);
            }
        }
        Ok(())
    }
}

fn service_name(wiring: &ServiceWiring) -> Result<ServiceName, PortError> {
    ServiceName::new(&wiring.name).map_err(|error| open_failed(wiring, error))
}

pub(super) fn open_failed(wiring: &ServiceWiring, source: impl Into<BoxedError>) -> PortError {
    PortError::new(&wiring.name, "cannot be opened", Some(source.into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// L4: iceoryx2 itself does not try again.
    #[test]
    fn a_connection_that_could_not_be_made_is_tried_again_until_it_is() {
        let mut connections = Connections::default();
        let mut n_tries = 0;
        connections.mend(|| unreachable!("all are made")).expect("nothing to mend");
        connections.has_failed.store(true, Ordering::Relaxed);
        while !connections.are_made() {
            let tried = connections.mend(|| {
                n_tries += 1;
                n_tries == 3
            });
            tried.expect("within the limit");
        }
        assert_eq!(n_tries, 3);
        connections.has_failed.store(true, Ordering::Relaxed);
        let long_ago = Instant::now() - 2 * CONNECT_LIMIT;
        connections.failing = Some((long_ago, long_ago));
        connections.mend(|| true).expect_err("it has failed for too long");
    }
}
