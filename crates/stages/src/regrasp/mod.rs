//! Proposals of better grasps after a grasp that is not lifted, learned from lifts (the next step announced by Dang &
//! Allen).
//!
//! [`Experience`] holds lifted grasps: their features, the object's pose in the hand, and whether the object stayed
//! there. [`Advisor`] proposes the palm's next pose from a feature alone: similar grasps say where the object may be,
//! and the lifts of their objects say where to hold it. It plans one step, the next grasp.
//!
//! Objects are assumed to stand again as they stood, with z of their frame up. Pure: no clock; only the experience's
//! file is read and written.

mod advisor;
mod experience;
mod pose_field;
mod stage;

pub use advisor::{Advisor, AdvisorOptions, Hypotheses};
pub use experience::{Experience, ExperienceError, FORMAT, LiftedGrasp};
pub use stage::{AdviceStage, AdviceState};
