//! The iceoryx2 service of a port.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use iceoryx2::port::{DegradationAction, DegradationCause, DegradationInfo};
use iceoryx2::prelude::{Node, ServiceName, ipc};
use iceoryx2::service::port_factory::publish_subscribe;

use super::{BoxedError, PortError};
use crate::wiring::ServiceWiring;
use blindgrasp_messages::Message;

/// Opening a service is tried so often, with this pause between tries.
const N_OPENINGS: u32 = 20;
const OPENING_PAUSE: Duration = Duration::from_millis(10);

pub(super) type PubSub<M> = publish_subscribe::PortFactory<ipc::Service, [<M as Message>::Item], <M as Message>::Head>;

/// The first process to come creates the service, and the others must ask for the same: the wiring decides for all.
pub(super) fn pub_sub<M: Message>(node: &Node<ipc::Service>, wiring: &ServiceWiring) -> Result<PubSub<M>, PortError> {
    if wiring.type_name != M::TYPE_NAME {
        let (service, found) = (wiring.name.clone(), wiring.type_name.clone());
        return Err(PortError::WrongType { service, found, expected: M::TYPE_NAME });
    }
    let name = service_name(wiring)?;
    let open = || {
        node.service_builder(&name)
            .publish_subscribe::<[M::Item]>()
            .user_header::<M::Head>()
            .enable_safe_overflow(true)
            .subscriber_max_buffer_size(wiring.max_capacity)
            .subscriber_max_borrowed_samples(wiring.max_borrowed)
            .history_size(wiring.history)
            .max_publishers(wiring.max_publishers)
            .max_subscribers(wiring.max_subscribers)
            .max_nodes(wiring.max_nodes)
            .open_or_create()
    };
    open_with_retries(open).map_err(|error| open_failed(wiring, error))
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

/// A connection that could not be made is tried so often, each time that the port looks for its partners.
const N_CONNECTIONS: u32 = 20;

/// Notices connections that iceoryx2 could not make, for want of a descriptor or of memory or because the other process stood
/// still. iceoryx2 0.10 passes over them, and tries them again only when another port comes or goes.
#[derive(Debug, Clone, Default)]
pub(super) struct Connections {
    has_failed: Arc<AtomicBool>,
    n_failures: Arc<AtomicU32>,
}

/// A connection could not be made.
#[derive(Debug, thiserror::Error)]
#[error(
    "a connection could not be made {N_CONNECTIONS} times: the process may have too few descriptors ('ulimit -n'), or shared \
     memory may be full"
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

    /// Whether a connection has failed since the last look and must be tried again.
    ///
    /// # Errors
    /// It has failed too often.
    pub(super) fn is_to_be_tried_again(&self) -> Result<bool, NotConnected> {
        if !self.has_failed.swap(false, Ordering::Relaxed) {
            self.n_failures.store(0, Ordering::Relaxed);
            return Ok(false);
        }
        if self.n_failures.fetch_add(1, Ordering::Relaxed) >= N_CONNECTIONS {
            return Err(NotConnected);
        }
        Ok(true)
    }
}

fn service_name(wiring: &ServiceWiring) -> Result<ServiceName, PortError> {
    ServiceName::new(&wiring.name).map_err(|error| open_failed(wiring, error))
}

pub(super) fn open_failed(wiring: &ServiceWiring, source: impl Into<BoxedError>) -> PortError {
    PortError::Open { service: wiring.name.clone(), source: source.into() }
}
