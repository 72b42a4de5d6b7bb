//! A test that no stage allocates memory for a sample once it is warm.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use blindgrasp_graph::dataflow::{self, Scope};
use blindgrasp_graph::plan::{Plan, PlanOptions};
use blindgrasp_messages::{LiftDecision, TactileFrame};
use blindgrasp_operator::cursors::SharedCursors;
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::namespace::{self, Namespace};
use blindgrasp_operator::operator::{TICK, join, open};
use blindgrasp_operator::port::{Sent, Subscriber};
use blindgrasp_operator::source::send_parts;
use blindgrasp_operator::wiring::Clock;
use blindgrasp_replay::player::{Player, Playing, Program};
use blindgrasp_replay::selection::Selection;

use crate::{form_of, operators_of};

thread_local! {
    static N_ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

/// The system's allocator, which counts.
struct Counting;

#[global_allocator]
static COUNTING: Counting = Counting;

// SAFETY: it calls the system's allocator with the same arguments.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        N_ALLOCATIONS.with(|n| n.set(n.get() + 1));
        // SAFETY: as the caller says.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as the caller says.
        unsafe { System.dealloc(pointer, layout) }
    }
}

fn describe(_program: &Path, args: &[String]) -> Result<OperatorDescription, String> {
    Ok((form_of(args).expect("shipped").describe)())
}

/// iceoryx2 0.10 itself allocates so often for a sample that is sent: 48 bytes that count who holds it.
const N_BY_ICEORYX2: u64 = 1;

/// So many grasps of the recording have no contact with an object.
const N_EXPLAINED: u64 = 37;

/// The stages of the default graph as a group in this thread, on the recording of held-out objects.
#[test]
fn no_stage_allocates_for_a_sample_once_it_is_warm() {
    let project = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the project");
    let text = std::fs::read_to_string(project.join("dataflow.yaml")).expect("dataflow.yaml");
    // A sandbox would restrict the other tests of this process.
    let text = text.replace("    sandbox: on\n", "    group: judge\n").replacen("    group: judge\n", "", 1);
    let folder = tempfile::tempdir_in(project.join("target")).expect("a folder");
    let text = ["recordings", "models", "hands"]
        .iter()
        .fold(text, |text, shared| text.replace(&format!(" {shared}/"), &format!(" {}/{shared}/", project.display())));
    std::fs::write(folder.path().join("dataflow.yaml"), text).expect("written");
    let file = dataflow::load(&folder.path().join("dataflow.yaml")).expect("read");
    let graph = dataflow::check(&file, &operators_of(Path::new("blindgrasp")), &[], Scope::Everything, describe)
        .expect("a graph");

    let namespace = Namespace::reserve(&format!("allocations-{}", std::process::id())).expect("reserved");
    let port = ("lift_arbiter".to_owned(), "decision".to_owned());
    let options = PlanOptions { wait_limit_millis: 5000, clock: Clock::Machine };
    let plan = Plan::new(&graph, namespace.name(), namespace.wiring(), &BTreeSet::from([port.clone()]), options);
    let _cursors = plan.create_cursors().expect("cursors");
    let wiring = |idx: usize| plan.wiring(&graph.nodes[idx], 0, false).expect("planned");
    let of_node = |idx: usize| form_of(&graph.nodes[idx].args).expect("shipped");

    let node = namespace::join(namespace.wiring(), "reader").expect("joined");
    let cursors = Arc::new(SharedCursors::open(&namespace.wiring().cursors()).expect("cursors"));
    let input = plan.observer_input(&port).expect("observed");
    let mut decisions = Subscriber::<LiftDecision>::open(&node, Some(&cursors), &input).expect("opened");
    decisions.take_over(None);
    let hand = join(&[(of_node(0).describe)()], vec![wiring(0)]).expect("joined").remove(0);
    let stages = 1..graph.nodes.len();
    let descriptions: Vec<_> = stages.clone().map(|idx| (of_node(idx).describe)()).collect();
    let operators = join(&descriptions, stages.clone().map(wiring).collect()).expect("joined");
    let works: Vec<_> = stages.map(|idx| of_node(idx).work).collect();
    let mut tasks = open(&operators, &works).expect("opened");

    let recording = project.join("recordings/held-out.mcap");
    let program = Program { recording, selection: Selection::default(), topic: None, n_repetitions: 1 };
    let mut player = Player::<TactileFrame>::open(program).expect("opened");
    let mut frames = hand.publisher::<TactileFrame>("tactile", player.max_items()).expect("opened");
    player.resume(None, None, &mut || true).expect("placed");
    let (mut n_frames, mut n_decisions, mut n_steps_that_allocated) = (0_u64, 0_u64, [0_u64; 4]);
    let mut warm: Option<Instant> = None;
    loop {
        player.advance().expect("played");
        match player.current() {
            Playing::End => break,
            Playing::Frame { head, items, .. } => {
                let sent = send_parts(&hand, &mut frames, head, items).expect("sent");
                assert_eq!(sent, Sent::Yes);
            }
            _ => continue,
        }
        n_frames += 1;
        for (task, n_that_allocated) in tasks.iter_mut().zip(&mut n_steps_that_allocated) {
            let before = N_ALLOCATIONS.with(Cell::get);
            task.step().expect("answered");
            let has_allocated = N_ALLOCATIONS.with(Cell::get) > before + N_BY_ICEORYX2;
            *n_that_allocated += u64::from(has_allocated && warm.is_some());
        }
        while let Some(sample) = decisions.receive().expect("received") {
            decisions.commit(&sample.head().header);
            n_decisions += 1;
        }
        if n_frames == 1000 {
            warm = Some(Instant::now());
        }
    }
    assert_eq!((n_frames, n_decisions), (3360, 240));
    // Some times a second, between samples, a stage looks for new readers and reports its counts; and a line of the log explains
    // a grasp without contact.
    let n_looks = warm.expect("warm").elapsed().div_duration_f64(TICK).ceil() as u64 + 1;
    for (idx, n) in n_steps_that_allocated.into_iter().enumerate() {
        let n_allowed = n_looks + N_EXPLAINED;
        assert!(n <= n_allowed, "{}: {n} of 2360 steps allocated, {n_allowed} expected", graph.nodes[idx + 1].id);
    }
}
