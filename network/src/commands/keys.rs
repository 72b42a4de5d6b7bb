//! `blindgrasp keys`

use std::path::{Path, PathBuf};

use clap::Args;
use serde_json::{Value, json};
use time::OffsetDateTime;

use super::{Outcome, print_line, write_out};
use blindgrasp_bridge::access;
use blindgrasp_bridge::keys::{
    self, AUTHORITY_DAYS, AUTHORITY_KEY_FILE, KeyRequest, MadeKeys, ROUTER_FILES, drop_old_authorities, list,
    renew_authority,
};
use blindgrasp_graph::link::config::{AUTHORITY_FILE, KeyFiles, ROUTER_COMMON_NAME};

/// Make keys and certificates for several machines
///
/// Make keys for machines that run a graph together: an authority of your own, and a certificate for each machine.
///
/// The authority's private key stays in the folder: everybody who has it can make a certificate in any machine's name.
/// If the folder has an authority, it is used again.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                  blindgrasp keys keys --machine robot --machine brain\n  \
                  blindgrasp keys keys --machine robot --namespace robot7\n  \
                  blindgrasp keys keys --machine robot --renew\n  \
                  blindgrasp keys keys --revoke robot\n  \
                  blindgrasp keys keys --show")]
pub(super) struct Arguments {
    /// The folder of the keys; it is made if it does not exist.
    folder: PathBuf,
    /// A machine of the dataflow file; give this option once for each machine.
    #[arg(long = "machine", value_name = "NAME")]
    machines: Vec<String>,
    /// The one namespace (`run --namespace`) in which these certificates are valid; without it, they are valid in all.
    #[arg(long, value_name = "NAME")]
    namespace: Option<String>,
    /// Number of days for which the certificates are valid.
    #[arg(long, default_value_t = 365, value_parser = clap::value_parser!(u32).range(1..=i64::from(AUTHORITY_DAYS)))]
    days: u32,
    /// Replace existing keys and certificates.
    #[arg(long)]
    renew: bool,
    /// Make a Zenoh router's certificate too, and a configuration for zenohd that admits the machines with keys in the
    /// folder.
    #[arg(long)]
    router: bool,
    /// Make a new authority. Machines with the new ca.pem trust the old one too, until --drop-old-ca.
    #[arg(long, conflicts_with_all = ["machines", "namespace", "renew", "router", "drop_old_ca", "show"])]
    renew_ca: bool,
    /// Remove all authorities but the newest from ca.pem.
    #[arg(long, conflicts_with_all = ["machines", "namespace", "renew", "router", "show"])]
    drop_old_ca: bool,
    /// Revoke the certificate of this machine, whose private key somebody else may have.
    #[arg(long, value_name = "NAME", conflicts_with_all = ["machines", "renew", "router", "renew_ca", "drop_old_ca", "show"])]
    revoke: Option<String>,
    /// List the certificates in the folder: names, last days, issuers.
    #[arg(long, conflicts_with_all = ["machines", "namespace", "renew", "router"])]
    show: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let now = OffsetDateTime::now_utc();
    let folder = &arguments.folder;
    if let Some(machine) = &arguments.revoke {
        return revoke(arguments, machine, now);
    }
    match (arguments.show, arguments.renew_ca, arguments.drop_old_ca) {
        (true, ..) => show(arguments, now),
        (_, true, _) => {
            let made = renew_authority(folder, now)?;
            say(
                arguments,
                &json!({ "authority": made }),
                &[
                    format!("{}: new authority '{}' until {}", made.file.display(), made.common_name, made.until()),
                    format!("copy {} to all machines and start their parts of the graph again;", made.file.display()),
                    "then renew the certificate of each machine (--machine NAME --renew); then use --drop-old-ca"
                        .into(),
                ],
            )
        }
        (.., true) => {
            let dropped = drop_old_authorities(folder)?;
            let mut lines: Vec<String> =
                dropped.iter().map(|old| format!("'{}' is no longer trusted", old.common_name)).collect();
            lines.push(if dropped.is_empty() {
                "there is only one authority".into()
            } else {
                format!("copy {} to all machines", folder.join(AUTHORITY_FILE).display())
            });
            say(arguments, &json!({ "dropped": dropped }), &lines)
        }
        _ => make(arguments, now),
    }
}

