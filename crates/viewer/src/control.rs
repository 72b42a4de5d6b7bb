//! Orders from the page to the graph, for a browser that knows the token.

use std::sync::{Arc, Mutex, TryLockError};

use axum::Extension;
use axum::body::Bytes;
use axum::extract::{Request, State};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use crate::{FOXGLOVE, IsOwner, Shared};

/// A change of the graph that the page asks for.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "order", rename_all = "snake_case", deny_unknown_fields)]
pub enum Order {
    /// Changes a live parameter.
    Set { node: String, param: String, value: String },
    /// Replaces a node, after a comparison if that takes any time.
    Swap {
        node: String,
        /// Parameters that the replacement has other values of, as `NAME=VALUE`.
        changes: Vec<String>,
        compare_secs: f64,
        min_agreement: f64,
    },
    /// Stops the graph.
    Stop {},
}

/// Carries an order out, which may take its time, and gives the answer for the page, or the reason for the failure.
pub type Act = Box<dyn Fn(Order) -> Result<String, String> + Send + Sync>;

/// The right to change the graph.
pub struct Control {
    token: String,
    act: Act,
    /// Locked while an order is carried out, but for the order to stop, which waits for nothing.
    busy: Mutex<()>,
}

impl Control {
    /// Makes a token that nobody can guess.
    ///
    /// # Errors
    /// The operating system gives no random numbers.
    pub fn new(act: Act) -> std::io::Result<Control> {
        let mut bytes = [0; 16];
        getrandom::fill(&mut bytes).map_err(|error| std::io::Error::other(error.to_string()))?;
        let token = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Control { token, act, busy: Mutex::new(()) })
    }

    pub fn token(&self) -> &str {
        &self.token
    }

    /// Whether a request bears the token: in a header, or, as a stream of events and a WebSocket have none, behind the address of
    /// these. The time that this takes does not tell how much of a wrong one is right.
    pub(crate) fn is_borne_by(&self, request: &Request) -> bool {
        let header = request.headers().get(header::AUTHORIZATION).map(|value| value.as_bytes()).unwrap_or_default();
        let is_stream = ["/events", FOXGLOVE].contains(&request.uri().path());
        let query = if is_stream { request.uri().query().unwrap_or_default() } else { "" };
        is_same(header, &format!("Bearer {}", self.token))
            || is_same(query.as_bytes(), &format!("token={}", self.token))
    }
}

fn is_same(given: &[u8], expected: &str) -> bool {
    let differs = given.iter().zip(expected.as_bytes()).fold(0, |differs, (a, b)| differs | (a ^ b));
    given.len() == expected.len() && differs == 0
}

/// The answer to a request that needs the token and does not bear it.
pub(crate) fn refusal(shared: &Shared) -> Response {
    match &shared.control {
        None => {
            (StatusCode::NOT_FOUND, "the page only shows the graph: start it with --view-control\n").into_response()
        }
        Some(_) => {
            let why = "the token is not that of this page: open the address that the command has printed\n";
            (StatusCode::UNAUTHORIZED, why).into_response()
        }
    }
}

/// The log, which other users of the machine may not read.
pub(crate) async fn log(
    State(shared): State<Arc<Shared>>,
    Extension(IsOwner(is_owner)): Extension<IsOwner>,
) -> Response {
    if is_owner {
        ([(header::CONTENT_TYPE, "application/json")], shared.log()).into_response()
    } else {
        refusal(&shared)
    }
}

/// Carries out an order of a request that bears the token.
pub(crate) async fn order(State(shared): State<Arc<Shared>>, body: Bytes) -> Response {
    let order: Order = match serde_json::from_slice(&body) {
        Ok(order) => order,
        Err(error) => return (StatusCode::BAD_REQUEST, format!("expected an order: {error}\n")).into_response(),
    };
    let answer = tokio::task::spawn_blocking(move || {
        let control = shared.control.as_ref()?;
        let turn = match control.busy.try_lock() {
            Ok(turn) => Some(turn),
            Err(TryLockError::Poisoned(turn)) => Some(turn.into_inner()),
            Err(TryLockError::WouldBlock) => None,
        };
        (turn.is_some() || order == (Order::Stop {})).then(|| (control.act)(order))
    });
    match answer.await {
        Ok(Some(Ok(text))) => text.into_response(),
        Ok(Some(Err(why))) => (StatusCode::UNPROCESSABLE_ENTITY, why).into_response(),
        Ok(None) => (StatusCode::CONFLICT, "another order is being carried out: wait for its answer\n").into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}
