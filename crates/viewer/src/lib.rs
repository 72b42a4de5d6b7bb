//! A page in a browser that shows a graph as it runs, or a recording, served by the program itself.
//!
//! The page, its style, its script and the library three.js are files in the program. The page reads one stream of events
//! (server-sent events), which [`Viewer::send`] feeds: the caller decides what an event says. A browser that reads too slowly
//! misses events and is told how many; it holds up neither the caller nor other browsers. Of a recording, the page asks for one
//! grasp after the other ([`Grasps`]).
//!
//! Without a [`Control`] the page can only be read. With one, a browser that knows the token may give orders, and others do not
//! keep it out. The page is served on the loopback interface, and requests that a page from elsewhere makes are refused by their
//! host and origin.

mod control;
mod foxglove;
mod serving;

use std::convert::Infallible;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, Path, Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Extension, Router};
use blindgrasp_pictures::{CHART_JS, STAGE_JS, THREE_JS};
use futures_util::stream;
use tokio::sync::broadcast;
use tokio::sync::broadcast::error::RecvError;

pub use control::{Act, Control, Order};
pub use foxglove::Channel;
use foxglove::Streams;
use serving::Owned;

/// Events that wait for a browser; the eldest are dropped for newer ones.
const MAX_WAITING: usize = 64;
/// Browsers that read events at a time; others without the token are turned away.
const MAX_BROWSERS: usize = 64;
/// Bytes of an order.
const MAX_ORDER_BYTES: usize = 16 << 10;
/// The event after which a browser's stream ends.
const FINISHED: &str = "finished";
/// The browsers have this time to read the last event.
const FINISH_LIMIT: Duration = Duration::from_secs(1);
/// Between two looks whether they have, and for the last bytes on their way.
const FINISH_PAUSE: Duration = Duration::from_millis(20);
/// The address of orders.
const ORDERS: &str = "/orders";
/// The address of Foxglove's WebSocket.
const FOXGLOVE: &str = "/foxglove";
/// Pages and programs from elsewhere that may open it: Foxglove in the browser, and as an application.
const FOXGLOVE_ORIGINS: [&str; 3] = ["https://app.foxglove.dev", "https://studio.foxglove.dev", "file://"];
/// Scripts and styles come from here alone, and no other page may frame this one.
const CONTENT_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; \
                              base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
/// The parts of the page's script are one file for the browser: a round trip may take half a second.
const APP_JS: &str = concat!(
    include_str!("../assets/page.js"),
    include_str!("../assets/timeline.js"),
    include_str!("../assets/list.js"),
    include_str!("../assets/history.js"),
    include_str!("../assets/player.js"),
    include_str!("../assets/control.js"),
    include_str!("../assets/app.js"),
);
const FILES: [(&str, &str, &str); 6] = [
    ("/", "text/html; charset=utf-8", include_str!("../assets/index.html")),
    ("/app.css", "text/css; charset=utf-8", include_str!("../assets/app.css")),
    ("/app.js", "text/javascript; charset=utf-8", APP_JS),
    ("/chart.js", "text/javascript; charset=utf-8", CHART_JS),
    ("/stage.js", "text/javascript; charset=utf-8", STAGE_JS),
    ("/three.js", "text/javascript; charset=utf-8", THREE_JS),
];

#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    #[error("cannot listen on port {port} of 127.0.0.1: {source}; give another port, or 0 for any free one")]
    Listen { port: u16, source: std::io::Error },
}

/// Gives a grasp of a recording as JSON, by its place in the list of grasps, or the reason for its lack. Only one call runs at a
/// time.
pub type Grasps = Box<dyn FnMut(usize) -> Result<String, String> + Send>;

/// A page that is being served until the process ends.
#[derive(Clone)]
pub struct Viewer {
    shared: Arc<Shared>,
    address: SocketAddr,
}

