//! `blindgrasp swap`

use std::collections::{BTreeMap, HashMap};
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail};
use clap::Args;
use serde::Serialize;

use super::{Outcome, completions, number_in, percent, print_line, secs_in, stop_signal};
use blindgrasp_cli::graph_file::{refuse_misfit, shipped};
use blindgrasp_graph::client::observer::{ObservedEdge, Observer, Sink, can_observe};
use blindgrasp_graph::client::shadow_comparison::{
    ComparisonReport, Latency, PromotionLimits, Saying, ShadowComparison, Side, objections,
};
use blindgrasp_graph::client::{ANSWER_LIMIT, ClientError, Connection, pick_graph};
use blindgrasp_graph::control::{Reply, Request, ShadowOutput, SwapRequest, SwappedNode};
use blindgrasp_graph::log::printable;
use blindgrasp_messages::Record;
use blindgrasp_operator::cursors::COMPARE_BELL;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::text::counted;
use blindgrasp_operator::text::is_name;
use blindgrasp_operator::wiring::NamespaceWiring;

/// The time of the handover itself and of the old operator's end, beyond the given limits.
const MARGIN: Duration = Duration::from_secs(30);
/// A comparison checks this often whether it is to end.
const POLL: Duration = Duration::from_millis(50);
/// More disagreements are printed with --json only.
const MAX_PRINTED: usize = 20;

/// Replace the program or params of running operators
///
/// If a replacement fails, the old operator takes over again. The program of --run is run with --describe first, as the user
/// of the graph.
#[derive(Debug, Args)]
#[command(after_help = "Examples: blindgrasp swap encoder classifier --set model=models/new.json\n          \
                        blindgrasp swap classifier --run ./my_classifier --shadow 30 \
                        --min-agreement 0.99 --max-latency-p99-us 500\n\n\
                        Ctrl-C abandons the swap. Exit code 1 if the old operator goes on or came back.")]
pub(super) struct Arguments {
    /// Nodes to swap; several are handed over at one sample
    #[arg(required = true, add = completions::nodes())]
    nodes: Vec<String>,
    /// Replacement: a shipped operator or a path [default: the same program]
    #[arg(long)]
    run: Option<PathBuf>,
    /// Change a parameter of each node that has it; repeatable
    #[arg(long, value_name = "NAME=VALUE", value_parser = assignment)]
    set: Vec<(String, String)>,
    /// Compare both on live samples for so many seconds first
    ///
    /// Without a limit below, the comparison is printed and the old operator goes on.
    #[arg(long, value_name = "TIME", value_parser = |text: &str| secs_in(text, 0.1..=3600.0))]
    shadow: Option<f64>,
    #[command(flatten)]
    promote: Promote,
    /// Let the old operator stand by for so many seconds after the swap
    #[arg(long, value_name = "TIME", default_value = "2", value_parser = |text: &str| secs_in(text, 0.0..=3600.0))]
    probation: f64,
    /// Give up if the replacement is not ready after so many seconds
    #[arg(long, value_name = "TIME", default_value = "20", value_parser = |text: &str| secs_in(text, 0.1..=3600.0))]
    ready_limit: f64,
    /// Swap even if the replacement is made for another hand or model
    #[arg(long)]
    allow_mismatch: bool,
    /// Graph [default: the only one running]
    #[arg(short, long, add = completions::graphs())]
    graph: Option<String>,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Arguments for the program of --run; takes all that follows
    #[arg(long, value_name = "ARG", num_args = 0.., allow_hyphen_values = true, requires = "run")]
    args: Option<Vec<String>>,
}

/// With one of these limits, a shadow comparison that keeps all of them at every output ends in the swap.
#[derive(Debug, Args)]
#[command(next_help_heading = "Swap after the comparison if")]
struct Promote {
    /// Both sides agree on at least this share of the samples
    #[arg(long, value_name = "SHARE", requires = "shadow", value_parser = |text: &str| number_in(text, 0.0..=1.0))]
    min_agreement: Option<f64>,
    /// They disagree in at most so many grasps
    #[arg(long, value_name = "N", requires = "shadow")]
    max_disagreements: Option<usize>,
    /// The replacement's latency at 99 % is at most so many microseconds
    #[arg(long, value_name = "MICROS", requires = "shadow", value_parser = |text: &str| number_in(text, 0.0..=1e12))]
    max_latency_p99_us: Option<f64>,
}

