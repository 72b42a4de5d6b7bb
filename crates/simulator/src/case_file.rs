//! Grasp cases as text: JSON with one case, a list of them, or one after the other (JSON lines).
//!
//! A case is a [`GraspCase`], or an object that holds one under `input`, with a `name` if it likes; whatever else lies
//! beside `input`, such as expected values, is left alone. What is wrong with one case does not hide the others.

use serde_json::{Map, Value};
use thiserror::Error;

use crate::wrench_space::{GraspCase, GraspContact};

/// A case and what it is called.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedCase {
    /// Its name in the text, if it has one.
    pub name: Option<String>,
    /// The case, or what is wrong with it.
    pub case: Result<GraspCase, CaseError>,
}

/// Why a text holds no cases at all.
#[derive(Debug, Error)]
pub enum CaseFileError {
    /// Not JSON; says line and column. JSON knows neither NaN nor infinity.
    #[error("not JSON: {0}; expected a grasp case, or a list of cases, with finite numbers")]
    Json(#[from] serde_json::Error),
    /// Nothing in it.
    #[error("no grasp case in it: expected one, or a list of cases")]
    Empty,
}

/// What is wrong with a case: the place within it, what was expected and what was found.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("{place}{problem}")]
pub struct CaseError {
    /// `contact 2: ` or nothing.
    place: String,
    problem: String,
}

const WRAPPER_FIELD: &str = "input";
const CASE_FIELDS: [&str; 3] = ["centre_of_mass_m", "max_radius_m", "contacts"];
const CONTACT_FIELDS: [&str; 5] = ["point_m", "inward_normal", "tangent", "friction", "torsion_m"];

/// Longest piece of the text that a message repeats, in characters.
const MAX_QUOTED_CHARS: usize = 60;

/// The cases of a text, in its order.
///
/// # Errors
/// Text that is not JSON, with line and column, and text without a case. What is wrong with a single case is told in its
/// place. Values that no grasp can have are not looked for: [`crate::wrench_space::quality`] does that.
pub fn parse_cases(text: &str) -> Result<Vec<NamedCase>, CaseFileError> {
    let mut cases = Vec::new();
    for value in serde_json::Deserializer::from_str(text).into_iter::<Value>() {
        match value? {
            Value::Array(list) => cases.extend(list.iter().map(named_case)),
            value => cases.push(named_case(&value)),
        }
    }
    if cases.is_empty() { Err(CaseFileError::Empty) } else { Ok(cases) }
}

fn named_case(value: &Value) -> NamedCase {
    let (inner, place) = match value.get(WRAPPER_FIELD) {
        Some(inner) => (inner, format!("{WRAPPER_FIELD}: ")),
        None => (value, String::new()),
    };
    let name = value.get("name").and_then(Value::as_str).map(str::to_owned);
    let case = match inner {
        Value::Object(fields) if std::ptr::eq(inner, value) && name.is_some() => {
            let mut fields = fields.clone();
            fields.remove("name");
            grasp_case(&fields)
        }
        Value::Object(fields) => grasp_case(fields),
        other => Err(error(&place, format!("expected an object with {}, found {}", list(&CASE_FIELDS), quote(other)))),
    };
    NamedCase { name, case }
}

fn grasp_case(fields: &Map<String, Value>) -> Result<GraspCase, CaseError> {
    check_names(fields, &CASE_FIELDS, "")?;
    let centre_of_mass_m = vector(fields, "centre_of_mass_m", "")?;
    let max_radius_m = number(fields, "max_radius_m", "")?;
    let Value::Array(contacts) = field(fields, "contacts", "")? else {
        return Err(error("", format!("contacts: expected a list, found {}", quote(&fields["contacts"]))));
    };
    let contacts = contacts.iter().enumerate().map(|(idx, value)| contact(idx, value)).collect::<Result<_, _>>()?;
    Ok(GraspCase { centre_of_mass_m, max_radius_m, contacts })
}

fn contact(idx: usize, value: &Value) -> Result<GraspContact, CaseError> {
    let place = format!("contact {idx}: ");
    let Value::Object(fields) = value else {
        let problem = format!("expected an object with {}, found {}", list(&CONTACT_FIELDS), quote(value));
        return Err(error(&place, problem));
    };
    check_names(fields, &CONTACT_FIELDS, &place)?;
    Ok(GraspContact {
        point_m: vector(fields, "point_m", &place)?,
        inward_normal: vector(fields, "inward_normal", &place)?,
        tangent: vector(fields, "tangent", &place)?,
        friction: number(fields, "friction", &place)?,
        torsion_m: number(fields, "torsion_m", &place)?,
    })
}

fn check_names(fields: &Map<String, Value>, known: &[&str], place: &str) -> Result<(), CaseError> {
    let Some(unknown) = fields.keys().find(|name| !known.contains(&name.as_str())) else { return Ok(()) };
    let distance = |name: &&&str| strsim::osa_distance(unknown, name);
    let nearest = known.iter().min_by_key(distance).filter(|name| distance(name) <= 3);
    let help = match nearest {
        Some(name) => format!("did you mean '{name}'?"),
        None => format!("expected {}", list(known)),
    };
    Err(error(place, format!("unknown field '{}'; {help}", shortened(unknown))))
}

fn field<'a>(fields: &'a Map<String, Value>, name: &str, place: &str) -> Result<&'a Value, CaseError> {
    fields.get(name).ok_or_else(|| error(place, format!("field '{name}' is missing")))
}

