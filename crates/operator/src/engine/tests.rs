//! The rules of a node for which the search through histories (`recovery_model.rs`) has no worlds: ends, silence and cuts,
//! several inputs and outputs, batches, late samples, bells, and a standby.

use std::cell::{Cell, RefCell};

use super::*;
use crate::saved::Output;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Note(Header);

impl Sample for Note {
    fn header(&self) -> &Header {
        &self.0
    }

    fn copied(self) -> Self {
        self
    }
}

/// A site that says what is done with it.
#[derive(Default)]
struct Desk {
    /// The numbers of the samples to come, by input.
    inputs: Vec<VecDeque<u64>>,
    n_missing: u64,
    late: Option<(OnLate, u64)>,
    is_live: bool,
    is_cut_off: bool,
    is_hurried: bool,
    is_full: bool,
    has_partners: bool,
    skipped: Option<u64>,
    /// Up to these samples, the readers of each output have all.
    known: [Option<SampleId>; 2],
    saved: Option<Vec<u8>>,
    sent: Vec<Header>,
    is_at_work: Cell<bool>,
    names: RefCell<Vec<SampleId>>,
    said: RefCell<Vec<String>>,
}

impl Desk {
    fn with(inputs: &[&[u64]]) -> Desk {
        Desk { inputs: inputs.iter().map(|input| input.iter().copied().collect()).collect(), ..Desk::default() }
    }

    fn say(&self, text: String) {
        self.said.borrow_mut().push(text);
    }

    /// All that was done since the last call.
    fn said(&self) -> String {
        self.said.take().join(", ")
    }
}

fn id(seq: u64) -> SampleId {
    SampleId { epoch: 3, seq }
}

fn header(seq: u64) -> Header {
    Header { epoch: 3, seq, ..Header::default() }
}

impl Site for Desk {
    type Sample = Note;
    const STATE_BYTES: usize = 4096;

