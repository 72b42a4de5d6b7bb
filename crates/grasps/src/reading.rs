//! What a hand felt of recorded grasps, and which of the grasps can be learned from.

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, HashMap};

use crate::dataset::DatasetError;
use blindgrasp_messages::{Contact, Fault, OwnedSenses, Phase, Stamped, TactileFrame};
use blindgrasp_stages::contacts::{ContactSummary, clip_to_limits, contacts_from_frame};
use blindgrasp_stages::encoder::FeltReading;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::training_summary::ReadingId;

/// Why a grasp is left out whose cells feel, but only on links of the hand that touch each other.
pub const SELF_CONTACT: &str = "contact between links of the hand alone";

/// What a frame felt. A frame that cannot be used has no contacts.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Felt {
    pub joints: Vec<f64>,
    pub contacts: Vec<Contact>,
    pub senses: OwnedSenses,
}

impl Felt {
    pub fn of(hand: &Hand, frame: &Stamped<TactileFrame>) -> Felt {
        Felt::with_summary(hand, frame).0
    }

    /// What the encoder gets of a frame, and what is known besides.
    fn with_summary(hand: &Hand, frame: &Stamped<TactileFrame>) -> (Felt, ContactSummary) {
        let TactileFrame { joints, cells_newtons, senses, .. } = &frame.message;
        let mut felt = Felt { joints: joints.clone(), contacts: Vec::new(), senses: senses.clone() };
        let summary = contacts_from_frame(hand, frame.header.hand_id, joints, cells_newtons, &mut felt.contacts);
        clip_to_limits(hand, &mut felt.joints);
        (felt, summary)
    }

    pub fn reading(&self) -> FeltReading<'_> {
        FeltReading { joints: &self.joints, contacts: &self.contacts, senses: self.senses.view() }
    }
}

/// The first settled frame of a grasp.
#[derive(Debug, Clone)]
pub struct Settled {
    pub felt: Felt,
    /// Why it has no feature.
    pub fault: Fault,
    /// [`ContactSummary::n_self_contacts`]
    n_self_contacts: u32,
    pub reading_id: ReadingId,
    /// The number of its recording day; 0 if it is not known.
    pub day: u32,
}

impl Settled {
    /// `None` if the hand never settled.
    pub fn of(hand: &Hand, frames: &[Stamped<TactileFrame>]) -> Option<Settled> {
        let frame = frames.iter().find(|frame| frame.message.phase == Phase::Settled)?;
        let reading_id = ReadingId::of(&frame.message.joints, &frame.message.cells_newtons);
        let (felt, ContactSummary { fault, n_self_contacts, .. }) = Felt::with_summary(hand, frame);
        Some(Settled { felt, fault, n_self_contacts, reading_id, day: frame.message.day })
    }

    /// Why its grasp is left out, if it has a fault.
    pub fn left_out_as(&self) -> &'static str {
        if self.fault == Fault::NoContact && self.n_self_contacts > 0 { SELF_CONTACT } else { self.fault.as_str() }
    }
}

/// The first recording with a reading, and whether that grasp was stable.
pub type SeenReadings = HashMap<ReadingId, (usize, bool)>;

/// Remembers a reading; or gives the reason why its grasp is left out, because another grasp has it already.
pub fn note_reading(
    seen: &mut SeenReadings,
    reading: ReadingId,
    recording_idx: usize,
    stable: bool,
) -> Result<(), &'static str> {
    match seen.entry(reading) {
        Entry::Occupied(known) if known.get().1 == stable => Err("the reading of another grasp"),
        Entry::Occupied(_) => Err("the reading of another grasp, which ended otherwise"),
        Entry::Vacant(new) => {
            new.insert((recording_idx, stable));
            Ok(())
        }
    }
}

/// Refuses an object of two classes among pairs of object and class: splits by class would put it on both sides.
///
/// # Errors
/// It names the object and both classes.
pub fn check_classes<'a>(objects: impl IntoIterator<Item = (&'a str, &'a str)>) -> Result<(), DatasetError> {
    let mut class_of: BTreeMap<&str, &str> = BTreeMap::new();
    for (object, class) in objects {
        let known = *class_of.entry(object).or_insert(class);
        if known != class {
            return Err(DatasetError::Classes { object: object.into(), known: known.into(), class: class.into() });
        }
    }
    Ok(())
}
