//! A hosted operator that answers samples.
//!
//! It is one of two kinds. One without state that answers each sample on each output under the number of the sample saves
//! nothing, and after a restart it answers again what readers may lack. Any other is saved after each sample, with its answers
//! and the places of all its inputs, before the answers are sent.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;

use blindgrasp_messages::Header;
use serde_json::{Map, Value};

use super::child::Program;
use super::ports::{self, HostedOutput, output_of};
use super::protocol::{Ask, Hears, MORE, Part, Ready, Work};
use super::{child, listen, log};
use crate::description::OperatorDescription;
use crate::engine::{Answer, Hearing, Manner, Taken, Worker, header_of, with_header};
use crate::monotonic_nanos;
use crate::operator::Operator;
use crate::partner::{self, PartnerInput};
use crate::port::UntypedSample;
use crate::runner::{self, InputPort, OutputPort, Ports};
use crate::saved::{Book, Input, Numbers, Output};

/// A partner input, and its number in the description.
type NumberedPartner = (usize, Rc<RefCell<PartnerInput>>);

/// The open ports of a program.
pub(super) struct HostedPorts {
    pub(super) site: Ports,
    pub(super) book: Book,
    /// The numbers of the inputs in the description.
    pub(super) inputs: Vec<usize>,
    pub(super) outputs: Vec<HostedOutput>,
    partners: Vec<NumberedPartner>,
}

/// A program as the worker of an [`Engine`](crate::engine::Engine).
struct ProgramWorker {
    operator: Operator,
    child: Program,
    has_state: bool,
    saves: bool,
    hears: Vec<Hears>,
    inputs: Vec<usize>,
    outputs: Vec<HostedOutput>,
    partners: Vec<NumberedPartner>,
    /// The answers to the samples that were asked, and before them those to the present one, with the numbers of their outputs.
    works: VecDeque<Vec<Part>>,
    answers: Vec<Part>,
    /// The state of the program after the last message.
    state: Vec<u8>,
    /// When the program wants to hear of silence.
    deadline_nanos: Option<u64>,
    /// The head that is sent just now.
    head: Vec<u8>,
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
    let mut ports = HostedPorts::open(operator, description, &ready, true)?;
    // An optional input that is not connected changes nothing of how answers are numbered.
    let has_one_input = description.inputs.iter().filter(|port| !port.partner).count() == 1 && ports.inputs.len() == 1;
    let n_outputs = ports.outputs.len();
    let answers_each = description.answers_each || !ready.has_state && n_outputs == 1;
    let is_each = answers_each && has_one_input && n_outputs > 0;
    for output in &mut ports.book.outputs {
        if is_each {
            output.numbers = Numbers::OfSample;
        } else if has_one_input && n_outputs == 1 && output.numbers == Numbers::Counted {
            output.numbers = Numbers::OfWorker;
        }
    }
    let manner = Manner {
        saves: ready.has_state || !is_each,
        answers_each: is_each,
        n_batch: ready.batch,
        has_suspect: operator.has_suspect(),
    };
    let worker = ProgramWorker {
        operator: operator.clone(),
        child,
        has_state: ready.has_state,
        saves: manner.saves,
        hears: ready.hears,
        inputs: ports.inputs,
        outputs: ports.outputs,
        partners: ports.partners,
        works: VecDeque::new(),
        answers: Vec::new(),
        state: Vec::new(),
        deadline_nanos: None,
        head: Vec::new(),
    };
    runner::run(ports.site, worker, ports.book, manner, ready.identity)
}

impl HostedPorts {
    /// Opens the ports that are connected. The outputs of a standby are also compared, if `is_compared`.
    ///
    /// # Errors
    /// The reason of a port.
    pub(super) fn open(
        operator: &Operator,
        description: &OperatorDescription,
        ready: &Ready,
        is_compared: bool,
    ) -> anyhow::Result<HostedPorts> {
        let is_standby = operator.begins_as_standby();
        let (mut inputs, mut partners) = (Vec::new(), Vec::new());
        let (mut input_ports, mut input_places): (Vec<InputPort>, _) = (Vec::new(), Vec::new());
        for (idx, port) in description.inputs.iter().enumerate() {
            if !operator.has_input(&port.name) {
                continue;
            }
            let has_onlooker = is_standby && !port.feedback;
            let opened = ports::open_input(operator, &port.name, &port.type_name, has_onlooker)?;
            if port.partner {
                partners.push((idx, operator.add_partner(&port.name, opened)?));
                continue;
            }
            input_ports.push(opened);
            input_places.push(Input::new(&port.name, port.feedback));
            inputs.push(idx);
        }
        let mut outputs = Vec::new();
        let (mut output_ports, mut output_places): (Vec<OutputPort>, _) = (Vec::new(), Vec::new());
        for (idx, port) in description.outputs.iter().enumerate() {
            let max_items = ready.max_items.get(&port.name).copied();
            let is_compared = is_compared && is_standby;
            let (opened, layout) = ports::open_output(operator, &port.name, &port.type_name, max_items, is_compared)?;
            let numbers = match ready.answers.get(&port.name) {
                Some(answered) => Numbers::OfInput(input_places.iter().position(|input| *input.name == **answered)),
                None => Numbers::Counted,
            };
            output_ports.push(opened);
            output_places.push(Output::new(&port.name, numbers));
            outputs.push(HostedOutput { idx, name: port.name.clone(), layout, max_items });
        }
        let site = Ports::new(operator, input_ports, output_ports);
        Ok(HostedPorts { site, book: Book::new(input_places, output_places), inputs, outputs, partners })
    }
}

