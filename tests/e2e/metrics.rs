//! The figures of a running graph for Prometheus, and its logs.

use std::io::{Read, Write};
use std::net::TcpStream;

use crate::common::{FAST_FOREVER, Graph, REPORTS, dataflow, json_lines, run, text, wait_until};

fn ask(address: &str, request: &str) -> (String, String) {
    let mut stream = TcpStream::connect(address).expect("connected");
    stream.write_all(request.as_bytes()).expect("asked");
    let mut response = String::new();
    stream.read_to_string(&mut response).expect("UTF-8");
    let (head, body) = response.split_once("\r\n\r\n").expect("a head and a body");
    (head.to_string(), body.to_string())
}

/// The value of a figure whose labels contain all of these.
fn figure(metrics: &str, name: &str, labels: &[&str]) -> f64 {
    let lines = metrics.lines().filter(|line| line.strip_prefix(name).is_some_and(|rest| rest.starts_with('{')));
    let mut found = lines.filter(|line| labels.iter().all(|label| line.contains(label)));
    let line = found.next().unwrap_or_else(|| panic!("no {name} {labels:?} in\n{metrics}"));
    assert_eq!(found.next(), None, "several {name} {labels:?}");
    line.rsplit_once(' ').expect("a value").1.parse().expect("a number")
}

#[test]
fn prometheus_gets_the_figures_of_a_running_graph() {
    let folder = tempfile::tempdir().expect("a folder");
    let arguments: Vec<&str> = FAST_FOREVER.into_iter().chain(["--metrics", "0"]).collect();
    let graph = Graph::start(&dataflow(folder.path(), &[]), &arguments);
    graph.wait_for_decisions(20);
    let said = graph.said();
    let address = said.split("http://").nth(1).and_then(|rest| rest.split("/metrics").next()).expect("an address");
    assert!(address.starts_with("127.0.0.1:"), "{address}");

    let (head, metrics) = ask(address, "GET /metrics HTTP/1.1\r\nHost: localhost\r\nAccept: */*\r\n\r\n");
    assert!(head.starts_with("HTTP/1.1 200 OK") && head.contains("application/openmetrics-text"), "{head}");
    assert!(metrics.ends_with("# EOF\n"), "{metrics}");
    let graph_label = format!("graph=\"{}\"", graph.name);
    assert_eq!(figure(&metrics, "blindgrasp_up", &[&graph_label]), 1.0);
    assert_eq!(figure(&metrics, "blindgrasp_node_up", &["node=\"classifier\""]), 1.0);
    assert_eq!(figure(&metrics, "blindgrasp_node_restarts_total", &["node=\"classifier\""]), 0.0);
    assert!(figure(&metrics, "blindgrasp_node_resident_memory_bytes", &["node=\"classifier\""]) > 1e6);
    let edge = ["from=\"classifier/prediction\"", "to=\"lift_arbiter/prediction\""];
    let received = figure(&metrics, "blindgrasp_edge_received_total", &edge);
    assert!(received >= 20.0 && figure(&metrics, "blindgrasp_edge_sent_total", &edge) >= received);
    assert_eq!(figure(&metrics, "blindgrasp_edge_missing_total", &edge), 0.0);
    // The buckets of a histogram add up, and its sum agrees with them.
    let n_aged = figure(&metrics, "blindgrasp_edge_age_seconds_count", &edge);
    let all: Vec<&str> = edge.iter().copied().chain(["le=\"+Inf\""]).collect();
    assert_eq!(figure(&metrics, "blindgrasp_edge_age_seconds_bucket", &all), n_aged);
    let within: Vec<&str> = edge.iter().copied().chain(["le=\"10.0\""]).collect();
    assert!(figure(&metrics, "blindgrasp_edge_age_seconds_bucket", &within) <= n_aged && n_aged >= received);
    let mean_secs = figure(&metrics, "blindgrasp_edge_age_seconds_sum", &edge) / n_aged;
    assert!(mean_secs > 1e-6 && mean_secs < 60.0, "{mean_secs}");
    let decided = |labels: &[&str]| figure(&metrics, "blindgrasp_decisions_total", labels);
    let held = ["unstable", "no_contact"].map(|reason| decided(&["action=\"hold\"", &format!("reason=\"{reason}\"")]));
    let decisions = [decided(&["action=\"lift\"", "reason=\"stable\""]), held[0], held[1]];
    assert!(decisions.iter().sum::<f64>() >= 20.0 && decisions.iter().all(|n| *n > 0.0), "{decisions:?}");

    // Counters only grow, and a killed operator is counted.
    crate::common::signal(graph.pid_of("encoder"), rustix::process::Signal::KILL);
    let get = || ask(address, "GET /metrics HTTP/1.1\r\n\r\n").1;
    wait_until(
        || figure(&get(), "blindgrasp_node_restarts_total", &["node=\"encoder\""]) == 1.0,
        || "no restart is shown".into(),
    );
    assert!(figure(&get(), "blindgrasp_edge_received_total", &edge) >= received);

    for (request, expected) in [
        ("GET /metrics?x=1 HTTP/1.1\r\n\r\n", "200"),
        ("GET /metrics HTTP/1.1\r\nHost: somewhere.example\r\n\r\n", "403"),
        ("GET /else HTTP/1.1\r\n\r\n", "404"),
        ("POST /metrics HTTP/1.1\r\nContent-Length: 0\r\n\r\n", "405"),
        ("\r\n", "405"),
        ("\u{fffd} nonsense\r\n\r\n", "405"),
    ] {
        assert!(ask(address, request).0.starts_with(&format!("HTTP/1.1 {expected}")), "{request:?}");
    }
    graph.wait_for_decisions(2);
    let ended = graph.stop();
    assert_eq!((ended.code, ended.summary["samples_lost"].as_u64()), (Some(0), Some(0)), "{}", ended.stderr);
}

