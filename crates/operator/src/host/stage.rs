//! A hosted operator that answers samples.
//!
//! It is one of two kinds. One without state and with one input answers each sample on each output under the number of the
//! sample: nothing is saved, and after a restart it answers again what readers may lack. Any other is saved after each sample,
//! with its answers and the places of all its inputs, before the answers are sent.

use std::time::Instant;

use blindgrasp_messages::Header;

use super::child::{Answer, Program, ProgramError};
use super::ports::{self, PartnerPort, RawAnswer, RawSample};
use super::protocol::{Ask, Hears, MORE, Part, Ready, Work};
use super::store::{Input, Output, Store, look_for_readers};
use super::{listen, log};
use crate::cursors::SampleId;
use crate::description::OperatorDescription;
use crate::identity::stable_hash;
use crate::monotonic_nanos;
use crate::operator::{Operator, TICK, Task, Turn, run_in_turn};
use crate::partner::Partners;
use crate::port::Sent;
use crate::stage::{N_WARM, ROOM_PAUSE, STATE_OF_HAND_OVER, arrival_nanos, too_late};
use crate::wiring::{Clock, Command, InputCounts, OnLate};

/// The most samples that a program gets at once.
const MAX_BATCH: usize = 256;

/// A partner input, and its number in the description.
type NumberedPartner = (usize, Box<dyn PartnerPort>);

struct HostedStage {
    operator: Operator,
    child: Program,
    ready: Ready,
    inputs: Vec<Input>,
    outputs: Vec<Output>,
    partners: Partners,
    partner_ports: Vec<NumberedPartner>,
    /// Of a stage whose answers are saved.
    store: Option<Store>,
    /// The program numbers its answers: it has a state, one input and one output.
    numbers_itself: bool,
    /// The state of the program after the last message.
    state: Vec<u8>,
    /// The saved state with which it has handed over, in case that its replacement fails.
    handed_over: Option<Vec<u8>>,
    /// When the program wants to hear of silence.
    deadline_nanos: Option<u64>,
    /// The input whose turn it is.
    turn: usize,
    last: Option<SampleId>,
    is_active: bool,
    /// It has said that the graph must end.
    is_unfit: bool,
    /// The program has heard that no sample can come.
    is_cut_off: bool,
    has_heard_end: bool,
    n_looked_on: u64,
    last_look: Instant,
    is_drained: bool,
    /// So many samples are given to the program one by one, so that the launcher learns on which one it dies.
    n_one_by_one: usize,
}

/// Runs the stage of a program until the operator is asked to stop.
///
/// # Errors
/// The reason of the program or of a port.
pub(super) fn run(
    operator: &Operator,
    description: &OperatorDescription,
    ready: Ready,
    child: Program,
) -> anyhow::Result<()> {
    let (inputs, partner_ports) = open_inputs(operator, description)?;
    let outputs = open_outputs(operator, description, &ready, true)?;
    // An optional input that is not connected changes nothing of how answers are numbered.
    let has_one_input = description.inputs.iter().filter(|port| !port.partner).count() == 1 && inputs.len() == 1;
    let is_alike =
        !ready.has_state && has_one_input && !outputs.is_empty() && (description.answers_each || outputs.len() == 1);
    let mut stage = HostedStage {
        operator: operator.clone(),
        child,
        numbers_itself: !is_alike && has_one_input && outputs.len() == 1,
        inputs,
        outputs,
        partners: Partners::of(operator),
        partner_ports,
        store: if is_alike { None } else { Some(Store::new(operator)?) },
        ready,
        state: Vec::new(),
        handed_over: None,
        deadline_nanos: None,
        turn: 0,
        last: None,
        is_active: !operator.begins_as_standby(),
        is_unfit: false,
        is_cut_off: false,
        has_heard_end: false,
        n_looked_on: 0,
        last_look: Instant::now(),
        is_drained: false,
        n_one_by_one: if operator.has_suspect() { MAX_BATCH } else { 0 },
    };
    if stage.is_active {
        stage.take_over(false)?;
    } else {
        stage.stand_by()?;
    }
    stage.connect()?;
    run_in_turn(vec![Box::new(stage)])
}