struct Shared {
    events: broadcast::Sender<Bytes>,
    /// The last event of each name that a browser gets when it comes, in the order of the names' first events.
    kept: Mutex<Vec<(&'static str, Bytes)>>,
    /// Lines of the log as JSON, for browsers with the token.
    log: Mutex<String>,
    n_browsers: AtomicUsize,
    grasps: Option<Mutex<Grasps>>,
    control: Option<Control>,
    streams: Option<Streams>,
}

/// The abilities of a page beside showing events.
#[derive(Default)]
pub struct Abilities {
    /// The grasps of a recording.
    pub grasps: Option<Grasps>,
    /// Orders to a graph.
    pub control: Option<Control>,
    /// Whether Foxglove may read the graph's samples (see [`Viewer::advertise`]).
    pub foxglove: bool,
}

impl Viewer {
    /// Serves the page on a port of the loopback interface, 0 for any free one, from a thread of its own.
    ///
    /// # Errors
    /// The port is taken.
    pub fn serve(port: u16, abilities: Abilities) -> Result<Viewer, ViewerError> {
        let refused = |source| ViewerError::Listen { port, source };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(refused)?;
        let bind = |host: IpAddr| runtime.block_on(tokio::net::TcpListener::bind(SocketAddr::from((host, port))));
        // A machine of IPv6 alone has only the other address.
        let listener = bind(Ipv4Addr::LOCALHOST.into()).or_else(|error| match error.kind() {
            std::io::ErrorKind::AddrNotAvailable => bind(Ipv6Addr::LOCALHOST.into()),
            _ => Err(error),
        });
        let listener = listener.map_err(refused)?;
        let address = listener.local_addr().map_err(refused)?;
        let shared = Arc::new(Shared {
            events: broadcast::channel(MAX_WAITING).0,
            kept: Mutex::default(),
            log: Mutex::new("[]".into()),
            n_browsers: AtomicUsize::new(0),
            grasps: abilities.grasps.map(Mutex::new),
            control: abilities.control,
            streams: abilities.foxglove.then(Streams::new),
        });
        let files = FILES.into_iter().fold(Router::new(), |router, (path, kind, text)| {
            router.route(path, get(move || async move { ([(header::CONTENT_TYPE, kind)], text) }))
        });
        let pages = files
            .route("/events", get(events))
            .route("/grasps/{idx}", get(grasp))
            .route(ORDERS, post(control::order))
            .route("/log", get(control::log))
            .route(FOXGLOVE, get(foxglove::connect))
            .layer(DefaultBodyLimit::max(MAX_ORDER_BYTES))
            .with_state(Arc::clone(&shared))
            .layer(middleware::from_fn_with_state(Arc::clone(&shared), guard));
        std::thread::spawn(move || runtime.block_on(serving::serve(listener, pages)));
        let viewer = Viewer { shared, address };
        // A page reloads if another server answers at its address.
        let started = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos();
        viewer.keep("server", &format!("\"{started}\""));
        Ok(viewer)
    }

    /// The address of the page. With a control it holds the token, which browsers do not send with it.
    pub fn address(&self) -> String {
        let token = self.shared.control.as_ref().map(|control| format!("/#{}", control.token()));
        format!("http://{}{}", self.address, token.unwrap_or_default())
    }

    /// The address for Foxglove, if it may read. With a control it holds the token, for a place of its own.
    pub fn foxglove_address(&self) -> Option<String> {
        let token = self.shared.control.as_ref().map(|control| format!("?token={}", control.token()));
        self.shared.streams.as_ref().map(|_| format!("ws://{}{FOXGLOVE}{}", self.address, token.unwrap_or_default()))
    }

    /// Replaces the streams that Foxglove may read.
    pub fn advertise(&self, channels: Vec<Channel>) {
        self.shared.streams.iter().for_each(|streams| streams.advertise(channels.clone()));
    }

    /// Whether a client of Foxglove reads a stream, by its place in the list of [`Viewer::advertise`].
    pub fn is_wanted(&self, channel: usize) -> bool {
        self.shared.streams.as_ref().is_some_and(|streams| streams.is_wanted(channel))
    }

    /// Sends a message, in CDR, to the clients of Foxglove that read this stream.
    pub fn send_to_foxglove(&self, channel: usize, data: &[u8]) {
        self.shared.streams.iter().for_each(|streams| streams.send(channel, data));
    }

    /// The number of browsers that read the events.
    pub fn n_browsers(&self) -> usize {
        self.shared.n_browsers.load(Ordering::Relaxed)
    }

    /// Sends an event with JSON to all browsers.
    pub fn send(&self, name: &'static str, json: &str) {
        // It fails without browsers, which is no loss.
        let _ = self.shared.events.send(event(name, json));
    }

    /// Sends an event, and sends it again to each browser that comes later, until the next of this name.
    pub fn keep(&self, name: &'static str, json: &str) {
        let event = event(name, json);
        let mut kept = self.shared.kept();
        match kept.iter_mut().find(|(known, _)| *known == name) {
            Some((_, last)) => *last = event.clone(),
            None => kept.push((name, event.clone())),
        }
        let _ = self.shared.events.send(event);
    }

