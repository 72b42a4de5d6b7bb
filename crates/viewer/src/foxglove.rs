//! Samples for Foxglove, by its WebSocket protocol (subprotocols `foxglove.sdk.v1` and `foxglove.websocket.v1`, of which this
//! needs the part that both have): channels are advertised, and a client gets the samples of those to which it subscribes.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use axum::Extension;
use axum::body::Bytes;
use axum::extract::State;
use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::{broadcast, watch};

use crate::{IsOwner, Shared};

const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
/// Samples that wait for a client; the eldest are dropped for newer ones.
const MAX_WAITING: usize = 2048;
/// Clients that are served at a time; others without the token are turned away.
const MAX_CLIENTS: usize = 16;
/// A client sends lists of channels, nothing larger.
const MAX_MESSAGE_BYTES: usize = 64 * 1024;
/// The first byte of a sample's message.
const MESSAGE_DATA: u8 = 1;

/// A stream of ROS 2 messages in CDR.
#[derive(Debug, Clone)]
pub struct Channel {
    pub topic: String,
    /// Like `sensor_msgs/msg/JointState`.
    pub schema: String,
    /// The definition of the message and of those in it (`ros2msg`).
    pub definition: String,
}

/// The channels of a graph. Their numbers are never used again for others.
#[derive(Default)]
struct Advertised {
    first_id: u32,
    channels: Vec<Channel>,
    n_subscribers: Vec<AtomicUsize>,
}

impl Advertised {
    fn counter(&self, id: u32) -> Option<&AtomicUsize> {
        self.n_subscribers.get(id.checked_sub(self.first_id)? as usize)
    }
}

#[derive(Clone)]
struct Sample {
    channel_id: u32,
    unix_nanos: u64,
    data: Bytes,
}

/// The streams for all clients.
pub(crate) struct Streams {
    advertised: watch::Sender<Arc<Advertised>>,
    samples: broadcast::Sender<Sample>,
    n_clients: AtomicUsize,
}

impl Streams {
    pub(crate) fn new() -> Streams {
        Streams {
            advertised: watch::channel(Arc::default()).0,
            samples: broadcast::channel(MAX_WAITING).0,
            n_clients: AtomicUsize::new(0),
        }
    }

    /// Replaces the channels.
    pub(crate) fn advertise(&self, channels: Vec<Channel>) {
        self.advertised.send_modify(|before| {
            let first_id = before.first_id + before.channels.len() as u32;
            let n_subscribers = channels.iter().map(|_| AtomicUsize::new(0)).collect();
            *before = Arc::new(Advertised { first_id, channels, n_subscribers });
        });
    }

    /// Whether a client subscribes to a channel, by its place in the list.
    pub(crate) fn is_wanted(&self, channel: usize) -> bool {
        let advertised = self.advertised.borrow();
        advertised.n_subscribers.get(channel).is_some_and(|n| n.load(Ordering::Relaxed) > 0)
    }

    pub(crate) fn send(&self, channel: usize, data: &[u8]) {
        let unix_nanos = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as u64;
        let channel_id = self.advertised.borrow().first_id + channel as u32;
        // It fails without clients, which is no loss.
        let _ = self.samples.send(Sample { channel_id, unix_nanos, data: Bytes::copy_from_slice(data) });
    }
}

/// A message of a client. Others, for abilities that this server does not offer, are ignored.
#[derive(Deserialize)]
#[serde(tag = "op", rename_all = "camelCase")]
enum Wish {
    Subscribe {
        subscriptions: Vec<Subscription>,
    },
    Unsubscribe {
        #[serde(rename = "subscriptionIds")]
        ids: Vec<u32>,
    },
    #[serde(other)]
    Other,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Subscription {
    id: u32,
    channel_id: u32,
}

pub(crate) async fn connect(
    State(shared): State<Arc<Shared>>,
    Extension(IsOwner(is_owner)): Extension<IsOwner>,
    upgrade: WebSocketUpgrade,
) -> Response {
    if shared.streams.is_none() {
        return (StatusCode::NOT_FOUND, "start the page with --foxglove\n").into_response();
    }
    let upgrade = upgrade.protocols(SUBPROTOCOLS).max_message_size(MAX_MESSAGE_BYTES);
    if upgrade.selected_protocol().is_none() {
        let expected = format!("expected the subprotocol {}\n", SUBPROTOCOLS.join(" or "));
        return (StatusCode::BAD_REQUEST, expected).into_response();
    }
    upgrade.on_upgrade(move |socket| async move {
        let Some(streams) = &shared.streams else { return };
        if streams.n_clients.fetch_add(1, Ordering::Relaxed) < MAX_CLIENTS || is_owner {
            let mut client = Client { streams, advertised: Arc::default(), subscriptions: BTreeMap::new(), socket };
            // An error is the end of the connection.
            let _ = client.serve().await;
        }
        streams.n_clients.fetch_sub(1, Ordering::Relaxed);
    })
}

struct Client<'a> {
    streams: &'a Streams,
    advertised: Arc<Advertised>,
    /// The subscription of each channel.
    subscriptions: BTreeMap<u32, u32>,
    socket: WebSocket,
}