/// The inputs that are connected, and the partner inputs among them.
///
/// # Errors
/// The reason of a port.
pub(super) fn open_inputs(
    operator: &Operator,
    description: &OperatorDescription,
) -> anyhow::Result<(Vec<Input>, Vec<NumberedPartner>)> {
    let (mut inputs, mut partners) = (Vec::new(), Vec::new());
    for (idx, port) in description.inputs.iter().enumerate() {
        if !operator.has_input(&port.name) {
            continue;
        }
        if port.partner {
            partners.push((idx, ports::open_partner(operator, &port.name, &port.type_name)?));
            continue;
        }
        let onlooker = if operator.begins_as_standby() && !port.feedback {
            Some(ports::open_onlooker(operator, &port.name, &port.type_name)?)
        } else {
            None
        };
        inputs.push(Input {
            idx,
            name: port.name.clone(),
            is_feedback: port.feedback,
            port: ports::open_input(operator, &port.name, &port.type_name)?,
            onlooker,
            last: None,
            counts: InputCounts::default(),
        });
    }
    Ok((inputs, partners))
}

/// The outputs. Those of a standby are also compared, if `is_compared`.
///
/// # Errors
/// The reason of a port.
pub(super) fn open_outputs(
    operator: &Operator,
    description: &OperatorDescription,
    ready: &Ready,
    is_compared: bool,
) -> anyhow::Result<Vec<Output>> {
    let is_compared = is_compared && operator.begins_as_standby();
    let mut outputs = Vec::new();
    for (idx, port) in description.outputs.iter().enumerate() {
        let max_items = ready.max_items.get(&port.name).copied();
        let answers = ready.answers.get(&port.name);
        let answers = answers.and_then(|input| description.inputs.iter().position(|port| port.name == *input));
        let opened = ports::open_output(operator, &port.name, &port.type_name, max_items, is_compared)?;
        outputs.push(Output::new(idx, &port.name, max_items, answers, opened));
    }
    Ok(outputs)
}

impl Task for HostedStage {
    fn operator(&self) -> &Operator {
        &self.operator
    }

    fn begin(&mut self) {
        let identity = std::mem::take(&mut self.ready.identity);
        self.operator.ready_with(identity, self.store.is_some());
    }

    fn step(&mut self) -> anyhow::Result<Turn> {
        let turn = self.take_turn();
        log(&self.operator, self.child.lines());
        turn
    }
}

impl HostedStage {
    fn take_turn(&mut self) -> anyhow::Result<Turn> {
        if self.is_drained {
            return self.wait_for_the_end();
        }
        // The request is read before the input: samples that were sent before the request are still answered.
        let stop = self.operator.should_stop();
        self.obey()?;
        let mut sent = Sent::Yes;
        if self.is_active {
            sent = self.work(stop)?;
        } else {
            self.look_on()?;
        }
        if self.operator.should_quit() || (stop && (!self.is_active || self.is_caught_up())) {
            self.look()?;
            self.partners.have_ended();
            self.operator.report_drained();
            self.is_drained = true;
            return self.wait_for_the_end();
        }
        if self.last_look.elapsed() >= TICK {
            self.look()?;
        }
        if self.is_interrupted() {
            return Ok(Turn::Interrupted);
        }
        Ok(Turn::Idle(match sent {
            Sent::GaveWay => Some(Instant::now() + ROOM_PAUSE),
            Sent::Yes => self.deadline(),
        }))
    }

    /// Keeps the ports open until the launcher needs nothing more.
    fn wait_for_the_end(&mut self) -> anyhow::Result<Turn> {
        if self.operator.should_quit() {
            return Ok(Turn::Ended);
        }
        look_for_readers(&mut self.outputs)?;
        Ok(Turn::Idle(None))
    }

