//! Machines' certificates as they lie in a folder: read, and checked before they are used.

use std::path::{Path, PathBuf};

use rcgen::KeyPair;
use serde::Serialize;
use time::{Duration, OffsetDateTime};
use x509_parser::certificate::X509Certificate;
use x509_parser::pem::Pem;

use super::config::KeyFiles;

/// The authority's certificate, in a folder of keys. It may hold several, while an authority is replaced.
pub const AUTHORITY_FILE: &str = "ca.pem";
/// The common name in the certificate of a Zenoh router. No machine can have it.
pub const ROUTER_COMMON_NAME: &str = "@router";
/// A certificate that ends sooner is spoken of at each start.
pub const RENEWAL: Duration = Duration::days(30);

/// A certificate in PEM, as far as it matters here.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct CertificateSummary {
    /// The file.
    pub file: PathBuf,
    /// Whose it is: the subject's common name, `MACHINE` or `MACHINE@NAMESPACE`.
    pub common_name: String,
    /// The common name of who signed it.
    pub issuer: String,
    /// Whether it is an authority's.
    pub is_authority: bool,
    /// From when it counts, in seconds since 1970.
    pub from_unix_secs: i64,
    /// Until when it counts, in seconds since 1970.
    pub until_unix_secs: i64,
    /// Its number, in hexadecimal.
    pub serial: String,
}

/// Why a certificate cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CertificateError {
    /// A file cannot be read.
    #[error("{}: {source}; `blindgrasp keys` makes certificates and keys", file.display())]
    Unreadable {
        /// Which.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// It holds something else.
    #[error("{}: {message}", file.display())]
    Malformed {
        /// Which.
        file: PathBuf,
        /// What was found and expected.
        message: String,
    },
    /// It is not, or no longer, or not yet to be used for this.
    #[error("{}: {message}", file.display())]
    Unfit {
        /// Which.
        file: PathBuf,
        /// What was found and expected, and what to do.
        message: String,
    },
}

impl CertificateSummary {
    /// The day of its end, as `2027-11-22`.
    pub fn until(&self) -> String {
        day(self.until_unix_secs)
    }
}

/// The common name of a machine's certificate.
///
/// The separator is none that can stand in a name on the internet: Zenoh's connecting side also takes certificates that
/// public authorities have signed, and none of those will sign this.
pub fn common_name(machine: &str, namespace: Option<&str>) -> String {
    namespace.map_or_else(|| machine.to_string(), |namespace| format!("{machine}@{namespace}"))
}

/// The common names under which a machine is known in a namespace: its own there, and the one that counts everywhere.
pub fn accepted_names(machine: &str, namespace: Option<&str>) -> Vec<String> {
    let everywhere = common_name(machine, None);
    let here = namespace.map(|namespace| common_name(machine, Some(namespace)));
    [everywhere].into_iter().chain(here).collect()
}

/// Where a machine's keys lie in a folder.
pub fn key_files(folder: &Path, machine: &str) -> KeyFiles {
    KeyFiles {
        authority: folder.join(AUTHORITY_FILE),
        certificate: folder.join(format!("{machine}.pem")),
        private_key: folder.join(format!("{machine}.key.pem")),
    }
}

/// The certificates in a file, in its order.
///
/// # Errors
/// It cannot be read or holds no certificate.
pub fn read(file: &Path) -> Result<Vec<CertificateSummary>, CertificateError> {
    let pems = pems(file)?;
    pems.iter().map(|pem| Ok(summary(file, &parsed(file, pem)?))).collect()
}