    fn receive(&mut self, input: usize) -> Result<Option<Received<Note>>, PortError> {
        let Some(seq) = self.inputs[input].pop_front() else { return Ok(None) };
        let counts = InputCounts { n_missing: self.n_missing, ..InputCounts::default() };
        Ok(Some(Received { sample: Note(header(seq)), counts, late: self.late }))
    }
    fn put_back(&mut self, input: usize, sample: Note) {
        self.say(format!("back {input}.{}", sample.0.seq));
    }
    fn take_over(&mut self, _: usize, _: &Input, _: Option<SampleId>) {}
    fn look_on_from(&mut self, _: usize, _: SampleId) {}
    fn commit(&mut self, input: usize, key: SampleId, _: &InputCounts) {
        self.say(format!("commit {input}.{}", key.seq));
    }
    fn is_caught_up(&self, input: usize) -> bool {
        self.inputs[input].is_empty()
    }
    fn is_cut_off(&self, _: usize) -> bool {
        self.is_cut_off
    }
    fn place(&self, _: usize) -> (Option<SampleId>, InputCounts) {
        (None, InputCounts::default())
    }
    fn is_after(&self, _: usize, key: SampleId, other: Option<SampleId>) -> bool {
        other.is_none_or(|other| key.seq > other.seq)
    }
    fn is_hurried(&self, _: usize) -> bool {
        self.is_hurried
    }
    fn begin_active(&mut self) {}
    fn begin(&mut self, output: usize, is_handed_over: bool) -> Option<SampleId> {
        self.say(format!("begin {output} {is_handed_over}"));
        self.known[output]
    }
    fn written(&self, _: usize) -> Option<Written> {
        self.sent.last().map(|sent| Written { last: sample_id(sent), first_seq: 0, before: None })
    }
    fn has_readers(&self, _: usize) -> bool {
        true
    }
    fn answered_by_readers(&self, output: usize) -> Option<SampleId> {
        self.known[output]
    }
    fn wait_for_room(&mut self, _: usize, _: SampleId) -> Result<Sent, PortError> {
        Ok(if self.is_full { Sent::GaveWay } else { Sent::Yes })
    }
    fn wait_for_answers(&mut self, output: usize, key: SampleId, _: Yields) -> Result<Sent, PortError> {
        self.say(format!("wait {output}.{}", key.seq));
        if self.is_full {
            return Ok(Sent::GaveWay);
        }
        self.known[output] = Some(key);
        Ok(Sent::Yes)
    }
    fn send(&mut self, output: usize, key: SampleId, head: &[u8], _: &[u8]) -> Result<(), PortError> {
        self.sent.push(header_of(head));
        self.say(format!("send {output}.{}", key.seq));
        Ok(())
    }
    fn send_beside(&mut self, output: usize, key: SampleId, _: &[u8], _: &[u8]) -> Result<(), PortError> {
        self.say(format!("beside {output}.{}", key.seq));
        Ok(())
    }
    fn delay_bells(&mut self, _: usize, delays: bool) {
        if delays {
            self.say("quiet".into());
        }
    }
    fn ring_if_due(&self, _: usize) {
        self.say("ring".into());
    }
    fn take_in_partners(&mut self, _: bool) -> Result<(), PortError> {
        Ok(())
    }
    fn choose_partners(&mut self, _: &Header, _: bool, _: bool) -> Result<bool, PortError> {
        Ok(true)
    }
    fn partners_have_answered(&mut self, main: Option<SampleId>) {
        self.say(format!("answered {:?}", main.map(|main| main.seq)));
    }
    fn has_partners(&self) -> bool {
        self.has_partners
    }
    fn partners_are_caught_up(&self) -> bool {
        true
    }
    fn save_state(&mut self, bytes: &[u8]) -> anyhow::Result<()> {
        self.saved = Some(bytes.to_vec());
        self.say("save".into());
        Ok(())
    }
    fn saved_state(&self) -> Option<Vec<u8>> {
        self.saved.clone()
    }
    fn forget_state(&mut self) {
        self.saved = None;
    }
    fn is_interrupted(&self) -> bool {
        false
    }
    fn should_stop(&self) -> bool {
        false
    }
    fn beat(&self) {}
    fn works_on(&self, sample: Option<SampleId>) {
        self.is_at_work.set(sample.is_some());
        self.names.borrow_mut().extend(sample);
    }
    fn skips(&self, sample: SampleId) -> bool {
        self.skipped == Some(sample.seq)
    }
    fn is_unfit(&self, seq: u64, _: u64) {
        self.say(format!("unfit {seq}"));
    }
    fn warm(&self, n_samples: u64) {
        self.say(format!("warm {n_samples}"));
    }
    fn made_by(&self, made_by: u64) -> u64 {
        made_by + 1
    }
    fn clock(&self) -> Clock {
        if self.is_live { Clock::Machine } else { Clock::Recording }
    }
    fn arrival_nanos(&self, _: &Header) -> u64 {
        0
    }
    fn now_nanos(&self) -> u64 {
        0
    }
}

/// A worker that answers each sample on these outputs.
#[derive(Default)]
struct Scribe {
    outputs: Vec<usize>,
    /// The sample that it does not answer.
    silent_at: Option<u64>,
    /// Whether it answers what it hears.
    speaks: bool,
    wants_one_by_one: bool,
    asked: Vec<Vec<u64>>,
    heard: Vec<Hearing>,
    works: VecDeque<Vec<(usize, Header)>>,
    answers: Vec<(usize, Header)>,
    head: Vec<u8>,
}