fn revoke(arguments: &Arguments, machine: &str, now: OffsetDateTime) -> anyhow::Result<Outcome> {
    let (revoked, list) = keys::revoke(&arguments.folder, machine, arguments.namespace.as_deref(), now)?;
    let namespace = arguments.namespace.iter().map(|name| format!(" --namespace {name}")).collect::<String>();
    say(
        arguments,
        &json!({ "revoked": revoked, "copy": list }),
        &[
            format!("{}: '{}', serial {}, is revoked", revoked.file.display(), revoked.common_name, revoked.serial),
            format!("copy {} to the folders of keys of all other machines: links read it at once", list.display()),
            format!("--machine {machine}{namespace} --renew makes new keys for the machine, if it comes back"),
        ],
    )
}

fn make(arguments: &Arguments, now: OffsetDateTime) -> anyhow::Result<Outcome> {
    let request = KeyRequest {
        folder: arguments.folder.clone(),
        machines: arguments.machines.clone(),
        namespace: arguments.namespace.clone(),
        router: arguments.router,
        days: arguments.days,
        renew: arguments.renew,
    };
    let MadeKeys { authority: (authority, is_new), machines } = keys::make(&request, now)?;
    let router_config = arguments.router.then(|| write_router_config(&arguments.folder)).transpose()?;
    let mut lines = Vec::new();
    let article = if is_new { "new" } else { "the" };
    lines.push(format!(
        "{}: {article} authority '{}', until {}",
        authority.file.display(),
        authority.common_name,
        authority.until()
    ));
    for (made, files) in &machines {
        lines.push(format!("{}: '{}', until {}", made.file.display(), made.common_name, made.until()));
        let KeyFiles { authority, certificate, private_key } = files;
        let revoked = files.revoked();
        let mut copied = vec![authority, certificate, private_key];
        copied.extend(Some(&revoked).filter(|file| file.exists()));
        if made.common_name == ROUTER_COMMON_NAME {
            copied.extend(router_config.as_ref());
        }
        let copied: Vec<String> = copied.into_iter().map(|file| file.display().to_string()).collect();
        lines.push(format!("  copy to that machine's folder of keys: {}", copied.join(" ")));
    }
    lines.push(format!(
        "{} can sign for any machine: copy it nowhere",
        arguments.folder.join(AUTHORITY_KEY_FILE).display()
    ));
    let machines: Vec<Value> =
        machines.iter().map(|(made, files)| json!({ "certificate": made, "copy": files })).collect();
    let report = json!({
        "authority": authority,
        "is_new_authority": is_new,
        "machines": machines,
        "router_config": router_config,
    });
    say(arguments, &report, &lines)
}

/// Writes a configuration of zenohd beside the router's certificate.
fn write_router_config(folder: &Path) -> anyhow::Result<PathBuf> {
    let all = list(folder)?;
    let machines = all.iter().filter(|found| !found.is_authority && found.common_name != ROUTER_COMMON_NAME);
    let config = json!({
        "mode": "router",
        "listen": {"endpoints": ["tls/[::]:7447"]},
        "scouting": {"multicast": {"enabled": false}, "gossip": {"enabled": false}},
        "transport": {"link": {
            "protocols": ["tls"],
            "tls": {
                "root_ca_certificate": AUTHORITY_FILE,
                "enable_mtls": true,
                "listen_certificate": format!("{ROUTER_FILES}.pem"),
                "listen_private_key": format!("{ROUTER_FILES}.key.pem"),
                "close_link_on_expiration": true,
            },
        }},
        "access_control": access::for_router(machines),
    });
    let file = folder.join(format!("{ROUTER_FILES}.json5"));
    write_out(&file, &format!("{}\n", serde_json::to_string_pretty(&config)?))?;
    Ok(file)
}

fn show(arguments: &Arguments, now: OffsetDateTime) -> anyhow::Result<Outcome> {
    let found = list(&arguments.folder)?;
    let lines = found.iter().map(|found| {
        let ends = if found.until_unix_secs < now.unix_timestamp() { "ended" } else { "until" };
        let kind = if found.is_authority { "authority" } else { "machine" };
        format!(
            "{:<28} {kind:<9} {:<28} {ends} {} by {}",
            found.file.display(),
            found.common_name,
            found.until(),
            found.issuer
        )
    });
    say(arguments, &json!({ "certificates": found }), &lines.collect::<Vec<_>>())
}

fn say(arguments: &Arguments, report: &Value, lines: &[String]) -> anyhow::Result<Outcome> {
    if arguments.json {
        print_line(&report.to_string())?
    } else {
        lines.iter().try_for_each(|line| print_line(line))?
    }
    Ok(Outcome::Done)
}
