//! Decides which of two files a sample of a live recording belongs to, so that no grasp is torn.

use std::collections::{BTreeSet, VecDeque};

use super::Record;

/// A late sample may belong to one of so many last grasps: readers take hundreds of samples of an edge in a row, and
/// a grasp may have only one sample.
const N_RECENT_GRASPS: usize = 1024;

/// A grasp: its source's epoch and its number.
pub(super) type GraspKey = (u64, u64);

/// Where one file ends and the next begins.
pub(super) enum Split {
    /// Between grasps: the grasps `next` belong to the next file, the grasps `last` to the file before.
    Grasps { next: BTreeSet<GraspKey>, last: RecentGrasps },
    /// Within a grasp, at this frame.
    Frame { epoch: u64, seq: u64 },
}

impl Split {
    /// Whether a sample belongs to the file before.
    pub(super) fn is_late(&mut self, record: &Record) -> bool {
        match self {
            Split::Grasps { next, last } => {
                let key = key_of(record);
                let is_late = !next.contains(&key) && last.contains(&key);
                if !is_late {
                    next.insert(key);
                }
                is_late
            }
            Split::Frame { epoch, seq } => match record {
                Record::Tactile(_) | Record::Contacts(_) | Record::Feature(_) | Record::Prediction(_) => {
                    record.header().epoch == *epoch && record.header().seq < *seq
                }
                // The grasp goes on, and these samples belong to its end.
                Record::Decision(_) | Record::Truth(_) | Record::Outcome(_) | Record::Scene(_) => false,
            },
        }
    }
}

/// The grasps of the last samples.
#[derive(Default)]
pub(super) struct RecentGrasps {
    keys: BTreeSet<GraspKey>,
    in_order: VecDeque<GraspKey>,
}

impl RecentGrasps {
    pub(super) fn contains(&self, key: &GraspKey) -> bool {
        self.in_order.back() == Some(key) || self.keys.contains(key)
    }

    pub(super) fn add(&mut self, key: GraspKey) {
        if self.contains(&key) {
            return;
        }
        self.keys.insert(key);
        self.in_order.push_back(key);
        if self.in_order.len() > N_RECENT_GRASPS
            && let Some(oldest) = self.in_order.pop_front()
        {
            self.keys.remove(&oldest);
        }
    }
}

pub(super) fn key_of(record: &Record) -> GraspKey {
    (record.header().epoch, record.grasp_id())
}