impl Worker<Note> for Scribe {
    fn has_state(&self) -> bool {
        false
    }
    fn ask(&mut self, _: usize, samples: &[Taken<Note>]) -> anyhow::Result<bool> {
        self.asked.push(samples.iter().map(|taken| taken.header.seq).collect());
        if samples.len() > 1 && self.wants_one_by_one {
            return Ok(false);
        }
        for taken in samples {
            let outputs = if self.silent_at == Some(taken.header.seq) { &[][..] } else { &self.outputs };
            self.works.push_back(outputs.iter().map(|output| (*output, Header::default())).collect());
        }
        Ok(true)
    }
    fn next(&mut self) -> usize {
        self.answers = self.works.pop_front().unwrap_or_default();
        self.answers.len()
    }
    fn hear(&mut self, hearing: Hearing, _: u64) -> anyhow::Result<Option<usize>> {
        self.heard.push(hearing);
        self.answers = vec![(0, header(90 + self.heard.len() as u64))];
        Ok(if self.speaks { Some(1) } else { None })
    }
    fn answer(&self, idx: usize) -> Answer<'_> {
        (self.answers[idx].0, self.answers[idx].1.as_bytes(), &[])
    }
    fn set_header(&mut self, idx: usize, header: &Header) {
        self.answers[idx].1 = *header;
    }
    fn before_sending(&mut self, idx: usize, _: u64) -> anyhow::Result<Answer<'_>> {
        Ok(self.answer(idx))
    }
    fn before_sending_saved(&mut self, (_, head, _): Answer<'_>, _: u64) -> anyhow::Result<&[u8]> {
        self.head = head.to_vec();
        Ok(&self.head)
    }
    fn state(&self, _: &mut Vec<u8>) -> anyhow::Result<()> {
        Ok(())
    }
    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<bool> {
        Ok(state.is_some())
    }
    fn deadline_nanos(&self) -> Option<u64> {
        None
    }
    fn set(&mut self, _: &Map<String, Value>) -> anyhow::Result<anyhow::Result<()>> {
        Ok(Ok(()))
    }
    fn look(&mut self) -> anyhow::Result<()> {
        Ok(())
    }
}

const PLAIN: Manner = Manner { saves: false, answers_each: true, n_batch: 1, has_suspect: false };
const SAVING: Manner = Manner { saves: true, answers_each: false, ..PLAIN };

/// An active node that answers each sample on each output.
fn node(desk: &mut Desk, outputs: &[Numbers], manner: Manner) -> Engine<Note, Scribe> {
    let inputs = (0..desk.inputs.len()).map(|idx| Input::new(["a", "b"][idx], false)).collect();
    let numbered = outputs.iter().enumerate().map(|(idx, numbers)| Output::new(["x", "y"][idx], *numbers));
    let worker = Scribe { outputs: (0..outputs.len()).collect(), ..Scribe::default() };
    let engine = Engine::begin(desk, worker, Book::new(inputs, numbered.collect()), manner, false).expect("it begins");
    assert!(engine.is_active());
    engine
}

/// Lets it answer samples of an input, and says what it has done.
fn done(engine: &mut Engine<Note, Scribe>, desk: &mut Desk, input: usize, seqs: &[u64]) -> String {
    desk.inputs[input].extend(seqs);
    turn(engine, desk, false)
}

fn turn(engine: &mut Engine<Note, Scribe>, desk: &mut Desk, stop: bool) -> String {
    assert_eq!(engine.work(desk, stop).expect("it works"), Sent::Yes);
    desk.said()
}

#[test]
fn a_worker_hears_the_end_once_and_silence_by_the_clock_of_the_machine_alone() {
    let mut desk = Desk::with(&[&[0]]);
    let mut engine = node(&mut desk, &[Numbers::OfWorker], PLAIN);
    engine.worker.speaks = true;
    assert_eq!(desk.said(), "begin 0 false");
    assert_eq!(done(&mut engine, &mut desk, 0, &[1]), "send 0.0, commit 0.0, send 0.1, commit 0.1, ring");
    assert_eq!((engine.worker.heard.len(), engine.next_seq()), (0, Some(2)));
    assert!(engine.is_caught_up(&desk) && !engine.is_over(&desk));
    desk.is_live = true;
    assert_eq!(done(&mut engine, &mut desk, 0, &[]), "send 0.91, ring", "once in a turn");
    assert_eq!(desk.sent[2], Header { made_by: 1, ..header(91) });
    desk.inputs[0].push_back(2);
    assert_eq!(
        turn(&mut engine, &mut desk, true),
        "send 0.2, commit 0.2, send 0.92, ring",
        "the end comes after the samples"
    );
    assert!(engine.is_over(&desk));
    desk.inputs[0].push_back(3);
    assert!(!engine.is_over(&desk));
    assert_eq!(turn(&mut engine, &mut desk, true), "send 0.3, commit 0.3, ring");
    assert!(engine.is_over(&desk));
    assert_eq!(engine.worker.heard, [Hearing::Silence, Hearing::End]);
}

