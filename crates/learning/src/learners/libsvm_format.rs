//! LIBSVM's model file: our support vector machine for LIBSVM, and LIBSVM's (or scikit-learn's, written so) for us.
//!
//! The file holds a machine and, with `probA` and `probB`, its Platt calibration; nothing of dictionary or hand. Only
//! C-SVC of two classes with RBF kernel is read. Numbers are written so that they are read back bit for bit.
//!
//! A decision value above 0 speaks for the file's *first* label, whichever that is. Here it always speaks for "stable",
//! so a file whose first label is the unstable one is turned round.

use std::fmt::Write;

use thiserror::Error;

use blindgrasp_stages::classifier::calibration::PlattCalibration;
use blindgrasp_stages::classifier::svm::{RbfSvm, SvmError};

/// The label of stable grasps; the other one is -1 (written) or 0 (also read).
const STABLE: i64 = 1;
const UNSTABLE: i64 = -1;

/// Why a text is no LIBSVM model that can be used here.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum LibsvmError {
    /// A line cannot be used.
    #[error("line {line}: {problem}")]
    Line {
        /// Its number, from 1.
        line: usize,
        /// The problem and what was expected.
        problem: String,
    },
    /// A line of the header is missing.
    #[error("there is no line '{keyword}' before 'SV': expected a model file of LIBSVM (svm-train)")]
    Missing {
        /// What it would begin with.
        keyword: &'static str,
    },
    /// Another number of support vectors than the header says.
    #[error("{found} support vectors, but the header says {expected}: the file is cut off or was edited")]
    SupportVectorCount {
        /// `total_sv`.
        expected: usize,
        /// Lines after `SV`.
        found: usize,
    },
    /// The machine as a whole.
    #[error(transparent)]
    Svm(#[from] SvmError),
}

/// Writes a machine and its calibration as LIBSVM's model file. Labels are 1 (stable) and -1; the support vectors of
/// label 1 come first, as LIBSVM wants, each class in the order of `svm`.
pub fn write_libsvm(svm: &RbfSvm, calibration: Option<&PlattCalibration>) -> String {
    let support = || svm.dual_coefficients.iter().zip(svm.support_vectors.chunks_exact(svm.n_features.max(1)));
    let n_stable = svm.dual_coefficients.iter().filter(|coefficient| **coefficient > 0.0).count();
    let n_unstable = svm.n_support_vectors() - n_stable;
    let mut text = format!(
        "svm_type c_svc\nkernel_type rbf\ngamma {}\nnr_class 2\ntotal_sv {}\nrho {}\nlabel {STABLE} {UNSTABLE}\n",
        number(svm.gamma),
        svm.n_support_vectors(),
        number(svm.rho)
    );
    if let Some(calibration) = calibration {
        text += &format!("probA {}\nprobB {}\n", number(calibration.a), number(calibration.b));
    }
    text += &format!("nr_sv {n_stable} {n_unstable}\nSV\n");
    for of_stable in [true, false] {
        for (coefficient, vector) in support().filter(|(coefficient, _)| (**coefficient > 0.0) == of_stable) {
            text += &number(*coefficient);
            for (idx, value) in vector.iter().enumerate().filter(|(_, value)| **value != 0.0) {
                // Writing to a String cannot fail.
                let _ = write!(text, " {}:{}", idx + 1, number(*value));
            }
            text += " \n";
        }
    }
    text
}

/// Shortest decimals that are read back as the same number, with an exponent where plain digits would be many.
fn number(value: f64) -> String {
    format!("{value:?}")
}

/// Reads LIBSVM's model file of samples of `n_features` features (the file does not say how many), and its calibration
/// if it has one.
///
/// # Errors
/// A text that is not a consistent C-SVC of two classes, 1 and -1 or 0, with RBF kernel and at most `n_features`
/// features.
pub fn parse_libsvm(text: &str, n_features: usize) -> Result<(RbfSvm, Option<PlattCalibration>), LibsvmError> {
    let mut lines = text.lines().enumerate().map(|(idx, line)| (idx + 1, line.trim_end()));
    let header = parse_header(&mut lines)?;
    let missing = |keyword| LibsvmError::Missing { keyword };
    header.svm_type.ok_or(missing("svm_type"))?;
    header.kernel_type.ok_or(missing("kernel_type"))?;
    let gamma = header.gamma.ok_or(missing("gamma"))?;
    let rho = header.rho.ok_or(missing("rho"))?;
    let n_support_vectors = header.n_support_vectors.ok_or(missing("total_sv"))?;
    let sign = if header.first_is_stable.ok_or(missing("label"))? { 1.0 } else { -1.0 };

    let mut svm =
        RbfSvm { gamma, rho: sign * rho, n_features, dual_coefficients: Vec::new(), support_vectors: Vec::new() };
    for (line, text) in lines.filter(|(_, text)| !text.is_empty()) {
        let coefficient = parse_support_vector(line, text, n_features, &mut svm.support_vectors)?;
        svm.dual_coefficients.push(sign * coefficient);
    }
    if svm.n_support_vectors() != n_support_vectors {
        return Err(LibsvmError::SupportVectorCount { expected: n_support_vectors, found: svm.n_support_vectors() });
    }
    svm.validate()?;
    let calibration = match (header.prob_a, header.prob_b) {
        // P(first label | f) = 1 / (1 + exp(A f + B)). Of the second label at -f: 1 / (1 + exp(A (-f) - B)).
        (Some(a), Some(b)) => Some(PlattCalibration { a, b: sign * b }),
        (None, None) => None,
        (None, Some(_)) => return Err(missing("probA")),
        (Some(_), None) => return Err(missing("probB")),
    };
    Ok((svm, calibration))
}

