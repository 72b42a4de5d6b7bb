//! Commands with `--machine`, through `ssh` to a real `sshd` on the loopback interface. Both sides are this machine, so
//! that what a command does there can be compared with what it does here.

use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

use crate::common::{
    FAST_FOREVER, Graph, ON_TWO_MACHINES, blindgrasp, dataflow, json_lines, own_operator, program, run, script, signal,
    skipped, text, unique_name, wait_until,
};
use rustix::process::Signal;
use serde_json::json;

/// A server with keys of its own. Its programs are found in one folder, and in /usr/bin.
pub(crate) struct Sshd {
    folder: tempfile::TempDir,
    child: Child,
}

impl Sshd {
    /// `None` if there is no `sshd`; the test is skipped then.
    #[track_caller]
    pub(crate) fn start() -> Option<Sshd> {
        let programs = Path::new(program()).parent().expect("a folder");
        Sshd::with_programs(programs)
    }

    #[track_caller]
    fn with_programs(programs: &Path) -> Option<Sshd> {
        // It must be started by its whole path.
        let sshd = ["/usr/sbin/sshd", "/usr/bin/sshd", "/sbin/sshd"].into_iter().find(|path| Path::new(path).exists());
        let Some(sshd) = sshd else {
            skipped("there is no sshd: apt install openssh-server openssh-client");
            return None;
        };
        if rustix::process::getuid().is_root() {
            // Debian's makes it at the start of its service.
            std::fs::create_dir_all("/run/sshd").expect("a folder");
        }
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name).display().to_string();
        for key in ["host_key", "key", "other_key"] {
            let made = Command::new("ssh-keygen").args(["-q", "-t", "ed25519", "-N", "", "-f", &path(key)]).status();
            assert!(made.expect("started").success());
        }
        std::fs::copy(path("key.pub"), path("authorized_keys")).expect("copied");
        let port = TcpListener::bind("127.0.0.1:0").expect("bound").local_addr().expect("an address").port();
        let host_key = std::fs::read_to_string(path("host_key.pub")).expect("read");
        std::fs::write(path("known_hosts"), format!("[127.0.0.1]:{port} {host_key}")).expect("written");
        let state = Path::new(env!("CARGO_TARGET_TMPDIR")).join("state");
        let server = format!(
            "Port {port}\nListenAddress 127.0.0.1\nHostKey {}\nPidFile none\nAuthorizedKeysFile {}\nStrictModes no\n\
             UsePAM no\nPasswordAuthentication no\nKbdInteractiveAuthentication no\nPermitRootLogin yes\n\
             SetEnv PATH={}:/usr/bin:/bin XDG_STATE_HOME={}\n",
            path("host_key"),
            path("authorized_keys"),
            programs.display(),
            state.display()
        );
        std::fs::write(path("sshd_config"), server).expect("written");
        let known_hosts = path("known_hosts");
        let host = |name: &str, key: &str| {
            format!(
                "Host {name}\n  HostName 127.0.0.1\n  Port {port}\n  IdentityFile {}\n  IdentitiesOnly yes\n  \
                 UserKnownHostsFile {known_hosts}\n  GlobalKnownHostsFile /dev/null\n  StrictHostKeyChecking yes\n",
                path(key)
            )
        };
        // A host that is reached, but whose key is not in known_hosts.
        let stranger = host("stranger", "key").replace(&known_hosts, "/dev/null");
        let hosts = [host("brain", "key"), host("cortex.local", "key"), host("keyless", "other_key"), stranger];
        std::fs::write(path("ssh_config"), hosts.concat()).expect("written");
        let mut command = Command::new(sshd);
        command.args(["-D", "-e", "-f", &path("sshd_config")]).stdin(Stdio::null());
        let mut child = command.stderr(Stdio::piped()).spawn().expect("started");
        let mut log = BufReader::new(child.stderr.take().expect("piped"));
        let mut line = String::new();
        while !line.contains("Server listening") {
            line.clear();
            assert!(log.read_line(&mut line).expect("read") > 0, "sshd does not start");
        }
        // A pipe that nobody reads would stop it.
        std::thread::spawn(move || std::io::copy(&mut log, &mut std::io::sink()));
        Some(Sshd { folder, child })
    }

    pub(crate) fn blindgrasp(&self) -> Command {
        let mut command = blindgrasp();
        command.env("BLINDGRASP_SSH", format!("ssh -F {}", self.folder.path().join("ssh_config").display()));
        command
    }

    /// Runs a command to its end, which must have this exit code.
    fn run(&self, arguments: &[&str], exit_code: i32) -> Output {
        let output = self.blindgrasp().args(arguments).output().expect("started");
        let (out, err) = (text(&output.stdout), text(&output.stderr));
        assert_eq!(output.status.code(), Some(exit_code), "blindgrasp {arguments:?}\n{out}\n{err}");
        output
    }

    fn on_brain(&self, arguments: &[&str], exit_code: i32) -> Output {
        self.run(&[arguments, &["--machine", "brain"]].concat(), exit_code)
    }
}

