//! Makes certificates: an authority of one's own, and a certificate and a private key for each machine.
//!
//! Users who have an authority use that instead; `docs/security.md` says what a certificate must be.

use std::fs::{DirBuilder, OpenOptions};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use blindgrasp_messages::files::read_regular;
use blindgrasp_operator::text::is_name;
use rcgen::{
    BasicConstraints, CertificateParams, CertificateRevocationListParams, DnType, ExtendedKeyUsagePurpose, IsCa,
    Issuer, KeyIdMethod, KeyPair, KeyUsagePurpose, RevokedCertParams,
};
use time::{Duration, OffsetDateTime};

use super::certificates::{self, CertificateError, CertificateSummary, common_name};
use blindgrasp_graph::link::config::{AUTHORITY_FILE, KeyFiles, REVOKED_FILE, ROUTER_COMMON_NAME, key_files};

/// The file of the authority's private key. It stays in the folder where it was made.
pub const AUTHORITY_KEY_FILE: &str = "ca.key.pem";
/// The name of a router's files, in place of a machine's name.
pub const ROUTER_FILES: &str = "zenohd";
/// Days for which an authority is valid.
pub const AUTHORITY_DAYS: u32 = 3650;
/// Certificates are valid from a day before they are made, because clocks of machines may differ by that.
const BACKDATED: Duration = Duration::days(1);
/// Mode of a file that everybody may read, and of a private key.
const OPEN: u32 = 0o644;
const SECRET: u32 = 0o600;

/// The certificates to make.
#[derive(Debug, Clone, Default)]
pub struct KeyRequest {
    pub folder: PathBuf,
    /// The machines' names.
    pub machines: Vec<String>,
    /// The one namespace in which the certificates are valid; `None` for all. With a namespace, the files are in a
    /// folder of that name below `folder`.
    pub namespace: Option<String>,
    /// Whether to make a router's certificate as well.
    pub router: bool,
    /// Days for which the machines' certificates are valid.
    pub days: u32,
    /// Whether existing certificates and keys are replaced.
    pub renew: bool,
}

#[derive(Debug, Clone)]
pub struct MadeKeys {
    /// The authority, and whether it is new.
    pub authority: (CertificateSummary, bool),
    /// The certificates of the machines and of the router, each with the files for that machine.
    pub machines: Vec<(CertificateSummary, KeyFiles)>,
}