#[derive(Default)]
struct Header {
    svm_type: Option<()>,
    kernel_type: Option<()>,
    gamma: Option<f64>,
    rho: Option<f64>,
    n_support_vectors: Option<usize>,
    first_is_stable: Option<bool>,
    prob_a: Option<f64>,
    prob_b: Option<f64>,
}

fn parse_header<'a>(lines: &mut impl Iterator<Item = (usize, &'a str)>) -> Result<Header, LibsvmError> {
    let mut header = Header::default();
    for (line, text) in lines {
        let wrong = |problem: String| LibsvmError::Line { line, problem };
        let mut words = text.split_ascii_whitespace();
        let keyword = words.next().unwrap_or_default();
        let values: Vec<&str> = words.collect();
        let only = |expected: &str| {
            if values == [expected] {
                return Ok(Some(()));
            }
            Err(wrong(format!("{keyword} is '{}', expected {expected}: no other can be used here", values.join(" "))))
        };
        let one_number = || match values[..] {
            [value] => finite(value).map(Some).map_err(&wrong),
            _ => Err(wrong(format!("{keyword} has {} values, expected one number", values.len()))),
        };
        match keyword {
            "svm_type" => header.svm_type = only("c_svc")?,
            "kernel_type" => header.kernel_type = only("rbf")?,
            "nr_class" => _ = only("2")?,
            "gamma" => header.gamma = one_number()?,
            "rho" => header.rho = one_number()?,
            "probA" => header.prob_a = one_number()?,
            "probB" => header.prob_b = one_number()?,
            "total_sv" => {
                let n = values.first().and_then(|value| value.parse().ok());
                header.n_support_vectors = Some(n.ok_or_else(|| wrong("total_sv has no count".into()))?);
            }
            "label" => {
                let labels: Vec<i64> = values.iter().filter_map(|value| value.parse().ok()).collect();
                header.first_is_stable = Some(match labels[..] {
                    [STABLE, UNSTABLE | 0] => true,
                    [UNSTABLE | 0, STABLE] => false,
                    _ => {
                        let found = values.join(" ");
                        return Err(wrong(format!("labels '{found}', expected 1 (stable) and -1 or 0 (unstable)")));
                    }
                });
            }
            // How many of each class: the signs of the coefficients say so too.
            "nr_sv" => {}
            "SV" => return Ok(header),
            _ => {
                return Err(wrong(format!(
                    "'{keyword}', expected a line of the header of a model file of LIBSVM (svm-train)"
                )));
            }
        }
    }
    Err(LibsvmError::Missing { keyword: "SV" })
}

/// Appends the features of one support vector, 0 where the line has none, and returns its coefficient.
fn parse_support_vector(
    line: usize,
    text: &str,
    n_features: usize,
    support_vectors: &mut Vec<f64>,
) -> Result<f64, LibsvmError> {
    let wrong = |problem: String| LibsvmError::Line { line, problem };
    let mut words = text.split_ascii_whitespace();
    let coefficient = finite(words.next().unwrap_or_default()).map_err(wrong)?;
    let start = support_vectors.len();
    support_vectors.resize(start + n_features, 0.0);
    let mut last = 0;
    for word in words {
        let (index, value) = word
            .split_once(':')
            .and_then(|(index, value)| Some((index.parse::<usize>().ok()?, value)))
            .ok_or_else(|| wrong(format!("'{word}', expected index:value")))?;
        if index <= last {
            return Err(wrong(format!("index {index} after {last}, expected indices from 1 on, in ascending order")));
        }
        if index > n_features {
            return Err(wrong(format!("index {index}, but samples have {n_features} features here")));
        }
        support_vectors[start + index - 1] = finite(value).map_err(wrong)?;
        last = index;
    }
    Ok(coefficient)
}