    fn look(&mut self) -> anyhow::Result<()> {
        self.last_look = Instant::now();
        look_for_readers(&mut self.outputs)?;
        self.connect()?;
        self.partners.report(&self.operator);
        listen(&self.operator, &mut self.child)?;
        Ok(())
    }

    fn connect(&mut self) -> anyhow::Result<()> {
        for input in &mut self.inputs {
            input.port.connect()?;
        }
        Ok(self.partners.connect()?)
    }

    fn is_interrupted(&self) -> bool {
        self.operator.has_command() || self.operator.should_quit()
    }

    /// Whether all samples that are not feedback are answered.
    fn is_caught_up(&self) -> bool {
        self.inputs.iter().all(|input| input.is_feedback || input.port.is_caught_up()) && self.partners.is_caught_up()
    }

    /// When it must look again, if no sample comes before.
    fn deadline(&self) -> Option<Instant> {
        let partners = self.partners.deadline();
        if !self.is_active {
            return partners;
        }
        let silence = if self.operator.clock() == Clock::Machine { self.deadline_nanos } else { None };
        let held = self.inputs.iter().filter_map(|input| input.port.hold_deadline());
        held.chain(partners).chain(silence.map(crate::instant_of)).min()
    }

    fn obey(&mut self) -> anyhow::Result<()> {
        while let Some(command) = self.operator.next_command() {
            match command {
                Command::TakeOver { is_handed_over } => {
                    self.inputs.iter_mut().for_each(|input| input.onlooker = None);
                    self.outputs.iter_mut().for_each(|output| output.port.end_comparison());
                    self.take_over(is_handed_over)?;
                    self.is_active = true;
                    self.operator.took_over();
                }
                Command::HandOver => {
                    self.is_active = false;
                    if let Some(store) = &mut self.store {
                        self.handed_over = store.restore(&mut self.inputs, &mut self.outputs, false, false)?.state;
                    }
                    self.operator.handed_over();
                }
                Command::Set { id, params } => {
                    let from_seq = self.last.map(|last| last.seq + 1);
                    let outcome = super::set(&mut self.child, &params)?;
                    if outcome.is_ok() {
                        self.operator.has_params(&params);
                    }
                    self.operator.has_set(id, outcome.map_err(anyhow::Error::msg), from_seq);
                }
                Command::Go
                | Command::NodeEnded { .. }
                | Command::TakeNoMore { .. }
                | Command::Drain
                | Command::Quit => {}
            }
        }
        Ok(())
    }

    /// Answers the samples that are there, and tells the program of silence or the end of the stream.
    fn work(&mut self, stop: bool) -> anyhow::Result<Sent> {
        if self.send_saved()? == Sent::GaveWay {
            return Ok(Sent::GaveWay);
        }
        // Also while no main sample comes: their writers wait for this reader.
        self.partners.take_in(true, stop)?;
        let mut n_idle = 0;
        while !self.is_interrupted() && n_idle < self.inputs.len() {
            // In turn, so that no input waits for another.
            let idx = self.turn;
            self.turn = (self.turn + 1) % self.inputs.len();
            let samples = self.take(idx)?;
            let Some(first) = samples.first() else {
                n_idle += 1;
                continue;
            };
            n_idle = 0;
            self.operator.beat();
            if !self.partners.choose(&first.header, true, stop)? {
                self.inputs[idx].port.put_back(samples);
                return Ok(Sent::Yes);
            }
            if self.answer(idx, samples)? == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
        }
        if self.is_interrupted() {
            return Ok(Sent::Yes);
        }
        self.hear_of_silence(stop)
    }

