//! The messages that a recording can feed a graph with.

use blindgrasp_messages::{
    ContactSet, GraspFeature, MAX_CELLS, MAX_FEATURES, MAX_JOINTS, Message, Prediction, Recorded, Stamped, TactileFrame,
};
use blindgrasp_recording::Record;

/// A message that a recording can feed a graph with: one per frame.
pub trait Played: Message {
    /// The output port that the player sends it by.
    const PORT: &'static str;
    const MAX_ITEMS: usize;

    /// The sample, if the record is of this type.
    fn of_record(record: Record) -> Option<Stamped<Self>>;
    fn grasp_id_mut(head: &mut Self::Head) -> &mut u64;
}

macro_rules! played {
    ($message:ident, $variant:ident, $port:literal, $max_items:expr) => {
        impl Played for $message {
            const PORT: &'static str = $port;
            const MAX_ITEMS: usize = $max_items;

            fn of_record(record: Record) -> Option<Stamped<Self>> {
                match record {
                    Record::$variant(sample) => Some(sample),
                    _ => None,
                }
            }

            fn grasp_id_mut(head: &mut Self::Head) -> &mut u64 {
                &mut head.grasp_id
            }
        }
    };
}

played!(TactileFrame, Tactile, "tactile", MAX_JOINTS + MAX_CELLS);
played!(ContactSet, Contacts, "contacts", MAX_CELLS);
played!(GraspFeature, Feature, "feature", MAX_FEATURES);
played!(Prediction, Prediction, "prediction", 0);

/// Port and type of each message that can be played.
pub const PLAYED: [(&str, &str); 4] = [
    (TactileFrame::PORT, TactileFrame::TYPE_NAME),
    (ContactSet::PORT, ContactSet::TYPE_NAME),
    (GraspFeature::PORT, GraspFeature::TYPE_NAME),
    (Prediction::PORT, Prediction::TYPE_NAME),
];

/// Grasp and type of a record, if it can be played.
pub fn played(record: &Record) -> Option<(u64, &'static str)> {
    match record {
        Record::Tactile(sample) => Some((sample.message.grasp_id, TactileFrame::TYPE_NAME)),
        Record::Contacts(sample) => Some((sample.message.grasp_id, ContactSet::TYPE_NAME)),
        Record::Feature(sample) => Some((sample.message.grasp_id, GraspFeature::TYPE_NAME)),
        Record::Prediction(sample) => Some((sample.message.grasp_id, Prediction::TYPE_NAME)),
        Record::Decision(_) | Record::Truth(_) | Record::Outcome(_) | Record::Scene(_) => None,
    }
}
