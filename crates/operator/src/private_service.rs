//! The variant of iceoryx2's services that graphs use: all its files lie in the graph's folder.
//!
//! `iceoryx2::prelude::ipc` has its memory in POSIX shared memory, whose names all users of the computer share, and opens what
//! is there under a name, also if another user made it. The file could be a forged connection. Files in a folder of mode 0700
//! on the same file system (tmpfs) are the same memory under names that no other user can make, see or open.

use std::fmt::Debug;

use iceoryx2::service::Service;
use iceoryx2::service::internal::ServiceInternal;
use iceoryx2::service::ipc;
use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use iceoryx2_bb_lock_free::mpmc::counting_bit_set::RelocatableCountingBitSet;
use iceoryx2_cal::dynamic_storage::file::Storage;
use iceoryx2_cal::event::trigger::State;
use iceoryx2_cal::event::trigger::unix_datagram_socket::GenericUnixDatagramSocketTrigger;
use iceoryx2_cal::resizable_shared_memory::dynamic::DynamicMemory;
use iceoryx2_cal::shared_memory::file::Memory;
use iceoryx2_cal::shm_allocator::bump_allocator::BumpAllocator;
use iceoryx2_cal::shm_allocator::pool_allocator::PoolAllocator;
use iceoryx2_cal::{arc_sync_policy, zero_copy_connection};

/// iceoryx2's `ipc::Service` but for the places of its memory.
#[derive(Debug, Clone)]
pub struct PrivateService;

impl Service for PrivateService {
    type StaticStorage = <ipc::Service as Service>::StaticStorage;
    type ConfigSerializer = <ipc::Service as Service>::ConfigSerializer;
    type PersistentDynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> = Storage<T>;
    type Bag = <ipc::Service as Service>::Bag;
    type DynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> = Storage<T>;
    type ServiceNameHasher = <ipc::Service as Service>::ServiceNameHasher;
    type SharedMemory = Memory<PoolAllocator>;
    type ResizableSharedMemory = DynamicMemory<PoolAllocator, Memory<PoolAllocator>>;
    type Connection = zero_copy_connection::file::Connection;
    type Event =
        GenericUnixDatagramSocketTrigger<RelocatableCountingBitSet, Storage<State<RelocatableCountingBitSet, ()>>>;
    type Monitoring = <ipc::Service as Service>::Monitoring;
    type Reactor = <ipc::Service as Service>::Reactor;
    type ArcThreadSafetyPolicy<T: Send + Debug + Abandonable> = arc_sync_policy::single_threaded::SingleThreaded<T>;
    type BlackboardMgmt<T: Send + Sync + Debug + ZeroCopySend + 'static> = Storage<T>;
    type BlackboardPayload = Memory<BumpAllocator>;
    type UniqueId = <ipc::Service as Service>::UniqueId;
}

impl ServiceInternal<PrivateService> for PrivateService {}