impl Drop for Client<'_> {
    fn drop(&mut self) {
        self.forget_all();
    }
}

impl Client<'_> {
    /// Serves the client until it goes.
    async fn serve(&mut self) -> Result<(), axum::Error> {
        let mut advertised = self.streams.advertised.subscribe();
        let mut samples = self.streams.samples.subscribe();
        let started = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos();
        self.tell(
            json!({"op": "serverInfo", "name": "blindgrasp", "capabilities": [], "sessionId": started.to_string()}),
        )
        .await?;
        advertised.mark_changed();
        loop {
            tokio::select! {
                changed = advertised.changed() => {
                    if changed.is_err() {
                        return Ok(());
                    }
                    let now = Arc::clone(&advertised.borrow_and_update());
                    self.advertise(now).await?;
                }
                sample = samples.recv() => match sample {
                    Ok(sample) => self.pass_on(sample).await?,
                    Err(RecvError::Lagged(n)) => {
                        let message = format!("this client is too slow: it missed {n} samples of all topics. The graph lost nothing.");
                        self.tell(json!({"op": "status", "level": 1, "message": message})).await?;
                    }
                    Err(RecvError::Closed) => return Ok(()),
                },
                message = self.socket.recv() => match message {
                    Some(Ok(Message::Text(text))) => self.obey(&text).await?,
                    Some(Ok(Message::Close(_))) | None => return Ok(()),
                    Some(Ok(_)) => {}
                    Some(Err(error)) => return Err(error),
                },
            }
        }
    }

    async fn tell(&mut self, message: Value) -> Result<(), axum::Error> {
        self.socket.send(Message::Text(message.to_string().into())).await
    }

    async fn advertise(&mut self, now: Arc<Advertised>) -> Result<(), axum::Error> {
        self.forget_all();
        let before = std::mem::replace(&mut self.advertised, now);
        if !before.channels.is_empty() {
            let ids: Vec<u32> = (before.first_id..).take(before.channels.len()).collect();
            self.tell(json!({"op": "unadvertise", "channelIds": ids})).await?;
        }
        let channels = (self.advertised.first_id..).zip(&self.advertised.channels);
        let channels = channels.map(|(id, Channel { topic, schema, definition })| {
            json!({"id": id, "topic": topic, "encoding": "cdr", "schemaName": schema, "schema": definition, "schemaEncoding": "ros2msg"})
        });
        let message = json!({"op": "advertise", "channels": channels.collect::<Vec<_>>()});
        self.tell(message).await
    }

    async fn pass_on(&mut self, sample: Sample) -> Result<(), axum::Error> {
        let Some(id) = self.subscriptions.get(&sample.channel_id) else { return Ok(()) };
        let parts: [&[u8]; 4] = [&[MESSAGE_DATA], &id.to_le_bytes(), &sample.unix_nanos.to_le_bytes(), &sample.data];
        self.socket.send(Message::Binary(parts.concat().into())).await
    }

    async fn obey(&mut self, text: &str) -> Result<(), axum::Error> {
        match serde_json::from_str(text) {
            Ok(Wish::Subscribe { subscriptions }) => {
                for Subscription { id, channel_id } in subscriptions {
                    let is_known = self.advertised.counter(channel_id).is_some();
                    if !is_known || self.subscriptions.contains_key(&channel_id) {
                        let message = format!("channel {channel_id} is not advertised, or subscribed to already");
                        self.tell(json!({"op": "status", "level": 2, "message": message})).await?;
                        continue;
                    }
                    self.subscriptions.insert(channel_id, id);
                    self.advertised.counter(channel_id).map(|n| n.fetch_add(1, Ordering::Relaxed));
                }
            }
            Ok(Wish::Unsubscribe { ids }) => {
                let gone: Vec<_> = self.subscriptions.extract_if(.., |_, id| ids.contains(id)).collect();
                gone.into_iter().for_each(|(channel_id, _)| self.forget(channel_id));
            }
            Ok(Wish::Other) => {}
            Err(error) => {
                let message = format!("expected a message of the Foxglove WebSocket protocol: {error}");
                self.tell(json!({"op": "status", "level": 2, "message": message})).await?;
            }
        }
        Ok(())
    }

    fn forget(&self, channel_id: u32) {
        self.advertised.counter(channel_id).map(|n| n.fetch_sub(1, Ordering::Relaxed));
    }

    fn forget_all(&mut self) {
        std::mem::take(&mut self.subscriptions).into_keys().for_each(|channel_id| self.forget(channel_id));
    }
}
