//! LIBSVM's model file of a support vector machine and its Platt calibration; nothing of dictionary or hand.
//!
//! A decision value above 0 speaks for the file's first label, which is "stable" here.

use std::fmt::Write;

use blindgrasp_stages::classifier::calibration::PlattCalibration;
use blindgrasp_stages::classifier::svm::RbfSvm;

/// Writes a machine and its calibration as LIBSVM's model file. Labels are 1 (stable) and -1; the support vectors of
/// label 1 come first, as LIBSVM wants, each class in the order of `svm`.
pub fn write_libsvm(svm: &RbfSvm, calibration: Option<&PlattCalibration>) -> String {
    let support = || svm.dual_coefficients.iter().zip(svm.support_vectors.chunks_exact(svm.n_features.max(1)));
    let n_stable = svm.dual_coefficients.iter().filter(|coefficient| **coefficient > 0.0).count();
    let n_unstable = svm.n_support_vectors() - n_stable;
    let mut text = format!(
        "svm_type c_svc\nkernel_type rbf\ngamma {}\nnr_class 2\ntotal_sv {}\nrho {}\nlabel 1 -1\n",
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

/// The shortest decimals that are read back as the same number, with an exponent where plain digits would be many.
fn number(value: f64) -> String {
    format!("{value:?}")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whether LIBSVM and scikit-learn read the file, `scripts/benchsuite libsvm` says.
    #[test]
    fn the_stable_class_is_written_first_and_numbers_are_exact() {
        let svm = RbfSvm {
            gamma: 0.1 + 0.2,
            rho: -1.0 / 3.0,
            n_features: 3,
            dual_coefficients: vec![-0.5, 5e-324, -1e300, 2.0 / 3.0],
            support_vectors: vec![0.0, 0.1, 1e-17, 1.0, 2.0, 3.0, -0.7, 0.0, 0.0, 0.0, 0.0, 123_456.789],
        };
        let text = write_libsvm(&svm, Some(&PlattCalibration { a: -1.1, b: 0.07 }));
        let expected = "svm_type c_svc\nkernel_type rbf\ngamma 0.30000000000000004\nnr_class 2\ntotal_sv 4\n\
                        rho -0.3333333333333333\nlabel 1 -1\nprobA -1.1\nprobB 0.07\nnr_sv 2 2\nSV\n\
                        5e-324 1:1.0 2:2.0 3:3.0 \n0.6666666666666666 3:123456.789 \n\
                        -0.5 2:0.1 3:1e-17 \n-1e300 1:-0.7 \n";
        assert_eq!(text, expected);
        assert!(!write_libsvm(&svm, None).contains("prob"));
    }
}