impl Promote {
    fn limits(&self) -> PromotionLimits {
        PromotionLimits {
            min_agreement: self.min_agreement,
            max_disagreements: self.max_disagreements,
            max_latency_p99_micros: self.max_latency_p99_us,
        }
    }
}

/// How a swap ended.
#[derive(Debug, Serialize)]
#[serde(rename_all = "snake_case", tag = "result")]
enum Ended {
    /// The replacements are active.
    Swapped { nodes: Vec<SwappedNode>, shadow: Vec<ComparisonReport> },
    /// The old operators go on: only a comparison was asked for.
    Compared { shadow: Vec<ComparisonReport> },
    /// The old operators go on: the comparison broke a limit.
    HeldBack { shadow: Vec<ComparisonReport>, objections: Vec<String> },
}

struct Comparison {
    reports: Vec<ComparisonReport>,
    /// Outputs with messages of unknown types.
    not_compared: Vec<String>,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    if let Some(file) = arguments.nodes.iter().find(|node| !is_name(node)) {
        bail!("'{file}' is no name of a node: a model is given by --set model=FILE, a program by --run FILE");
    }
    let request = request(arguments)?;
    let graph = pick_graph(arguments.graph.as_deref())?;
    refuse_misfit(&graph, &request)?;
    let request = found_here(request)?;
    let stop = stop_signal()?;
    let mut connection = Connection::open(&graph)?;
    let ended = swap(arguments, request, &mut connection, &|| stop.load(Ordering::Relaxed)).map_err(explained)?;
    // The exit code tells how the swap ended, even if stdout is closed.
    let printed = if arguments.json {
        print_line(&serde_json::to_string(&ended)?).map_err(anyhow::Error::from)
    } else {
        print_ended(&ended)
    };
    match ended {
        Ended::HeldBack { objections, .. } => {
            bail!("not swapped, the old one goes on:\n  {}", objections.join("\n  "))
        }
        Ended::Swapped { .. } | Ended::Compared { .. } => printed.map(|()| Outcome::Done),
    }
}

fn request(arguments: &Arguments) -> anyhow::Result<SwapRequest> {
    if arguments.nodes.len() > 1 && (arguments.run.is_some() || arguments.args.is_some()) {
        bail!("--run and --args are for one node: swap the others on their own, or without them");
    }
    let mut set = BTreeMap::new();
    for (name, value) in &arguments.set {
        if set.insert(name.clone(), value.clone()).is_some() {
            bail!("--set {name}: it is given twice");
        }
    }
    let folder = std::env::current_dir().context("the current folder is unknown")?;
    Ok(SwapRequest {
        nodes: arguments.nodes.clone(),
        program: arguments.run.clone(),
        args: arguments.args.clone(),
        set,
        folder,
        // Twice as long and a margin: the limit is for a client that has been stopped.
        shadow_limit_millis: arguments.shadow.map_or(0, |secs| (1e3 * (2.0 * secs + 10.0)) as u64),
        ready_limit_millis: (1e3 * arguments.ready_limit).ceil() as u64,
        probation_millis: (1e3 * arguments.probation).ceil() as u64,
        allow_mismatch: arguments.allow_mismatch,
    })
}

/// The swap with the program as it is found here.
fn found_here(request: SwapRequest) -> anyhow::Result<SwapRequest> {
    let Some(run) = &request.program else { return Ok(request) };
    let args = request.args.as_deref().unwrap_or_default();
    let program = shipped()?
        .program_to_run(run, args, &request.folder)
        .map_err(|missing| anyhow!("--run {}: there is no such program ({})", run.display(), missing.display()))?;
    Ok(SwapRequest { program: Some(program.path), args: Some(program.args), ..request })
}

