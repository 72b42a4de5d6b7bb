//! What a robot may sense beside its joints and the hand's cells. A new sense is one more [`Sense`]: messages, checks,
//! definitions and the Python module loop over them.

use std::fmt;

use serde::Deserialize;
use serde::de::{Deserializer, Error as _, MapAccess, SeqAccess, Visitor};
use serde::ser::SerializeStruct;

use crate::declare::at_most;
use crate::ros::RosType;
use crate::{MAX_JOINTS, MessageError};

/// A sense that a robot may lack. Frames have their senses in this order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sense {
    /// Gravity in the palm frame: x, y, z.
    Gravity,
    /// Force and torque of the load on the wrist, in the palm frame: x, y, z each.
    WristWrench,
    /// The torque of each joint, in the hand's order, positive if its motor closes.
    JointTorques,
}

/// A [`Sense`] in words and numbers.
struct Entry {
    /// In JSON, recordings, ROS 2 and Python.
    name: &'static str,
    /// The comment in ROS 2 definitions.
    unit: &'static str,
    /// The number of its values; `None`: one for each joint.
    n_values: Option<usize>,
}

/// The number of senses.
pub(crate) const N_SENSES: usize = Sense::ALL.len();
/// The most values that all senses of a frame have together.
pub(crate) const MAX_SENSE_VALUES: usize = Sense::max_values(MAX_JOINTS);

impl Sense {
    pub const ALL: [Sense; 3] = [Sense::Gravity, Sense::WristWrench, Sense::JointTorques];

    const fn entry(self) -> Entry {
        match self {
            Sense::Gravity => Entry { name: "gravity_m_per_s2", unit: "Palm frame, m/s^2", n_values: Some(3) },
            Sense::WristWrench => {
                Entry { name: "wrist_wrench", unit: "Palm frame, newtons and newton metres", n_values: Some(6) }
            }
            Sense::JointTorques => {
                Entry { name: "joint_torques", unit: "Newton metres, in the hand's order", n_values: None }
            }
        }
    }

    /// The name of its field in JSON, recordings, ROS 2 and Python.
    pub const fn name(self) -> &'static str {
        self.entry().name
    }

    /// The number of its values; `None`: one for each joint.
    pub const fn n_values(self) -> Option<usize> {
        self.entry().n_values
    }

    /// The number of its values for a hand with `n_joints`.
    pub const fn len(self, n_joints: usize) -> usize {
        match self.n_values() {
            Some(n_values) => n_values,
            None => n_joints,
        }
    }

    /// The values of all senses together, for a hand with `n_joints`.
    pub(crate) const fn max_values(n_joints: usize) -> usize {
        let (mut sum, mut idx) = (0, 0);
        while idx < Sense::ALL.len() {
            sum += Sense::ALL[idx].len(n_joints);
            idx += 1;
        }
        sum
    }

    /// This sense in [`Senses::mask`].
    pub const fn bit(self) -> u32 {
        1 << self as u32
    }
}

/// The senses of a frame: the values of those that are there, one sense after the other.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Senses<'a> {
    lens: [u32; N_SENSES],
    values: &'a [f64],
}

impl<'a> Senses<'a> {
    /// The senses of `mask`, whose values are the first of `items`.
    ///
    /// # Errors
    /// An unknown sense, or more values than items.
    pub(crate) fn first_of(mask: u32, n_joints: usize, items: &'a [f64]) -> Result<Self, MessageError> {
        if mask >> N_SENSES != 0 {
            return Err(MessageError::Code { field: "has_senses", code: mask });
        }
        let mut senses = Senses::default();
        let mut n_values = 0;
        for sense in Sense::ALL {
            if mask & sense.bit() != 0 {
                senses.lens[sense as usize] = sense.len(n_joints) as u32;
                n_values += sense.len(n_joints);
            }
        }
        at_most("the senses' list", n_values, items.len())?;
        senses.values = &items[..n_values];
        Ok(senses)
    }

    /// The values of a sense; empty if it is not there.
    pub fn get(&self, sense: Sense) -> &'a [f64] {
        let (start, end) = span(&self.lens, sense);
        &self.values[start..end]
    }

    /// Each sense with its values.
    pub fn iter(self) -> impl Iterator<Item = (Sense, &'a [f64])> {
        Sense::ALL.into_iter().map(move |sense| (sense, self.get(sense)))
    }

    /// The values of all senses that are there.
    pub fn values(&self) -> &'a [f64] {
        self.values
    }

    /// The senses that are there, for the head of a message: the sum of their [`Sense::bit`]. Senses that a hand with
    /// `n_joints` cannot have get a mask that is refused.
    pub fn mask(&self, n_joints: usize) -> u32 {
        if self.check(n_joints).is_err() {
            return u32::MAX;
        }
        let is_there = |sense: &Sense| self.lens[*sense as usize] > 0;
        Sense::ALL.into_iter().filter(is_there).map(Sense::bit).sum()
    }

    /// # Errors
    /// A sense has another number of values than a hand with `n_joints` gives it.
    pub(crate) fn check(&self, n_joints: usize) -> Result<(), MessageError> {
        for (sense, values) in self.iter() {
            let (found, expected) = (values.len(), sense.len(n_joints));
            if found != 0 && found != expected {
                return Err(MessageError::Length { field: sense.name(), found, expected: format!("0 or {expected}") });
            }
        }
        Ok(())
    }
}

