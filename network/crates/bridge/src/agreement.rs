//! Keys for the frames between two processes of two machines.
//!
//! Each link has an X25519 key pair for the next process of the peer that answers. A hello carries the public key, and
//! the public key of the other link that it answers. When a link is answered, it derives two keys, one for each
//! direction, from both key pairs, both machines' names and both instances, and draws a new pair for the next process
//! of the peer. So a recorded hello of an earlier process answers nothing, and the keys cannot be found later by
//! an attacker with a machine's private key.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, PoisonError, RwLock};

use ring::aead::{Aad, CHACHA20_POLY1305, LessSafeKey, NONCE_LEN, Nonce, UnboundKey};
use ring::agreement::{EphemeralPrivateKey, UnparsedPublicKey, X25519, agree_ephemeral};
use ring::hkdf::{HKDF_SHA256, Prk, Salt};
use ring::rand::SystemRandom;

use super::envelope::{Form, HEAD_BYTES};
use super::wire::{Hello, WireError};
use blindgrasp_graph::link::config::KeyKind;

/// It tells the keys of frames from keys of other protocols.
const LABEL: &[u8] = b"blindgrasp frames";
/// The first bytes of the sender's public key, which tell frames of this agreement from frames of an earlier one.
const ID_BYTES: usize = 4;
const COUNTER_BYTES: usize = 8;
/// Bytes before the encrypted body.
const PREFIX_BYTES: usize = HEAD_BYTES + ID_BYTES + COUNTER_BYTES;

/// An X25519 public key.
pub type PublicKey = [u8; 32];

/// The keys in use with a peer; `None` until it has answered. Links' threads share it.
pub(super) type SharedKeys = Arc<RwLock<Option<Arc<PairKeys>>>>;

/// The operating system has no random numbers, or the peer's public key is not valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("no keys can be agreed on")]
pub struct NoAgreement;

/// The agreements of this process with one peer.
#[derive(Debug)]
pub struct Agreement {
    prefix: String,
    machine: String,
    peer: String,
    instance: u64,
    /// The key pair for the next process of the peer.
    next: (EphemeralPrivateKey, PublicKey),
    /// The public keys of the agreement in use: this link's and the peer's.
    settled: Option<(PublicKey, PublicKey)>,
    /// The keys that were agreed on.
    agreed: Option<Arc<PairKeys>>,
    /// Whether they count.
    is_valid: bool,
    /// The same keys while they count.
    keys: SharedKeys,
}

/// The keys that two processes have agreed on.
#[derive(Debug)]
pub struct PairKeys {
    sending: LessSafeKey,
    sending_id: [u8; ID_BYTES],
    n_sent: AtomicU64,
    receiving: LessSafeKey,
    receiving_id: [u8; ID_BYTES],
}

impl Agreement {
    /// # Errors
    /// The operating system has no random numbers.
    pub fn new(prefix: &str, machine: &str, peer: &str, instance: u64) -> Result<Agreement, NoAgreement> {
        Ok(Agreement {
            prefix: prefix.into(),
            machine: machine.into(),
            peer: peer.into(),
            instance,
            next: key_pair()?,
            settled: None,
            agreed: None,
            is_valid: false,
            keys: SharedKeys::default(),
        })
    }

    pub(super) fn keys(&self) -> SharedKeys {
        Arc::clone(&self.keys)
    }

    /// The keys in use; `None` until the peer has answered.
    pub fn pair(&self) -> Option<Arc<PairKeys>> {
        in_use(&self.keys)
    }

    /// The public keys for a hello: this link's, and the peer's that it answers; none while the peer's keys do not count,
    /// so that the peer notices. `candidate` is the key of a process of the peer that is not in use yet.
    pub fn for_hello(&self, candidate: Option<PublicKey>) -> (PublicKey, Option<PublicKey>) {
        match (candidate, self.settled) {
            (None, Some((own, peers))) => (own, self.is_valid.then_some(peers)),
            (candidate, _) => (self.next.1, candidate),
        }
    }

    /// Whether a hello to this process answers it: the process in use with the keys in use, or another process with the
    /// keys for the next one.
    pub fn is_answered(&self, hello: &Hello, is_in_use: bool) -> bool {
        if is_in_use {
            self.settled.is_some_and(|(own, peers)| hello.key == Some(peers) && hello.heard_key == Some(own))
        } else {
            hello.key.is_some() && hello.heard_key == Some(self.next.1)
        }
    }