fn finite(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err(format!("'{text}', expected a finite number")),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    fn svm() -> RbfSvm {
        RbfSvm {
            gamma: 0.1 + 0.2,
            rho: -1.0 / 3.0,
            n_features: 3,
            dual_coefficients: vec![2.0 / 3.0, 5e-324, -1e300, -0.5],
            support_vectors: vec![0.0, 0.1, 1e-17, 1.0, 2.0, 3.0, -0.7, 0.0, 0.0, 0.0, 0.0, 123_456.789],
        }
    }

    const SMALL: &str = "svm_type c_svc\nkernel_type rbf\ngamma 0.5\nnr_class 2\ntotal_sv 2\nrho 0.25\nlabel 1 -1\n\
                         probA -2\nprobB 0.5\nnr_sv 1 1\nSV\n1 2:3 \n-1 1:1 2:-1e-3 \n";

    #[test]
    fn a_written_machine_is_read_back_bit_for_bit() {
        let calibration = PlattCalibration { a: -1.1, b: 0.07 };
        let text = write_libsvm(&svm(), Some(&calibration));
        assert_eq!(parse_libsvm(&text, 3), Ok((svm(), Some(calibration))));
        assert_eq!(parse_libsvm(&write_libsvm(&svm(), None), 3), Ok((svm(), None)));
    }

    #[test]
    fn the_stable_class_is_written_first() {
        let mut mixed = svm();
        mixed.dual_coefficients.swap(0, 3);
        let text = write_libsvm(&mixed, None);
        assert!(text.contains("\nlabel 1 -1\nnr_sv 2 2\nSV\n5e-324 1:1.0 2:2.0 3:3.0 \n"), "{text}");
        let (read, _) = parse_libsvm(&text, 3).unwrap();
        assert_eq!(read.dual_coefficients, [5e-324, 2.0 / 3.0, -0.5, -1e300]);
    }

    #[test]
    fn a_small_file_by_hand() {
        let (svm, calibration) = parse_libsvm(SMALL, 3).unwrap();
        assert_eq!((svm.gamma, svm.rho, svm.n_features), (0.5, 0.25, 3));
        assert_eq!(svm.dual_coefficients, [1.0, -1.0]);
        assert_eq!(svm.support_vectors, [0.0, 3.0, 0.0, 1.0, -1e-3, 0.0]);
        assert_eq!(calibration, Some(PlattCalibration { a: -2.0, b: 0.5 }));
    }

    #[test]
    fn a_file_whose_first_label_is_the_unstable_one_is_turned_round() {
        let (svm, calibration) = parse_libsvm(SMALL, 2).unwrap();
        for labels in ["label -1 1", "label 0 1"] {
            let (turned, turned_calibration) = parse_libsvm(&SMALL.replace("label 1 -1", labels), 2).unwrap();
            let f = svm.decision_value(&[0.3, 0.4]).unwrap();
            let turned_f = turned.decision_value(&[0.3, 0.4]).unwrap();
            assert_eq!(turned_f, -f);
            // What was the probability of label 1 is now that of its opposite.
            let sum = calibration.unwrap().probability(f) + turned_calibration.unwrap().probability(turned_f);
            assert!((sum - 1.0).abs() < 1e-15, "{sum}");
        }
    }

    #[test]
    fn errors_say_where_and_what() {
        for (from, to, expected) in [
            ("c_svc", "nu_svc", "line 1: svm_type is 'nu_svc', expected c_svc"),
            ("rbf", "linear", "line 2: kernel_type is 'linear', expected rbf"),
            ("gamma 0.5", "gamma x", "line 3: 'x', expected a finite number"),
            ("nr_class 2", "nr_class 3", "line 4: nr_class is '3', expected 2"),
            ("total_sv 2", "total_sv 3", "2 support vectors, but the header says 3"),
            ("rho 0.25", "rho 1 2 3", "line 6: rho has 3 values"),
            ("label 1 -1", "label 3 4", "line 7: labels '3 4', expected 1 (stable)"),
            ("label 1 -1\n", "", "no line 'label'"),
            ("probB 0.5\n", "", "no line 'probB'"),
            ("nr_sv", "sv", "line 10: 'sv', expected a line of the header"),
            ("SV\n", "", "line 11: '1', expected a line of the header"),
            ("1 2:3 ", "1 2:3 2:4", "line 12: index 2 after 2"),
            ("1 2:3 ", "1 0:3", "line 12: index 0 after 0"),
            ("1 2:3 ", "1 5:3", "line 12: index 5, but samples have 4 features"),
            ("1 2:3 ", "1 2=3", "line 12: '2=3', expected index:value"),
            ("1 2:3 ", "1 2:nan", "line 12: 'nan', expected a finite number"),
            ("-1 1:1", "inf 1:1", "line 13: 'inf', expected a finite number"),
            ("gamma 0.5", "gamma -1", "gamma is -1"),
        ] {
            let text = SMALL.replacen(from, to, 1);
            assert_ne!(text, SMALL);
            let error = parse_libsvm(&text, 4).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}\nexpected {expected}");
        }
        assert_eq!(parse_libsvm("", 4), Err(LibsvmError::Missing { keyword: "SV" }));
    }
}
