//! The paper's six objects (Dang & Allen, section IV-E, Tables II-IV) as targets to lift, and others.
//!
//! Masses are the tables'. Frictions on the hand's rubber are assumed: the paper measured none, and describes four
//! of them in words. They were fixed before any result was looked at.
//!
//! | target | mass, kg | friction | why |
//! |---|---|---|---|
//! | mug | 0.43, 0.68, 0.93 | 1.0 | "the surface friction between the mug and the tactile sensor is very big" |
//! | paper wipe box | 0.17 | 0.8 | cardboard |
//! | pencil cup | 0.09 | 0.8 | plastic |
//! | candle box | 0.11 | 0.8 | cardboard |
//! | decorative rock | 0.28 | 0.4 | polished, "very slippery" |
//! | canteen without cover | 0.50, 0.75 | 0.4 | plastic, "very slippery" |
//! | canteen with cover | 0.50, 0.75 | 0.9 | fabric |
//!
//! Each was tried ten times: 110 trials, which [`target_of_trial`] deals out. Sizes and centres of mass are
//! [`PaperShape`]'s. Other targets keep their own mass, and have [`DEFAULT_FRICTION`], unless their entry says otherwise.

use std::collections::BTreeMap;
use std::path::Path;

use rayon::prelude::*;

use super::{LiftTarget, TrialError, TrialOptions, choose_start};
use crate::option_check::require;
use blindgrasp_objects::{NamedError, Object, PaperShape, SelectionError, objects_named};
use blindgrasp_stages::hand::Hand;

/// Friction of a target without one of its own: the friction of all objects in the paper's training data.
pub const DEFAULT_FRICTION: f64 = 1.0;

/// Number of targets that the paper tried: six objects, the mug in three masses, the canteen in two masses and two surfaces.
pub const N_PAPER_TARGETS: usize = 11;

/// Number of times that the paper tried each of its targets.
pub const N_PAPER_TRIALS_EACH: usize = 10;

/// The paper's targets: name, shape, mass (kg), friction, and how many of its ten lifts the paper's robot held (Tables
/// II, III and IV). The order spreads the groups.
const PAPER: [(&str, PaperShape, f64, f64, usize); N_PAPER_TARGETS] = [
    ("mug, 0.43 kg", PaperShape::Mug, 0.43, 1.0, 10),
    ("canteen with cover, 0.50 kg", PaperShape::Canteen, 0.50, 0.9, 10),
    ("pencil cup", PaperShape::PencilCup, 0.09, 0.8, 9),
    ("canteen without cover, 0.50 kg", PaperShape::Canteen, 0.50, 0.4, 9),
    ("mug, 0.68 kg", PaperShape::Mug, 0.68, 1.0, 8),
    ("decorative rock", PaperShape::Rock, 0.28, 0.4, 6),
    ("canteen with cover, 0.75 kg", PaperShape::Canteen, 0.75, 0.9, 7),
    ("candle box", PaperShape::CandleBox, 0.11, 0.8, 9),
    ("mug, 0.93 kg", PaperShape::Mug, 0.93, 1.0, 10),
    ("canteen without cover, 0.75 kg", PaperShape::Canteen, 0.75, 0.4, 6),
    ("paper wipe box", PaperShape::WipeBox, 0.17, 0.8, 9),
];

/// The targets of a comma-separated list: `paper` (all of Tables II-IV), `paper/GROUP` (`paper/mug`, `paper/canteen`,
/// ...), splits, classes and objects of the catalogue (`held-out`, `mug`, `box-03`), a mesh or a folder of meshes. Each
/// entry may end in `@MASSkg` and `@muFRICTION`, as in `box-03@0.3kg@mu0.5`, for all that it names.
///
/// # Errors
/// No such target, a mesh that cannot be used, or a mass or friction out of range.
pub fn targets_named(text: &str) -> Result<Vec<LiftTarget>, TrialError> {
    Ok(targets_and_warnings(text)?.0)
}

/// As [`targets_named`], with warnings about the meshes.
///
/// # Errors
/// As [`targets_named`].
pub fn targets_and_warnings(text: &str) -> Result<(Vec<LiftTarget>, Vec<String>), TrialError> {
    let (mut targets, mut warnings) = (Vec::new(), Vec::new());
    for entry in text.split(',').map(str::trim) {
        let Entry { name, mass_kg, friction } = Entry::parse(entry)?;
        let (mut named, said) = match paper_targets(name)? {
            Some(named) => (named, Vec::new()),
            None => others(name)?,
        };
        for target in &mut named {
            let object = &mut target.object;
            object.mass_kg = mass_kg.unwrap_or(object.mass_kg);
            if name != entry {
                object.name.push_str(&entry[name.len()..]);
            }
            target.friction = friction.unwrap_or(target.friction);
        }
        targets.extend(named);
        warnings.extend(said);
    }
    Ok((targets, warnings))
}

