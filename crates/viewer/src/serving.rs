//! The connections of the page's server. Every user of the machine can make some, so their number and the time for a request's
//! head are limited. A connection that has borne the token of the page's owner is never closed for another one.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpListener;
use tokio::task::AbortHandle;

/// Connections at a time; beyond that, the eldest without the token is closed for a new one.
const MAX_CONNECTIONS: usize = 128;
/// The head of a request must come within this time.
const HEAD_LIMIT: Duration = Duration::from_secs(10);
/// The pause after a failure to accept a connection.
const RETRY_PAUSE: Duration = Duration::from_millis(100);

/// Whether a request of a connection has borne the token.
#[derive(Debug, Clone, Default)]
pub(crate) struct Owned(Arc<AtomicBool>);

impl Owned {
    pub(crate) fn mark(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    fn is_so(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Serves connections until the process ends. Requests have [`Owned`] as an extension.
pub(crate) async fn serve(listener: TcpListener, pages: Router) {
    let mut connections: Vec<(AbortHandle, Owned)> = Vec::new();
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            // Out of descriptors, for example; this may pass.
            tokio::time::sleep(RETRY_PAUSE).await;
            continue;
        };
        connections.retain(|(task, _)| !task.is_finished());
        if connections.len() >= MAX_CONNECTIONS {
            let Some(eldest) = connections.iter().position(|(_, owned)| !owned.is_so()) else { continue };
            connections.remove(eldest).0.abort();
        }
        let owned = Owned::default();
        let service = TowerToHyperService::new(pages.clone().layer(Extension(owned.clone())));
        let connection = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(HEAD_LIMIT)
            .serve_connection(TokioIo::new(stream), service)
            .with_upgrades();
        // An error is the end of the connection.
        let task = tokio::spawn(async move { drop(connection.await) });
        connections.push((task.abort_handle(), owned));
    }
}
