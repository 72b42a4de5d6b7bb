//! Who may do what, as Zenoh enforces it: by the common name in the certificate at the other end of a connection.
//!
//! A machine says things only under keys that have its own name as FROM, and hears only those that have it as TO.
//! Everything else is refused, whoever asks. Rights to read and control a machine's part of the graph are the link's own
//! business ([`PeerConfig`](super::config::PeerConfig)).

use serde_json::{Value, json};

use super::certificates::{CertificateSummary, ROUTER_COMMON_NAME, accepted_names};
use super::config::LinkConfig;

/// What Zenoh is told of a machine's peers (its configuration's `access_control`).
pub(super) fn for_machine(config: &LinkConfig) -> Value {
    let prefix = config.key_prefix();
    let me = &config.machine;
    let mut acl = AccessControl::default();
    for peer in &config.peers {
        let peer = &peer.machine;
        // A router passes on what the machines say: it answers for who they are.
        let names = match config.endpoints.router.is_empty() {
            true => accepted_names(peer, config.namespace.as_deref()),
            false => vec![ROUTER_COMMON_NAME.to_string()],
        };
        acl.allow(peer, &names, Flow::Ingress, &SAID, &format!("{prefix}/{peer}/{me}/*"));
        acl.allow(peer, &names, Flow::Ingress, &ASKED_FOR, &format!("{prefix}/*/{peer}/*"));
        acl.allow(peer, &names, Flow::Egress, &SAID, &format!("{prefix}/{me}/{peer}/*"));
        acl.allow(peer, &names, Flow::Egress, &ASKED_FOR, &format!("{prefix}/*/{me}/*"));
    }
    acl.config()
}

/// The same for a Zenoh router that machines with these certificates connect to, of any graphs.
pub fn for_router<'a>(machines: impl IntoIterator<Item = &'a CertificateSummary>) -> Value {
    let mut acl = AccessControl::default();
    for CertificateSummary { common_name, .. } in machines {
        let (machine, namespace) = common_name.split_once('@').unwrap_or((common_name, "*"));
        let prefix = format!("blindgrasp/{namespace}/*");
        let names = [common_name.clone()];
        acl.allow(common_name, &names, Flow::Ingress, &SAID, &format!("{prefix}/{machine}/*/*"));
        acl.allow(common_name, &names, Flow::Ingress, &ASKED_FOR, &format!("{prefix}/*/{machine}/*"));
        acl.allow(common_name, &names, Flow::Egress, &SAID, &format!("{prefix}/*/{machine}/*"));
        acl.allow(common_name, &names, Flow::Egress, &ASKED_FOR, &format!("{prefix}/*/*/*"));
    }
    acl.config()
}

/// Messages that bear the key of what is said.
const SAID: [&str; 2] = ["put", "liveliness_token"];
/// Messages that bear the key of what somebody wants to hear.
const ASKED_FOR: [&str; 3] = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"];

#[derive(Clone, Copy)]
enum Flow {
    Ingress,
    Egress,
}

#[derive(Default)]
struct AccessControl {
    rules: Vec<Value>,
    subjects: Vec<Value>,
    policies: Vec<Value>,
}

impl AccessControl {
    fn allow(&mut self, peer: &str, names: &[String], flow: Flow, messages: &[&str], key: &str) {
        let id = format!("{peer} {}", self.rules.len());
        let flow = match flow {
            Flow::Ingress => "ingress",
            Flow::Egress => "egress",
        };
        self.rules
            .push(json!({"id": id, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": [key]}));
        if !self.subjects.iter().any(|subject| subject["id"] == peer) {
            self.subjects.push(json!({"id": peer, "link_protocols": ["tls"], "cert_common_names": names}));
        }
        self.policies.push(json!({"rules": [id], "subjects": [peer]}));
    }

    fn config(self) -> Value {
        json!({
            "enabled": true,
            "default_permission": "deny",
            "rules": self.rules,
            "subjects": self.subjects,
            "policies": self.policies,
        })
    }
}