/// Which of the targets trial number `trial` is of: they take turns, so that the paper's, in 110 trials, have ten each
/// as in its tables, and any eleven in a row are of all. `None` if there are no targets.
pub fn target_of_trial(targets: &[LiftTarget], trial: u64) -> Option<&LiftTarget> {
    let n = targets.len() as u64;
    if n == 0 { None } else { targets.get((trial % n) as usize) }
}

/// Looks for an approach to each target, as the first attempt at it begins: the names of targets without one are known before
/// the first of `n_trials` trials, which are left out. Flat objects on a table are such.
///
/// # Errors
/// No target has an approach, or a hand that cannot be simulated.
pub fn check_approaches(
    hand: &Hand,
    targets: &[LiftTarget],
    options: &TrialOptions,
    seed: u64,
    n_trials: u64,
) -> Result<Vec<String>, TrialError> {
    let n_tried = usize::try_from(n_trials).unwrap_or(usize::MAX).min(targets.len());
    let refused: Vec<TrialError> = targets[..n_tried]
        .par_iter()
        .enumerate()
        .filter_map(|(trial, target)| choose_start(hand, target, options, None, seed, trial as u64, 0).err())
        .collect();
    let is_all = refused.len() == n_tried;
    let mut left_out = Vec::new();
    for error in refused {
        match error {
            TrialError::NoApproach { target, .. } if !is_all => left_out.push(target),
            error => return Err(error),
        }
    }
    Ok(left_out)
}

/// The number of the paper's ten lifts of this target that were kept; `None` for a target that the paper did not try.
pub fn held_in_paper(target_name: &str) -> Option<usize> {
    PAPER.iter().find(|(name, ..)| *name == target_name).map(|(.., n_held)| *n_held)
}

/// An entry of a list.
#[derive(Debug, PartialEq)]
struct Entry<'a> {
    name: &'a str,
    mass_kg: Option<f64>,
    friction: Option<f64>,
}

impl<'a> Entry<'a> {
    fn parse(text: &'a str) -> Result<Self, TrialError> {
        let mut entry = Entry { name: text, mass_kg: None, friction: None };
        // A path may have an @ of its own, so other suffixes belong to the name.
        while let Some((name, suffix)) = entry.name.rsplit_once('@') {
            if let Some(number) = suffix.strip_suffix("kg").and_then(|number| number.parse().ok()) {
                entry.mass_kg = Some(in_range("mass_kg", number, 0.001..=10.0, "0.001 to 10 kg")?);
            } else if let Some(number) = suffix.strip_prefix("mu").and_then(|number| number.parse().ok()) {
                entry.friction = Some(in_range("friction", number, 0.01..=10.0, "0.01 to 10")?);
            } else {
                break;
            }
            entry.name = name;
        }
        Ok(entry)
    }
}

fn in_range(
    option: &'static str,
    found: f64,
    range: std::ops::RangeInclusive<f64>,
    expected: &'static str,
) -> Result<f64, TrialError> {
    require(option, found, range.contains(&found), expected)?;
    Ok(found)
}

/// `paper` and `paper/GROUP`; `None` for any other name.
fn paper_targets(name: &str) -> Result<Option<Vec<LiftTarget>>, TrialError> {
    let wanted: Vec<_> = match name.strip_prefix("paper/") {
        None if name != "paper" => return Ok(None),
        None => PAPER.iter().collect(),
        Some(group) => PAPER.iter().filter(|(_, shape, ..)| shape.name() == group).collect(),
    };
    if wanted.is_empty() {
        if Path::new(name).exists() {
            return Ok(None);
        }
        let groups: Vec<String> = PaperShape::ALL.iter().map(|shape| format!("paper/{}", shape.name())).collect();
        return Err(TrialError::Target {
            name: name.into(),
            reason: format!("not one of the paper's: expected paper, {}", groups.join(", ")),
        });
    }
    let mut targets = Vec::with_capacity(wanted.len());
    for &(of_paper, shape, mass_kg, friction, _) in wanted {
        let made = shape.object(mass_kg);
        let object = made.map_err(|error| TrialError::Target { name: name.into(), reason: error.to_string() })?;
        targets.push(LiftTarget::new(Object { name: of_paper.into(), ..object }, friction));
    }
    Ok(Some(targets))
}

