use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    PKCS_ECDSA_P384_SHA384, PKCS_ED25519,
};
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;

use super::*;
use crate::keys::{KeyRequest, make, renew_authority, revoke};
use blindgrasp_graph::link::config::key_files;

const FRAME: &[u8] = b"bg\x04\0a hello";

fn now() -> OffsetDateTime {
    OffsetDateTime::from_unix_timestamp(1_790_000_000).expect("a time")
}

fn request(folder: &Path, machines: &[&str], namespace: Option<&str>) -> KeyRequest {
    KeyRequest {
        folder: folder.into(),
        machines: machines.iter().map(ToString::to_string).collect(),
        namespace: namespace.map(Into::into),
        days: 90,
        renew: true,
        ..KeyRequest::default()
    }
}

fn keys(machines: &[&str]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    make(&request(folder.path(), machines, None), now()).expect("made");
    folder
}

fn config(folder: &Path, machine: &str, namespace: Option<&str>) -> LinkConfig {
    LinkConfig {
        graph: "g".into(),
        namespace: namespace.map(Into::into),
        machine: machine.into(),
        keys: Some(key_files(folder, machine)),
        ..LinkConfig::default()
    }
}

fn identity_in(folder: &Path, machine: &str, namespace: Option<&str>) -> Identity {
    Identity::load(&config(folder, machine, namespace), now()).expect("fit").expect("with keys")
}

fn identity(folder: &tempfile::TempDir, machine: &str) -> Identity {
    identity_in(folder.path(), machine, None)
}

fn reason(checked: Result<(), Unverified>) -> String {
    checked.expect_err("refused").0
}

#[test]
fn a_machine_proves_its_name_to_one_machine_for_one_frame() {
    let folder = keys(&["robot", "brain", "laptop"]);
    let [robot, brain, laptop] = ["robot", "brain", "laptop"].map(|machine| identity(&folder, machine));
    let proof = robot.sign("brain", FRAME, now()).expect("signed");
    assert_eq!(brain.verify("robot", &proof, FRAME, now()), Ok(()));

    // In another name, for another machine, or of another frame.
    let in_its_name = laptop.sign("brain", FRAME, now()).expect("signed");
    let refused = reason(brain.verify("robot", &in_its_name, FRAME, now()));
    assert!(refused.contains("'laptop'") && refused.contains("expected that of 'robot'"), "{refused}");
    for refused in [
        laptop.verify("robot", &proof, FRAME, now()),
        brain.verify("robot", &proof, b"bg\x04\0a hellp", now()),
        brain.verify(
            "robot",
            &Proof { signature: vec![7; 64].into(), ..robot.sign("brain", FRAME, now()).expect("signed") },
            FRAME,
            now(),
        ),
        brain.verify(
            "robot",
            &Proof { scheme: 0x0201, ..robot.sign("brain", FRAME, now()).expect("signed") },
            FRAME,
            now(),
        ),
        // The certificate is no secret: the signature is not with its key.
        brain.verify("robot", &Proof { certificates: proof.certificates.clone(), ..in_its_name }, FRAME, now()),
    ] {
        let refused = reason(refused);
        assert!(refused.contains("was not signed with its key"), "{refused}");
    }
    let none = Proof { certificates: Vec::new(), ..robot.sign("brain", FRAME, now()).expect("signed") };
    assert!(reason(brain.verify("robot", &none, FRAME, now())).contains("is missing"));
    for idx in 0..proof.signature.len() {
        let mut signature = proof.signature.to_vec();
        signature[idx] ^= 1;
        let changed =
            Proof { certificates: proof.certificates.clone(), scheme: proof.scheme, signature: signature.into() };
        brain.verify("robot", &changed, FRAME, now()).expect_err("changed");
    }
}

