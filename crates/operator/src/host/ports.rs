//! Ports whose type of message is known by its name alone: samples are bytes here.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blindgrasp_messages::zerocopy::IntoBytes as _;
use blindgrasp_messages::{Header, MESSAGE_TYPES, Message, WithMessage, with_message};

use crate::cursors::SampleId;
use crate::operator::{Operator, OperatorError};
use crate::outbox::Keyed;
use crate::partner::Partner;
use crate::port::bytes::{head_of, items_of};
use crate::port::{PortError, PortSample, Publisher, Sent, ShadowPublisher, Subscriber, sample_id};
use crate::wiring::{Clock, InputCounts, OnLate};

/// A sample that was received.
#[derive(Debug, Clone)]
pub(super) struct RawSample {
    pub(super) header: Header,
    pub(super) head: Vec<u8>,
    pub(super) items: Vec<u8>,
    /// The counts of its input at the time, itself included.
    pub(super) counts: InputCounts,
    /// The consequence of its lateness, and its age in nanoseconds.
    pub(super) late: Option<(OnLate, u64)>,
}

impl RawSample {
    pub(super) fn key(&self) -> SampleId {
        sample_id(&self.header)
    }
}

/// The receiving end of an edge.
pub(super) trait InputPort {
    fn connect(&mut self) -> Result<bool, PortError>;
    fn receive(&mut self) -> Result<Option<RawSample>, PortError>;
    /// Keeps samples that were not answered, the first one first.
    fn put_back(&mut self, samples: Vec<RawSample>);
    fn take_over(&mut self, answered: Option<SampleId>);
    fn take_over_at(&mut self, last: Option<SampleId>, counts: InputCounts);
    fn look_on_from(&mut self, last: SampleId);
    fn commit(&self, sample: &RawSample);
    fn is_caught_up(&self) -> bool;
    fn is_cut_off(&self) -> bool;
    fn hold_deadline(&self) -> Option<Instant>;
    /// The last sample that any instance has answered, with its counts.
    fn place(&self) -> (Option<SampleId>, InputCounts);
    /// Whether its writer has sent a sample after another one.
    fn is_after(&self, key: SampleId, other: Option<SampleId>) -> bool;
}

struct Input<M: Message> {
    subscriber: Subscriber<M>,
    /// A late sample expires, where the file asks for that: it has the machine's clock.
    may_expire: bool,
    back: VecDeque<RawSample>,
}

impl<M: Message> Input<M> {
    /// Gives the samples that were not answered to the subscriber, which finds their places again.
    fn begin_anew(&mut self) {
        for sample in self.back.drain(..) {
            if let (Some(head), Some(items)) = (head_of::<M>(&sample.head), items_of::<M>(&sample.items)) {
                self.subscriber.put_back(PortSample::of_copy(&head, &items));
            }
        }
    }
}

impl<M: Message> InputPort for Input<M> {
    fn connect(&mut self) -> Result<bool, PortError> {
        self.subscriber.connect()
    }

    fn receive(&mut self) -> Result<Option<RawSample>, PortError> {
        if let Some(sample) = self.back.pop_front() {
            return Ok(Some(sample));
        }
        let Some(sample) = self.subscriber.receive()? else { return Ok(None) };
        let mut head = *sample.head();
        let late = self.subscriber.lateness();
        if self.may_expire && late.is_some_and(|(on_late, _)| on_late != OnLate::Count) {
            // The least that says so: see `Header::valid_until_nanos`.
            M::header_mut(&mut head).valid_nanos = 1;
        }
        Ok(Some(RawSample {
            header: *M::header(&head),
            head: head.as_bytes().to_vec(),
            items: sample.items().as_bytes().to_vec(),
            counts: self.subscriber.counts(),
            late,
        }))
    }

    fn put_back(&mut self, samples: Vec<RawSample>) {
        for sample in samples.into_iter().rev() {
            self.back.push_front(sample);
        }
    }

    fn take_over(&mut self, answered: Option<SampleId>) {
        self.begin_anew();
        self.subscriber.take_over(answered);
    }

    fn take_over_at(&mut self, last: Option<SampleId>, counts: InputCounts) {
        self.begin_anew();
        self.subscriber.take_over_at(last, counts);
    }

    fn look_on_from(&mut self, last: SampleId) {
        self.begin_anew();
        self.subscriber.look_on_from(last);
    }

    fn commit(&self, sample: &RawSample) {
        self.subscriber.commit_with(&sample.header, &sample.counts);
    }

    fn is_caught_up(&self) -> bool {
        self.subscriber.is_caught_up()
    }

    fn is_cut_off(&self) -> bool {
        self.subscriber.is_cut_off()
    }

    fn hold_deadline(&self) -> Option<Instant> {
        self.subscriber.hold_deadline()
    }

    fn place(&self) -> (Option<SampleId>, InputCounts) {
        self.subscriber.place()
    }