impl Drop for Sshd {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A command that runs until it is stopped; killed if the test fails.
struct Running(Child);

impl Running {
    fn start(mut command: Command) -> Running {
        Running(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("started"))
    }

    /// Exit code, stdout, stderr.
    fn stop(mut self, with: Signal) -> (Option<i32>, String, String) {
        signal(self.0.id() as i32, with);
        let out = std::io::read_to_string(self.0.stdout.take().expect("piped")).expect("read");
        let err = std::io::read_to_string(self.0.stderr.take().expect("piped")).expect("read");
        (self.0.wait().expect("waited").code(), out, err)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Processes with these words in their command lines.
fn processes(words: &str) -> Vec<String> {
    let all = std::fs::read_dir("/proc").expect("readable").flatten().map(|entry| entry.path().join("cmdline"));
    let lines = all.filter_map(|path| std::fs::read_to_string(path).ok());
    lines.map(|line| line.replace('\0', " ")).filter(|line| line.contains(words)).collect()
}

#[test]
fn commands_do_there_what_they_do_here() {
    let Some(sshd) = Sshd::start() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::start(&dataflow(folder.path(), &[]), &FAST_FOREVER);
    let name = graph.name.as_str();

    let status = json_lines(&sshd.on_brain(&["ps", name, "--json"], 0).stdout)[0]["graphs"][0].clone();
    assert_eq!((&status["graph"], status["nodes"].as_array().map(Vec::len)), (&json!(name), Some(5)));
    assert!(status["usage"]["contacts"]["cpu_secs"].is_number(), "{status}");
    let top = sshd.on_brain(&["top", name, "--json", "-n", "1", "--interval", "0.1"], 0);
    assert!(json_lines(&top.stdout)[0]["nodes"][0]["resident_bytes"].is_number());
    let echoed = sshd.on_brain(&["echo", "lift_arbiter/decision", "-n", "2", "--graph", name], 0);
    assert_eq!(json_lines(&echoed.stdout).len(), 2);

    let changed = sshd.on_brain(&["set", "lift_arbiter.votes=4", "--graph", name, "--json"], 0);
    assert_eq!(json_lines(&changed.stdout)[0]["new"], 4);
    assert_eq!(graph.node("lift_arbiter")["params"]["votes"], 4);
    // It asks the programs which parameters are live.
    let listed = sshd.on_brain(&["set", "--graph", name, "--json"], 0);
    assert_eq!(text(&listed.stdout), text(&run(&["set", "--graph", name, "--json"], 0).stdout));
    let refused = sshd.on_brain(&["set", "lift_arbiter.votes=0", "--graph", name], 1);
    let here = run(&["set", "lift_arbiter.votes=0", "--graph", name], 1);
    assert_eq!(text(&refused.stderr), text(&here.stderr));

    // A path is relative to the folder of the dataflow file.
    own_operator(folder.path(), "classifier");
    let swap = ["swap", "classifier", "--graph", name, "--probation", "0.1"];
    sshd.on_brain(&[&swap[..], &["--run", "./own_classifier"]].concat(), 0);
    assert_eq!(graph.node("classifier")["program"], json!(folder.path().join("./own_classifier")));
    let missing = sshd.on_brain(&[&swap[..], &["--run", "./no_such"]].concat(), 1);
    assert!(text(&missing.stderr).contains("there is no such program"), "{}", text(&missing.stderr));
    // The comparison runs where the shared memory is.
    let compared = sshd.on_brain(&["swap", "classifier", "--graph", name, "--shadow", "0.5", "--json"], 0);
    assert_eq!(json_lines(&compared.stdout)[0]["result"], "compared");

    // This node says nothing meanwhile.
    let here = run(&["logs", "recorded_source", "--graph", name, "--json", "-n", "5"], 0);
    let there = sshd.on_brain(&["logs", "recorded_source", "--graph", name, "--json", "-n", "5"], 0);
    assert!(!here.stdout.is_empty());
    assert_eq!(text(&there.stdout), text(&here.stdout));

    let stopped = sshd.on_brain(&["stop", name, "--json"], 0);
    assert_eq!(json_lines(&stopped.stdout)[0]["ended"], json!([name]));
    assert_eq!(graph.finish().code, Some(0));
}

#[test]
fn ctrl_c_ends_the_command_there() {
    let Some(sshd) = Sshd::start() else { return };
    let graph = Graph::fast();
    // The arbiter says a line as it begins, and no more.
    let log = || blindgrasp().args(["logs", "lift_arbiter", "--graph", &graph.name]).output().expect("started");
    wait_until(|| log().status.success(), || text(&log().stderr));
    for with in [Signal::INT, Signal::KILL] {
        // It writes no further line, and so would not notice that nobody reads.
        let mut command = sshd.blindgrasp();
        command.args(["logs", "lift_arbiter", "-f", "-n", "3", "--graph", &graph.name, "--machine", "brain"]);
        let logs = Running::start(command);
        let there = format!("blindgrasp logs lift_arbiter -f -n 3 --graph {} --machine brain", graph.name);
        // The one here and the one there; ssh has it as one word.
        wait_until(|| processes(&there).len() >= 2, || format!("{:?}", processes(&there)));
        let (code, _, said) = logs.stop(with);
        assert_eq!(code, (with == Signal::INT).then_some(130), "{said}");
        wait_until(|| processes(&there).is_empty(), || format!("{:?}", processes(&there)));
    }
    graph.stop();
}

#[test]
fn words_arrive_as_they_are() {
    let Some(sshd) = Sshd::start() else { return };
    let mark = std::env::temp_dir().join(format!("blindgrasp-mark-{}", unique_name()));
    let touch = format!("touch {}", mark.display());
    for word in [
        format!("x; {touch}"),
        format!("$({touch})"),
        format!("`{touch}`"),
        format!("'; {touch}; '"),
        format!("\"; {touch}; \""),
        format!("\\'; {touch} #"),
        format!("a\n{touch}\n"),
        format!("| {touch}"),
        "* ~ ? [a] {b,c} !x $HOME %s \\n é→".to_owned(),
        String::new(),
        "a@b".to_owned(),
    ] {
        let here = run(&["ps", &word], 1);
        let there = sshd.on_brain(&["ps", &word], 1);
        assert_eq!(text(&there.stderr), text(&here.stderr), "{word:?}");
    }
    assert!(!mark.exists());
}

#[test]
fn a_machine_that_cannot_be_reached_is_an_error_that_says_what_to_do() {
    let Some(sshd) = Sshd::start() else { return };
    let said = |arguments: &[&str]| text(&sshd.run(&[&["ps"], arguments].concat(), 1).stderr);
    let unknown = said(&["--machine", "no-such-host.invalid"]);
    assert!(unknown.contains("resolve") && unknown.contains("try `ssh no-such-host.invalid`"), "{unknown}");
    let keyless = said(&["--machine", "keyless"]);
    assert!(
        keyless.contains("Permission denied") && keyless.contains("no connection to machine 'keyless'"),
        "{keyless}"
    );
    let stranger = said(&["--machine", "stranger"]);
    assert!(stranger.contains("Host key verification failed"), "{stranger}");
    // --ssh says where it is.
    sshd.run(&["ps", "--machine", "hidden", "--ssh", "brain"], 0);
    for option in ["-oProxyCommand=false", "-", "a b", ""] {
        let argument = format!("--machine={option}");
        assert!(said(&[&argument]).contains("is no destination of ssh"), "{option}");
        let argument = format!("--ssh={option}");
        assert!(said(&["--machine", "brain", &argument]).contains("is no destination of ssh"), "{option}");
    }
    let without = |path: &str| {
        let mut command = blindgrasp();
        command.args(["ps", "--machine", "brain"]).env("PATH", path).env_remove("BLINDGRASP_SSH");
        let output = command.output().expect("started");
        assert_eq!(output.status.code(), Some(1));
        text(&output.stderr)
    };
    assert!(without("/nowhere").contains("no program ssh on PATH"));
    run(&["ps", "--ssh", "brain"], 2);
}

#[test]
fn exit_codes_and_the_programs_there() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(sshd) = Sshd::with_programs(folder.path()) else { return };
    let missing = text(&sshd.on_brain(&["ps"], 1).stderr);
    assert!(missing.contains("machine 'brain' (brain) cannot start blindgrasp: install"), "{missing}");
    for code in [0, 1, 2, 3, 17] {
        script(folder.path(), "blindgrasp", &format!("echo out; echo err >&2; exit {code}"));
        let output = sshd.on_brain(&["ps"], code);
        assert_eq!((text(&output.stdout), text(&output.stderr)), ("out\n".into(), "err\n".into()));
    }
    // Another version, by a program in ssh's place that changes it.
    let other = script(
        folder.path(),
        "other",
        "for word; do :; done; exec sh -c \"$(echo \"$word\" | sed 's/SSH=[^ ]*/SSH=9.9/')\"",
    );
    let mut command = blindgrasp();
    let path =
        std::env::join_paths([Path::new(program()).parent().expect("a folder"), "/usr/bin".as_ref(), "/bin".as_ref()]);
    command.args(["ps", "--machine", "brain"]).env("BLINDGRASP_SSH", &other).env("PATH", path.expect("a path"));
    let output = command.output().expect("started");
    assert_eq!(output.status.code(), Some(1));
    assert!(text(&output.stderr).contains("from version 9.9: install the same version"), "{}", text(&output.stderr));
}

#[test]
fn the_dataflow_file_says_where_a_machine_is() {
    let Some(sshd) = Sshd::start() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let user = text(&Command::new("id").arg("-un").output().expect("started").stdout);
    let destination = format!("{}@cortex.local", user.trim());
    let unique = unique_name();
    // A name of its own: the tests beside this one ask all graphs of this user where 'brain' is.
    let renamed = |by: &str| by.replace("user@brain.local", &destination).replace("brain", "cortex");
    let of_test = |by: &str| renamed(by).replace("unix/gate", &format!("unix/{unique}"));
    let replace: Vec<(String, String)> =
        ON_TWO_MACHINES.iter().map(|(what, by)| (what.to_string(), of_test(by))).collect();
    let flow = crate::common::dataflow_with(folder.path(), &replace);
    let graph = Graph::launch(&unique_name(), &flow, &["--machine", "robot"]);
    wait_until(|| graph.said().contains("waiting for machine cortex"), || graph.said());
    assert_eq!(graph.status()["ssh_hosts"], json!({"cortex": destination}));
    let refused = text(&run(&["set", "classifier.votes=1", "--graph", &graph.name], 1).stderr);
    assert!(refused.contains("node 'classifier' runs on machine 'cortex': give --machine cortex"), "{refused}");
    // The configuration of ssh has no host called so: only the one that the file names.
    let listed = json_lines(&sshd.run(&["ps", &graph.name, "--json", "--machine", "cortex"], 0).stdout);
    assert_eq!(listed[0]["graphs"][0]["graph"], json!(graph.name));
    run(&["stop", &graph.name], 0);
    graph.finish();
}