#[test]
fn an_occupied_port_is_refused_before_the_start() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = taken.local_addr().expect("bound").port().to_string();
    let refused = run(&["run", "--name", &crate::common::unique_name(), "--metrics", &port], 1);
    assert!(text(&refused.stderr).contains(&format!("cannot answer on port {port} (--metrics)")));
    assert!(refused.stdout.is_empty());
}

#[test]
fn logs_can_be_written_as_json_with_levels_and_fields() {
    let folder = tempfile::tempdir().expect("a folder");
    let script = crate::common::script(
        folder.path(),
        "talker",
        &format!(
            "case \"$*\" in *--describe*) exec {operator} --describe;; esac\n\
             echo 'plain words'\n\
             echo '{{\"report\":\"log\",\"level\":\"warn\",\"message\":\"cell 7 drifts\",\
             \"fields\":{{\"cell\":7}}}}' >{REPORTS}\n\
             exec {operator}",
            operator = crate::common::operator("classifier")
        ),
    );
    let model = crate::common::project().join(crate::common::MODEL);
    let replace = crate::common::classifier_runs(&script, &format!("{{model: {}}}", model.display()));
    let path = crate::common::dataflow_with(folder.path(), &[replace]);
    for format in ["json", "text"] {
        let arguments: Vec<&str> = FAST_FOREVER.into_iter().chain(["--log-format", format]).collect();
        let graph = Graph::start(&path, &arguments);
        let logs = graph.status()["log_folder"].as_str().expect("a path").to_string();
        let said = || {
            let lines = json_lines(&run(&["logs", "classifier", "--graph", &graph.name, "--json"], 0).stdout);
            let mut said: Vec<String> =
                lines.iter().map(|line| format!("{} {}", line["level"], line["text"])).collect();
            said.retain(|line| !line.contains("==") && !line.contains("seems unstable"));
            said.sort();
            said
        };
        let entry = if format == "json" { "cell 7 drifts" } else { "cell 7 drifts cell=7" };
        // Printed lines and reports come over two pipes, in any order.
        let expected = [format!("\"warn\" \"{entry}\""), "null \"plain words\"".to_owned()];
        wait_until(|| said() == expected, || format!("{:?}", said()));
        let content = std::fs::read_to_string(format!("{logs}/classifier.log")).expect("a log");
        if format == "json" {
            let whole: Vec<serde_json::Value> = json_lines(content.as_bytes());
            assert!(whole.iter().all(|line| line["time"].is_string() && line["operator"] == "classifier"), "{content}");
            assert!(whole.iter().any(|line| line["fields"]["cell"] == 7), "{content}");
        } else {
            let is_entry = |line: &str| line.ends_with(" [classifier] WARN cell 7 drifts cell=7");
            assert!(content.lines().any(is_entry), "{content}");
        }
        let ended = graph.stop();
        assert!(ended.stderr.contains("[classifier] WARN cell 7 drifts cell=7"), "{}", ended.stderr);
    }
}
