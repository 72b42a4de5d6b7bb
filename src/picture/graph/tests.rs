//! Graphs of names that nobody would choose.

use super::*;

fn odd() -> DrawnGraph {
    let wild = "a\"b<c>&#35;`|]\\n\u{1}end";
    DrawnGraph {
        title: "odd".into(),
        nodes: vec![
            DrawnNode { name: wild.into(), notes: vec!["a note".into()], ..DrawnNode::default() },
            DrawnNode { name: "run".into(), warnings: vec!["FAILED".into()], is_outside: true, ..DrawnNode::default() },
        ],
        edges: vec![
            DrawnEdge {
                from: 0,
                to: 1,
                notes: vec![wild.into(), "latest 4".into()],
                is_dashed: true,
                ..DrawnEdge::default()
            },
            DrawnEdge { from: 0, to: 1, warnings: vec!["3 lost".into()], ..DrawnEdge::default() },
        ],
    }
}

#[test]
fn mermaid_takes_no_name_for_syntax() {
    let wild = "a#34;b#60;c#62;#38;#35;35#59;#96;#124;#93;#92;n end";
    let expected = format!(
        "---\ntitle: \"odd\"\n---\nflowchart LR\n  n0[\"{wild}<br/>a note\"]\n  n1([\"run<br/>FAILED\"])\n  \
         n0 -.->|\"{wild}<br/>latest 4\"| n1\n  n0 -->|\"3 lost\"| n1\n  style n1 stroke:#b42318,color:#b42318\n  \
         linkStyle 1 stroke:#b42318,color:#b42318\n"
    );
    assert_eq!(graph_mermaid(&odd()), expected);
}

#[test]
fn graphviz_takes_no_name_for_syntax() {
    let text = graph_dot(&odd());
    let wild = "a\\\"b<c>&amp;#35;`|]\\\\n end";
    assert!(text.contains(&format!("  n0 [label=\"{wild}\\na note\"];\n")), "{text}");
    assert!(text.contains(&format!("  n0 -> n1 [label=\"{wild}\\nlatest 4\", style=dashed];\n")), "{text}");
    assert!(text.contains("  n0 -> n1 [label=\"3 lost\", color=\"#b42318\", fontcolor=\"#b42318\"];\n"), "{text}");
}

#[test]
fn svg_takes_no_name_for_syntax() {
    let text = graph_svg(&odd());
    assert!(text.contains(">a&quot;b&lt;c&gt;&amp;#35;`|]\\n\u{fffd}end</text>"), "{text}");
    assert!(text.contains("class=\"line dashed\"") && text.contains("class=\"line-loud\""), "{text}");
    assert!(text.contains("class=\"loud edge\">3 lost</text>") && text.contains("class=\"failed\""), "{text}");
    let mut reader = quick_xml::Reader::from_str(&text);
    reader.config_mut().check_end_names = true;
    while reader.read_event().expect("well-formed") != quick_xml::events::Event::Eof {}
}
