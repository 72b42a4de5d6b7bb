//! Which topics and types the messages of a file have.

use std::collections::BTreeMap;

use mcap::records::{Channel, Record as McapRecord, SchemaHeader, op};

use super::schema::first_difference;
use super::types::{Decode, MESSAGE_ENCODING, SCHEMA_ENCODING, our_type};

/// The schemas and channels of a file, as far as it was read.
#[derive(Default)]
pub(super) struct Channels {
    schemas: BTreeMap<u16, Schema>,
    channels: BTreeMap<u16, KnownChannel>,
}

#[derive(PartialEq)]
pub(super) struct Schema {
    pub(super) name: String,
    pub(super) encoding: String,
    pub(super) data: Vec<u8>,
}

pub(super) struct KnownChannel {
    pub(super) channel: Channel,
    /// Of one of our types.
    pub(super) decode: Option<Decode>,
    /// It has the name of one of our types and is another version of it.
    pub(super) other_version: Option<String>,
}

impl Channels {
    /// Takes note of a schema or a channel; other records are passed over.
    ///
    /// # Errors
    /// It contradicts what is known.
    pub(super) fn add(&mut self, opcode: u8, data: &[u8]) -> Result<(), String> {
        if opcode != op::SCHEMA && opcode != op::CHANNEL {
            return Ok(());
        }
        match mcap::parse_record(opcode, data).map_err(|error| error.to_string())? {
            McapRecord::Schema { header: SchemaHeader { id, name, encoding }, data } => {
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

    /// The same, but what contradicts what was known takes its place.
    pub(super) fn replace(&mut self, opcode: u8, data: &[u8]) {
        if self.add(opcode, data).is_ok() {
            return;
        }
        match mcap::parse_record(opcode, data) {
            Ok(McapRecord::Schema { header, .. }) => self.schemas.remove(&header.id).is_some(),
            Ok(McapRecord::Channel(channel)) => self.channels.remove(&channel.id).is_some(),
            _ => return,
        };
        // A channel whose schema is not there stays unknown.
        let _ = self.add(opcode, data);
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

    /// What a channel in another version of our messages is to be read with.
    pub(super) fn other_version(&self) -> Option<&str> {
        self.iter().find_map(|known| known.other_version.as_deref())
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
        let mut known = KnownChannel { channel, decode: None, other_version: None };
        if let Some((schema, ours)) = schema.and_then(|schema| Some((schema, our_type(&schema.name)?))) {
            known.decode = Some(ours.decode);
            known.other_version = difference(&known.channel, schema, &ours.definition);
        }
        self.channels.insert(known.channel.id, known);
        Ok(())
    }
}

fn difference(channel: &Channel, schema: &Schema, definition: &str) -> Option<String> {
    let topic = &channel.topic;
    for (what, found, expected) in [
        ("messages are encoded as", channel.message_encoding.as_str(), MESSAGE_ENCODING),
        ("definition is in the form", schema.encoding.as_str(), SCHEMA_ENCODING),
    ] {
        if found != expected {
            return Some(format!("{topic}: its {what} '{found}', expected '{expected}'"));
        }
    }
    let (found, expected) = first_difference(&String::from_utf8_lossy(&schema.data), definition)?;
    Some(format!("{topic}: its {} has the line '{found}' where this version has '{expected}'", schema.name))
}
