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

/// Whether a record can be played.
pub fn is_played(record: &Record) -> bool {
    PLAYED.iter().any(|(_, type_name)| *type_name == record.type_name())
}
