//! How to grasp better after a grasp that is not to be lifted: the paper's announced next step, learned from lifts.
//!
//! [`Experience`] is what is known: grasps that were lifted, what the cells felt, where the object was in the hand, and
//! whether it stayed there. [`Advisor`] proposes from it where the palm should go next, from nothing but a feature: what felt alike before
//! says where an object may be, and what was tried on it says where to hold it. One step: it plans no further than the next grasp.
//!
//! Objects are taken to stand again as they stood, z of their frame up. Pure: no clock; only the experience's file is read and written.

mod advisor;
mod experience;
mod pose_field;
mod stage;

pub use advisor::{Advisor, AdvisorOptions, Hypotheses};
pub use experience::{Experience, ExperienceError, FORMAT, LiftedGrasp};
pub use stage::{AdviceStage, AdviceState};