    fn hear_of_silence(&mut self, stop: bool) -> anyhow::Result<Sent> {
        if stop && self.is_caught_up() {
            if self.ready.hears.contains(&Hears::End) && !std::mem::replace(&mut self.has_heard_end, true) {
                return self.hear(Ask::End);
            }
            return Ok(Sent::Yes);
        }
        let was_cut_off = self.is_cut_off;
        self.is_cut_off = self.inputs.iter().any(|input| input.port.is_cut_off());
        if self.is_cut_off {
            if self.ready.hears.contains(&Hears::CutOff) && !was_cut_off {
                return self.hear(Ask::CutOff);
            }
            return Ok(Sent::Yes);
        }
        let is_due = self.deadline_nanos.is_some_and(|deadline| deadline <= monotonic_nanos());
        if is_due && self.operator.clock() == Clock::Machine {
            return self.hear(Ask::Silence);
        }
        Ok(Sent::Yes)
    }

    /// Tells the program something that is no sample, and sends what it answers.
    fn hear(&mut self, ask: Ask) -> anyhow::Result<Sent> {
        self.child.ask(ask, monotonic_nanos(), 0, &[], std::iter::empty())?;
        let work = self.child.answer(ask)?.done()?;
        self.deadline_nanos = work.deadline_nanos();
        if self.store.is_none() {
            if work.parts.is_empty() {
                return Ok(Sent::Yes);
            }
            anyhow::bail!(
                "its program answered {ask:?}, and has no state: expected no answer, or a stage with a state"
            );
        }
        let answers = self.answers(None, &work.parts)?;
        self.take_state(work.state);
        for (idx, answer) in answers {
            self.outputs[idx].keep(answer);
        }
        if self.save()? == Sent::GaveWay {
            return Ok(Sent::GaveWay);
        }
        self.send_saved()
    }

    /// The samples of an input that are there, as many as are answered at once.
    fn take(&mut self, idx: usize) -> anyhow::Result<Vec<RawSample>> {
        let is_single = self.store.is_some() || !self.partner_ports.is_empty() || self.n_one_by_one > 0;
        let n_most = if is_single { 1 } else { self.ready.batch.clamp(1, MAX_BATCH) };
        let mut samples = Vec::with_capacity(1);
        while samples.len() < n_most
            && let Some(sample) = self.inputs[idx].port.receive()?
        {
            samples.push(sample);
        }
        Ok(samples)
    }

    /// Answers samples of an input. `GaveWay`: those that were not answered are put back.
    fn answer(&mut self, idx: usize, samples: Vec<RawSample>) -> anyhow::Result<Sent> {
        let works = self.ask(idx, &samples)?;
        let mut rest = samples.into_iter();
        for work in works {
            let Some(sample) = rest.next() else { break };
            self.judge_lateness(&sample);
            if self.send_answers(idx, &sample, work)? == Sent::GaveWay {
                // Another instance finds the sample in its own queue; this one finds it here if it is active again. A saved
                // state includes it, and then it is dropped.
                self.inputs[idx].port.put_back(std::iter::once(sample).chain(rest).collect());
                return Ok(Sent::GaveWay);
            }
            self.last = Some(sample.key());
            self.inputs[idx].port.commit(&sample);
            self.n_one_by_one = self.n_one_by_one.saturating_sub(1);
            self.partners.have_answered(self.needed_from(idx));
        }
        Ok(Sent::Yes)
    }

    /// The last sample of an input that an instance after this one will not answer again.
    fn needed_from(&self, idx: usize) -> Option<SampleId> {
        if self.store.is_some() {
            return self.inputs[idx].last;
        }
        let readers = self.outputs.iter().filter(|output| output.port.has_readers());
        let answered = readers.map(|output| output.port.answered_by_readers());
        let port = &self.inputs[idx].port;
        let least = answered.reduce(|a, b| if a.is_some_and(|a| port.is_after(a, b)) { b } else { a });
        least.unwrap_or(self.last)
    }

