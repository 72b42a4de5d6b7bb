//! Certificates for a start: an authority of one's own, and a certificate and private key for each machine.
//!
//! Who has an authority already uses that; see `docs/security.md` for what a certificate must be.

use std::fs::{DirBuilder, OpenOptions};
use std::io::Write;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, KeyUsagePurpose,
};
use time::{Duration, OffsetDateTime};

use super::certificates::{
    self, AUTHORITY_FILE, CertificateError, CertificateSummary, ROUTER_COMMON_NAME, common_name, key_files,
};
use super::config::KeyFiles;
use blindgrasp_operator::text::is_name;

/// The authority's private key, in a folder of keys. It stays where it was made.
pub const AUTHORITY_KEY_FILE: &str = "ca.key.pem";
/// What a router's files are called, in place of a machine's name.
pub const ROUTER_FILES: &str = "zenohd";
/// How long an authority counts.
pub const AUTHORITY_DAYS: u32 = 3650;
/// Certificates count from a day before they are made: machines' clocks may differ by that.
const BACKDATED: Duration = Duration::days(1);

/// What to make.
#[derive(Debug, Clone)]
pub struct KeyRequest {
    /// The folder.
    pub folder: PathBuf,
    /// The machines' names.
    pub machines: Vec<String>,
    /// The one namespace in which their certificates count; everywhere if none is given. Their files then lie in a folder
    /// of that name below `folder`.
    pub namespace: Option<String>,
    /// Whether to make a router's as well.
    pub router: bool,
    /// How long machines' certificates count.
    pub days: u32,
    /// Whether certificates and keys that are there are replaced.
    pub renew: bool,
}

/// What was made.
#[derive(Debug, Clone)]
pub struct MadeKeys {
    /// The authority, and whether it is new.
    pub authority: (CertificateSummary, bool),
    /// The machines', then the router's, with all that belongs on that machine.
    pub machines: Vec<(CertificateSummary, KeyFiles)>,
}

