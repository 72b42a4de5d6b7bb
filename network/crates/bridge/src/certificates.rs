//! Reads the certificates of machines from files and checks them before they are used.

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use blindgrasp_messages::files::{read_regular, read_regular_bytes};
use rcgen::KeyPair;
use serde::Serialize;
use time::{Duration, OffsetDateTime};
use x509_parser::certificate::X509Certificate;
use x509_parser::pem::Pem;
use x509_parser::prelude::FromDer;
use x509_parser::revocation_list::CertificateRevocationList;
use x509_parser::x509::X509Name;

use blindgrasp_graph::link::config::KeyFiles;

/// Each start warns about a certificate that ends within this time.
pub const RENEWAL: Duration = Duration::days(30);

/// The parts of a certificate that matter here.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct CertificateSummary {
    pub file: PathBuf,
    /// The subject's common name, `MACHINE` or `MACHINE@NAMESPACE`.
    pub common_name: String,
    /// The issuer's common name.
    pub issuer: String,
    /// Whether it is the certificate of an authority.
    pub is_authority: bool,
    /// Start of its validity in seconds since 1970.
    pub from_unix_secs: i64,
    /// End of its validity in seconds since 1970.
    pub until_unix_secs: i64,
    /// The serial number in hexadecimal.
    pub serial: String,
}

/// Why a certificate cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CertificateError {
    #[error("{}: {source}; `blindgrasp keys` makes certificates and keys", file.display())]
    Unreadable { file: PathBuf, source: std::io::Error },
    /// The file holds something else.
    #[error("{}: {message}", file.display())]
    Malformed { file: PathBuf, message: String },
    /// The certificate cannot be used for this machine now.
    #[error("{}: {message}", file.display())]
    Unfit { file: PathBuf, message: String },
    #[error(
        "{file}: other users of this machine may read or change this private key (mode {mode:03o}), expected mode 600: \
         chmod 600 {file}",
        file = file.display()
    )]
    Open { file: PathBuf, mode: u32 },
}

impl CertificateSummary {
    /// The last day of its validity, as `2027-11-22`.
    pub fn until(&self) -> String {
        day(self.until_unix_secs)
    }
}

/// The common name of a machine's certificate.
///
/// The separator `@` cannot be part of a name on the internet. Zenoh's connecting side also accepts certificates of
/// public authorities, and these do not sign such a name.
pub fn common_name(machine: &str, namespace: Option<&str>) -> String {
    namespace.map_or_else(|| machine.to_string(), |namespace| format!("{machine}@{namespace}"))
}

/// The common names that a machine may have in a namespace: the one for this namespace and the one for all namespaces.
pub fn accepted_names(machine: &str, namespace: Option<&str>) -> Vec<String> {
    let everywhere = common_name(machine, None);
    let here = namespace.map(|namespace| common_name(machine, Some(namespace)));
    [everywhere].into_iter().chain(here).collect()
}

/// The certificates in a file, in their order.
///
/// # Errors
/// The file cannot be read or holds no certificate.
pub fn read(file: &Path) -> Result<Vec<CertificateSummary>, CertificateError> {
    let pems = pems(file)?;
    pems.iter().map(|pem| Ok(summary(file, &parsed(file, pem)?))).collect()
}

/// Checks that a machine's files belong together and are valid now, and returns its certificate.
///
/// # Errors
/// A file is missing, or the certificate is for another machine, has ended, was signed by another authority, or is not
/// for the private key, or other users may read the private key.
pub fn check(
    files: &KeyFiles,
    machine: &str,
    namespace: Option<&str>,
    now: OffsetDateTime,
) -> Result<CertificateSummary, CertificateError> {
    check_mode(&files.private_key)?;
    let file = &files.certificate;
    let unfit = |message: String| CertificateError::Unfit { file: file.clone(), message };
    let pems_here = pems(file)?;
    let certificate = parsed(file, &pems_here[0])?;
    let found = summary(file, &certificate);
    let names = accepted_names(machine, namespace);
    if !names.contains(&found.common_name) {
        return Err(unfit(format!(
            "this is the certificate of '{}', expected that of {}: copy this machine's own certificate, or start this part \
             with the right --machine",
            found.common_name,
            names.iter().map(|name| format!("'{name}'")).collect::<Vec<_>>().join(" or ")
        )));
    }
    if let Some(message) = outside_its_time(&found, machine, now) {
        return Err(unfit(message));
    }
    let authority = pems(&files.authority)?;
    let authorities =
        authority.iter().map(|pem| parsed(&files.authority, pem)).collect::<Result<Vec<X509Certificate<'_>>, _>>()?;
    // If there are intermediate certificates, TLS checks the chain.
    if pems_here.len() == 1 && !authorities.iter().any(|it| certificate.verify_signature(Some(it.public_key())).is_ok())
    {
        return Err(unfit(format!(
            "this certificate was signed by '{}', which is not in {}: copy both files from the same folder",
            found.issuer,
            files.authority.display()
        )));
    }
    let private_key = read_regular(&files.private_key)
        .map_err(|source| CertificateError::Unreadable { file: files.private_key.clone(), source })?;
    // TLS checks keys of kinds that rcgen does not know.
    if let Ok(pair) = KeyPair::from_pem(&private_key)
        && !fits(&certificate, &pair)
    {
        return Err(unfit(format!(
            "this certificate is not for the private key in {}: copy both files from the same folder",
            files.private_key.display()
        )));
    }
    Ok(found)
}