fn swap(
    arguments: &Arguments,
    request: SwapRequest,
    connection: &mut Connection,
    is_interrupted: &dyn Fn() -> bool,
) -> anyhow::Result<Ended> {
    let limit = Duration::from_millis(request.ready_limit_millis + request.probation_millis) + MARGIN;
    connection.send(&Request::Swap(request))?;
    let mut reports = Vec::new();
    if let Some(secs) = arguments.shadow {
        let (domain, outputs) = match last_reply(connection, limit, is_interrupted)? {
            Reply::Shadowing { domain, outputs } => (domain, outputs),
            other => return Err(connection.unexpected(&other).into()),
        };
        let comparison = compare(&domain, outputs, Duration::from_secs_f64(secs), connection, is_interrupted)?;
        let limits = arguments.promote.limits();
        let mut objections = objections(&comparison.reports, &limits);
        objections.extend(
            comparison.not_compared.iter().map(|output| format!("{output}: its messages cannot be compared here")),
        );
        reports = comparison.reports;
        let is_comparison_all = !limits.is_any();
        if is_comparison_all || !objections.is_empty() {
            connection.send(&Request::Abandon)?;
            return match last_reply(connection, ANSWER_LIMIT + MARGIN, is_interrupted)? {
                Reply::Abandoned if is_comparison_all => Ok(Ended::Compared { shadow: reports }),
                Reply::Abandoned => Ok(Ended::HeldBack { shadow: reports, objections }),
                other => Err(connection.unexpected(&other).into()),
            };
        }
        connection.send(&Request::Promote)?;
    }
    match last_reply(connection, limit, is_interrupted)? {
        Reply::Swapped { nodes } => Ok(Ended::Swapped { nodes, shadow: reports }),
        other => Err(connection.unexpected(&other).into()),
    }
}

/// The next reply that is not progress.
fn last_reply(
    connection: &mut Connection,
    limit: Duration,
    is_interrupted: &dyn Fn() -> bool,
) -> Result<Reply, ClientError> {
    loop {
        match connection.receive(limit, is_interrupted)? {
            Reply::Progress { message } => print_diagnostic(&printable(&message)),
            reply => return Ok(reply),
        }
    }
}

/// Reads both streams of each output for a time.
fn compare(
    domain: &NamespaceWiring,
    outputs: Vec<ShadowOutput>,
    time: Duration,
    connection: &mut Connection,
    is_interrupted: &dyn Fn() -> bool,
) -> anyhow::Result<Comparison> {
    let (outputs, others): (Vec<_>, Vec<_>) =
        outputs.into_iter().partition(|output| can_observe(&output.active.service.type_name));
    let not_compared: Vec<String> = others.iter().map(name).collect();
    for output in &not_compared {
        print_diagnostic(&format!("blindgrasp: {output} is not compared: its message type is unknown"));
    }
    if outputs.is_empty() {
        return Ok(Comparison { reports: Vec::new(), not_compared });
    }
    let observer = Observer::start(domain, COMPARE_BELL, observed_edges(&outputs), ShadowLog::new(&outputs))?;
    print_diagnostic(&format!("comparing for {}", humantime::format_duration(time)));
    let watched = watch(time, connection, is_interrupted, &|| observer.has_failed());
    let end_nanos = monotonic_nanos();
    // Finished in any case: a reader that is only dropped would hold the graph up.
    let finished = observer.finish();
    watched?;
    let (log, _) = finished.context("cannot compare")?;
    let names = outputs.iter().map(name);
    let reports = names.zip(log.comparisons).map(|(name, comparison)| comparison.report(name, end_nanos)).collect();
    Ok(Comparison { reports, not_compared })
}

/// Waits for the end of the comparison, or for a reply that ends it early.
fn watch(
    time: Duration,
    connection: &mut Connection,
    is_interrupted: &dyn Fn() -> bool,
    has_failed: &dyn Fn() -> bool,
) -> Result<(), ClientError> {
    let end = Instant::now() + time;
    loop {
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() || has_failed() {
            return Ok(());
        }
        if is_interrupted() {
            return Err(ClientError::Interrupted);
        }
        match connection.receive_within(left.min(POLL))? {
            Some(Reply::Progress { message }) => print_diagnostic(&printable(&message)),
            Some(other) => return Err(connection.unexpected(&other)),
            None => {}
        }
    }
}

/// Both streams of each output, as the observer reads them.
fn observed_edges(outputs: &[ShadowOutput]) -> Vec<ObservedEdge> {
    let mut edges = Vec::new();
    for output in outputs {
        for (side, input) in [(Side::Active, &output.active), (Side::Shadow, &output.shadow)] {
            edges.push(ObservedEdge { topic: topic(side, output), input: input.clone(), is_prompt: true });
        }
    }
    edges
}

fn topic(side: Side, output: &ShadowOutput) -> String {
    format!("{side:?}/{}", name(output))
}

fn name(output: &ShadowOutput) -> String {
    format!("{}/{}", output.node, output.port)
}

