//! The definitions of a stable grasp.

use serde::{Deserialize, Serialize};

/// What it means that a grasp is stable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Label {
    /// Epsilon and volume of the grasp wrench space exceed thresholds: those of Dang & Allen, unless the simulation's options
    /// have others.
    #[default]
    WrenchSpace,
    /// In physics (the simulator's lift trials), the object stays in the hand, which lifts, holds and shakes it.
    Lift,
}

impl Label {
    pub const ALL: [Label; 2] = [Label::WrenchSpace, Label::Lift];

    /// The label's name in options.
    pub fn word(self) -> &'static str {
        match self {
            Label::WrenchSpace => "wrench-space",
            Label::Lift => "lift",
        }
    }

    /// The label's meaning for people.
    pub fn meaning(self) -> &'static str {
        match self {
            Label::WrenchSpace => {
                "wrench-space (stable: epsilon > 0.07 and volume > 0.1, unless the simulation had other thresholds)"
            }
            Label::Lift => "lift (stable: kept while lifted and shaken in physics)",
        }
    }

    /// Recordings made before there were two labels have none.
    pub fn is_default(&self) -> bool {
        *self == Label::default()
    }
}
