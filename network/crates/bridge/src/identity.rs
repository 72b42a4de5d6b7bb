//! The proof of a hello's sender: signatures with the private keys of the machines' certificates.
//!
//! Zenoh checks certificates as well, once per connection and by its own rules. A link does not depend on them. Each
//! hello carries the sender's certificates and a signature over the namespace, the graph, both machines and the whole
//! frame. So it is also over the key with which the machines agree on the keys of all other frames
//! ([`agreement`](super::agreement)).

use std::borrow::Cow;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use rustls::SignatureScheme;
use rustls::crypto::ring::{default_provider, sign::any_supported_type};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer, TrustAnchor, UnixTime};
use rustls::sign::SigningKey;
use serde::{Deserialize, Deserializer, Serialize};
use time::OffsetDateTime;
use webpki::{
    CertRevocationList, EndEntityCert, KeyUsage, OwnedCertRevocationList, RevocationOptionsBuilder,
    UnknownStatusPolicy, anchor_from_trusted_cert,
};

use super::certificates::{self, CertificateError, accepted_names};
use blindgrasp_graph::link::config::{KeyFiles, LinkConfig};
use blindgrasp_messages::read_list;

/// The first of the signed bytes: a signature for another purpose is not valid for a hello.
const LABEL: &[u8] = b"blindgrasp hello\0";
/// Maximum number of certificates with a hello: the machine's own and intermediates.
const MAX_CERTIFICATES: usize = 4;
/// Kinds of signatures, as in TLS 1.3.
const SCHEMES: [SignatureScheme; 4] = [
    SignatureScheme::ED25519,
    SignatureScheme::ECDSA_NISTP256_SHA256,
    SignatureScheme::ECDSA_NISTP384_SHA384,
    SignatureScheme::RSA_PSS_SHA256,
];

/// This machine's certificate and key, and the authorities that it trusts.
pub struct Identity {
    machine: String,
    namespace: Option<String>,
    /// [`LinkConfig::key_prefix`]
    prefix: String,
    files: KeyFiles,
    loaded: Mutex<(Arc<Loaded>, Stamps)>,
}

/// Why a hello is not believed, as a sentence for the user.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Unverified(pub String);

/// The proof of a hello as it is encoded.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Proof<'a> {
    #[serde(borrow, deserialize_with = "certificates")]
    certificates: Vec<Cow<'a, [u8]>>,
    /// A signature scheme of TLS 1.3.
    scheme: u16,
    #[serde(borrow)]
    signature: Cow<'a, [u8]>,
}

fn certificates<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Cow<'de, [u8]>>, D::Error> {
    let borrowed: Vec<&'de [u8]> = read_list(deserializer, MAX_CERTIFICATES)?;
    Ok(borrowed.into_iter().map(Cow::Borrowed).collect())
}

struct Loaded {
    certificates: Vec<CertificateDer<'static>>,
    key: Arc<dyn SigningKey>,
    authorities: Vec<TrustAnchor<'static>>,
    revoked: Vec<CertRevocationList<'static>>,
}

/// The number, the time and the size of each file when it was read.
type Stamps = [Option<(u64, SystemTime, u64)>; 4];

impl Identity {
    /// Reads and checks the files; `None` if this machine has no keys.
    ///
    /// # Errors
    /// A file is missing, or the certificate cannot be used for this machine now.
    pub fn load(config: &LinkConfig, now: OffsetDateTime) -> Result<Option<Identity>, CertificateError> {
        let Some(files) = config.keys.clone() else { return Ok(None) };
        let stamps = stamps(&files);
        let loaded = load(&files, &config.machine, config.namespace.as_deref(), now)?;
        Ok(Some(Identity {
            machine: config.machine.clone(),
            namespace: config.namespace.clone(),
            prefix: config.key_prefix(),
            files,
            loaded: Mutex::new((Arc::new(loaded), stamps)),
        }))
    }