    /// Derives the keys for a process of the peer.
    ///
    /// # Errors
    /// The keys in use stay the same then.
    pub fn settle(&mut self, instance: u64, peers: PublicKey) -> Result<(), NoAgreement> {
        let (private, own) = std::mem::replace(&mut self.next, key_pair()?);
        let (machine, peer) = (self.machine.as_bytes(), self.peer.as_bytes());
        let us = (machine, self.instance.to_le_bytes(), own);
        let them = (peer, instance.to_le_bytes(), peers);
        let derive = |prk: &Prk, from: &(&[u8], [u8; 8], PublicKey), to: &(&[u8], [u8; 8], PublicKey)| {
            let mut info = LABEL.to_vec();
            for (name, instance, key) in [from, to] {
                info.extend((name.len() as u64).to_le_bytes());
                [name, &instance[..], &key[..]].into_iter().for_each(|part| info.extend(part));
            }
            let info = [&info[..], self.prefix.as_bytes()];
            let key = prk.expand(&info, &CHACHA20_POLY1305).map_err(|_| NoAgreement)?;
            Ok(LessSafeKey::new(UnboundKey::from(key)))
        };
        let keys = agree_ephemeral(private, &UnparsedPublicKey::new(&X25519, peers), |secret| {
            let prk = Salt::new(HKDF_SHA256, LABEL).extract(secret);
            Ok(PairKeys {
                sending: derive(&prk, &us, &them)?,
                sending_id: id(&own),
                n_sent: AtomicU64::new(0),
                receiving: derive(&prk, &them, &us)?,
                receiving_id: id(&peers),
            })
        });
        let keys = keys.map_err(|_| NoAgreement)??;
        self.agreed = Some(Arc::new(keys));
        self.settled = Some((own, peers));
        self.set_valid(true);
        Ok(())
    }

    /// Whether a hello comes from the process in use, whether or not the peer takes this link's frames.
    pub fn is_from_settled(&self, hello: &Hello) -> bool {
        self.settled.is_some_and(|(_, peers)| hello.key == Some(peers))
    }

    /// Says whether the keys that were agreed on count.
    pub fn set_valid(&mut self, is_valid: bool) {
        self.is_valid = is_valid;
        let keys = if is_valid { self.agreed.clone() } else { None };
        *self.keys.write().unwrap_or_else(PoisonError::into_inner) = keys;
    }
}

impl PairKeys {
    /// Replaces a plain frame by an encrypted one that the peer takes under this kind of key alone.
    pub fn encrypt(&self, kind: KeyKind, frame: &mut Vec<u8>) {
        let counter = self.n_sent.fetch_add(1, Ordering::Relaxed);
        frame[HEAD_BYTES - 1] = Form::Encrypted as u8;
        frame.splice(HEAD_BYTES..HEAD_BYTES, [&self.sending_id[..], &counter.to_le_bytes()].concat());
        let (head, body) = frame.split_at_mut(PREFIX_BYTES);
        let sealed = self.sending.seal_in_place_separate_tag(nonce(counter), aad(kind, head), body);
        match sealed {
            Ok(tag) => frame.extend(tag.as_ref()),
            // A body would have to have 256 GiB. The peer rejects the rest.
            Err(_) => frame.truncate(PREFIX_BYTES),
        }
    }

    /// The plain frame in an encrypted one.
    ///
    /// # Errors
    /// [`WireError::OtherKeys`] or [`WireError::Forged`]
    pub fn decrypt(&self, kind: KeyKind, frame: &[u8]) -> Result<Vec<u8>, WireError> {
        let (head, body) = frame.split_at_checked(PREFIX_BYTES).ok_or(WireError::Forged)?;
        if head[HEAD_BYTES..][..ID_BYTES] != self.receiving_id {
            return Err(WireError::OtherKeys);
        }
        let counter =
            head[HEAD_BYTES + ID_BYTES..].try_into().map(u64::from_le_bytes).map_err(|_| WireError::Forged)?;
        let mut plain = [&head[..HEAD_BYTES - 1], &[Form::Plain as u8], body].concat();
        let opened = self.receiving.open_in_place(nonce(counter), aad(kind, head), &mut plain[HEAD_BYTES..]);
        let n_bytes = opened.map_err(|_| WireError::Forged)?.len();
        plain.truncate(HEAD_BYTES + n_bytes);
        Ok(plain)
    }
}

pub(super) fn in_use(keys: &SharedKeys) -> Option<Arc<PairKeys>> {
    keys.read().unwrap_or_else(PoisonError::into_inner).clone()
}

fn key_pair() -> Result<(EphemeralPrivateKey, PublicKey), NoAgreement> {
    let private = EphemeralPrivateKey::generate(&X25519, &SystemRandom::new()).map_err(|_| NoAgreement)?;
    let public = private.compute_public_key().map_err(|_| NoAgreement)?;
    let public = public.as_ref().try_into().map_err(|_| NoAgreement)?;
    Ok((private, public))
}

fn id(key: &PublicKey) -> [u8; ID_BYTES] {
    [key[0], key[1], key[2], key[3]]
}

/// Each key encrypts each count once.
fn nonce(counter: u64) -> Nonce {
    let mut bytes = [0; NONCE_LEN];
    bytes[..COUNTER_BYTES].copy_from_slice(&counter.to_le_bytes());
    Nonce::assume_unique_for_key(bytes)
}

fn aad(kind: KeyKind, head: &[u8]) -> Aad<Vec<u8>> {
    Aad::from([head, kind.word().as_bytes()].concat())
}

#[cfg(test)]
mod tests;