/// [`Senses`] with their own memory.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct OwnedSenses {
    lens: [u32; N_SENSES],
    values: Vec<f64>,
}

impl OwnedSenses {
    pub fn view(&self) -> Senses<'_> {
        Senses { lens: self.lens, values: &self.values }
    }

    /// The values of a sense; empty if it is not there.
    pub fn get(&self, sense: Sense) -> &[f64] {
        self.view().get(sense)
    }

    /// Replaces the values of a sense; none take it away.
    pub fn set(&mut self, sense: Sense, values: &[f64]) {
        let (start, end) = span(&self.lens, sense);
        self.values.splice(start..end, values.iter().copied());
        self.lens[sense as usize] = values.len() as u32;
    }

    /// With these values of a sense.
    #[must_use]
    pub fn with(mut self, sense: Sense, values: &[f64]) -> Self {
        self.set(sense, values);
        self
    }
}

impl From<Senses<'_>> for OwnedSenses {
    fn from(senses: Senses<'_>) -> Self {
        OwnedSenses { lens: senses.lens, values: senses.values.to_vec() }
    }
}

/// Where the values of a sense begin and end.
fn span(lens: &[u32; N_SENSES], sense: Sense) -> (usize, usize) {
    let start = lens[..sense as usize].iter().sum::<u32>() as usize;
    (start, start + lens[sense as usize] as usize)
}

/// In JSON the senses are fields of their message (`#[serde(flatten)]`), which leaves them every key that it does not know
/// itself; elsewhere they are lists, one after the other.
impl<'de> Deserialize<'de> for OwnedSenses {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        if deserializer.is_human_readable() {
            return deserializer.deserialize_map(OfFields);
        }
        deserializer.deserialize_tuple(N_SENSES, OfFields)
    }
}

struct OfFields;

impl<'de> Visitor<'de> for OfFields {
    type Value = OwnedSenses;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("lists of numbers")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut lists: A) -> Result<OwnedSenses, A::Error> {
        let mut senses = OwnedSenses::default();
        for sense in Sense::ALL {
            let Some(List(values)) = lists.next_element()? else {
                return Err(A::Error::missing_field(sense.name()));
            };
            senses.set(sense, &values);
        }
        Ok(senses)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut fields: A) -> Result<OwnedSenses, A::Error> {
        let mut senses = OwnedSenses::default();
        while let Some(name) = fields.next_key::<String>()? {
            let Some(sense) = Sense::ALL.into_iter().find(|sense| sense.name() == name) else {
                let names = Sense::ALL.map(Sense::name).join(", ");
                return Err(A::Error::custom(format!(
                    "unknown field `{name}`: it is none of a frame's, nor a sense ({names})"
                )));
            };
            if !senses.get(sense).is_empty() {
                return Err(A::Error::duplicate_field(sense.name()));
            }
            // A number that is not finite is null in JSON.
            let values: Vec<Option<f64>> = fields.next_value()?;
            let values: Vec<f64> = values.into_iter().map(|value| value.unwrap_or(f64::NAN)).collect();
            senses.set(sense, &values);
        }
        Ok(senses)
    }
}

#[derive(Deserialize)]
struct List(#[serde(deserialize_with = "crate::serialized::any_list")] Vec<f64>);

/// The senses as fields of the message that has them.
impl RosType for OwnedSenses {
    fn ros_name() -> String {
        Vec::<f64>::ros_name()
    }

    fn ros_lines(_: &str) -> String {
        let field = |sense: Sense| {
            let Entry { name, unit, .. } = sense.entry();
            format!("# {unit}; empty without this sense.\n{} {name}\n", Self::ros_name())
        };
        Sense::ALL.map(field).concat()
    }
}

/// Writes the senses as fields of the message that has them.
pub(crate) fn serialize_fields<S: SerializeStruct>(senses: &OwnedSenses, fields: &mut S) -> Result<(), S::Error> {
    for (sense, values) in senses.view().iter() {
        fields.serialize_field(sense.name(), values)?;
    }
    Ok(())
}

/// Serialises a message as its fields, of which each sense is one. Lists them all, in order.
macro_rules! serialize_with_senses {
    ($message:ident: $($before:ident)+, senses, $($after:ident)+) => {
        impl serde::Serialize for $message {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                use serde::ser::SerializeStruct as _;
                let $message { $($before,)+ senses, $($after,)+ } = self;
                let n_fields = [$(stringify!($before),)+ $(stringify!($after),)+].len() + crate::senses::N_SENSES;
                let mut fields = serializer.serialize_struct(stringify!($message), n_fields)?;
                $(fields.serialize_field(stringify!($before), $before)?;)+
                crate::senses::serialize_fields(senses, &mut fields)?;
                $(fields.serialize_field(stringify!($after), $after)?;)+
                fields.end()
            }
        }
    };
}