    fn is_after(&self, key: SampleId, other: Option<SampleId>) -> bool {
        self.subscriber.is_after(key, other)
    }
}

/// The partner of the sample that is answered just now.
pub(super) trait PartnerPort {
    /// The bytes of its head and items; `None` if there is none.
    fn sample(&self) -> Option<(Vec<u8>, Vec<u8>)>;
}

impl<M: Message> PartnerPort for Partner<M> {
    fn sample(&self) -> Option<(Vec<u8>, Vec<u8>)> {
        let sample = Partner::sample(self)?;
        Some((sample.head.as_bytes().to_vec(), sample.items.as_bytes().to_vec()))
    }
}

/// A sample to send.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct RawAnswer {
    pub(super) header: Header,
    pub(super) head: Vec<u8>,
    pub(super) items: Vec<u8>,
}

impl Keyed for RawAnswer {
    fn key(&self) -> SampleId {
        sample_id(&self.header)
    }
}

/// A change of the bytes of a head right before it is sent; false if it cannot be sent.
pub(super) type Check<'a> = &'a mut dyn FnMut(&Header, &mut Vec<u8>, &[u8]) -> bool;

/// The sending end of an edge.
pub(super) trait OutputPort {
    fn send(
        &mut self,
        answer: &RawAnswer,
        should_yield: &mut dyn FnMut() -> bool,
        check: Option<Check<'_>>,
    ) -> Result<Sent, PortError>;
    /// Sends for comparison, as a standby.
    fn send_beside(&self, answer: &RawAnswer) -> Result<(), PortError>;
    /// Gives up the port for comparison.
    fn end_comparison(&mut self);
    fn look_for_readers(&mut self) -> Result<(), PortError>;
    /// Takes over; returns the last sample that need not be sent again.
    fn begin(&mut self, is_handed_over: bool) -> Option<SampleId>;
    /// As [`OutputPort::begin`], without taking over.
    fn known(&self, is_handed_over: bool) -> Option<SampleId>;
    fn last(&self) -> Option<SampleId>;
    fn has_readers(&self) -> bool;
    fn answered_by_readers(&self) -> Option<SampleId>;
    fn wait_limit(&self) -> Duration;
    fn has_waited(&self, time: Duration);
    fn give_up_attached_that_lack(&self, key: SampleId, waited: Duration) -> bool;
    /// The header in the bytes of a head.
    fn header_of(&self, head: &[u8]) -> Option<Header>;
    /// The bytes of a head with another header.
    fn with_header(&self, head: &[u8], header: Header) -> Vec<u8>;
    /// Whether the lengths are those of this message, and the number of items.
    fn n_items(&self, head: &[u8], items: &[u8]) -> Option<usize>;
    /// The greatest length of a head with so many items.
    fn n_bytes(&self, n_items: usize) -> usize;
}

struct Output<M: Message> {
    publisher: Publisher<M>,
    shadow: Option<ShadowPublisher<M>>,
}

impl<M: Message> Output<M> {
    fn parts(answer: &RawAnswer) -> Option<(M::Head, Vec<M::Item>)> {
        Some((head_of::<M>(&answer.head)?, items_of::<M>(&answer.items)?))
    }
}

impl<M: Message> OutputPort for Output<M> {
    fn send(
        &mut self,
        answer: &RawAnswer,
        should_yield: &mut dyn FnMut() -> bool,
        check: Option<Check<'_>>,
    ) -> Result<Sent, PortError> {
        // Lengths were checked when the answer came.
        let Some((head, items)) = Self::parts(answer) else { return Ok(Sent::Yes) };
        self.publisher.send_checked(head, &items, should_yield, |head| {
            let Some(check) = check else { return true };
            let header = *M::header(head);
            let mut bytes = head.as_bytes().to_vec();
            if !check(&header, &mut bytes, &answer.items) {
                return false;
            }
            let Some(changed) = head_of::<M>(&bytes) else { return false };
            *head = changed;
            *M::header_mut(head) = header;
            true
        })
    }

    fn send_beside(&self, answer: &RawAnswer) -> Result<(), PortError> {
        if let (Some(shadow), Some((head, items))) = (&self.shadow, Self::parts(answer)) {
            shadow.send(&head, &items)?;
        }
        Ok(())
    }

    fn end_comparison(&mut self) {
        self.shadow = None;
    }

    fn look_for_readers(&mut self) -> Result<(), PortError> {
        self.publisher.look_for_readers()
    }

    fn begin(&mut self, is_handed_over: bool) -> Option<SampleId> {
        self.publisher.begin(is_handed_over)
    }

    fn known(&self, is_handed_over: bool) -> Option<SampleId> {
        self.publisher.known(is_handed_over)
    }

    fn last(&self) -> Option<SampleId> {
        self.publisher.last()
    }

    fn has_readers(&self) -> bool {
        self.publisher.has_readers()
    }