#[test]
fn a_worker_hears_of_each_cut_once() {
    let mut desk = Desk { is_live: true, ..Desk::with(&[&[]]) };
    let mut engine = node(&mut desk, &[Numbers::OfWorker], PLAIN);
    for (is_cut_off, seqs) in [(true, &[][..]), (true, &[]), (false, &[]), (true, &[]), (true, &[7]), (true, &[])] {
        desk.is_cut_off = is_cut_off;
        done(&mut engine, &mut desk, 0, seqs);
    }
    assert_eq!(engine.worker.heard, [Hearing::CutOff, Hearing::Silence, Hearing::CutOff, Hearing::CutOff]);
}

#[test]
fn readers_are_woken_for_every_ninth_of_many_answers_and_at_the_end_of_a_turn() {
    let mut desk = Desk { is_hurried: true, ..Desk::with(&[&[]]) };
    let mut engine = node(&mut desk, &[Numbers::OfWorker], PLAIN);
    let mut bells = |seqs: &[u64], silent_at| {
        engine.worker.silent_at = silent_at;
        let said = done(&mut engine, &mut desk, 0, seqs);
        let bells = said.split(", ").filter(|said| !said.starts_with("commit") && !said.starts_with("begin"));
        bells.map(|said| &said[..1]).collect::<String>()
    };
    // The first answer may be a decision. The ninth of those that follow wakes the readers.
    assert_eq!(bells(&(0..12).collect::<Vec<_>>(), None), "sqsqsqsqsqsqsqsqssqsqsr");
    assert_eq!(bells(&(12..20).collect::<Vec<_>>(), None), "qsqsqsqsqsqsqsqsr", "the count begins with the turn");
    assert_eq!(bells(&[20, 21, 22], Some(21)), "qsrsr", "no answer wakes the readers of those before");
}

#[test]
fn counted_answers_to_several_inputs_have_gaps_where_samples_are_missing() {
    let mut desk = Desk::with(&[&[0, 1], &[0]]);
    let mut engine = node(&mut desk, &[Numbers::Counted], SAVING);
    desk.said();
    let said = done(&mut engine, &mut desk, 0, &[]);
    let expected = "save, send 0.0, commit 0.0, save, send 0.1, commit 1.0, save, send 0.2, commit 0.1, ring";
    assert_eq!(said, expected, "the inputs have turns");
    desk.n_missing = 1;
    assert_eq!(done(&mut engine, &mut desk, 0, &[3]), "save, send 0.4, commit 0.3, ring");
    assert_eq!(done(&mut engine, &mut desk, 0, &[4]), "save, send 0.5, commit 0.4, ring");
    desk.skipped = Some(5);
    assert_eq!(done(&mut engine, &mut desk, 0, &[5, 6]), "save, commit 0.5, save, send 0.7, commit 0.6, ring");
    desk.has_partners = true;
    let said = done(&mut engine, &mut desk, 0, &[9]);
    assert_eq!(said, "save, send 0.8, commit 0.9, answered Some(9), ring", "the saved state includes it");
    assert!(desk.sent.iter().all(|sent| sent.epoch == desk.sent[0].epoch && sent.epoch != 3));
    let names = desk.names.take();
    assert!(names[0].seq == names[1].seq && names[0] != names[1], "the launcher tells them apart: {names:?}");
}