    /// The answers of the program to each sample; `None` to one that has killed earlier instances again and again. The launcher
    /// learns on which of them the process dies.
    fn ask(&mut self, idx: usize, samples: &[RawSample]) -> anyhow::Result<Vec<Option<Work>>> {
        let is_asked: Vec<bool> =
            samples.iter().map(|sample| !self.operator.skips(self.name_of(idx, sample))).collect();
        let asked: Vec<&RawSample> =
            samples.iter().zip(&is_asked).filter(|(_, is_asked)| **is_asked).map(|(sample, _)| sample).collect();
        let mut works = self.ask_all(idx, &asked)?.into_iter();
        Ok(is_asked.into_iter().map(|is_asked| if is_asked { works.next() } else { None }).collect())
    }

    fn ask_all(&mut self, idx: usize, samples: &[&RawSample]) -> anyhow::Result<Vec<Work>> {
        let Some(first) = samples.first() else { return Ok(Vec::new()) };
        self.operator.works_on(Some(self.name_of(idx, first)));
        let mut partners = Vec::new();
        for (port, partner) in &self.partner_ports {
            if let Some((head, items)) = partner.sample() {
                partners.push((*port, head, items));
            }
        }
        let port = self.inputs[idx].idx;
        for (n, sample) in samples.iter().enumerate() {
            let flags = if n + 1 < samples.len() { MORE } else { 0 };
            let own = std::iter::once((port, &sample.head[..], &sample.items[..]));
            let others = partners.iter().map(|(port, head, items)| (*port, &head[..], &items[..]));
            self.child.ask(
                Ask::Sample,
                arrival_nanos(&self.operator, &sample.header),
                flags,
                &[],
                own.chain(others),
            )?;
        }
        let mut works = Vec::with_capacity(samples.len());
        for _ in samples {
            match self.child.answer(Ask::Sample)? {
                Answer::OneByOne if works.is_empty() && samples.len() > 1 => {
                    let mut one_by_one = Vec::with_capacity(samples.len());
                    for sample in samples {
                        one_by_one.extend(self.ask_all(idx, std::slice::from_ref(sample))?);
                    }
                    return Ok(one_by_one);
                }
                answer => works.push(answer.done()?),
            }
        }
        self.operator.works_on(None);
        if let Some(last) = works.last() {
            self.deadline_nanos = last.deadline_nanos();
        }
        Ok(works)
    }

    /// The name of a sample for the launcher, which knows nothing of inputs: two inputs may have samples of one number.
    fn name_of(&self, idx: usize, sample: &RawSample) -> SampleId {
        let key = sample.key();
        if self.inputs.len() == 1 {
            return key;
        }
        SampleId { epoch: key.epoch ^ stable_hash(&[&self.inputs[idx].name]), seq: key.seq }
    }

    fn judge_lateness(&mut self, sample: &RawSample) {
        let Some((OnLate::Stop, age_nanos)) = sample.late else { return };
        if self.operator.clock() == Clock::Machine && !std::mem::replace(&mut self.is_unfit, true) {
            self.operator.is_unfit(too_late(sample.header.seq, age_nanos));
        }
    }

    /// Sends the answers to a sample, and saves them before if it is a stage that is saved.
    fn send_answers(&mut self, idx: usize, sample: &RawSample, work: Option<Work>) -> anyhow::Result<Sent> {
        let is_skipped = work.is_none();
        if is_skipped {
            // Readers find a gap: nothing is lifted on it.
            let seq = sample.header.seq;
            tracing::error!("sample {seq} is not answered: it has killed this operator again and again");
        }
        let work = work.unwrap_or_default();
        if self.store.is_none() {
            return if is_skipped { Ok(Sent::Yes) } else { self.send_alike(idx, sample, &work.parts) };
        }
        self.find_gap(idx, sample, is_skipped);
        let answers = self.answers(Some((idx, sample)), &work.parts)?;
        if !is_skipped {
            self.require_answers(idx, &answers)?;
            self.take_state(work.state);
        }
        for (idx, answer) in answers {
            self.outputs[idx].keep(answer);
        }
        let input = &mut self.inputs[idx];
        // A sample that goes back in order is answered, but does not move the cursor.
        if input.port.is_after(sample.key(), input.last) {
            input.last = Some(sample.key());
        }
        input.counts = sample.counts;
        if self.save()? == Sent::GaveWay {
            return Ok(Sent::GaveWay);
        }
        self.send_saved()
    }