impl ProgramWorker {
    /// Takes in the answers to a message.
    fn answered(&mut self, work: Work) -> anyhow::Result<Vec<Part>> {
        self.deadline_nanos = work.deadline_nanos();
        let mut parts = work.parts;
        for part in &mut parts {
            part.port = output_of(&self.outputs, part)?;
        }
        if self.has_state {
            self.state = work.state;
        }
        Ok(parts)
    }

    /// Sends a sample to the program, with its partners.
    fn send(&mut self, input: usize, taken: &Taken<UntypedSample>, flags: u32) -> anyhow::Result<()> {
        let mut partners = Vec::new();
        for (port, partner) in &self.partners {
            if let Some(sample) = partner::chosen(partner) {
                partners.push((*port, sample));
            }
        }
        let (head, items) = taken.sample.parts();
        let head = with_header(head.to_vec(), &taken.header);
        let own = std::iter::once((self.inputs[input], &head[..], items));
        let others = partners.iter().map(|(port, sample)| {
            let (head, items) = sample.parts();
            (*port, head, items)
        });
        self.child.ask(Ask::Sample, taken.arrival_nanos, flags, &[], own.chain(others))
    }

    /// The head that the program wants to send, if it changes one right before it is sent.
    fn checked(&mut self, (output, head, items): Answer<'_>, now_nanos: u64) -> anyhow::Result<Option<Vec<u8>>> {
        if !self.hears.contains(&Hears::Check) {
            return Ok(None);
        }
        let own = std::iter::once((self.outputs[output].idx, head, items));
        self.child.ask(Ask::Check, now_nanos, 0, &[], own)?;
        let work = self.child.answer(Ask::Check)?.done()?;
        let Some(part) = work.parts.into_iter().next() else { return Ok(None) };
        let (found, expected) = (part.head.len(), head.len());
        if found != expected {
            anyhow::bail!(
                "its program changed a head into one of {found} bytes right before it was sent, expected {expected}"
            );
        }
        Ok(Some(with_header(part.head, &header_of(head))))
    }
}

impl Worker<UntypedSample> for ProgramWorker {
    fn has_state(&self) -> bool {
        self.has_state
    }

    fn ask(&mut self, input: usize, samples: &[Taken<UntypedSample>]) -> anyhow::Result<bool> {
        for (n, taken) in samples.iter().enumerate() {
            self.send(input, taken, if n + 1 < samples.len() { MORE } else { 0 })?;
        }
        for n in 0..samples.len() {
            match self.child.answer(Ask::Sample)? {
                child::Answer::OneByOne if n == 0 && samples.len() > 1 => return Ok(false),
                answer => {
                    let parts = self.answered(answer.done()?)?;
                    self.works.push_back(parts);
                }
            }
        }
        Ok(true)
    }

    fn next(&mut self) -> usize {
        self.answers = self.works.pop_front().unwrap_or_default();
        self.answers.len()
    }

    fn hear(&mut self, hearing: Hearing, now_nanos: u64) -> anyhow::Result<Option<usize>> {
        let (ask, is_heard) = match hearing {
            Hearing::Silence => (Ask::Silence, self.deadline_nanos.is_some_and(|deadline| deadline <= now_nanos)),
            Hearing::End => (Ask::End, self.hears.contains(&Hears::End)),
            Hearing::CutOff => (Ask::CutOff, self.hears.contains(&Hears::CutOff)),
        };
        if !is_heard {
            return Ok(None);
        }
        self.child.ask(ask, monotonic_nanos(), 0, &[], std::iter::empty())?;
        let work = self.child.answer(ask)?.done()?;
        self.answers = self.answered(work)?;
        if !self.saves {
            if self.answers.is_empty() {
                return Ok(None);
            }
            anyhow::bail!(
                "its program answered {ask:?}, and has no state: expected no answer, or a stage with a state"
            );
        }
        if self.answers.iter().any(|part| header_of(&part.head) == Header::default()) {
            anyhow::bail!("it answered {ask:?} with an empty header: expected one with stamp and hand");
        }
        Ok(Some(self.answers.len()))
    }

    fn answer(&self, idx: usize) -> Answer<'_> {
        let part = &self.answers[idx];
        (part.port, &part.head, &part.items)
    }

    fn set_header(&mut self, idx: usize, header: &Header) {
        let head = std::mem::take(&mut self.answers[idx].head);
        self.answers[idx].head = with_header(head, header);
    }

    fn before_sending(&mut self, idx: usize, now_nanos: u64) -> anyhow::Result<Answer<'_>> {
        let part = std::mem::take(&mut self.answers[idx]);
        let checked = self.checked((part.port, &part.head, &part.items), now_nanos);
        self.answers[idx] = part;
        if let Some(head) = checked? {
            self.answers[idx].head = head;
        }
        Ok(self.answer(idx))
    }

    fn before_sending_saved(&mut self, answer: Answer<'_>, now_nanos: u64) -> anyhow::Result<&[u8]> {
        self.head = match self.checked(answer, now_nanos)? {
            Some(head) => head,
            None => answer.1.to_vec(),
        };
        Ok(&self.head)
    }

    fn state(&self, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
        bytes.extend_from_slice(&self.state);
        Ok(())
    }

    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<bool> {
        if self.has_state {
            let work = super::restore(&mut self.child, state)?;
            self.deadline_nanos = work.deadline_nanos();
            self.state = work.state;
        }
        Ok(state.is_some())
    }

    fn deadline_nanos(&self) -> Option<u64> {
        self.deadline_nanos
    }

    fn set(&mut self, params: &Map<String, Value>) -> anyhow::Result<anyhow::Result<()>> {
        Ok(super::set(&mut self.child, params)?.map_err(anyhow::Error::msg))
    }

    fn look(&mut self) -> anyhow::Result<()> {
        listen(&self.operator, &mut self.child)
    }

    fn has_had_turn(&mut self) {
        log(&self.operator, self.child.lines());
    }
}