#[test]
fn an_answer_that_breaks_a_promise_of_its_output_is_refused() {
    let refusal = |inputs: &[&[u64]], numbers, outputs: &[usize]| {
        let mut desk = Desk { is_live: true, ..Desk::with(inputs) };
        let mut engine = node(&mut desk, &[numbers], SAVING);
        (engine.worker.outputs, engine.worker.speaks) = (outputs.into(), true);
        engine.work(&mut desk, false).expect_err("refused").to_string()
    };
    assert!(refusal(&[&[0]], Numbers::OfSample, &[]).contains("gave 0 answers on the output x"));
    assert!(refusal(&[&[0]], Numbers::OfSample, &[0, 0]).contains("gave 2 answers on the output x"));
    assert!(refusal(&[&[]], Numbers::OfSample, &[0]).contains("answered silence on the output x"));
    assert!(refusal(&[&[0], &[]], Numbers::OfInput(Some(1)), &[0]).contains("answered a on the output x"));
    assert!(refusal(&[&[], &[0]], Numbers::OfInput(Some(1)), &[]).contains("one to each sample of b"));
    assert!(refusal(&[&[0]], Numbers::OfInput(None), &[0]).contains("answered a on the output x"));
}

#[test]
fn a_batch_is_asked_at_once_unless_a_sample_is_suspect_or_the_worker_refuses() {
    for (wants_one_by_one, has_suspect, skipped, expected) in [
        (false, false, None, vec![vec![0, 1, 2], vec![3]]),
        (true, false, None, vec![vec![0, 1, 2], vec![0], vec![1], vec![2], vec![3]]),
        (false, true, None, vec![vec![0], vec![1], vec![2], vec![3]]),
        (false, false, Some(1), vec![vec![0], vec![2, 3]]),
    ] {
        let mut desk = Desk { skipped, ..Desk::with(&[&[0, 1, 2, 3]]) };
        let mut engine = node(&mut desk, &[Numbers::OfSample], Manner { n_batch: 3, has_suspect, ..PLAIN });
        engine.worker.wants_one_by_one = wants_one_by_one;
        let said = done(&mut engine, &mut desk, 0, &[]);
        assert_eq!(said.matches("commit").count(), 4, "{said}");
        let named: Vec<u64> = desk.names.take().iter().map(|name| name.seq).collect();
        assert_eq!(named, expected.iter().map(|batch| batch[0]).collect::<Vec<u64>>());
        assert_eq!((engine.worker.asked, desk.is_at_work.get()), (expected, false));
    }
}

/// They exist nowhere else.
#[test]
fn samples_that_were_asked_and_not_answered_go_back_at_a_hand_over() {
    let mut desk = Desk { is_full: true, ..Desk::with(&[&[0, 1, 2]]) };
    let mut engine = node(&mut desk, &[Numbers::OfSample], Manner { n_batch: 3, ..PLAIN });
    desk.said();
    assert_eq!(engine.work(&mut desk, false).expect("it works"), Sent::GaveWay);
    engine.hand_over(&mut desk);
    assert_eq!(desk.said(), "ring, back 0.0, back 0.1, back 0.2");
    assert!(!engine.is_active() && engine.worker.works.is_empty());
}

#[test]
fn a_late_sample_expires_and_ends_the_graph_once_where_the_file_says_so() {
    for (on_late, is_live, valid_nanos, n_unfit) in [
        (OnLate::Stop, true, 1, 1),
        (OnLate::Hold, true, 1, 0),
        (OnLate::Count, true, 0, 0),
        (OnLate::Stop, false, 0, 0),
    ] {
        let mut desk = Desk { is_live, late: Some((on_late, 5)), ..Desk::with(&[&[]]) };
        let mut engine = node(&mut desk, &[Numbers::OfSample], PLAIN);
        let said = done(&mut engine, &mut desk, 0, &[0, 1]);
        assert_eq!(said.matches("unfit 0").count(), n_unfit, "{said}");
        assert_eq!(said.matches("unfit").count(), n_unfit, "{said}");
        assert!(desk.sent.iter().all(|sent| sent.valid_nanos == valid_nanos));
    }
}

/// Readers of the first one have sample 1, those of the second one do not. A recording may come back to a number.
#[test]
fn an_output_that_is_ahead_of_another_sends_nothing_twice() {
    let mut desk = Desk { known: [Some(id(1)), Some(id(0))], has_partners: true, ..Desk::with(&[&[]]) };
    let mut engine = node(&mut desk, &[Numbers::OfSample, Numbers::OfSample], PLAIN);
    assert_eq!(desk.said(), "begin 0 false, begin 1 false");
    let said = done(&mut engine, &mut desk, 0, &[1, 2, 1]);
    let of_1 = "send 1.1, commit 0.1, answered Some(0)";
    let of_2 = "send 0.2, send 1.2, commit 0.2, answered Some(0)";
    let again = "send 0.1, send 1.1, commit 0.1, answered Some(0)";
    assert_eq!(said, format!("{of_1}, {of_2}, {again}, ring, ring"));
}