/// Why a machine's certificate is not valid now, for a person; `None` if it is.
fn outside_its_time(found: &CertificateSummary, machine: &str, now: OffsetDateTime) -> Option<String> {
    if now.unix_timestamp() > found.until_unix_secs {
        return Some(format!(
            "this certificate ended on {}: renew it (blindgrasp keys DIR --machine {machine} --renew, where the \
             authority's key is) and copy it here",
            found.until()
        ));
    }
    if now.unix_timestamp() < found.from_unix_secs {
        return Some(format!(
            "this certificate is valid from {} on, but this machine's clock says {}: set the clock",
            day(found.from_unix_secs),
            day(now.unix_timestamp())
        ));
    }
    None
}

/// As ssh does: a key that others can read is no secret.
fn check_mode(private_key: &Path) -> Result<(), CertificateError> {
    // A file that is missing is reported where it is read.
    let mode = std::fs::metadata(private_key).map_or(0, |found| found.permissions().mode() & 0o777);
    match mode & 0o077 {
        0 => Ok(()),
        _ => Err(CertificateError::Open { file: private_key.into(), mode }),
    }
}

/// Whether the first certificate in a file is for this private key.
///
/// # Errors
/// The file cannot be read or holds no certificate.
pub(super) fn is_for(file: &Path, pair: &KeyPair) -> Result<bool, CertificateError> {
    Ok(fits(&parsed(file, &pems(file)?[0])?, pair))
}

/// The certificates that an authority has revoked, each with its serial number and the time, and the text of the lists
/// of other authorities in the same file.
///
/// # Errors
/// The text holds something else than lists of revoked certificates.
pub(super) fn revoked(
    file: &Path,
    text: &str,
    authority: &str,
) -> Result<(Vec<(String, OffsetDateTime)>, String), CertificateError> {
    const END: &str = "-----END X509 CRL-----\n";
    let malformed = |error: &dyn std::fmt::Display| CertificateError::Malformed {
        file: file.to_path_buf(),
        message: format!("not a list of revoked certificates: {error}"),
    };
    let (mut all, mut others) = (Vec::new(), String::new());
    for block in text.split_inclusive(END).filter(|block| !block.trim().is_empty()) {
        let (pem, _) = Pem::read(std::io::Cursor::new(block.as_bytes())).map_err(|error| malformed(&error))?;
        let (_, list) = CertificateRevocationList::from_der(&pem.contents).map_err(|error| malformed(&error))?;
        if first_common_name(list.issuer()) != Some(authority) {
            others.push_str(block);
            continue;
        }
        all.extend(list.iter_revoked_certificates().map(|revoked| {
            let serial = revoked.raw_serial().iter().map(|byte| format!("{byte:02x}")).collect();
            (serial, revoked.revocation_date.to_datetime())
        }));
    }
    Ok((all, others))
}

/// The common name of a certificate; `None` if it has none.
pub(super) fn common_name_of(der: &[u8]) -> Option<String> {
    let (_, certificate) = X509Certificate::from_der(der).ok()?;
    first_common_name(certificate.subject()).map(str::to_string)
}

fn first_common_name<'a>(name: &'a X509Name<'_>) -> Option<&'a str> {
    name.iter_common_name().next()?.as_str().ok()
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
        read_regular_bytes(file).map_err(|source| CertificateError::Unreadable { file: file.to_path_buf(), source })?;
    let malformed = |message: &str| CertificateError::Malformed { file: file.to_path_buf(), message: message.into() };
    let all: Result<Vec<Pem>, _> = Pem::iter_from_buffer(&bytes).collect();
    let all = all.map_err(|_| malformed("not a PEM file, expected -----BEGIN CERTIFICATE----- in it"))?;
    let certificates: Vec<Pem> = all.into_iter().filter(|pem| pem.label == "CERTIFICATE").collect();
    if certificates.is_empty() {
        return Err(malformed("the file has no certificate, expected -----BEGIN CERTIFICATE----- in it"));
    }
    Ok(certificates)
}

fn parsed<'a>(file: &Path, pem: &'a Pem) -> Result<X509Certificate<'a>, CertificateError> {
    pem.parse_x509().map_err(|error| CertificateError::Malformed {
        file: file.to_path_buf(),
        message: format!("not an X.509 certificate: {error}"),
    })
}

fn summary(file: &Path, certificate: &X509Certificate<'_>) -> CertificateSummary {
    CertificateSummary {
        file: file.to_path_buf(),
        common_name: first_common_name(certificate.subject()).unwrap_or_default().to_string(),
        issuer: first_common_name(certificate.issuer()).unwrap_or_default().to_string(),
        is_authority: certificate.is_ca(),
        from_unix_secs: certificate.validity().not_before.timestamp(),
        until_unix_secs: certificate.validity().not_after.timestamp(),
        serial: certificate.raw_serial().iter().map(|byte| format!("{byte:02x}")).collect(),
    }
}