/// Checks that a machine's files belong together and count now, and gives its certificate.
///
/// # Errors
/// One is missing, is another machine's, has ended, was signed by another authority, or does not fit the private key.
pub fn check(
    files: &KeyFiles,
    machine: &str,
    namespace: Option<&str>,
    now: OffsetDateTime,
) -> Result<CertificateSummary, CertificateError> {
    let file = &files.certificate;
    let unfit = |message: String| CertificateError::Unfit { file: file.clone(), message };
    let pems_here = pems(file)?;
    let certificate = parsed(file, &pems_here[0])?;
    let found = summary(file, &certificate);
    let names = accepted_names(machine, namespace);
    if !names.contains(&found.common_name) {
        return Err(unfit(format!(
            "this is the certificate of '{}', expected that of {}: copy this machine's own, or start it as the machine \
             that it is",
            found.common_name,
            names.iter().map(|name| format!("'{name}'")).collect::<Vec<_>>().join(" or ")
        )));
    }
    if now.unix_timestamp() > found.until_unix_secs {
        return Err(unfit(format!(
            "this certificate ended on {}: renew it (blindgrasp keys DIR --machine {machine} --renew, where the \
             authority's key is) and copy it here",
            found.until()
        )));
    }
    if now.unix_timestamp() < found.from_unix_secs {
        return Err(unfit(format!(
            "this certificate counts from {} on, and this machine's clock says {}: set the clock",
            day(found.from_unix_secs),
            day(now.unix_timestamp())
        )));
    }
    let authority = pems(&files.authority)?;
    let authorities =
        authority.iter().map(|pem| parsed(&files.authority, pem)).collect::<Result<Vec<X509Certificate<'_>>, _>>()?;
    let is_signed_by =
        |authority: &X509Certificate<'_>| certificate.verify_signature(Some(authority.public_key())).is_ok();
    // With certificates between this one and the authority, TLS itself has to find out.
    if pems_here.len() == 1 && !authorities.iter().any(is_signed_by) {
        return Err(unfit(format!(
            "this certificate was signed by '{}', which is not in {}: copy both from the same folder",
            found.issuer,
            files.authority.display()
        )));
    }
    let private_key = std::fs::read_to_string(&files.private_key)
        .map_err(|source| CertificateError::Unreadable { file: files.private_key.clone(), source })?;
    // Kinds of keys that it doesn't know are for TLS to judge.
    if let Ok(pair) = KeyPair::from_pem(&private_key)
        && !fits(&certificate, &pair)
    {
        return Err(unfit(format!(
            "this certificate is not for the private key in {}: copy both from the same folder",
            files.private_key.display()
        )));
    }
    Ok(found)
}

/// Whether the first certificate in a file is for this private key.
///
/// # Errors
/// The file cannot be read or holds no certificate.
pub(super) fn is_for(file: &Path, pair: &KeyPair) -> Result<bool, CertificateError> {
    Ok(fits(&parsed(file, &pems(file)?[0])?, pair))
}

/// A day, as `2027-11-22`.
pub fn day(unix_secs: i64) -> String {
    OffsetDateTime::from_unix_timestamp(unix_secs)
        .map_or_else(|_| format!("{unix_secs} s after 1970"), |time| time.date().to_string())
}

fn fits(certificate: &X509Certificate<'_>, pair: &KeyPair) -> bool {
    certificate.public_key().subject_public_key.data.as_ref() == pair.public_key_raw()
}

fn pems(file: &Path) -> Result<Vec<Pem>, CertificateError> {
    let bytes =
        std::fs::read(file).map_err(|source| CertificateError::Unreadable { file: file.to_path_buf(), source })?;
    let malformed = |message: &str| CertificateError::Malformed { file: file.to_path_buf(), message: message.into() };
    let all: Result<Vec<Pem>, _> = Pem::iter_from_buffer(&bytes).collect();
    let all = all.map_err(|_| malformed("not PEM: expected a file with -----BEGIN CERTIFICATE-----"))?;
    let certificates: Vec<Pem> = all.into_iter().filter(|pem| pem.label == "CERTIFICATE").collect();
    if certificates.is_empty() {
        return Err(malformed("no certificate in it: expected -----BEGIN CERTIFICATE-----"));
    }
    Ok(certificates)
}

fn parsed<'a>(file: &Path, pem: &'a Pem) -> Result<X509Certificate<'a>, CertificateError> {
    pem.parse_x509().map_err(|error| CertificateError::Malformed {
        file: file.to_path_buf(),
        message: format!("not an X.509 certificate ({error})"),
    })
}

fn summary(file: &Path, certificate: &X509Certificate<'_>) -> CertificateSummary {
    let name = |name: &x509_parser::x509::X509Name<'_>| {
        name.iter_common_name().next().and_then(|name| name.as_str().ok()).unwrap_or_default().to_string()
    };
    CertificateSummary {
        file: file.to_path_buf(),
        common_name: name(certificate.subject()),
        issuer: name(certificate.issuer()),
        is_authority: certificate.is_ca(),
        from_unix_secs: certificate.validity().not_before.timestamp(),
        until_unix_secs: certificate.validity().not_after.timestamp(),
        serial: certificate.raw_serial().iter().map(|byte| format!("{byte:02x}")).collect(),
    }
}