    /// Readers of an output that counts must find a gap of an input as well.
    fn find_gap(&mut self, idx: usize, sample: &RawSample, is_skipped: bool) {
        let has_gap = is_skipped || sample.counts.n_missing > self.inputs[idx].counts.n_missing;
        if !has_gap || self.numbers_itself {
            return;
        }
        for output in self.outputs.iter_mut().filter(|output| output.answers.is_none()) {
            if let Some(last) = &mut output.last {
                last.seq += 1;
            }
        }
    }

    fn require_answers(&self, idx: usize, answers: &[(usize, RawAnswer)]) -> anyhow::Result<()> {
        let input = &self.inputs[idx];
        for (output_idx, output) in self.outputs.iter().enumerate() {
            let n_answers = answers.iter().filter(|(at, _)| *at == output_idx).count();
            if output.answers == Some(input.idx) && n_answers != 1 {
                anyhow::bail!(
                    "it gave {n_answers} answers on the output {}, expected one to each sample of {}",
                    output.name,
                    input.name
                );
            }
        }
        Ok(())
    }

    /// Sends the answers of a stage that is not saved.
    fn send_alike(&mut self, idx: usize, sample: &RawSample, parts: &[Part]) -> anyhow::Result<Sent> {
        let answers = self.answers(Some((idx, sample)), parts)?;
        for (output_idx, output) in self.outputs.iter().enumerate() {
            let n_answers = answers.iter().filter(|(at, _)| *at == output_idx).count();
            if n_answers != 1 {
                anyhow::bail!(
                    "a stage without state answers every sample on every output, with a fault where it has nothing to say; it \
                     gave {n_answers} answers on the output {}",
                    output.name
                );
            }
        }
        let is_checked = self.ready.hears.contains(&Hears::Check);
        let has_others = self.outputs.len() > 1;
        for (output_idx, answer) in answers {
            let output = &mut self.outputs[output_idx];
            // One output may be ahead of another: its readers have this answer.
            if has_others && !self.inputs[idx].port.is_after(sample.key(), output.known) {
                continue;
            }
            let (operator, child) = (&self.operator, &mut self.child);
            let mut failure = None;
            let mut check = |header: &Header, head: &mut Vec<u8>, items: &[u8]| {
                failure = checked(child, output.idx, head, items, arrival_nanos(operator, header)).err();
                failure.is_none()
            };
            let check: Option<ports::Check<'_>> = if is_checked { Some(&mut check) } else { None };
            let sent = output.port.send(&answer, &mut || operator.should_yield(), check)?;
            if let Some(failure) = failure {
                return Err(failure.into());
            }
            if sent == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
            output.known = None;
        }
        Ok(Sent::Yes)
    }

    /// The answers of the program to a sample, or to something else, under the headers with which they are sent.
    fn answers(&mut self, to: Option<(usize, &RawSample)>, parts: &[Part]) -> anyhow::Result<Vec<(usize, RawAnswer)>> {
        let mut answers = Vec::with_capacity(parts.len());
        for part in parts {
            let output_idx = output_of(&self.outputs, part)?;
            let header = self.header_of_answer(output_idx, to, part)?;
            let head = self.outputs[output_idx].port.with_header(&part.head, header);
            answers.push((output_idx, RawAnswer { header, head, items: part.items.clone() }));
        }
        Ok(answers)
    }