/// Objects of the catalogue, and meshes; with warnings.
fn others(name: &str) -> Result<(Vec<LiftTarget>, Vec<String>), TrialError> {
    let (objects, warnings) = objects_named(name).map_err(|error| match error {
        NamedError::Selection(SelectionError::Unknown { .. }) => TrialError::Target {
            name: name.into(),
            reason: format!(
                "{error}; or paper, paper/mug, ... for the paper's objects, each perhaps with @MASSkg and @muFRICTION"
            ),
        },
        error => TrialError::Mesh { path: name.into(), reason: error.to_string() },
    })?;
    let mut targets: Vec<LiftTarget> =
        objects.into_iter().map(|object| LiftTarget::new(object, DEFAULT_FRICTION)).collect();
    // Groups take turns, so that any number of trials reaches all of them.
    let mut n_of_group: BTreeMap<String, usize> = BTreeMap::new();
    targets.sort_by_cached_key(|target| {
        let n = n_of_group.entry(target.object.class.clone()).or_default();
        *n += 1;
        *n
    });
    Ok((targets, warnings))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trial::start::world_from_standing;

    #[test]
    fn a_hundred_and_ten_trials_are_the_papers_and_eleven_are_of_all() {
        let targets = targets_named("paper").expect("the paper's");
        let mut n_by_group: BTreeMap<&str, u64> = BTreeMap::new();
        let mut n_by_target: BTreeMap<&str, u64> = BTreeMap::new();
        for trial in 0..110 {
            let target = target_of_trial(&targets, trial).expect("a target");
            *n_by_group.entry(&target.object.class).or_default() += 1;
            *n_by_target.entry(&target.object.name).or_default() += 1;
        }
        let table_2 =
            [("candle-box", 10), ("canteen", 40), ("mug", 30), ("pencil-cup", 10), ("rock", 10), ("wipe-box", 10)];
        assert_eq!(n_by_group.into_iter().collect::<Vec<_>>(), table_2);
        assert_eq!(n_by_target.len(), 11);
        assert!(n_by_target.values().all(|n| *n == 10));
        let names: std::collections::BTreeSet<&str> = (40..51)
            .filter_map(|trial| target_of_trial(&targets, trial))
            .map(|target| target.object.name.as_str())
            .collect();
        assert_eq!(names.len(), 11);
        assert!(target_of_trial(&[], 0).is_none());
    }

    #[test]
    fn what_the_paper_held_adds_up_to_its_table_2() {
        let held = |group: &str| -> usize {
            let targets = targets_named(group).expect("the paper's");
            targets.iter().filter_map(|target| held_in_paper(&target.object.name)).sum()
        };
        let groups = ["mug", "wipe-box", "pencil-cup", "candle-box", "rock", "canteen"];
        assert_eq!(groups.map(|group| held(&format!("paper/{group}"))), [28, 9, 9, 9, 6, 32]);
        assert_eq!(held("paper"), 93);
        assert_eq!(held_in_paper("box-02"), None);
    }

    #[test]
    fn no_two_names_of_the_papers_targets_are_alike() {
        let targets = targets_named("paper").expect("the paper's");
        for target in &targets {
            let name = &target.object.name;
            assert!(name.len() <= 64);
            assert_eq!(targets.iter().filter(|other| other.object.name == *name).count(), 1);
        }
        let canteens = targets_named("paper/canteen").expect("canteens");
        assert_eq!(canteens.iter().map(|target| target.friction).collect::<Vec<_>>(), [0.9, 0.4, 0.9, 0.4]);
        assert_eq!(targets_named("paper/mug").expect("mugs").len(), 3);
    }

    #[test]
    fn targets_of_the_catalogue_stand_on_the_ground() {
        let targets = targets_named("box-02, ball, paper/rock").expect("targets");
        assert_eq!(targets.len(), 1 + 30 + 1);
        for target in &targets {
            let world_from_target = world_from_standing(target, 0.7);
            let corners: Vec<f64> =
                target.object.to_mesh().vertices_m.iter().map(|corner| (world_from_target * corner).z).collect();
            let least = corners.iter().copied().fold(f64::INFINITY, f64::min);
            let most = corners.iter().copied().fold(0.0, f64::max);
            // A ball's mesh is a little smaller than the ball.
            assert!(least.abs() < 1e-3, "{}: {least}", target.object.name);
            let centre = world_from_target * target.object.centre_of_mass_m;
            assert!(
                (0.0..most).contains(&centre.z) && centre.coords.xy().norm() < 1e-9,
                "{}: {centre}",
                target.object.name
            );
            assert!(target.friction == DEFAULT_FRICTION || target.object.class == "rock");
        }
    }

    #[test]
    fn an_entry_can_have_another_mass_and_friction() {
        let targets = targets_named("box-02@0.3kg@mu0.5,box-02").expect("targets");
        assert_eq!([targets[0].object.mass_kg, targets[0].friction], [0.3, 0.5]);
        assert_eq!(targets[0].object.name, "box-02@0.3kg@mu0.5");
        assert_ne!(targets[1].object.mass_kg, 0.3);
        let entry = Entry::parse("odd@name.off@mu0.2").expect("an entry");
        assert_eq!(entry, Entry { name: "odd@name.off", mass_kg: None, friction: Some(0.2) });
        for (text, expected) in
            [("mug@0kg", "mass_kg is 0"), ("mug@mu-1", "friction is -1"), ("mug@NaNkg", "mass_kg is NaN")]
        {
            let error = targets_named(text).expect_err(text).to_string();
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn unknown_names_say_what_there_is() {
        for (text, expected) in [
            ("paper/pan", "expected paper, paper/pencil-cup, paper/mug"),
            ("mugg", "did you mean 'mug'"),
            ("mugg", "or paper, paper/mug"),
            ("", "no object or class ''"),
        ] {
            let error = targets_named(text).expect_err(text).to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