#[test]
fn every_changed_byte_of_a_certificate_is_noticed() {
    let folder = keys(&["robot", "brain"]);
    let [robot, brain] = ["robot", "brain"].map(|machine| identity(&folder, machine));
    let proof = robot.sign("brain", FRAME, now()).expect("signed");
    for idx in 0..proof.certificates[0].len() {
        let mut certificate = proof.certificates[0].to_vec();
        certificate[idx] ^= 1;
        let changed =
            Proof { certificates: vec![certificate.into()], scheme: proof.scheme, signature: proof.signature.clone() };
        brain.verify("robot", &changed, FRAME, now()).expect_err("changed");
    }
}

#[test]
fn another_authority_and_an_ended_certificate_are_refused() {
    let (folder, other) = (keys(&["robot", "brain"]), keys(&["robot"]));
    let brain = identity(&folder, "brain");
    let proof = identity(&other, "robot").sign("brain", FRAME, now()).expect("signed");
    assert!(reason(brain.verify("robot", &proof, FRAME, now())).contains("was not signed by an authority in"));
    let proof = identity(&folder, "robot").sign("brain", FRAME, now()).expect("signed");
    let ended = reason(brain.verify("robot", &proof, FRAME, now() + time::Duration::days(91)));
    assert!(ended.contains("has ended: renew it"), "{ended}");
    let early = reason(brain.verify("robot", &proof, FRAME, now() - time::Duration::days(2)));
    assert!(early.contains("set the clock"), "{early}");
    // The authority's own certificate is no machine's.
    let authority = CertificateDer::from_pem_file(folder.path().join("ca.pem")).expect("read");
    let proof = Proof { certificates: vec![authority.to_vec().into()], ..proof };
    assert!(reason(brain.verify("robot", &proof, FRAME, now())).contains("is not valid"));
}

#[test]
fn a_certificate_of_another_namespace_is_refused() {
    let folder = keys(&["brain"]);
    for namespace in ["robot7", "robot8"] {
        make(&request(folder.path(), &["robot"], Some(namespace)), now()).expect("made");
    }
    let robot = |namespace: &str| identity_in(&folder.path().join(namespace), "robot", Some(namespace));
    let brain = identity_in(folder.path(), "brain", Some("robot7"));
    let proof = robot("robot7").sign("brain", FRAME, now()).expect("signed");
    assert_eq!(brain.verify("robot", &proof, FRAME, now()), Ok(()));
    let proof = robot("robot8").sign("brain", FRAME, now()).expect("signed");
    assert!(reason(brain.verify("robot", &proof, FRAME, now())).contains("'robot@robot8'"));
    // Brain of robot7's graph has the same certificate as brain of robot8's.
    let proof = identity_in(folder.path(), "brain", Some("robot8")).sign("robot", FRAME, now()).expect("signed");
    let refused = reason(robot("robot7").verify("brain", &proof, FRAME, now()));
    assert!(refused.contains("was not signed with its key"), "{refused}");
}

#[test]
fn keys_of_every_kind_sign() {
    for algorithm in [&PKCS_ED25519, &PKCS_ECDSA_P384_SHA384] {
        let folder = tempfile::tempdir().expect("a folder");
        let key = KeyPair::generate_for(algorithm).expect("a key");
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let authority = params.self_signed(&key).expect("signed");
        let issuer = Issuer::new(params, key);
        std::fs::write(folder.path().join("ca.pem"), authority.pem()).expect("written");
        for machine in ["robot", "brain"] {
            let (files, key) = (key_files(folder.path(), machine), KeyPair::generate_for(algorithm).expect("a key"));
            let mut params = CertificateParams::default();
            params.distinguished_name.push(DnType::CommonName, machine);
            params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
            std::fs::write(&files.certificate, params.signed_by(&key, &issuer).expect("signed").pem())
                .expect("written");
            std::fs::write(&files.private_key, key.serialize_pem()).expect("written");
            std::fs::set_permissions(&files.private_key, Permissions::from_mode(0o600)).expect("set");
        }
        let proof = identity(&folder, "robot").sign("brain", FRAME, now()).expect("signed");
        assert_eq!(identity(&folder, "brain").verify("robot", &proof, FRAME, now()), Ok(()));
    }
}