    fn header_of_answer(&mut self, idx: usize, to: Option<(usize, &RawSample)>, part: &Part) -> anyhow::Result<Header> {
        let own = self.outputs[idx].port.header_of(&part.head).unwrap_or_default();
        // A header that the program left empty is that of the sample.
        let is_empty = own == Header::default();
        let mut header = match to {
            Some((_, sample)) if !self.numbers_itself || is_empty => sample.header,
            None if is_empty => {
                anyhow::bail!("it answered silence with an empty header: expected one with stamp and hand")
            }
            _ => own,
        };
        header.made_by = self.operator.made_by(to.map_or(own.made_by, |(_, sample)| sample.header.made_by));
        if self.store.is_none() || self.numbers_itself {
            return Ok(header);
        }
        let output = &self.outputs[idx];
        if let Some(answered) = output.answers {
            let input = to.map(|(input, _)| &self.inputs[input]);
            if input.is_none_or(|input| input.idx != answered) {
                let found = input.map_or("silence", |input| input.name.as_str());
                anyhow::bail!("it answered {found} on the output {}, which answers another input", output.name);
            }
            return Ok(header);
        }
        let next = next_key(&self.outputs, idx);
        self.outputs[idx].last = Some(next);
        (header.epoch, header.seq) = (next.epoch, next.seq);
        Ok(header)
    }

    fn take_state(&mut self, state: Vec<u8>) {
        if self.ready.has_state {
            self.state = state;
        }
    }

    fn save(&mut self) -> anyhow::Result<Sent> {
        match &mut self.store {
            Some(store) => store.save(&self.inputs, &mut self.outputs, &self.state, true),
            None => Ok(Sent::Yes),
        }
    }

    fn send_saved(&mut self) -> anyhow::Result<Sent> {
        let Some(store) = &self.store else { return Ok(Sent::Yes) };
        let is_checked = self.ready.hears.contains(&Hears::Check);
        let (operator, child) = (&self.operator, &mut self.child);
        let mut failure = None;
        let sent = store.send(&mut self.outputs, is_checked, |output, header, head, items| {
            failure = checked(child, output, head, items, arrival_nanos(operator, header)).err();
            failure.is_none()
        })?;
        match failure {
            Some(failure) => Err(failure.into()),
            None => Ok(sent),
        }
    }

    fn stand_by(&mut self) -> anyhow::Result<()> {
        self.restore(false)?;
        if self.store.is_some() {
            for input in &mut self.inputs {
                if let (Some(onlooker), Some(last)) = (&mut input.onlooker, input.last) {
                    onlooker.look_on_from(last);
                }
            }
        }
        Ok(())
    }

    /// Takes over what was saved, and gives the program its state.
    fn restore(&mut self, is_handed_over: bool) -> anyhow::Result<()> {
        let Some(store) = &mut self.store else { return Ok(()) };
        let restored = store.restore(&mut self.inputs, &mut self.outputs, is_handed_over, false)?;
        if self.ready.has_state {
            let own = self.handed_over.take();
            if restored.state.is_none() && own.is_some() {
                tracing::warn!("{STATE_OF_HAND_OVER}");
            }
            let work = super::restore(&mut self.child, restored.state.or(own).as_deref())?;
            self.deadline_nanos = work.deadline_nanos();
            self.state = work.state;
        }
        Ok(())
    }

    fn take_over(&mut self, is_handed_over: bool) -> anyhow::Result<()> {
        self.partners.take_over();
        self.is_cut_off = false;
        for output in &mut self.outputs {
            output.known = output.port.begin(is_handed_over);
        }
        if self.store.is_some() {
            self.restore(is_handed_over)?;
            for input in &mut self.inputs {
                input.port.take_over_at(input.last, input.counts);
            }
            self.last = self.inputs.first().and_then(|input| input.last);
            return Ok(());
        }
        // A later instance with a state must not go on with an old one.
        self.operator.forget_state();
        self.last = self.least_known();
        self.inputs[0].port.take_over(self.last);
        Ok(())
    }