/// Why keys were not made.
#[derive(Debug, thiserror::Error)]
pub enum KeysError {
    /// What was asked for makes no sense.
    #[error("{0}")]
    Request(String),
    /// A file is there that would be overwritten.
    #[error("{} is there already{}: {help}", file.display(), what)]
    Exists {
        /// Which.
        file: PathBuf,
        /// Whose it is, if that can be told.
        what: String,
        /// What to do.
        help: &'static str,
    },
    /// A file cannot be read or written.
    #[error("{}: {source}", file.display())]
    File {
        /// Which.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A certificate that is there is unreadable.
    #[error(transparent)]
    Certificate(#[from] CertificateError),
    /// The cryptographic library refuses.
    #[error("cannot make a certificate: {0}")]
    Library(#[from] rcgen::Error),
}

/// Makes certificates and keys, and the authority if the folder has none. Nothing is written unless all can be.
///
/// # Errors
/// A name that is none, a file that is there already, an authority without its key or one that ends before the
/// certificates would.
pub fn make(request: &KeyRequest, now: OffsetDateTime) -> Result<MadeKeys, KeysError> {
    check_names(request)?;
    let folder = machine_folder(request);
    let wanted = wanted(request);
    for (file_name, _) in &wanted {
        let files = key_files(&folder, file_name);
        let there = [&files.certificate, &files.private_key].into_iter().find(|file| file.exists());
        if let Some(file) = there.filter(|_| !request.renew) {
            let what = certificates::read(file).ok().and_then(|found| found.first().cloned());
            let what = what.map(|found| format!(" ({}, until {})", found.common_name, found.until()));
            let what = what.unwrap_or_default();
            return Err(KeysError::Exists { file: file.clone(), what, help: "--renew makes a new one" });
        }
    }
    make_folder(&request.folder)?;
    let authority_file = request.folder.join(AUTHORITY_FILE);
    let is_new = !authority_file.exists();
    if is_new {
        let key_file = request.folder.join(AUTHORITY_KEY_FILE);
        if key_file.exists() {
            let help = "put the authority's certificate (ca.pem) beside it, or take another folder";
            return Err(KeysError::Exists { file: key_file, what: " without its certificate".into(), help });
        }
        write_authority(&request.folder, "", now)?;
    }
    let authority = certificates::read(&authority_file)?.swap_remove(0);
    let issuer = issuer(&request.folder)?;
    let until = now + Duration::days(i64::from(request.days));
    if until.unix_timestamp() > authority.until_unix_secs {
        return Err(KeysError::Request(format!(
            "{}: this authority ends on {}, before the certificates would: take fewer --days, or replace it first \
             (--renew-ca)",
            authority_file.display(),
            authority.until()
        )));
    }
    if folder != request.folder {
        make_folder(&folder)?;
        copy_authority(&request.folder, &folder)?;
    }
    let mut machines = Vec::new();
    for (file_name, common_name) in wanted {
        let files = key_files(&folder, &file_name);
        let key = KeyPair::generate()?;
        let certificate = machine_params(&common_name, now, until).signed_by(&key, &issuer)?;
        write_files(&[
            (&files.private_key, &key.serialize_pem(), Secrecy::Secret),
            (&files.certificate, &certificate.pem(), Secrecy::Open),
        ])?;
        machines.push((certificates::read(&files.certificate)?.swap_remove(0), files));
    }
    Ok(MadeKeys { authority: (authority, is_new), machines })
}

/// Makes a new authority beside the old one: machines that have the new `ca.pem` trust both, and certificates made from
/// now on are the new one's.
///
/// # Errors
/// There is no authority in the folder, or files cannot be written.
pub fn renew_authority(folder: &Path, now: OffsetDateTime) -> Result<CertificateSummary, KeysError> {
    let file = folder.join(AUTHORITY_FILE);
    let old = read_text(&file)?;
    write_authority(folder, &old, now)?;
    copy_authority_to_namespaces(folder)?;
    Ok(certificates::read(&file)?.swap_remove(0))
}

/// Removes all authorities but the newest from `ca.pem`, and gives those removed.
///
/// # Errors
/// There is no authority in the folder, or files cannot be written.
pub fn drop_old_authorities(folder: &Path) -> Result<Vec<CertificateSummary>, KeysError> {
    let file = folder.join(AUTHORITY_FILE);
    let mut all = certificates::read(&file)?;
    let text = read_text(&file)?;
    const END: &str = "-----END CERTIFICATE-----";
    let newest = text.find(END).map_or(text.as_str(), |end| &text[..end + END.len()]);
    write_files(&[(&file, &format!("{newest}\n"), Secrecy::Open)])?;
    copy_authority_to_namespaces(folder)?;
    all.remove(0);
    Ok(all)
}

/// All certificates in a folder and in its namespaces' folders, the authority's first.
///
/// # Errors
/// The folder or a certificate cannot be read.
pub fn list(folder: &Path) -> Result<Vec<CertificateSummary>, KeysError> {
    let mut all = certificates::read(&folder.join(AUTHORITY_FILE))?;
    for folder in [vec![folder.to_path_buf()], namespace_folders(folder)?].concat() {
        let mut files = entries(&folder)?;
        files.retain(|file| {
            let name = file.file_name().unwrap_or_default().to_string_lossy();
            name.ends_with(".pem") && !name.ends_with(".key.pem") && name != AUTHORITY_FILE
        });
        for file in files {
            all.extend(certificates::read(&file)?);
        }
    }
    Ok(all)
}

/// Where a request's machine files lie.
pub fn machine_folder(request: &KeyRequest) -> PathBuf {
    request.namespace.as_ref().map_or_else(|| request.folder.clone(), |namespace| request.folder.join(namespace))
}

fn check_names(request: &KeyRequest) -> Result<(), KeysError> {
    let refused = |what: &str, name: &str| {
        KeysError::Request(format!(
            "{what} '{name}' must be letters (a-z, A-Z), digits, _ and -, as in the dataflow file"
        ))
    };
    for machine in &request.machines {
        if !is_name(machine) {
            return Err(refused("the machine's name", machine));
        }
        if machine == "ca" || machine == ROUTER_FILES {
            return Err(KeysError::Request(format!("'{machine}' names other files here: call the machine otherwise")));
        }
        if request.machines.iter().filter(|other| *other == machine).count() > 1 {
            return Err(KeysError::Request(format!("--machine {machine} is there twice")));
        }
    }
    if let Some(namespace) = request.namespace.as_ref().filter(|namespace| !is_name(namespace)) {
        return Err(refused("the namespace", namespace));
    }
    match (request.machines.is_empty() && !request.router, request.router && request.namespace.is_some()) {
        (true, _) => Err(KeysError::Request("no machine is named: --machine NAME, once for each".into())),
        (_, true) => Err(KeysError::Request("a router has no namespace: make its keys without --namespace".into())),
        _ => Ok(()),
    }
}

/// File names and common names.
fn wanted(request: &KeyRequest) -> Vec<(String, String)> {
    let machines =
        request.machines.iter().map(|machine| (machine.clone(), common_name(machine, request.namespace.as_deref())));
    let router = request.router.then(|| (ROUTER_FILES.to_string(), ROUTER_COMMON_NAME.to_string()));
    machines.chain(router).collect()
}

fn write_authority(folder: &Path, older: &str, now: OffsetDateTime) -> Result<(), KeysError> {
    let key = KeyPair::generate()?;
    let mut params = params(now, now + Duration::days(i64::from(AUTHORITY_DAYS)));
    // Authorities of different names: what `--show` says of a certificate's issuer then tells which one it was.
    let number: String = key.public_key_raw().iter().rev().take(4).map(|byte| format!("{byte:02x}")).collect();
    params.distinguished_name.push(DnType::CommonName, format!("blindgrasp authority {number}"));
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    let certificate = params.self_signed(&key)?;
    write_files(&[
        (&folder.join(AUTHORITY_KEY_FILE), &key.serialize_pem(), Secrecy::Secret),
        (&folder.join(AUTHORITY_FILE), &format!("{}{older}", certificate.pem()), Secrecy::Open),
    ])
}

fn machine_params(common_name: &str, now: OffsetDateTime, until: OffsetDateTime) -> CertificateParams {
    let mut params = params(now, until);
    params.distinguished_name.push(DnType::CommonName, common_name);
    params.is_ca = IsCa::ExplicitNoCa;
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
    params.use_authority_key_identifier_extension = true;
    params
}

fn params(now: OffsetDateTime, until: OffsetDateTime) -> CertificateParams {
    let mut params = CertificateParams::default();
    params.distinguished_name = rcgen::DistinguishedName::new();
    params.not_before = now - BACKDATED;
    params.not_after = until;
    params
}

fn issuer(folder: &Path) -> Result<Issuer<'static, KeyPair>, KeysError> {
    let file = folder.join(AUTHORITY_KEY_FILE);
    let key = std::fs::read_to_string(&file).map_err(|source| match source.kind() {
        std::io::ErrorKind::NotFound => KeysError::Request(format!(
            "{} is not there: certificates can only be made where the authority's private key is",
            file.display()
        )),
        _ => KeysError::File { file: file.clone(), source },
    })?;
    let key = KeyPair::from_pem(&key)
        .map_err(|error| KeysError::Request(format!("{}: not a private key that signs ({error})", file.display())))?;
    let certificate_file = folder.join(AUTHORITY_FILE);
    if !certificates::is_for(&certificate_file, &key)? {
        return Err(KeysError::Request(format!(
            "{} is not for the private key in {}: the first certificate must be that of the authority that signs",
            certificate_file.display(),
            file.display()
        )));
    }
    let certificate = read_text(&certificate_file)?;
    Ok(Issuer::from_ca_cert_pem(&certificate, key)?)
}

fn copy_authority(from: &Path, to: &Path) -> Result<(), KeysError> {
    let text = read_text(&from.join(AUTHORITY_FILE))?;
    write_files(&[(&to.join(AUTHORITY_FILE), &text, Secrecy::Open)])
}

fn copy_authority_to_namespaces(folder: &Path) -> Result<(), KeysError> {
    namespace_folders(folder)?.iter().try_for_each(|namespace| copy_authority(folder, namespace))
}

/// The folders below that hold an authority's certificate.
fn namespace_folders(folder: &Path) -> Result<Vec<PathBuf>, KeysError> {
    let mut folders = entries(folder)?;
    folders.retain(|folder| folder.join(AUTHORITY_FILE).is_file());
    Ok(folders)
}

fn entries(folder: &Path) -> Result<Vec<PathBuf>, KeysError> {
    let failed = |source| KeysError::File { file: folder.to_path_buf(), source };
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        paths.push(entry.map_err(failed)?.path());
    }
    paths.sort();
    Ok(paths)
}

fn read_text(file: &Path) -> Result<String, KeysError> {
    std::fs::read_to_string(file).map_err(|source| KeysError::File { file: file.to_path_buf(), source })
}

fn make_folder(folder: &Path) -> Result<(), KeysError> {
    DirBuilder::new()
        .recursive(true)
        .mode(0o700)
        .create(folder)
        .map_err(|source| KeysError::File { file: folder.to_path_buf(), source })
}

#[derive(Clone, Copy)]
enum Secrecy {
    Open,
    Secret,
}

/// All are complete under other names before the first takes its own.
fn write_files(files: &[(&PathBuf, &String, Secrecy)]) -> Result<(), KeysError> {
    let partial = |file: &Path| file.with_extension("pem.partial");
    let written = files.iter().try_for_each(|(file, text, secrecy)| {
        let mode = match secrecy {
            Secrecy::Open => 0o644,
            Secrecy::Secret => 0o600,
        };
        let failed = |source| KeysError::File { file: file.to_path_buf(), source };
        let partial = partial(file);
        // One that an interrupted command left may have another mode.
        match std::fs::remove_file(&partial) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(failed(error)),
            _ => {}
        }
        let mut opened = OpenOptions::new().write(true).create_new(true).mode(mode).open(partial).map_err(failed)?;
        opened.write_all(text.as_bytes()).and_then(|()| opened.sync_all()).map_err(failed)
    });
    let placed = written.and_then(|()| {
        files.iter().try_for_each(|(file, ..)| {
            std::fs::rename(partial(file), file).map_err(|source| KeysError::File { file: file.to_path_buf(), source })
        })
    });
    if placed.is_err() {
        for (file, ..) in files {
            let _ = std::fs::remove_file(partial(file));
        }
    }
    placed
}