/// The comparison of each output.
struct ShadowLog {
    /// The side and the output, by topic.
    sides: HashMap<String, (Side, usize)>,
    comparisons: Vec<ShadowComparison>,
    /// Older samples come from the ports' histories, and tell nothing of latency.
    start_nanos: u64,
}

impl ShadowLog {
    fn new(outputs: &[ShadowOutput]) -> Self {
        let sides = outputs.iter().enumerate();
        let sides = sides.flat_map(|(idx, it)| [Side::Active, Side::Shadow].map(|side| (topic(side, it), (side, idx))));
        let comparisons = outputs.iter().map(|_| ShadowComparison::default()).collect();
        ShadowLog { sides: sides.collect(), comparisons, start_nanos: monotonic_nanos() }
    }
}

impl Sink for ShadowLog {
    fn take(&mut self, topic: &str, record: Record, received_nanos: u64) -> anyhow::Result<()> {
        if record.header().origin_nanos >= self.start_nanos
            && let Some(&(side, output_idx)) = self.sides.get(topic)
        {
            self.comparisons[output_idx].add(side, &record, received_nanos);
        }
        Ok(())
    }
}

/// Adds the state of the operators to an error.
fn explained(error: anyhow::Error) -> anyhow::Error {
    match error.downcast_ref::<ClientError>() {
        Some(ClientError::Refused { message, rolled_back: true }) => {
            anyhow!("the replacement took over and failed; the old operator is active again: {}", printable(message))
        }
        Some(ClientError::Refused { message, rolled_back: false }) => {
            anyhow!("not swapped: {}", printable(message))
        }
        Some(ClientError::Interrupted) => {
            anyhow!("interrupted: the swap is abandoned; blindgrasp ps shows what is running")
        }
        Some(ClientError::NotAnswering { .. }) => {
            error.context("the swap is abandoned; blindgrasp ps shows what is running")
        }
        _ => error,
    }
}

fn print_ended(ended: &Ended) -> anyhow::Result<()> {
    let (nodes, reports): (&[SwappedNode], _) = match ended {
        Ended::Swapped { nodes, shadow } => (nodes, shadow),
        Ended::Compared { shadow } | Ended::HeldBack { shadow, .. } => (&[], shadow),
    };
    for line in reports.iter().flat_map(formatted).chain(nodes.iter().map(swapped_line)) {
        print_line(&line)?;
    }
    Ok(())
}

fn swapped_line(node: &SwappedNode) -> String {
    let after = node.last_seq.map_or("before the first sample".into(), |seq| format!("after sample {seq}"));
    format!(
        "{}: process {} → {} {after}, no operator active for {:.1} ms",
        node.node,
        node.old_pid,
        node.new_pid,
        node.handover_pause_nanos as f64 / 1e6
    )
}

fn formatted(report: &ComparisonReport) -> Vec<String> {
    let agreement = match report.agreement {
        Some(share) => format!("{} of {} agree", percent(Some(share)), counted(report.n_pairs, "sample")),
        None => "agreement unknown: no sample was answered by both".into(),
    };
    let mut lines = vec![
        format!("{}: {agreement}, {} with disagreement", report.output, counted(report.disagreements.len(), "grasp")),
        format!(
            "  answered by the old one only: {} ({} of them in the replacement's time); by the replacement only: {}",
            report.n_only_active, report.n_unanswered, report.n_only_shadow
        ),
        format!(
            "  latency at 50 and 99 %: the old one {}, the replacement {}",
            latency(report.active_latency),
            latency(report.shadow_latency)
        ),
    ];
    for one in report.disagreements.iter().take(MAX_PRINTED) {
        lines.push(format!(
            "  grasp {:>5}  {} → {}  in {} of its samples",
            one.grasp_id,
            saying(&one.active),
            saying(&one.shadow),
            one.n_samples
        ));
    }
    if report.disagreements.len() > MAX_PRINTED {
        lines.push(format!("  … and {} more grasps (--json has all)", report.disagreements.len() - MAX_PRINTED));
    }
    lines
}

fn latency(latency: Option<Latency>) -> String {
    latency.map_or("unknown".into(), |at| format!("{:.0} and {:.0} µs", at.p50_micros, at.p99_micros))
}

fn saying(saying: &Saying) -> String {
    match saying.probability_stable {
        Some(probability) => format!("{} (p {probability:.3})", saying.says),
        None => saying.says.clone(),
    }
}

