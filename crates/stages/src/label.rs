//! The definitions of a stable grasp.

use serde::{Deserialize, Serialize};

/// What the truth of a grasp is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Label {
    /// Epsilon and volume of the grasp wrench space exceed the thresholds of Dang & Allen.
    #[default]
    WrenchSpace,
    /// In physics (the simulator's lift trials), the object stays in the hand that lifts, holds and shakes it.
    Lift,
}

impl Label {
    /// Both.
    pub const ALL: [Label; 2] = [Label::WrenchSpace, Label::Lift];

    /// As options have it.
    pub fn word(self) -> &'static str {
        match self {
            Label::WrenchSpace => "wrench-space",
            Label::Lift => "lift",
        }
    }

    /// What it means that a grasp is stable, for people.
    pub fn meaning(self) -> &'static str {
        match self {
            Label::WrenchSpace => "wrench-space (stable: epsilon > 0.07 and volume > 0.1)",
            Label::Lift => "lift (stable: held while lifted and shaken in physics)",
        }
    }

    /// Recordings from before there were two don't say it.
    pub fn is_default(&self) -> bool {
        *self == Label::default()
    }
}
