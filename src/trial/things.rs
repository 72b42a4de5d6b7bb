//! The paper's six objects (its Fig. 3(a) and Tables II-IV), modelled as such, and others as things to lift.

use super::{Thing, TrialError};

/// The things of a comma-separated list: `paper` (all of Tables II-IV), one of the paper's groups (`mug`), objects and
/// classes of the catalogue, meshes.
///
/// # Errors
/// No such thing, or a mesh that is none.
pub fn things_named(_text: &str) -> Result<Vec<Thing>, TrialError> {
    Ok(Vec::new())
}