    fn answered_by_readers(&self) -> Option<SampleId> {
        self.publisher.answered_by_readers()
    }

    fn wait_limit(&self) -> Duration {
        self.publisher.wait_limit()
    }

    fn has_waited(&self, time: Duration) {
        self.publisher.has_waited(time);
    }

    fn give_up_attached_that_lack(&self, key: SampleId, waited: Duration) -> bool {
        self.publisher.give_up_attached_that_lack(key, waited)
    }

    fn header_of(&self, head: &[u8]) -> Option<Header> {
        head_of::<M>(head).map(|head| *M::header(&head))
    }

    fn with_header(&self, head: &[u8], header: Header) -> Vec<u8> {
        let Some(mut head) = head_of::<M>(head) else { return head.to_vec() };
        *M::header_mut(&mut head) = header;
        head.as_bytes().to_vec()
    }

    fn n_items(&self, head: &[u8], items: &[u8]) -> Option<usize> {
        let is_whole = head.len() == size_of::<M::Head>() && items.len().is_multiple_of(size_of::<M::Item>());
        is_whole.then(|| items.len() / size_of::<M::Item>())
    }

    fn n_bytes(&self, n_items: usize) -> usize {
        size_of::<M::Head>() + n_items * size_of::<M::Item>()
    }
}

/// Opens an input port.
///
/// # Errors
/// The type is unknown, the wiring lacks the port, or iceoryx2 refuses it.
pub(super) fn open_input(operator: &Operator, port: &str, type_name: &str) -> anyhow::Result<Box<dyn InputPort>> {
    opened(type_name, OpenInput { operator, port, is_onlooker: false })
}

/// Opens a second reader of an input, for a standby.
///
/// # Errors
/// As [`open_input`].
pub(super) fn open_onlooker(operator: &Operator, port: &str, type_name: &str) -> anyhow::Result<Box<dyn InputPort>> {
    opened(type_name, OpenInput { operator, port, is_onlooker: true })
}

/// Opens a partner input.
///
/// # Errors
/// As [`open_input`].
pub(super) fn open_partner(operator: &Operator, port: &str, type_name: &str) -> anyhow::Result<Box<dyn PartnerPort>> {
    opened(type_name, OpenPartner { operator, port })
}

/// Opens an output port, for samples of up to `max_items` items if there is a limit. A standby sends to it for comparison.
///
/// # Errors
/// As [`open_input`].
pub(super) fn open_output(
    operator: &Operator,
    port: &str,
    type_name: &str,
    max_items: Option<usize>,
    is_compared: bool,
) -> anyhow::Result<Box<dyn OutputPort>> {
    opened(type_name, OpenOutput { operator, port, max_items, is_compared })
}

fn opened<T, W: WithMessage<Output = Result<T, OperatorError>>>(type_name: &str, work: W) -> anyhow::Result<T> {
    let opened = with_message(type_name, work)
        .with_context(|| format!("there is no message '{type_name}', expected one of {}", MESSAGE_TYPES.join(", ")))?;
    Ok(opened?)
}

struct OpenInput<'a> {
    operator: &'a Operator,
    port: &'a str,
    is_onlooker: bool,
}

impl WithMessage for OpenInput<'_> {
    type Output = Result<Box<dyn InputPort>, OperatorError>;

    fn with<M: Message>(self) -> Self::Output {
        let subscriber: Subscriber<M> =
            if self.is_onlooker { self.operator.onlooker(self.port)? } else { self.operator.subscriber(self.port)? };
        let may_expire = self.operator.clock() == Clock::Machine;
        Ok(Box::new(Input { subscriber, may_expire, back: VecDeque::new() }))
    }
}

struct OpenPartner<'a> {
    operator: &'a Operator,
    port: &'a str,
}

impl WithMessage for OpenPartner<'_> {
    type Output = Result<Box<dyn PartnerPort>, OperatorError>;

    fn with<M: Message>(self) -> Self::Output {
        Ok(Box::new(self.operator.partner::<M>(self.port)?))
    }
}

struct OpenOutput<'a> {
    operator: &'a Operator,
    port: &'a str,
    max_items: Option<usize>,
    is_compared: bool,
}

impl WithMessage for OpenOutput<'_> {
    type Output = Result<Box<dyn OutputPort>, OperatorError>;

    fn with<M: Message>(self) -> Self::Output {
        let OpenOutput { operator, port, max_items, is_compared } = self;
        let publisher = match max_items {
            Some(max_items) => operator.publisher::<M>(port, max_items)?,
            None => operator.growing_publisher::<M>(port)?,
        };
        let shadow = match max_items {
            _ if !is_compared => None,
            Some(max_items) => Some(operator.shadow::<M>(port, max_items)?),
            None => Some(operator.growing_shadow::<M>(port)?),
        };
        Ok(Box::new(Output { publisher, shadow }))
    }
}