    /// The last sample whose answers all readers of all outputs have.
    fn least_known(&self) -> Option<SampleId> {
        let known: Option<Vec<SampleId>> = self.outputs.iter().map(|output| output.known).collect();
        let input = &self.inputs[0].port;
        known?.into_iter().reduce(|least, key| if input.is_after(least, Some(key)) { key } else { least })
    }

    /// Computes live samples beside the active instance.
    fn look_on(&mut self) -> anyhow::Result<()> {
        for idx in 0..self.inputs.len() {
            while !self.operator.has_command() && !self.operator.should_stop() {
                let has_begun_from_state = self.store.is_some() && self.inputs[idx].last.is_some();
                let Some(onlooker) = &mut self.inputs[idx].onlooker else { break };
                let Some(sample) = onlooker.receive()? else { break };
                self.operator.beat();
                if has_begun_from_state && sample.counts.n_missing > 0 {
                    // Its queue has overflowed: the state does not include the samples before this one, the saved one does.
                    onlooker.put_back(vec![sample]);
                    return self.stand_by();
                }
                if !self.partners.choose(&sample.header, false, false)? {
                    onlooker.put_back(vec![sample]);
                    return Ok(());
                }
                let Some(work) = self.ask(idx, std::slice::from_ref(&sample))?.pop().flatten() else { continue };
                for (output, answer) in self.answers(Some((idx, &sample)), &work.parts)? {
                    self.outputs[output].port.send_beside(&answer)?;
                }
                self.n_looked_on += 1;
                if self.n_looked_on == N_WARM {
                    self.operator.warm(N_WARM);
                }
            }
        }
        Ok(())
    }
}

/// The output that a part of an answer is for, if its lengths are right.
///
/// # Errors
/// There is no such output, or a length is that of another message.
pub(super) fn output_of(outputs: &[Output], part: &Part) -> anyhow::Result<usize> {
    let Some((idx, output)) = outputs.iter().enumerate().find(|(_, output)| output.idx == part.port) else {
        anyhow::bail!(
            "it answered on the output number {}, expected 0 to {}",
            part.port,
            outputs.len().saturating_sub(1)
        );
    };
    let Some(n_items) = output.port.n_items(&part.head, &part.items) else {
        anyhow::bail!(
            "its sample for the output {} has a head of {} bytes and items of {}, expected the lengths of its message",
            output.name,
            part.head.len(),
            part.items.len()
        );
    };
    if let Some(max_items) = output.max_items.filter(|max_items| n_items > *max_items) {
        anyhow::bail!(
            "its sample for the output {} has {n_items} items, expected at most max_items={max_items}",
            output.name
        );
    }
    Ok(idx)
}

/// The number of the next sample of an output that counts.
pub(super) fn next_key(outputs: &[Output], idx: usize) -> SampleId {
    if let Some(last) = outputs[idx].last {
        return SampleId { epoch: last.epoch, seq: last.seq + 1 };
    }
    // The first one of a node begins its epoch.
    let epoch = outputs.iter().find_map(|output| output.last).map_or_else(unix_nanos, |last| last.epoch);
    SampleId { epoch, seq: 0 }
}

fn unix_nanos() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Realtime);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Lets the program change a head right before it is sent.
fn checked(
    child: &mut Program,
    output: usize,
    head: &mut Vec<u8>,
    items: &[u8],
    now_nanos: u64,
) -> Result<(), ProgramError> {
    child.ask(Ask::Check, now_nanos, 0, &[], std::iter::once((output, &head[..], items)))?;
    let work = child.answer(Ask::Check)?.done()?;
    if let Some(part) = work.parts.into_iter().next() {
        if part.head.len() != head.len() {
            return Err(ProgramError::CheckedHead { found: part.head.len(), expected: head.len() });
        }
        *head = part.head;
    }
    Ok(())
}
