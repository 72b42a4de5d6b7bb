//! Recorded grasps: their hand, labels and frames, and decisions on them by the stages.
//!
//! * [`dataset`] - a recording's grasps one by one. [`reading`] - what the settled hand felt of each.
//! * [`decide`] - decisions as the graph makes them. [`feature_table`] - the features that a model sees.
//! * [`summary`] - recordings summed up. [`shown_hand`] - the hand for viewers.

pub mod dataset;
pub mod decide;
pub mod feature_table;
pub mod reading;
pub mod shown_hand;
pub mod summary;
