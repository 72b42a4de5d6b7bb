//! Which topics and types the messages of a file have.

use std::collections::{BTreeMap, BTreeSet};

use blindgrasp_messages::first_difference;
use mcap::records::{Channel, Record as McapRecord, SchemaHeader, op};

use super::source::parse_record;
use super::types::{MESSAGE_ENCODING, OurType, SCHEMA_ENCODING, our_types};

/// The remedy for a bag whose recorder did not know the types.
pub(super) const CONVERT: &str =
    "source a workspace with blindgrasp_msgs, and record there or write the bag anew with ros2 bag convert";

/// The schemas and channels of a file, as far as it was read.
#[derive(Default)]
pub(super) struct Channels {
    schemas: BTreeMap<u16, Schema>,
    channels: BTreeMap<u16, KnownChannel>,
    /// Schemas and channels that a checksum covers, by opcode and number.
    checked: BTreeSet<(u8, u16)>,
    /// How often a schema or a channel took the place of another.
    n_replaced: u64,
}

#[derive(PartialEq)]
pub(super) struct Schema {
    pub(super) name: String,
    pub(super) encoding: String,
    pub(super) data: Vec<u8>,
}

pub(super) struct KnownChannel {
    pub(super) channel: Channel,
    /// The type of its messages; `None` if it is not one of ours.
    pub(super) ours: Option<&'static OurType>,
    /// How its type differs from our type of the same name.
    pub(super) other_version: Option<String>,
}

impl Channels {
    /// Adds a schema or a channel; other records are ignored.
    ///
    /// # Errors
    /// It contradicts a schema or a channel of the same number.
    pub(super) fn add(&mut self, opcode: u8, data: &[u8]) -> Result<(), String> {
        if opcode != op::SCHEMA && opcode != op::CHANNEL {
            return Ok(());
        }
        match parse_record(opcode, data)? {
            McapRecord::Schema { header: SchemaHeader { id, mut name, encoding }, data } => {
                // Some programs leave out /msg.
                let full_name = name.replacen('/', "/msg/", 1);
                if our_types(&full_name).next().is_some() {
                    name = full_name;
                }
                let schema = Schema { name, encoding, data: data.into_owned() };
                if self.schemas.get(&id).is_some_and(|known| *known != schema) {
                    return Err(format!("two schemas have the number {id}"));
                }
                self.schemas.insert(id, schema);
            }
            McapRecord::Channel(channel) => self.add_channel(channel)?,
            _ => {}
        }
        Ok(())
    }

    /// As [`Channels::add`] for a damaged file: a schema or channel that contradicts a known one takes its place,
    /// unless a checksum covers only the known one.
    pub(super) fn replace(&mut self, opcode: u8, data: &[u8], is_checked: bool) {
        let id = match parse_record(opcode, data) {
            Ok(McapRecord::Schema { header, .. }) => header.id,
            Ok(McapRecord::Channel(channel)) => channel.id,
            _ => return,
        };
        if self.add(opcode, data).is_err() {
            if self.checked.contains(&(opcode, id)) && !is_checked {
                return;
            }
            self.n_replaced += 1;
            self.checked.remove(&(opcode, id));
            if opcode == op::SCHEMA {
                self.schemas.remove(&id);
            } else {
                self.channels.remove(&id);
            }
            // A channel whose schema is not there stays unknown.
            if self.add(opcode, data).is_err() {
                return;
            }
            if opcode == op::SCHEMA {
                self.look_again_at_channels_of(id);
            }
        }
        if is_checked {
            self.checked.insert((opcode, id));
        }
    }

    /// A checksum covers all known schemas and channels.
    pub(super) fn set_checked(&mut self) {
        self.checked.extend(self.schemas.keys().map(|id| (op::SCHEMA, *id)));
        self.checked.extend(self.channels.keys().map(|id| (op::CHANNEL, *id)));
    }

    /// Whether a checksum covers a channel and its schema.
    pub(super) fn is_checked(&self, channel: &Channel) -> bool {
        let is_schema_checked = channel.schema_id == 0 || self.checked.contains(&(op::SCHEMA, channel.schema_id));
        is_schema_checked && self.checked.contains(&(op::CHANNEL, channel.id))
    }

    /// How often a schema or a channel took the place of another.
    pub(super) fn n_replaced(&self) -> u64 {
        self.n_replaced
    }

    pub(super) fn get(&self, channel_id: u16) -> Option<&KnownChannel> {
        self.channels.get(&channel_id)
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &KnownChannel> {
        self.channels.values()
    }

    pub(super) fn schema(&self, channel: &Channel) -> Option<&Schema> {
        self.schemas.get(&channel.schema_id)
    }

    /// The name of a channel's schema; empty without one.
    pub(super) fn schema_name(&self, known: &KnownChannel) -> String {
        self.schema(&known.channel).map_or(String::new(), |schema| schema.name.clone())
    }

    /// How a channel's type differs from ours, if one does.
    pub(super) fn other_version(&self) -> Option<&str> {
        self.iter().find_map(|known| known.other_version.as_deref())
    }

    fn look_again_at_channels_of(&mut self, schema_id: u16) {
        let (of_schema, others): (BTreeMap<_, _>, _) =
            std::mem::take(&mut self.channels).into_iter().partition(|(_, known)| known.channel.schema_id == schema_id);
        self.channels = others;
        for known in of_schema.into_values() {
            let _ = self.add_channel(known.channel);
        }
    }

    fn add_channel(&mut self, channel: Channel) -> Result<(), String> {
        if let Some(known) = self.channels.get(&channel.id) {
            let is_same = known.channel == channel;
            return if is_same { Ok(()) } else { Err(format!("two channels have the number {}", channel.id)) };
        }
        let schema = self.schemas.get(&channel.schema_id);
        if schema.is_none() && channel.schema_id != 0 {
            return Err(format!("{} has a schema that is not there", channel.topic));
        }
        let mut known = KnownChannel { channel, ours: None, other_version: None };
        if let Some(schema) = schema {
            let difference = |ours: &OurType| difference(&known.channel, schema, &ours.definition);
            let mut versions = our_types(&schema.name);
            let ours = versions.next();
            let other_version = ours.and_then(difference);
            let earlier = if other_version.is_some() { versions.find(|ours| difference(ours).is_none()) } else { None };
            known.other_version = if earlier.is_some() { None } else { other_version };
            known.ours = earlier.or(ours);
        }
        self.channels.insert(known.channel.id, known);
        Ok(())
    }
}

fn difference(channel: &Channel, schema: &Schema, ours: &str) -> Option<String> {
    let topic = &channel.topic;
    if channel.message_encoding != MESSAGE_ENCODING {
        let found = &channel.message_encoding;
        return Some(format!("{topic}: its messages are encoded as '{found}', expected '{MESSAGE_ENCODING}'"));
    }
    let definition = String::from_utf8_lossy(&schema.data);
    if schema.encoding != SCHEMA_ENCODING || definition.trim().is_empty() {
        let found = if definition.trim().is_empty() { "no definition" } else { "a definition in another form" };
        return Some(format!(
            "{topic}: the file holds {found} of {} ('{}'), expected one in the form '{SCHEMA_ENCODING}': {CONVERT}",
            schema.name, schema.encoding
        ));
    }
    let (found, expected) = first_difference(&definition, ours)?;
    Some(format!("{topic}: its {} has the line '{found}' where this version has '{expected}'", schema.name))
}