    /// Replaces the log that a browser with the token of the [`Control`] may read.
    pub fn show_log(&self, json: String) {
        *self.shared.log.lock().unwrap_or_else(PoisonError::into_inner) = json;
    }

    /// Tells the browsers that nothing more will come, and why. It waits until all have been told, but not for long: one may not
    /// read.
    pub fn finish(&self, why: &str) {
        self.keep(FINISHED, &serde_json::Value::from(why).to_string());
        let limit = Instant::now() + FINISH_LIMIT;
        while self.n_browsers() > 0 && Instant::now() < limit {
            std::thread::sleep(FINISH_PAUSE);
        }
        // The last bytes are on their way to the sockets.
        std::thread::sleep(FINISH_PAUSE);
    }

    /// Sends the kept event of this name to no browser any more.
    pub fn forget(&self, name: &str) {
        self.shared.kept().retain(|(known, _)| *known != name);
    }
}

impl Shared {
    fn kept(&self) -> MutexGuard<'_, Vec<(&'static str, Bytes)>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn log(&self) -> String {
        self.log.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The kept events, the last one first: they are taken from the end.
    fn kept_reversed(&self) -> Vec<Bytes> {
        self.kept().iter().rev().map(|(_, event)| event.clone()).collect()
    }
}

fn event(name: &str, json: &str) -> Bytes {
    format!("{}data: {}\n\n", event_head(name), json.replace('\n', " ")).into()
}

fn event_head(name: &str) -> String {
    format!("event: {name}\n")
}

/// Whether a request bears the token of the page's owner.
#[derive(Clone, Copy)]
struct IsOwner(bool);

/// Refuses what a page from elsewhere asks for, and orders without the token before their body is read. It adds what tells
/// browsers to be strict.
async fn guard(
    State(shared): State<Arc<Shared>>,
    Extension(connection): Extension<Owned>,
    mut request: Request,
    next: Next,
) -> Response {
    let is_owner = shared.control.as_ref().is_some_and(|control| control.is_borne_by(&request));
    if is_owner {
        connection.mark();
    }
    request.extensions_mut().insert(IsOwner(is_owner));
    let is_allowed = if request.uri().path() == FOXGLOVE { may_be_foxglove } else { is_from_here };
    let mut response = if !is_allowed(request.headers()) {
        let why = "expected Host: localhost or 127.0.0.1, and no page from elsewhere\n";
        (StatusCode::FORBIDDEN, why).into_response()
    } else if !matches!(*request.method(), Method::GET | Method::HEAD) && request.uri().path() != ORDERS {
        (StatusCode::METHOD_NOT_ALLOWED, "expected GET: this can only be read\n").into_response()
    } else if request.uri().path() == ORDERS && !is_owner {
        control::refusal(&shared)
    } else {
        next.run(request).await
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, CONTENT_POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-cache"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

fn text(headers: &HeaderMap, name: header::HeaderName) -> Option<&str> {
    headers.get(name).map(|value| value.to_str().unwrap_or("?"))
}

/// Whether `HOST:PORT` is of the loopback interface. A browser tells the name by which it found the host, so that a name that was
/// made to lead here (DNS rebinding) is of no use.
fn is_loopback(host: &str) -> bool {
    let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
    ["localhost", "127.0.0.1", "[::1]"].iter().any(|known| name.eq_ignore_ascii_case(known))
}

/// Whether the request names a host of the loopback interface, and comes from a page of this server or from none.
fn is_from_here(headers: &HeaderMap) -> bool {
    let host = text(headers, header::HOST).unwrap_or_default();
    let is_own = text(headers, header::ORIGIN).is_none_or(|origin| origin == format!("http://{host}"));
    let is_same_site = text(headers, header::HeaderName::from_static("sec-fetch-site"))
        .is_none_or(|site| ["same-origin", "none"].contains(&site));
    is_loopback(host) && is_own && is_same_site
}

/// Whether the request names a host of the loopback interface, and comes from Foxglove, a page of this machine, or no page.
fn may_be_foxglove(headers: &HeaderMap) -> bool {
    let is_known =
        |origin: &str| FOXGLOVE_ORIGINS.contains(&origin) || origin.strip_prefix("http://").is_some_and(is_loopback);
    is_loopback(text(headers, header::HOST).unwrap_or_default()) && text(headers, header::ORIGIN).is_none_or(is_known)
}

/// A browser that reads events; it is counted until the response is dropped.
struct Reader {
    shared: Arc<Shared>,
    kept: Vec<Bytes>,
    receiver: broadcast::Receiver<Bytes>,
    /// Whether it has read the last event.
    is_finished: bool,
}

impl Drop for Reader {
    fn drop(&mut self) {
        self.shared.n_browsers.fetch_sub(1, Ordering::Relaxed);
    }
}

async fn events(State(shared): State<Arc<Shared>>, Extension(IsOwner(is_owner)): Extension<IsOwner>) -> Response {
    if shared.n_browsers.fetch_add(1, Ordering::Relaxed) >= MAX_BROWSERS && !is_owner {
        shared.n_browsers.fetch_sub(1, Ordering::Relaxed);
        return (StatusCode::SERVICE_UNAVAILABLE, format!("{MAX_BROWSERS} browsers are served already\n"))
            .into_response();
    }
    let receiver = shared.events.subscribe();
    let kept = shared.kept_reversed();
    let stream = stream::unfold(Reader { shared, kept, receiver, is_finished: false }, |mut reader| async {
        if reader.is_finished {
            return None;
        }
        let next = match reader.kept.pop() {
            Some(kept) => kept,
            None => match reader.receiver.recv().await {
                Ok(event) => event,
                Err(RecvError::Lagged(n)) => {
                    // Among the missed events may have been kept ones.
                    reader.kept = reader.shared.kept_reversed();
                    event("dropped", &n.to_string())
                }
                Err(RecvError::Closed) => return None,
            },
        };
        reader.is_finished = next.starts_with(event_head(FINISHED).as_bytes());
        Some((Ok::<_, Infallible>(next), reader))
    });
    ([(header::CONTENT_TYPE, "text/event-stream")], Body::from_stream(stream)).into_response()
}

async fn grasp(State(shared): State<Arc<Shared>>, Path(idx): Path<usize>) -> Response {
    // It reads a file, which takes its time.
    let answer = tokio::task::spawn_blocking(move || {
        let grasps = shared.grasps.as_ref()?;
        Some(grasps.lock().unwrap_or_else(PoisonError::into_inner)(idx))
    });
    match answer.await {
        Ok(Some(Ok(json))) => ([(header::CONTENT_TYPE, "application/json")], json).into_response(),
        Ok(Some(Err(why))) => (StatusCode::NOT_FOUND, why).into_response(),
        Ok(None) => (StatusCode::NOT_FOUND, "the page is not of a recording\n").into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader, Read, Write};
    use std::net::TcpStream;

    use super::*;

    fn asked(viewer: &Viewer, head: &str) -> TcpStream {
        let mut client = TcpStream::connect(viewer.address).expect("connected");
        write!(client, "{head}\r\n\r\n").expect("sent");
        client
    }

    fn answer(viewer: &Viewer, head: &str) -> String {
        let mut text = String::new();
        asked(viewer, &format!("{head}\r\nConnection: close")).read_to_string(&mut text).expect("an answer");
        text
    }

    #[test]
    fn pages_from_elsewhere_get_nothing_and_nothing_can_be_sent() {
        let viewer = Viewer::serve(0, Abilities::default()).expect("served");
        let page = answer(&viewer, "GET / HTTP/1.1\r\nHost: localhost");
        assert!(page.starts_with("HTTP/1.1 200") && page.contains("<title>"), "{page}");
        assert!(page.contains("content-security-policy: default-src 'none'; script-src 'self'"), "{page}");
        for head in [
            "GET / HTTP/1.1\r\nHost: robot.example",
            "GET /events HTTP/1.1\r\nHost: localhost\r\nOrigin: http://robot.example",
            "GET /events HTTP/1.1\r\nHost: localhost\r\nSec-Fetch-Site: cross-site",
            "GET / HTTP/1.1\r\nHost: localhost.robot.example:80",
        ] {
            let page = answer(&viewer, head);
            assert!(page.starts_with("HTTP/1.1 403") && !page.contains("<title>"), "{head}: {page}");
        }
        let grasps: Grasps = Box::new(|idx| if idx == 3 { Ok("{}".into()) } else { Err("no grasp".into()) });
        let recording = Viewer::serve(0, Abilities { grasps: Some(grasps), ..Abilities::default() }).expect("served");
        let of = |id: &str| answer(&recording, &format!("GET /grasps/{id} HTTP/1.1\r\nHost: localhost"));
        assert!(of("3").ends_with("{}") && of("4").starts_with("HTTP/1.1 404") && of("x").starts_with("HTTP/1.1 400"));
        assert!(answer(&viewer, "GET /grasps/3 HTTP/1.1\r\nHost: localhost").starts_with("HTTP/1.1 404"));
        assert!(answer(&viewer, "POST / HTTP/1.1\r\nHost: localhost").starts_with("HTTP/1.1 405"));
        assert!(answer(&viewer, "GET /secret HTTP/1.1\r\nHost: localhost").starts_with("HTTP/1.1 404"));
    }

    #[test]
    fn orders_need_the_token_and_a_page_of_this_server() {
        let orders = Arc::new(Mutex::new(Vec::new()));
        let taken = Arc::clone(&orders);
        let act: Act = Box::new(move |order| {
            taken.lock().expect("a list").push(order.clone());
            if order == (Order::Stop {}) { Err("it goes on".into()) } else { Ok("done".into()) }
        });
        let viewer =
            Viewer::serve(0, Abilities { control: Some(Control::new(act).expect("a token")), ..Abilities::default() });
        let viewer = viewer.expect("served");
        let token = viewer.address().split_once('#').map(|(_, token)| token.to_owned()).expect("a token");
        assert_eq!(token.len(), 32);
        let sent = |viewer: &Viewer, head: &str, body: &str| {
            let length = body.len();
            let head = format!(
                "POST /orders HTTP/1.1\r\nHost: localhost\r\nContent-Length: {length}\r\nConnection: close\r\n{head}"
            );
            let mut client = TcpStream::connect(viewer.address).expect("connected");
            write!(client, "{head}\r\n\r\n{body}").expect("sent");
            let mut text = String::new();
            client.read_to_string(&mut text).expect("an answer");
            text
        };
        let set = r#"{"order":"set","node":"a","param":"b","value":"1"}"#;
        let with_token = format!("Authorization: Bearer {token}");
        // The answer comes before the body, which would never be complete.
        let endless = |head: &str| {
            answer(&viewer, &format!("POST /orders HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2000000\r\n{head}"))
        };
        assert!(endless("X: y").starts_with("HTTP/1.1 401"), "{}", endless("X: y"));
        assert!(sent(&viewer, &with_token, &"7".repeat(MAX_ORDER_BYTES + 1)).starts_with("HTTP/1.1 413"));
        let other_end = if token.ends_with('0') { '1' } else { '0' };
        for (head, status) in [
            ("X: y".to_owned(), 401),
            (format!("Authorization: Bearer {}", &token[1..]), 401),
            (format!("Authorization: Bearer {}{other_end}", &token[..31]), 401),
            (format!("{with_token}\r\nOrigin: http://robot.example"), 403),
            (format!("{with_token}\r\nSec-Fetch-Site: cross-site"), 403),
        ] {
            let answer = sent(&viewer, &head, set);
            assert!(answer.starts_with(&format!("HTTP/1.1 {status}")), "{head}: {answer}");
        }
        assert!(orders.lock().expect("a list").is_empty());
        assert!(sent(&viewer, &with_token, set).ends_with("done"));
        assert!(sent(&viewer, &with_token, r#"{"order":"stop"}"#).ends_with("it goes on"));
        assert!(sent(&viewer, &with_token, r#"{"order":"burn"}"#).starts_with("HTTP/1.1 400"));
        assert_eq!(orders.lock().expect("a list").len(), 2);
        viewer.show_log(r#"["a secret"]"#.into());
        let asked = |head: &str| answer(&viewer, &format!("GET /log HTTP/1.1\r\nHost: localhost\r\n{head}"));
        assert!(asked(&with_token).ends_with(r#"["a secret"]"#));
        assert!(asked("X: y").starts_with("HTTP/1.1 401") && !asked("X: y").contains("secret"));
        let reader = Viewer::serve(0, Abilities::default()).expect("served");
        assert!(sent(&reader, &with_token, set).starts_with("HTTP/1.1 404"));
    }

    /// Lines of an event stream until this one.
    fn read_until(reader: &mut impl BufRead, expected: &str) -> Vec<String> {
        let mut lines = Vec::new();
        loop {
            let mut line = String::new();
            assert!(reader.read_line(&mut line).expect("read") > 0, "the end; {lines:?}");
            lines.push(line.trim_end().to_owned());
            if lines.last().is_some_and(|line| line == expected) {
                return lines;
            }
        }
    }

    #[test]
    fn a_late_browser_gets_what_is_kept_and_a_slow_one_is_told_of_what_it_missed() {
        let viewer = Viewer::serve(0, Abilities::default()).expect("served");
        viewer.keep("scene", "{\"hand\":\n1}");
        viewer.send("frame", "0");
        let mut reader = BufReader::new(asked(&viewer, "GET /events HTTP/1.1\r\nHost: localhost"));
        let lines = read_until(&mut reader, "data: {\"hand\": 1}");
        assert!(lines.contains(&"event: scene".to_owned()) && !lines.contains(&"event: frame".to_owned()), "{lines:?}");
        assert_eq!(viewer.n_browsers(), 1);
        // More than sockets and queue hold, while it does not read.
        let large = "7".repeat(100_000);
        (0..400).for_each(|_| viewer.send("frame", &large));
        viewer.send("frame", "\"last\"");
        let lines = read_until(&mut reader, "data: \"last\"");
        let n_frames = lines.iter().filter(|line| line.starts_with("data: 777")).count();
        let told = lines.windows(2).filter(|pair| pair[0] == "event: dropped");
        let n_dropped: usize =
            told.map(|pair| pair[1].trim_start_matches("data: ").parse::<usize>().expect("a number")).sum();
        assert!(n_dropped > 0 && n_frames + n_dropped == 400, "{n_frames} frames, {n_dropped} dropped");
    }

    #[test]
    fn a_browser_is_told_of_the_end_and_its_stream_ends() {
        let viewer = Viewer::serve(0, Abilities::default()).expect("served");
        viewer.keep("scene", "1");
        let mut reader = BufReader::new(asked(&viewer, "GET /events HTTP/1.1\r\nHost: localhost"));
        read_until(&mut reader, "data: 1");
        viewer.finish("the \"run\" has ended");
        assert_eq!(viewer.n_browsers(), 0);
        read_until(&mut reader, "event: finished");
        let mut rest = String::new();
        reader.read_line(&mut rest).expect("read");
        assert_eq!(rest.trim_end(), r#"data: "the \"run\" has ended""#);
    }

    /// Strangers who read events, and others who never end the head of a request, keep the owner out of nothing.
    #[test]
    fn the_owner_of_the_token_always_comes_in() {
        let control = Control::new(Box::new(|_| Ok("done".into()))).expect("a token");
        let viewer = Viewer::serve(0, Abilities { control: Some(control), ..Abilities::default() }).expect("served");
        viewer.keep("scene", "1");
        let token = viewer.address().split_once('#').map(|(_, token)| token.to_owned()).expect("a token");
        let mut readers = Vec::new();
        for _ in 0..MAX_BROWSERS {
            let mut reader = BufReader::new(asked(&viewer, "GET /events HTTP/1.1\r\nHost: localhost"));
            read_until(&mut reader, "data: 1");
            readers.push(reader);
        }
        let of_owner = format!("GET /events?token={token} HTTP/1.1\r\nHost: localhost");
        let mut owner = BufReader::new(asked(&viewer, &of_owner));
        read_until(&mut owner, "data: 1");
        let half_requests: Vec<_> = (0..300)
            .map(|_| {
                let mut client = TcpStream::connect(viewer.address).expect("connected");
                client.write_all(b"GET / HTTP/1.1\r\n").expect("sent");
                client
            })
            .collect();
        let log = format!("GET /log HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {token}");
        assert!(answer(&viewer, &log).starts_with("HTTP/1.1 200"));
        viewer.send("frame", "2");
        read_until(&mut owner, "data: 2");
        drop(half_requests);
    }

    #[test]
    fn browsers_beyond_the_most_are_turned_away() {
        let viewer = Viewer::serve(0, Abilities::default()).expect("served");
        viewer.keep("scene", "1");
        let readers: Vec<_> = (0..MAX_BROWSERS)
            .map(|_| {
                let mut reader = BufReader::new(asked(&viewer, "GET /events HTTP/1.1\r\nHost: localhost"));
                read_until(&mut reader, "data: 1");
                reader
            })
            .collect();
        assert!(answer(&viewer, "GET /events HTTP/1.1\r\nHost: localhost").starts_with("HTTP/1.1 503"));
        drop(readers);
        for _ in 0..500 {
            if viewer.n_browsers() == 0 {
                return;
            }
            viewer.send("frame", "0");
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
        panic!("{} browsers are still counted", viewer.n_browsers());
    }
}