#[test]
fn a_standby_sends_its_answers_beside_and_is_warm_after_some_samples() {
    let mut desk = Desk::with(&[&[0, 1, 2, 3, 4, 5, 6, 7, 8]]);
    let book = Book::new(vec![Input::new("a", false)], vec![Output::new("x", Numbers::OfSample)]);
    let worker = Scribe { outputs: vec![0], ..Scribe::default() };
    let mut engine = Engine::begin(&mut desk, worker, book, PLAIN, true).expect("it begins");
    engine.look_on(&mut desk).expect("it looks on");
    let beside: Vec<String> = (0..9).map(|seq| format!("beside 0.{seq}")).collect();
    assert_eq!(desk.said(), format!("{}, warm 8, {}", beside[..8].join(", "), beside[8]));
    assert!(!engine.is_active());
}

/// Two outputs with answers of 1,556 bytes that were sent and are kept, and those of the second one take more.
fn book_of_kept_answers(desk: &mut Desk) -> Book {
    let outputs = ["x", "y"].map(|name| Output::new(name, Numbers::Counted));
    let mut book = Book::new(vec![], outputs.into());
    for (output, seq) in [(0, 1), (1, 0), (1, 1)] {
        book.keep(output, &header(seq), &[0; size_of::<Header>()], &[0; 1500]);
        book.outputs[output].kept.has_sent_next();
    }
    desk.sent = vec![header(1)];
    book
}

#[test]
fn room_is_waited_for_where_most_is_kept_until_there_is_enough() {
    for (n_bytes, is_full, expected) in [
        (0, true, "wait 1.0"),
        (0, false, "wait 1.0"),
        (1000, false, "wait 1.0, wait 1.1"),
        (9000, false, "wait 1.0, wait 1.1, wait 0.1"),
    ] {
        let mut desk = Desk { is_full, ..Desk::default() };
        let mut book = book_of_kept_answers(&mut desk);
        let sent = book.wait_for_room(&mut desk, n_bytes).expect("no error");
        assert_eq!((desk.said().as_str(), sent), (expected, if is_full { Sent::GaveWay } else { Sent::Yes }));
        let mut book = book_of_kept_answers(&mut desk);
        desk.known = [None; 2];
        let state = |bytes: &mut Vec<u8>| {
            bytes.extend(vec![0; n_bytes]);
            Ok(())
        };
        let sent = book.save(&mut desk, Yields::ToOthers, state).expect("no error");
        let saved = if is_full { "" } else { ", save" };
        assert_eq!(desk.said(), format!("{expected}{saved}"));
        assert_eq!(sent, if is_full { Sent::GaveWay } else { Sent::Yes });
    }
}

#[test]
fn a_source_goes_on_after_its_saved_samples_unless_it_has_sent_more_since() {
    let mut desk = Desk::default();
    let mut book = book_of_kept_answers(&mut desk);
    assert!(!book.is_done);
    book.is_done = true;
    assert_eq!(book.save(&mut desk, Yields::ToOthers, |_| Ok(())).expect("no error"), Sent::Yes);
    for (sent, is_used) in [(1, true), (2, false)] {
        desk.sent = vec![header(sent)];
        let restored = book.restore(&desk, true).expect("it can be read");
        assert_eq!((restored.is_some(), book.is_done), (is_used, is_used));
        assert_eq!(book.next_key(1), id(sent + 1));
    }
    assert_eq!(header_of(&with_header(vec![0; 80], &header(7))), header(7));
    // A source in Rust has saved bytes of its own.
    desk.saved = Some(b"mine".to_vec());
    assert_eq!(book.restore(&desk, true).expect("not read"), None);
    assert!(book.restore(&desk, false).is_err());
}
