//! Graphs of names that nobody would choose.

use super::*;

fn odd() -> DrawnGraph {
    let wild = "a\"b<c>&#35;`|]\\n\u{1}end";
    DrawnGraph {
        title: "odd".into(),
        nodes: vec![
            DrawnNode { name: wild.into(), notes: vec!["a note".into()], ..DrawnNode::default() },
            DrawnNode { name: "run".into(), notes: vec!["FAILED".into()], is_outside: true, ..DrawnNode::default() },
        ],
        edges: vec![
            DrawnEdge {
                from: 0,
                to: 1,
                notes: vec![wild.into(), "latest 4".into()],
                is_dashed: true,
                ..DrawnEdge::default()
            },
            DrawnEdge { from: 0, to: 1, notes: vec!["3 lost".into()], ..DrawnEdge::default() },
        ],
        groups: Vec::new(),
    }
}

#[test]
fn mermaid_takes_no_name_for_syntax() {
    let wild = "a#34;b#60;c#62;#38;#35;35#59;#96;#124;#93;#92;n end";
    let expected = format!(
        "---\ntitle: \"odd\"\n---\nflowchart LR\n  n0[\"{wild}<br/>a note\"]\n  n1([\"run<br/>FAILED\"])\n  \
         n0 -.->|\"{wild}<br/>latest 4\"| n1\n  n0 -->|\"3 lost\"| n1\n"
    );
    assert_eq!(graph_mermaid(&odd()), expected);
}

#[test]
fn graphviz_takes_no_name_for_syntax() {
    let text = graph_dot(&odd());
    let wild = "a\\\"b<c>&amp;#35;`|]\\\\n end";
    assert!(text.contains(&format!("  n0 [label=\"{wild}\\na note\"];\n")), "{text}");
    assert!(text.contains(&format!("  n0 -> n1 [label=\"{wild}\\nlatest 4\", style=dashed];\n")), "{text}");
    assert!(text.contains("  n0 -> n1 [label=\"3 lost\"];\n"), "{text}");
}

/// Two machines with an edge there and one back, a third without nodes, and a node on none.
fn split() -> DrawnGraph {
    let node = |name: &str, group| DrawnNode { name: name.into(), group, ..DrawnNode::default() };
    let edge = |from, to, note: &str, carrier: Option<&str>| DrawnEdge {
        from,
        to,
        notes: vec![note.into()],
        carrier: carrier.map(String::from),
        ..DrawnEdge::default()
    };
    DrawnGraph {
        title: "split".into(),
        nodes: vec![node("source", Some(0)), node("judge", Some(1)), node("gate", Some(0)), node("stray", None)],
        edges: vec![
            edge(0, 1, "tactile", Some("Zenoh")),
            edge(1, 2, "prediction", Some("Zenoh")),
            edge(0, 2, "tactile", None),
        ],
        groups: ["ro<b\"ot", "brain", "laptop"]
            .iter()
            .zip(["", "listens at tls/gateway:7447", ""])
            .map(|(name, note)| DrawnGroup { name: name.to_string(), note: note.into() })
            .collect(),
    }
}

#[test]
fn mermaid_draws_groups_and_what_goes_between_them() {
    let expected = "---
title: \"split\"
---
flowchart LR
  subgraph g0[\"ro#60;b#34;ot\"]
    n0[\"source\"]
    n2[\"gate\"]
  end
  subgraph g1[\"brain<br/>listens at tls/gateway:7447\"]
    n1[\"judge\"]
  end
  subgraph g2[\"laptop\"]
  end
  n3[\"stray\"]
  n0 -.->|\"tactile<br/>Zenoh\"| n1
  n1 -.->|\"prediction<br/>Zenoh\"| n2
  n0 -->|\"tactile\"| n2
  linkStyle 0 stroke:#7a4fb5,color:#7a4fb5
  linkStyle 1 stroke:#7a4fb5,color:#7a4fb5
  style g0 fill:#f5f8ef,stroke:#a9bf86
  style g1 fill:#fbf5ea,stroke:#d9b878
  style g2 fill:#f6f2fa,stroke:#b9a3d3
";
    assert_eq!(graph_mermaid(&split()), expected);
}

#[test]
fn graphviz_draws_groups_and_what_goes_between_them() {
    let text = graph_dot(&split());
    for expected in [
        "  subgraph cluster_0 {\n    label=\"ro<b\\\"ot\";\n    labeljust=l;\n    style=\"rounded,filled\";\n    \
         fillcolor=\"#f5f8ef\";\n    color=\"#a9bf86\";\n    n0 [label=\"source\"];\n    n2 [label=\"gate\"];\n  }\n",
        "    label=\"brain\\nlistens at tls/gateway:7447\";\n",
        "  n3 [label=\"stray\"];\n",
        "  n0 -> n1 [label=\"tactile\\nZenoh\", style=dashed, color=\"#7a4fb5\", fontcolor=\"#7a4fb5\"];\n",
        "  n1 -> n2 [label=\"prediction\\nZenoh\", style=dashed, color=\"#7a4fb5\", fontcolor=\"#7a4fb5\"];\n",
        "  n0 -> n2 [label=\"tactile\"];\n",
    ] {
        assert!(text.contains(expected), "no {expected} in\n{text}");
    }
}
