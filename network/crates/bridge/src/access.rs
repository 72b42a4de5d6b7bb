//! Zenoh's access control. It goes by the common name in the certificate at the other end of a connection.
//!
//! A machine may send only under keys with its own name as FROM, and receive only keys with its own name as TO.
//! Everything else is denied. That is a second wall: links prove who they are to each other
//! ([`identity`](super::identity)).

use serde_json::{Value, json};

use super::certificates::{CertificateSummary, accepted_names};
use blindgrasp_graph::link::config::{LinkConfig, ROUTER_COMMON_NAME};

/// The part `access_control` of a machine's Zenoh configuration.
pub(super) fn for_machine(config: &LinkConfig) -> Value {
    let prefix = config.key_prefix();
    let me = &config.machine;
    let mut acl = AccessControl::default();
    for peer in &config.peers {
        // A router passes the machines' messages on, and checks their names.
        let names = if config.endpoints.router.is_empty() {
            accepted_names(peer, config.namespace.as_deref())
        } else {
            vec![ROUTER_COMMON_NAME.to_string()]
        };
        acl.allow(peer, &names, Flow::Ingress, &DATA, &format!("{prefix}/{peer}/{me}/*"));
        acl.allow(peer, &names, Flow::Ingress, &SUBSCRIPTIONS, &format!("{prefix}/*/{peer}/*"));
        acl.allow(peer, &names, Flow::Egress, &DATA, &format!("{prefix}/{me}/{peer}/*"));
        acl.allow(peer, &names, Flow::Egress, &SUBSCRIPTIONS, &format!("{prefix}/*/{me}/*"));
    }
    acl.config()
}

/// The part `access_control` of a Zenoh router's configuration. Machines with these certificates may connect, for any
/// graph.
pub fn for_router<'a>(machines: impl IntoIterator<Item = &'a CertificateSummary>) -> Value {
    let mut acl = AccessControl::default();
    for CertificateSummary { common_name, .. } in machines {
        let (machine, namespace) = common_name.split_once('@').unwrap_or((common_name, "*"));
        let prefix = format!("blindgrasp/{namespace}/*");
        let names = [common_name.clone()];
        acl.allow(common_name, &names, Flow::Ingress, &DATA, &format!("{prefix}/{machine}/*/*"));
        acl.allow(common_name, &names, Flow::Ingress, &SUBSCRIPTIONS, &format!("{prefix}/*/{machine}/*"));
        acl.allow(common_name, &names, Flow::Egress, &DATA, &format!("{prefix}/*/{machine}/*"));
        acl.allow(common_name, &names, Flow::Egress, &SUBSCRIPTIONS, &format!("{prefix}/*/*/*"));
    }
    acl.config()
}

/// Kinds of messages whose key is the key of the data.
const DATA: [&str; 2] = ["put", "liveliness_token"];
/// Kinds of messages whose key is the key of a subscription.
const SUBSCRIPTIONS: [&str; 3] = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"];

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