/// Why keys were not made.
#[derive(Debug, thiserror::Error)]
pub enum KeysError {
    /// The request cannot be fulfilled.
    #[error("{0}")]
    Request(String),
    /// A file cannot be read or written.
    #[error("{}: {source}", file.display())]
    File { file: PathBuf, source: std::io::Error },
    #[error(transparent)]
    Certificate(#[from] CertificateError),
    #[error("cannot make a certificate: {0}")]
    Library(#[from] rcgen::Error),
}

/// Makes certificates and keys, and the authority if the folder has none. A machine's files are written together or not
/// at all.
///
/// # Errors
/// A name is not valid, a file exists already, or the authority has no private key or ends before the certificates
/// would.
pub fn make(request: &KeyRequest, now: OffsetDateTime) -> Result<MadeKeys, KeysError> {
    check_names(request)?;
    let folder = request.namespace.as_ref().map_or(request.folder.clone(), |name| request.folder.join(name));
    let wanted = wanted(request);
    if !request.renew {
        wanted.iter().try_for_each(|(file_name, _)| check_absent(&key_files(&folder, file_name)))?;
    }
    make_folder(&request.folder)?;
    let authority_file = request.folder.join(AUTHORITY_FILE);
    let is_new = !authority_file.exists();
    if is_new {
        let key_file = request.folder.join(AUTHORITY_KEY_FILE);
        if key_file.exists() {
            return Err(KeysError::Request(format!(
                "{} has no certificate beside it, expected {}: put the authority's certificate there, or use another \
                 folder",
                key_file.display(),
                authority_file.display()
            )));
        }
        write_authority(&request.folder, "", now)?;
    }
    let authority = certificates::read(&authority_file)?.swap_remove(0);
    let issuer = issuer(&request.folder)?;
    let until = now + Duration::days(i64::from(request.days));
    if until.unix_timestamp() > authority.until_unix_secs {
        return Err(KeysError::Request(format!(
            "{}: this authority ends on {}, before the certificates would: use fewer --days, or make a new authority first \
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
            (&files.private_key, &key.serialize_pem(), SECRET),
            (&files.certificate, &certificate.pem(), OPEN),
        ])?;
        machines.push((certificates::read(&files.certificate)?.swap_remove(0), files));
    }
    Ok(MadeKeys { authority: (authority, is_new), machines })
}

/// Makes a new authority beside the old one. Machines with the new `ca.pem` trust both; the new one signs from now on.
///
/// # Errors
/// The folder has no authority, or files cannot be written.
pub fn renew_authority(folder: &Path, now: OffsetDateTime) -> Result<CertificateSummary, KeysError> {
    let file = folder.join(AUTHORITY_FILE);
    let old = read_text(&file)?;
    write_authority(folder, &old, now)?;
    copy_authority_to_namespaces(folder)?;
    Ok(certificates::read(&file)?.swap_remove(0))
}

/// Removes all authorities but the newest from `ca.pem`, and returns the removed ones.
///
/// # Errors
/// The folder has no authority, or files cannot be written.
pub fn drop_old_authorities(folder: &Path) -> Result<Vec<CertificateSummary>, KeysError> {
    const END: &str = "-----END CERTIFICATE-----";
    let file = folder.join(AUTHORITY_FILE);
    let mut all = certificates::read(&file)?;
    let text = read_text(&file)?;
    let newest = text.find(END).map_or(text.as_str(), |end| &text[..end + END.len()]);
    write_files(&[(&file, &format!("{newest}\n"), OPEN)])?;
    copy_authority_to_namespaces(folder)?;
    all.remove(0);
    Ok(all)
}

/// Adds the certificate of a machine to the list of revoked ones, and returns the certificate and the file of the list.
///
/// # Errors
/// The folder does not have this certificate or the key of its authority, or files cannot be written.
pub fn revoke(
    folder: &Path,
    machine: &str,
    namespace: Option<&str>,
    now: OffsetDateTime,
) -> Result<(CertificateSummary, PathBuf), KeysError> {
    if let Some(name) = namespace.into_iter().chain([machine]).find(|name| !is_name(name)) {
        return Err(KeysError::Request(format!("'{name}' is no name of a machine or a namespace")));
    }
    let files = key_files(&namespace.map_or(folder.to_path_buf(), |namespace| folder.join(namespace)), machine);
    let found = certificates::read(&files.certificate)?.swap_remove(0);
    let authority = certificates::read(&folder.join(AUTHORITY_FILE))?.swap_remove(0);
    if found.issuer != authority.common_name {
        return Err(KeysError::Request(format!(
            "{}: '{}' has signed this certificate, and only it can revoke it: use --drop-old-ca to shut out all of its \
             certificates",
            found.file.display(),
            found.issuer
        )));
    }
    let file = folder.join(REVOKED_FILE);
    let old = if file.exists() { read_text(&file)? } else { String::new() };
    let (mut revoked, others) = certificates::revoked(&file, &old, &authority.common_name)?;
    if !revoked.iter().any(|(serial, _)| *serial == found.serial) {
        revoked.push((found.serial.clone(), now));
    }
    let revoked = revoked.into_iter().map(|(serial, revocation_time)| RevokedCertParams {
        serial_number: bytes_of(&serial).into(),
        revocation_time,
        reason_code: None,
        invalidity_date: None,
    });
    let list = CertificateRevocationListParams {
        this_update: now - BACKDATED,
        next_update: now + Duration::days(i64::from(AUTHORITY_DAYS)),
        crl_number: now.unix_timestamp().unsigned_abs().into(),
        issuing_distribution_point: None,
        revoked_certs: revoked.collect(),
        key_identifier_method: KeyIdMethod::Sha256,
    };
    let list = list.signed_by(&issuer(folder)?)?;
    write_files(&[(&file, &format!("{}{others}", list.pem()?), OPEN)])?;
    copy_authority_to_namespaces(folder)?;
    Ok((found, file))
}

/// All certificates in a folder and in the folders of its namespaces; the authority's are first.
///
/// # Errors
/// The folder or a certificate cannot be read.
pub fn list(folder: &Path) -> Result<Vec<CertificateSummary>, KeysError> {
    let mut all = certificates::read(&folder.join(AUTHORITY_FILE))?;
    for folder in [vec![folder.to_path_buf()], namespace_folders(folder)?].concat() {
        for file in entries(&folder)? {
            let name = file.file_name().unwrap_or_default().to_string_lossy();
            let is_other = name == AUTHORITY_FILE || name == REVOKED_FILE;
            if name.ends_with(".pem") && !name.ends_with(".key.pem") && !is_other {
                all.extend(certificates::read(&file)?);
            }
        }
    }
    Ok(all)
}

fn check_names(request: &KeyRequest) -> Result<(), KeysError> {
    let names = request.machines.iter().map(|machine| ("the machine's name", machine));
    let names = names.chain(request.namespace.iter().map(|namespace| ("the namespace", namespace)));
    let machines = &request.machines;
    let refused = if let Some((what, name)) = names.into_iter().find(|(_, name)| !is_name(name)) {
        format!("{what} '{name}' must consist of letters (a-z, A-Z), digits, _ and -, as in the dataflow file")
    } else if let Some(machine) = machines.iter().find(|it| ["ca", "crl", ROUTER_FILES].contains(&it.as_str())) {
        format!("'{machine}' is a reserved name; choose another machine name")
    } else if let Some((_, machine)) = machines.iter().enumerate().find(|(at, it)| machines[at + 1..].contains(it)) {
        format!("--machine {machine} is given twice")
    } else if machines.is_empty() && !request.router {
        "no machine is given, expected --machine NAME once for each machine".into()
    } else if request.router && request.namespace.is_some() {
        "a router has no namespace: make its keys without --namespace".into()
    } else {
        return Ok(());
    };
    Err(KeysError::Request(refused))
}

/// The file names and common names of the requested certificates.
fn wanted(request: &KeyRequest) -> Vec<(String, String)> {
    let machines =
        request.machines.iter().map(|machine| (machine.clone(), common_name(machine, request.namespace.as_deref())));
    let router = request.router.then(|| (ROUTER_FILES.to_string(), ROUTER_COMMON_NAME.to_string()));
    machines.chain(router).collect()
}

fn check_absent(files: &KeyFiles) -> Result<(), KeysError> {
    let Some(file) = [&files.certificate, &files.private_key].into_iter().find(|file| file.exists()) else {
        return Ok(());
    };
    let found = certificates::read(file).ok().and_then(|found| found.first().cloned());
    let found = found.map(|found| format!(" ({}, until {})", found.common_name, found.until())).unwrap_or_default();
    Err(KeysError::Request(format!("{} exists already{found}: use --renew to replace it", file.display())))
}

fn write_authority(folder: &Path, older: &str, now: OffsetDateTime) -> Result<(), KeysError> {
    let key = KeyPair::generate()?;
    let mut params = params(now, now + Duration::days(i64::from(AUTHORITY_DAYS)));
    // Each authority has its own name, so that `--show` tells which one has signed a certificate.
    let number: String = key.public_key_raw().iter().rev().take(4).map(|byte| format!("{byte:02x}")).collect();
    params.distinguished_name.push(DnType::CommonName, format!("blindgrasp authority {number}"));
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    let certificate = params.self_signed(&key)?;
    write_files(&[
        (&folder.join(AUTHORITY_KEY_FILE), &key.serialize_pem(), SECRET),
        (&folder.join(AUTHORITY_FILE), &format!("{}{older}", certificate.pem()), OPEN),
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
    let (key_file, certificate_file) = (folder.join(AUTHORITY_KEY_FILE), folder.join(AUTHORITY_FILE));
    if !key_file.exists() {
        return Err(KeysError::Request(format!(
            "{} does not exist: make certificates in the folder that holds the authority's private key",
            key_file.display()
        )));
    }
    let key = KeyPair::from_pem(&read_text(&key_file)?).map_err(|error| {
        KeysError::Request(format!("{} is not a private key that can sign ({error})", key_file.display()))
    })?;
    if !certificates::is_for(&certificate_file, &key)? {
        return Err(KeysError::Request(format!(
            "{} is not for the private key in {}: the first certificate in it must be that of the authority that signs",
            certificate_file.display(),
            key_file.display()
        )));
    }
    Ok(Issuer::from_ca_cert_pem(&read_text(&certificate_file)?, key)?)
}

/// Copies the authority's certificate, and its list of revoked certificates if there is one.
fn copy_authority(from: &Path, to: &Path) -> Result<(), KeysError> {
    for name in [AUTHORITY_FILE, REVOKED_FILE] {
        if name == AUTHORITY_FILE || from.join(name).exists() {
            write_files(&[(&to.join(name), &read_text(&from.join(name))?, OPEN)])?;
        }
    }
    Ok(())
}

fn bytes_of(hexadecimal: &str) -> Vec<u8> {
    hexadecimal
        .as_bytes()
        .chunks(2)
        .filter_map(|pair| u8::from_str_radix(str::from_utf8(pair).ok()?, 16).ok())
        .collect()
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
    let read = std::fs::read_dir(folder).and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect());
    let mut paths: Vec<PathBuf> = read.map_err(in_file(folder))?;
    paths.sort();
    Ok(paths)
}

fn read_text(file: &Path) -> Result<String, KeysError> {
    read_regular(file).map_err(in_file(file))
}

fn make_folder(folder: &Path) -> Result<(), KeysError> {
    DirBuilder::new().recursive(true).mode(0o700).create(folder).map_err(in_file(folder))
}

fn in_file(file: &Path) -> impl FnOnce(std::io::Error) -> KeysError {
    move |source| KeysError::File { file: file.to_path_buf(), source }
}

fn partial(file: &Path) -> PathBuf {
    file.with_extension("pem.partial")
}

fn write_partial(file: &Path, text: &str, mode: u32) -> std::io::Result<()> {
    // A file that an interrupted command has left may have another mode.
    if let Err(error) = std::fs::remove_file(partial(file))
        && error.kind() != ErrorKind::NotFound
    {
        return Err(error);
    }
    let mut opened = OpenOptions::new().write(true).create_new(true).mode(mode).open(partial(file))?;
    opened.write_all(text.as_bytes())?;
    opened.sync_all()
}

/// Writes files with their modes. All are complete under temporary names before the first gets its own name.
fn write_files(files: &[(&PathBuf, &String, u32)]) -> Result<(), KeysError> {
    let written =
        files.iter().try_for_each(|(file, text, mode)| write_partial(file, text, *mode).map_err(in_file(file)));
    let placed = written.and_then(|()| {
        files.iter().try_for_each(|(file, ..)| std::fs::rename(partial(file), file).map_err(in_file(file)))
    });
    if placed.is_err() {
        for (file, ..) in files {
            let _ = std::fs::remove_file(partial(file));
        }
    }
    placed
}
