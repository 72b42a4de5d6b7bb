//! Grasp cases as text: JSON with one case, a list of cases, or one case after the other (JSON lines).
//!
//! A case is a [`GraspCase`], optionally with a `name`, or an object that holds one under `input`. Other fields beside
//! `input`, such as expected values, are ignored. A fault of one case does not hide the others.

use serde_json::Value;
use thiserror::Error;

use crate::wrench_space::{GraspCase, GraspContact, MAX_FRICTION};

/// A contact may lie this much farther from the centre of mass than the object's farthest point: both are measured, and
/// rubber has a thickness. Larger differences are other units or another origin.
const RADIUS_TOLERANCE: f64 = 1.1;

#[derive(Debug, Clone, PartialEq)]
pub struct NamedCase {
    pub name: Option<String>,
    /// The case, or its fault.
    pub case: Result<GraspCase, CaseError>,
}

/// Why a text holds no cases at all.
#[derive(Debug, Error)]
pub enum CaseFileError {
    /// The text is not JSON, which knows neither NaN nor infinity.
    #[error("not JSON: {0}; expected a grasp case, or a list of cases, with finite numbers")]
    Json(#[from] serde_json::Error),
    #[error("no grasp case in it: expected a case, or a list of cases")]
    Empty,
}

/// The fault of a case, with the contact that it belongs to.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("{}{reason}", contact_idx.map(|idx| format!("contact {idx}: ")).unwrap_or_default())]
pub struct CaseError {
    contact_idx: Option<usize>,
    reason: String,
}

/// The cases of a text, in its order.
///
/// # Errors
/// A text that is not JSON, with line and column, or has no case. The result holds the fault of a single case.
/// [`super::wrench_space::quality`] refuses values that no grasp can have.
pub fn parse_cases(text: &str) -> Result<Vec<NamedCase>, CaseFileError> {
    let mut cases = Vec::new();
    for value in serde_json::Deserializer::from_str(text).into_iter::<Value>() {
        match value? {
            Value::Array(list) => cases.extend(list.into_iter().map(named_case)),
            value => cases.push(named_case(value)),
        }
    }
    if cases.is_empty() { Err(CaseFileError::Empty) } else { Ok(cases) }
}

fn named_case(mut value: Value) -> NamedCase {
    let mut name = None;
    if let Value::Object(fields) = &mut value {
        name = fields.get("name").and_then(Value::as_str).map(str::to_owned);
        if let Some(inner) = fields.remove("input") {
            value = inner;
        } else if name.is_some() {
            fields.remove("name");
        }
    }
    NamedCase { name, case: grasp_case(value) }
}

fn grasp_case(mut value: Value) -> Result<GraspCase, CaseError> {
    let contacts = value.get_mut("contacts").and_then(Value::as_array_mut).map(std::mem::take).unwrap_or_default();
    let mut case: GraspCase =
        serde_json::from_value(value).map_err(|error| CaseError { contact_idx: None, reason: error.to_string() })?;
    for (idx, contact) in contacts.into_iter().enumerate() {
        let invalid = |reason: String| CaseError { contact_idx: Some(idx), reason };
        let contact: GraspContact = serde_json::from_value(contact).map_err(|error| invalid(error.to_string()))?;
        check_contact(&contact, &case).map_err(invalid)?;
        case.contacts.push(contact);
    }
    Ok(case)
}

/// Refuses what no contact with an object of this size can have. Such a case would have a quality without a meaning.
fn check_contact(contact: &GraspContact, case: &GraspCase) -> Result<(), String> {
    let GraspContact { point_m, friction, .. } = contact;
    let radius_m = case.max_radius_m;
    let offsets_m = point_m.iter().zip(&case.centre_of_mass_m).map(|(point, centre)| point - centre);
    let distance_m = offsets_m.map(|offset| offset * offset).sum::<f64>().sqrt();
    if radius_m > 0.0 && distance_m > RADIUS_TOLERANCE * radius_m {
        return Err(format!(
            "point_m is {point_m:?}, {distance_m} m from centre_of_mass_m, expected at most max_radius_m ({radius_m} m): \
             write metres, all in one frame"
        ));
    }
    if *friction > MAX_FRICTION {
        return Err(format!("friction is {friction}, expected a coefficient from 0 to {MAX_FRICTION}"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONTACT: &str = r#"{"point_m": [0, 0, 0.02], "inward_normal": [0, 0, -1], "tangent": [1, 0, 0],
        "friction": 0.5, "torsion_m": 0.001}"#;

    fn case(contacts: &str) -> String {
        format!(r#"{{"centre_of_mass_m": [0, 0, 0], "max_radius_m": 0.05, "contacts": [{contacts}]}}"#)
    }

    fn names_and_contacts(text: &str) -> Vec<(Option<String>, usize)> {
        let cases = parse_cases(text).expect("cases");
        cases.into_iter().map(|case| (case.name, case.case.expect("a case").contacts.len())).collect()
    }

    #[test]
    fn all_forms_are_read() {
        let (one, two) = (case(CONTACT), case(&format!("{CONTACT}, {CONTACT}")));
        assert_eq!(names_and_contacts(&one), [(None, 1)]);
        assert_eq!(names_and_contacts(&format!("[{one}, {two}]")), [(None, 1), (None, 2)]);
        assert_eq!(names_and_contacts(&format!("{two}\n{one}\n")), [(None, 2), (None, 1)]);
        let wrapped =
            format!(r#"[{{"name": "cup", "input": {two}, "expected": {{"epsilon": 1}}}}, {{"input": {one}}}]"#);
        assert_eq!(names_and_contacts(&wrapped), [(Some("cup".into()), 2), (None, 1)]);
        assert_eq!(names_and_contacts(&one.replacen('{', "{\"name\": \"can\", ", 1)), [(Some("can".into()), 1)]);
    }

    #[test]
    fn mistakes_say_where_they_are_and_hide_no_other_case() {
        let wrong = |from: &str, to: &str| case(&format!("{CONTACT}, {}", CONTACT.replacen(from, to, 1)));
        for (text, expected) in [
            (wrong("friction", "frictoin"), &["contact 1", "unknown field `frictoin`", "`friction`"][..]),
            (wrong("\"friction\": 0.5,", ""), &["contact 1", "missing field `friction`"]),
            (wrong("0.5", "\"0.5\""), &["contact 1", "\"0.5\"", "expected f64"]),
            (wrong("[1, 0, 0]", "[1, 0]"), &["contact 1", "length 2, expected an array of length 3"]),
            (wrong("0.02]", "20]"), &["contact 1", "point_m is [0.0, 0.0, 20.0], 20 m from", "write metres"]),
            (wrong("0.5", "40"), &["contact 1", "friction is 40", "from 0 to 10"]),
            (case("7"), &["contact 0", "`7`", "expected struct GraspContact"]),
            (case("").replace("[]", "{}"), &["invalid type: map, expected a sequence"]),
            (case("").replace("max_radius_m", "radius"), &["unknown field `radius`"]),
            (r#"{"input": 3}"#.into(), &["`3`", "expected struct GraspCase"]),
            ("{}".into(), &["missing field `centre_of_mass_m`"]),
        ] {
            let mut cases = parse_cases(&format!("[{text}, {}]", case(CONTACT))).expect("cases");
            assert!(cases.remove(1).case.is_ok());
            let error = cases.remove(0).case.expect_err("wrong").to_string();
            assert!(expected.iter().all(|part| error.contains(part)), "expected {expected:?} in {error}");
        }
    }

    #[test]
    fn a_contact_may_be_as_far_from_the_centre_as_the_object_reaches() {
        for (z_m, is_fine) in [("0.05", true), ("0.054", true), ("-0.056", false)] {
            let cases = parse_cases(&case(&CONTACT.replace("0.02", z_m))).expect("a case");
            assert_eq!(cases[0].case.is_ok(), is_fine, "{z_m}");
        }
    }

    #[test]
    fn a_text_that_is_not_json_says_line_and_column() {
        let error = parse_cases(&format!("[{},\n{}]", case(""), case(&CONTACT.replace("0.5", "NaN"))));
        let error = error.expect_err("NaN").to_string();
        assert!(error.contains("line 3 column") && error.contains("finite"), "{error}");
        for empty in ["", " \n", "[]"] {
            assert!(matches!(parse_cases(empty), Err(CaseFileError::Empty)), "{empty:?}");
        }
    }
}