    /// Signs a frame for another machine.
    ///
    /// # Errors
    /// The private key cannot sign.
    pub(super) fn sign(&self, to: &str, frame: &[u8], now: OffsetDateTime) -> Result<Proof<'static>, Unverified> {
        let loaded = self.current(now);
        let file = self.files.private_key.display();
        let signer = loaded.key.choose_scheme(&SCHEMES).ok_or_else(|| {
            Unverified(format!("{file}: a key of this kind cannot sign; expected ECDSA P-256 or P-384, Ed25519 or RSA"))
        })?;
        let signature = signer.sign(&signed_bytes(&self.prefix, &self.machine, to, frame));
        Ok(Proof {
            certificates: loaded.certificates.iter().map(|certificate| certificate.to_vec().into()).collect(),
            scheme: signer.scheme().into(),
            signature: signature.map_err(|error| Unverified(format!("{file}: {error}")))?.into(),
        })
    }

    /// Checks that a machine with this name has signed this frame for this machine.
    ///
    /// # Errors
    /// It has not, or its certificate is not valid now.
    pub(super) fn verify(
        &self,
        from: &str,
        proof: &Proof<'_>,
        frame: &[u8],
        now: OffsetDateTime,
    ) -> Result<(), Unverified> {
        let loaded = self.current(now);
        let certificates: Vec<CertificateDer<'_>> =
            proof.certificates.iter().map(|bytes| CertificateDer::from(bytes.as_ref())).collect();
        let unfit = |message: String| Unverified(format!("the certificate in the hello of machine '{from}' {message}"));
        let [own, intermediates @ ..] = &certificates[..] else { return Err(unfit("is missing".into())) };
        let invalid = |error: webpki::Error| unfit(self.in_words(&error));
        let certificate = EndEntityCert::try_from(own).map_err(invalid)?;
        let algorithms = default_provider().signature_verification_algorithms;
        let revoked: Vec<_> = loaded.revoked.iter().collect();
        // An authority need not have a list, and an old list counts until there is a newer one.
        let revocation = RevocationOptionsBuilder::new(&revoked).ok();
        let revocation = revocation.map(|options| options.with_status_policy(UnknownStatusPolicy::Allow).build());
        let unix_secs = u64::try_from(now.unix_timestamp()).unwrap_or(0);
        certificate
            .verify_for_usage(
                algorithms.all,
                &loaded.authorities,
                intermediates,
                UnixTime::since_unix_epoch(Duration::from_secs(unix_secs)),
                KeyUsage::client_auth(),
                revocation,
                None,
            )
            .map_err(invalid)?;
        let found = certificates::common_name_of(own).ok_or_else(|| unfit("has no common name".into()))?;
        let names = accepted_names(from, self.namespace.as_deref());
        if !names.contains(&found) {
            return Err(unfit(format!("is that of '{found}', expected that of '{}'", names.join("' or '"))));
        }
        let scheme = SignatureScheme::from(proof.scheme);
        let algorithms = algorithms.mapping.iter().find(|(known, _)| *known == scheme && SCHEMES.contains(known));
        let message = signed_bytes(&self.prefix, from, &self.machine, frame);
        let is_signed = algorithms.is_some_and(|(_, algorithms)| {
            algorithms
                .iter()
                .any(|algorithm| certificate.verify_signature(*algorithm, &message, &proof.signature).is_ok())
        });
        is_signed.then_some(()).ok_or_else(|| {
            Unverified(format!(
                "a hello of machine '{from}' was not signed with its key for machine '{}'",
                self.machine
            ))
        })
    }

    /// The keys, read again if the files have changed. While the new files do not belong together, because they are
    /// being copied, the old ones count.
    fn current(&self, now: OffsetDateTime) -> Arc<Loaded> {
        let mut loaded = self.loaded.lock().unwrap_or_else(PoisonError::into_inner);
        let found = stamps(&self.files);
        if found != loaded.1 {
            loaded.1 = found;
            match load(&self.files, &self.machine, self.namespace.as_deref(), now) {
                Ok(new) => {
                    tracing::info!("this machine's keys have changed and were read again");
                    loaded.0 = Arc::new(new);
                }
                Err(error) => tracing::warn!("the earlier keys stay in use: {error}"),
            }
        }
        Arc::clone(&loaded.0)
    }

    fn in_words(&self, error: &webpki::Error) -> String {
        match error {
            webpki::Error::CertExpired { .. } => "has ended: renew it".into(),
            webpki::Error::CertNotValidYet { .. } => "is not valid yet: set the clock of both machines".into(),
            webpki::Error::CertRevoked => {
                format!("was revoked ({}): renew it", self.files.revoked().display())
            }
            webpki::Error::UnknownIssuer => format!(
                "was not signed by an authority in {}: copy the keys of both machines from the same folder",
                self.files.authority.display()
            ),
            other => format!("is not valid: {other}"),
        }
    }
}

fn load(
    files: &KeyFiles,
    machine: &str,
    namespace: Option<&str>,
    now: OffsetDateTime,
) -> Result<Loaded, CertificateError> {
    certificates::check(files, machine, namespace, now)?;
    let authorities = certificates_in(&files.authority)?;
    let authorities: Result<Vec<_>, _> =
        authorities.iter().map(|it| anchor_from_trusted_cert(it).map(|anchor| anchor.to_owned())).collect();
    let key = PrivateKeyDer::from_pem_file(&files.private_key)
        .map_err(|error| malformed(&files.private_key, error.to_string()))?;
    let certificates = certificates_in(&files.certificate)?;
    if certificates.len() > MAX_CERTIFICATES {
        let message = format!("{} certificates, expected at most {MAX_CERTIFICATES}", certificates.len());
        return Err(malformed(&files.certificate, message));
    }
    let file = files.revoked();
    let revoked = if file.exists() {
        CertificateRevocationListDer::pem_file_iter(&file)
            .and_then(Iterator::collect::<Result<Vec<_>, _>>)
            .map_err(|error| malformed(&file, error.to_string()))?
    } else {
        Vec::new()
    };
    let revoked: Result<Vec<_>, _> =
        revoked.iter().map(|der| OwnedCertRevocationList::from_der(der).map(Into::into)).collect();
    Ok(Loaded {
        certificates,
        key: any_supported_type(&key).map_err(|error| malformed(&files.private_key, error.to_string()))?,
        authorities: authorities.map_err(|error| malformed(&files.authority, error.to_string()))?,
        revoked: revoked.map_err(|error| malformed(&file, error.to_string()))?,
    })
}

fn certificates_in(file: &Path) -> Result<Vec<CertificateDer<'static>>, CertificateError> {
    let read = CertificateDer::pem_file_iter(file).and_then(Iterator::collect);
    read.map_err(|error| malformed(file, error.to_string()))
}

fn malformed(file: &Path, message: String) -> CertificateError {
    CertificateError::Malformed { file: file.to_path_buf(), message }
}

fn stamps(files: &KeyFiles) -> Stamps {
    [&files.authority, &files.certificate, &files.private_key, &files.revoked()].map(|file| {
        let found = std::fs::metadata(file).ok()?;
        Some((found.ino(), found.modified().ok()?, found.len()))
    })
}

fn signed_bytes(prefix: &str, from: &str, to: &str, frame: &[u8]) -> Vec<u8> {
    let mut bytes = LABEL.to_vec();
    for part in [prefix.as_bytes(), from.as_bytes(), to.as_bytes(), frame] {
        bytes.extend((part.len() as u64).to_le_bytes());
        bytes.extend(part);
    }
    bytes
}

#[cfg(test)]
mod tests;