fn number(fields: &Map<String, Value>, name: &str, place: &str) -> Result<f64, CaseError> {
    let value = field(fields, name, place)?;
    value.as_f64().ok_or_else(|| error(place, format!("{name}: expected a number, found {}", quote(value))))
}

fn vector(fields: &Map<String, Value>, name: &str, place: &str) -> Result<[f64; 3], CaseError> {
    let value = field(fields, name, place)?;
    let numbers: Option<Vec<f64>> = value.as_array().and_then(|list| list.iter().map(Value::as_f64).collect());
    numbers
        .and_then(|numbers| numbers.try_into().ok())
        .ok_or_else(|| error(place, format!("{name}: expected a list of three numbers, found {}", quote(value))))
}

fn error(place: &str, problem: String) -> CaseError {
    CaseError { place: place.into(), problem }
}

fn list(names: &[&str]) -> String {
    names.join(", ")
}

fn quote(value: &Value) -> String {
    shortened(&value.to_string())
}

fn shortened(text: &str) -> String {
    match text.char_indices().nth(MAX_QUOTED_CHARS) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.into(),
    }
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

    #[track_caller]
    fn check_err(text: &str, expected: &[&str]) {
        let error = parse_cases(text).expect("cases").remove(0).case.expect_err("wrong").to_string();
        for part in expected {
            assert!(error.contains(part), "expected '{part}' in {error}");
        }
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
    fn mistakes_say_where_they_are() {
        let wrong = |from: &str, to: &str| case(&format!("{CONTACT}, {}", CONTACT.replacen(from, to, 1)));
        check_err(&wrong("friction", "frictoin"), &["contact 1", "'frictoin'", "did you mean 'friction'"]);
        check_err(&wrong("\"friction\": 0.5,", ""), &["contact 1", "'friction' is missing"]);
        check_err(&wrong("0.5", "\"0.5\""), &["contact 1", "friction", "\"0.5\""]);
        check_err(&wrong("[1, 0, 0]", "[1, 0]"), &["contact 1", "tangent", "three numbers", "[1,0]"]);
        check_err(&wrong("[1, 0, 0]", "[1, 0, null]"), &["contact 1", "tangent", "null"]);
        check_err(&case("7"), &["contact 0", "point_m", "found 7"]);
        check_err(&case("").replace("[]", "{}"), &["contacts: expected a list", "{}"]);
        check_err(&case("").replace("max_radius_m", "radius"), &["unknown field 'radius'"]);
        check_err(r#"{"input": 3}"#, &["input: ", "found 3"]);
        check_err("{}", &["centre_of_mass_m", "missing"]);
        check_err(&format!("[[{}]]", case("")), &["expected an object"]);
    }

    #[test]
    fn what_is_not_json_says_line_and_column() {
        let error = parse_cases(&format!("[{},\n{}]", case(""), case(&CONTACT.replace("0.5", "NaN"))));
        let error = error.expect_err("NaN").to_string();
        assert!(error.contains("line 3 column") && error.contains("finite"), "{error}");
        for empty in ["", " \n", "[]"] {
            assert!(matches!(parse_cases(empty), Err(CaseFileError::Empty)), "{empty:?}");
        }
    }

    #[test]
    fn a_wrong_case_does_not_hide_the_others() {
        let cases = parse_cases(&format!("[{{}}, {}]", case(CONTACT))).expect("cases");
        assert!(cases[0].case.is_err() && cases[1].case.is_ok());
    }
}
