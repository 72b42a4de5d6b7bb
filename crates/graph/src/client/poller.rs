//! Asks a graph again and again over one connection: each new one would cost the launcher two threads.

use std::time::{Duration, Instant};

use super::activity::Look;
use super::{ANSWER_LIMIT, ClientError, Connection};
use crate::control::{Reply, Request};

/// A connection, and whether an answer is due.
pub struct Poller {
    connection: Connection,
    asked: Option<Instant>,
}

impl Poller {
    /// Connects and looks for the first time.
    ///
    /// # Errors
    /// The graph does not run or does not answer.
    pub fn connect(graph: &str) -> Result<(Poller, Look), ClientError> {
        let mut poller = Poller { connection: Connection::open(graph)?, asked: None };
        let first = poller.look()?;
        Ok((poller, first))
    }

    /// Looks, and waits for the answer.
    ///
    /// # Errors
    /// The graph has ended or does not answer.
    pub fn look(&mut self) -> Result<Look, ClientError> {
        let reply = self.connection.ask(&Request::Status, ANSWER_LIMIT)?;
        self.look_of(reply)
    }

    /// Asks, unless an answer is still due.
    ///
    /// # Errors
    /// The graph has ended.
    pub fn ask(&mut self) -> Result<(), ClientError> {
        if self.asked.is_none() {
            self.connection.send(&Request::Status)?;
            self.asked = Some(Instant::now());
        }
        Ok(())
    }

    /// For how long an answer has been due.
    pub fn waited(&self) -> Option<Duration> {
        self.asked.map(|asked| asked.elapsed())
    }

    /// The answer, if it comes within `limit`.
    ///
    /// # Errors
    /// The graph has ended, or what came is no answer.
    pub fn answer_within(&mut self, limit: Duration) -> Result<Option<Look>, ClientError> {
        let Some(reply) = self.connection.receive_within(limit)? else { return Ok(None) };
        self.asked = None;
        self.look_of(reply).map(Some)
    }

    fn look_of(&self, reply: Reply) -> Result<Look, ClientError> {
        match reply {
            Reply::Status(status) => Ok(Look::new(status)),
            other => Err(self.connection.unexpected(&other)),
        }
    }
}