/// New files count for the next hello. While they are copied, the old ones do.
#[test]
fn keys_that_change_are_read_again() {
    let folder = keys(&["robot", "brain"]);
    let [robot, brain] = ["robot", "brain"].map(|machine| identity(&folder, machine));
    let late = now() + time::Duration::days(100);
    let sign = || robot.sign("brain", FRAME, late).expect("signed");
    assert!(reason(brain.verify("robot", &sign(), FRAME, late)).contains("has ended"));
    let certificate = key_files(folder.path(), "robot").certificate;
    std::fs::write(&certificate, "-----BEGIN CERT").expect("written");
    assert!(reason(brain.verify("robot", &sign(), FRAME, late)).contains("has ended"));
    make(&request(folder.path(), &["robot"], None), late).expect("renewed");
    assert_eq!(brain.verify("robot", &sign(), FRAME, late), Ok(()));
    let brains = std::fs::read(key_files(folder.path(), "brain").certificate).expect("read");
    std::fs::write(&certificate, brains).expect("written");
    assert_eq!(brain.verify("robot", &sign(), FRAME, late), Ok(()), "another machine's certificate is not taken");
}

/// The list is read again at each hello. It grows, and each authority has its own.
#[test]
fn a_revoked_machine_is_refused_until_it_has_a_new_certificate() {
    let folder = keys(&["robot", "brain", "laptop"]);
    let [robot, brain, laptop] = ["robot", "brain", "laptop"].map(|machine| identity(&folder, machine));
    let hello = |from: &Identity, name: &str| {
        let proof = from.sign("brain", FRAME, now()).expect("signed");
        brain.verify(name, &proof, FRAME, now())
    };
    let with_list = || std::fs::read_to_string(folder.path().join("crl.pem")).expect("there").matches("BEGIN").count();
    assert_eq!(hello(&robot, "robot"), Ok(()));
    let (revoked, file) = revoke(folder.path(), "robot", None, now()).expect("revoked");
    assert_eq!((revoked.common_name.as_str(), file), ("robot", folder.path().join("crl.pem")));
    let refused = reason(hello(&robot, "robot"));
    assert!(refused.contains("was revoked") && refused.contains("crl.pem"), "{refused}");
    assert_eq!(hello(&laptop, "laptop"), Ok(()));
    revoke(folder.path(), "laptop", None, now()).expect("revoked");
    assert!(hello(&robot, "robot").is_err() && hello(&laptop, "laptop").is_err());

    make(&request(folder.path(), &["robot"], None), now()).expect("renewed");
    assert_eq!(hello(&robot, "robot"), Ok(()));
    assert_eq!(with_list(), 1);

    // Another authority, in a namespace's folder too.
    make(&request(folder.path(), &["robot"], Some("robot7")), now()).expect("made");
    renew_authority(folder.path(), now()).expect("renewed");
    let refused = revoke(folder.path(), "robot", None, now()).expect_err("signed by the old authority").to_string();
    assert!(refused.contains("only it can revoke it") && refused.contains("--drop-old-ca"), "{refused}");
    make(&request(folder.path(), &["robot"], None), now()).expect("renewed");
    assert_eq!(hello(&robot, "robot"), Ok(()));
    revoke(folder.path(), "robot", None, now()).expect("revoked");
    assert_eq!(with_list(), 2);
    assert!(hello(&robot, "robot").is_err() && hello(&laptop, "laptop").is_err());
    let copy = std::fs::read(folder.path().join("robot7/crl.pem")).expect("copied");
    assert_eq!(copy, std::fs::read(folder.path().join("crl.pem")).expect("there"));
    // A list that is no list is not taken, and the earlier one stays in use.
    std::fs::write(folder.path().join("crl.pem"), "-----BEGIN X509 CRL-----").expect("written");
    assert!(hello(&robot, "robot").is_err());
}
