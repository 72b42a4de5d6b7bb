//! The iceoryx2 service of a port.

use std::time::Duration;

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

fn service_name(wiring: &ServiceWiring) -> Result<ServiceName, PortError> {
    ServiceName::new(&wiring.name).map_err(|error| open_failed(wiring, error))
}

pub(super) fn open_failed(wiring: &ServiceWiring, source: impl Into<BoxedError>) -> PortError {
    PortError::Open { service: wiring.name.clone(), source: source.into() }
}
