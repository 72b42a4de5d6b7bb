//! Zenoh's access control for a session: what passes its connections. Everything else is denied.
//!
//! Without it, a session passes messages on between the programs that connect to it, and takes samples on all keys to which
//! something here subscribes. With TLS it goes by the common name in the certificate at the other end.

use serde_json::{Value, json};

/// What a session takes from other programs, and what it sends. Keys are key expressions of Zenoh.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Rights {
    /// Keys of which samples are taken.
    pub takes: Vec<String>,
    /// Keys under which samples are sent.
    pub sends: Vec<String>,
}

/// The part `access_control` of Zenoh's configuration. With TLS, `names` are the common names of the certificates that take
/// part.
pub(super) fn access_control(rights: &Rights, names: Option<&[String]>) -> Value {
    let Rights { takes, sends } = rights;
    let asked = if sends.is_empty() { vec![] } else { vec!["**".to_owned()] };
    let wanted = [
        ("egress", "declare_subscriber", takes),
        ("ingress", "put", takes),
        ("egress", "put", sends),
        ("ingress", "declare_subscriber", &asked),
    ];
    let rules: Vec<Value> = wanted
        .iter()
        .filter(|(_, _, keys)| !keys.is_empty())
        .enumerate()
        .map(|(idx, (flow, message, keys))| {
            json!({"id": idx.to_string(), "permission": "allow", "flows": [flow], "messages": [message], "key_exprs": keys})
        })
        .collect();
    let ids: Vec<&Value> = rules.iter().map(|rule| &rule["id"]).collect();
    let policies = json!([{"rules": ids, "subjects": ["others"]}]);
    let mut subject = json!({"id": "others"});
    if let Some(names) = names {
        subject["cert_common_names"] = json!(names);
    }
    json!({
        "enabled": true,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [subject],
        "policies": policies,
    })
}