fn assignment(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((name, value)) if !name.is_empty() => Ok((name.into(), value.into())),
        _ => Err("expected NAME=VALUE".into()),
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::commands::{Cli, Command};
    use blindgrasp_graph::testing::serve;
    use blindgrasp_messages::{Header, Prediction, Stamped};
    use blindgrasp_operator::wiring::EdgePolicy;
    use blindgrasp_operator::wiring::{InputWiring, OnLate, ServiceWiring};

    fn parsed(line: &str) -> Result<Arguments, clap::Error> {
        match Cli::try_parse_from(["blindgrasp", "swap"].into_iter().chain(line.split_whitespace()))?.command {
            Command::Swap(arguments) => Ok(arguments),
            other => panic!("{other:?}"),
        }
    }

    fn never() -> bool {
        false
    }

    #[test]
    fn the_request_says_what_the_arguments_say() {
        let line = "classifier --set model=a=b --shadow 1.5 --min-agreement 0.9 --max-disagreements 2 --ready-limit 0.25 \
                    --run /bin/true --args -v --fast";
        let arguments = parsed(line).expect("accepted");
        let limits = arguments.promote.limits();
        assert_eq!(
            (limits.min_agreement, limits.max_disagreements, limits.max_latency_p99_micros),
            (Some(0.9), Some(2), None)
        );
        let found = request(&arguments).expect("consistent");
        assert_eq!(found.set, [("model".to_string(), "a=b".to_string())].into());
        assert_eq!(found.args, Some(vec!["-v".into(), "--fast".into()]));
        assert_eq!((found.ready_limit_millis, found.probation_millis), (250, 2000));
        assert_eq!((found.shadow_limit_millis, found.program), (13_000, Some("/bin/true".into())));
        assert!(found.folder.is_absolute());
        let two = request(&parsed("a b --run /bin/true").expect("accepted"));
        assert!(two.expect_err("two nodes").to_string().contains("one node"));
        parsed("a --args -v").expect_err("arguments of which program?");
        let missing = parsed("a --run no/such/program").expect("accepted");
        let found = found_here(request(&missing).expect("consistent")).expect_err("missing");
        assert!(found.to_string().contains("there is no such program"), "{found}");
    }

    #[test]
    fn arguments_that_cannot_be_meant_are_refused() {
        for wrong in [
            "--shadow 1",
            "a --min-agreement 0.9",
            "a --shadow 1 --min-agreement 99",
            "a --shadow 1 --min-agreement nan",
            "a --shadow 1 --max-disagreements -1",
            "a --shadow 1 --max-latency-p99-us x",
            "a --shadow 0",
            "a --set model",
        ] {
            parsed(wrong).expect_err(wrong);
        }
        let twice = parsed("a --set x=1 --set x=2").expect("accepted");
        assert!(request(&twice).expect_err("twice").to_string().contains("given twice"));
    }

    fn ran(
        name: &str,
        arguments: &Arguments,
        then: Vec<(Request, Vec<Reply>)>,
        first: Vec<Reply>,
    ) -> anyhow::Result<Ended> {
        let graph = format!("swap-{name}-{}", std::process::id());
        let request = request(arguments).expect("consistent");
        let answers = [(Request::Swap(request.clone()), first)].into_iter().chain(then).collect();
        let server = serve(&graph, answers);
        let mut connection = Connection::open(&graph).expect("connected");
        let ended = swap(arguments, request, &mut connection, &never).map_err(explained);
        server.join().expect("asked as expected");
        ended
    }

    #[test]
    fn a_swap_ends_with_what_the_graph_says() {
        let arguments = parsed("classifier").expect("accepted");
        let node = SwappedNode {
            node: "classifier".into(),
            old_pid: 10,
            new_pid: 11,
            last_seq: Some(991),
            handover_pause_nanos: 2_700_000,
        };
        let progress = || Reply::Progress { message: "ready".into() };
        let swapped = Reply::Swapped { nodes: vec![node.clone()] };
        match ran("done", &arguments, Vec::new(), vec![progress(), progress(), swapped]).expect("swapped") {
            Ended::Swapped { nodes, .. } => assert_eq!(nodes, std::slice::from_ref(&node)),
            other => panic!("{other:?}"),
        }
        assert_eq!(swapped_line(&node), "classifier: process 10 → 11 after sample 991, no operator active for 2.7 ms");
        let error = |rolled_back| Reply::Error { message: "it crashed".into(), rolled_back };
        let back = ran("back", &arguments, Vec::new(), vec![progress(), error(true)]).expect_err("rolled back");
        assert_eq!(
            back.to_string(),
            "the replacement took over and failed; the old operator is active again: it crashed"
        );
        let refused = ran("refused", &arguments, Vec::new(), vec![error(false)]).expect_err("refused");
        assert_eq!(refused.to_string(), "not swapped: it crashed");
    }

    #[test]
    fn a_comparison_of_nothing_is_abandoned() {
        let domain = NamespaceWiring { folder: "/nowhere".into() };
        let shadowing = || vec![Reply::Shadowing { domain: domain.clone(), outputs: Vec::new() }];
        let abandoned = || vec![(Request::Abandon, vec![Reply::Abandoned])];
        let only = parsed("a --shadow 0.1").expect("accepted");
        let ended = ran("only", &only, abandoned(), shadowing()).expect("compared");
        assert!(matches!(ended, Ended::Compared { .. }), "{ended:?}");
        let gated = parsed("a --shadow 0.1 --min-agreement 0").expect("accepted");
        match ran("gated", &gated, abandoned(), shadowing()).expect("compared") {
            Ended::HeldBack { objections, .. } => assert_eq!(objections, ["there is no output to compare"]),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn each_output_is_compared_with_its_own_shadow() {
        let input = |name: &str| InputWiring {
            tolerance_nanos: 0,
            partner_wait_nanos: 0,
            service: ServiceWiring {
                name: name.into(),
                type_name: "blindgrasp/Prediction/2".into(),
                history: 1,
                max_capacity: 4,
                max_publishers: 2,
                max_subscribers: 2,
                max_borrowed: 2,
                max_nodes: 4,
            },
            policy: EdgePolicy::Latest,
            capacity: 4,
            deadline_nanos: None,
            on_late: OnLate::Count,
            slot: None,
            writer_slot: 0,
        };
        let output = |port: &str| ShadowOutput {
            node: "n".into(),
            port: port.into(),
            active: input(&format!("active {port}")),
            shadow: input(&format!("shadow {port}")),
        };
        let outputs = [output("a"), output("b")];
        let edges = observed_edges(&outputs);
        let services: Vec<&str> = edges.iter().map(|edge| edge.input.service.name.as_str()).collect();
        assert_eq!(services, ["active a", "shadow a", "active b", "shadow b"]);
        let mut log = ShadowLog::new(&outputs);
        // Both sides of a, one of b.
        for (edge, stable) in edges.iter().zip([true, false, true]) {
            let message = Prediction { stable, ..Prediction::default() };
            let header = Header { origin_nanos: u64::MAX, ..Header::default() };
            let record = Record::Prediction(Stamped { header, message });
            log.take(&edge.topic, record, 1).expect("taken");
        }
        let reports: Vec<_> =
            log.comparisons.into_iter().map(|comparison| comparison.report(String::new(), 2)).collect();
        assert_eq!((reports[0].n_pairs, reports[0].agreement), (1, Some(0.0)));
        assert_eq!((reports[1].n_pairs, reports[1].n_only_active), (0, 1));
        let lines = formatted(&reports[0]).join("\n");
        assert!(lines.contains("0.0 % of 1 sample agree"), "{lines}");
        assert!(lines.contains("stable (p 0.000) → unstable (p 0.000)  in 1 of its samples"), "{lines}");
    }

    #[test]
    fn a_shadow_that_fails_ends_the_comparison() {
        let graph = format!("swap-fails-{}", std::process::id());
        let error = Reply::Error { message: "it crashed".into(), rolled_back: false };
        let progress = Reply::Progress { message: "still there".into() };
        let server = serve(&graph, vec![(Request::Status, vec![progress, error])]);
        let mut connection = Connection::open(&graph).expect("connected");
        connection.send(&Request::Status).expect("sent");
        let hour = Duration::from_secs(3600);
        let failed = watch(hour, &mut connection, &never, &never).expect_err("the shadow crashed");
        assert!(matches!(failed, ClientError::Refused { .. }), "{failed:?}");
        let interrupted = watch(hour, &mut connection, &|| true, &never).expect_err("interrupted");
        assert!(matches!(interrupted, ClientError::Interrupted), "{interrupted:?}");
        watch(hour, &mut connection, &never, &|| true).expect("the observer's own error says why");
        server.join().expect("asked as expected");
    }
}
