//! Ports whose type of message is known by its name alone: samples are bytes here.

use anyhow::Context as _;
use blindgrasp_messages::{MESSAGE_TYPES, Message, WithMessage, with_message};

use super::protocol::Part;
use crate::operator::{Operator, OperatorError};
use crate::port::bytes::Layout;
use crate::runner::{InputPort, OutputPort};

/// An output for the answers of a program.
pub(super) struct HostedOutput {
    /// Its number in the description.
    pub(super) idx: usize,
    pub(super) name: String,
    pub(super) layout: Layout,
    pub(super) max_items: Option<usize>,
}

/// The output that a part of an answer is for, if its lengths are right.
///
/// # Errors
/// There is no such output, or a length is that of another message.
pub(super) fn output_of(outputs: &[HostedOutput], part: &Part) -> anyhow::Result<usize> {
    let Some((idx, output)) = outputs.iter().enumerate().find(|(_, output)| output.idx == part.port) else {
        anyhow::bail!(
            "it answered on the output number {}, expected 0 to {}",
            part.port,
            outputs.len().saturating_sub(1)
        );
    };
    let Some(n_items) = output.layout.n_items(part.head.len(), part.items.len()) else {
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

/// Opens an input port, with a second reader for a standby.
///
/// # Errors
/// The type is unknown, the wiring lacks the port, or iceoryx2 refuses it.
pub(super) fn open_input(
    operator: &Operator,
    port: &str,
    type_name: &str,
    has_onlooker: bool,
) -> anyhow::Result<InputPort> {
    opened(type_name, OpenInput { operator, port, has_onlooker })
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
) -> anyhow::Result<(OutputPort, Layout)> {
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
    has_onlooker: bool,
}

impl WithMessage for OpenInput<'_> {
    type Output = Result<InputPort, OperatorError>;

    fn with<M: Message>(self) -> Self::Output {
        InputPort::open::<M>(self.operator, self.port, self.has_onlooker)
    }
}

struct OpenOutput<'a> {
    operator: &'a Operator,
    port: &'a str,
    max_items: Option<usize>,
    is_compared: bool,
}

impl WithMessage for OpenOutput<'_> {
    type Output = Result<(OutputPort, Layout), OperatorError>;

    fn with<M: Message>(self) -> Self::Output {
        let port = OutputPort::open::<M>(self.operator, self.port, self.max_items, self.is_compared)?;
        Ok((port, Layout::of::<M>()))
    }
}
