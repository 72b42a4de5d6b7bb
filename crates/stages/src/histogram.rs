//! The histogram stage: a frame's contacts as a distribution over the dictionary (Dang & Allen, Eq. 2-4).
//!
//! Pure: no clock, no I/O, no state.

use crate::dictionary::Dictionary;
use blindgrasp_messages::{Contact, Fault, MAX_PADS};

/// Writes the scaled histogram of `contacts` over `dictionary` to `values`, one value per word.
///
/// `h_i = exp(-‖c - ĉ_i‖² / σ²)` (Eq. 3: σ², not 2σ²), `D = Σ h · f_c / S_c` with `S_c` the sum of the forces of the
/// contacts on the same pad (Eq. 2), divided by the number of pads with contact (Eq. 4). `sigma_m` is σ in metres.
///
/// # Errors
/// The fault, with `values` empty: no contact ([`Fault::NoContact`]: there is no feature). Another one is a contact
/// whose position is not finite, whose force is not positive and finite, or whose pad index is beyond any hand
/// ([`Fault::InvalidValue`]).
pub fn histogram(
    dictionary: &Dictionary,
    sigma_m: f64,
    contacts: &[Contact],
    values: &mut Vec<f64>,
) -> Result<u32, Fault> {
    values.clear();
    if contacts.is_empty() {
        return Err(Fault::NoContact);
    }
    let mut pad_newtons = [0.0; MAX_PADS];
    for contact in contacts {
        let is_valid = contact.position_m.iter().all(|number| number.is_finite())
            && contact.force_newtons.is_finite()
            && contact.force_newtons > 0.0
            && (contact.pad as usize) < MAX_PADS;
        if !is_valid {
            return Err(Fault::InvalidValue);
        }
        pad_newtons[contact.pad as usize] += contact.force_newtons;
    }
    if !pad_newtons.iter().all(|newtons| newtons.is_finite()) {
        return Err(Fault::InvalidValue);
    }
    let n_pads_in_contact = pad_newtons.iter().filter(|newtons| **newtons > 0.0).count();
    let sigma_squared = sigma_m * sigma_m;
    values.extend(dictionary.words_m.iter().map(|word| {
        let distribution: f64 = contacts
            .iter()
            .map(|contact| {
                let squared: f64 = contact.position_m.iter().zip(word).map(|(c, w)| (c - w) * (c - w)).sum();
                libm::exp(-squared / sigma_squared) * (contact.force_newtons / pad_newtons[contact.pad as usize])
            })
            .sum();
        distribution / n_pads_in_contact as f64
    }));
    Ok(n_pads_in_contact as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn contact(position_m: [f64; 3], force_newtons: f64, pad: u32) -> Contact {
        Contact { position_m, normal: [0.0, 0.0, 1.0], force_newtons, pad, cell: 0 }
    }

    fn of(contacts: &[Contact]) -> Result<Vec<f64>, Fault> {
        let dictionary = Dictionary { words_m: vec![[0.0; 3], [0.03, 0.0, 0.0]] };
        let mut values = vec![7.0];
        histogram(&dictionary, 0.03, contacts, &mut values).map(|_| values)
    }

    #[test]
    fn two_pads_by_hand() {
        // Pad 0: a contact on word 0 with a quarter of the pad's force, one on word 1 with three quarters.
        // Pad 2: one contact on word 0. exp(-1) between the words.
        let values = of(&[contact([0.0; 3], 1.0, 0), contact([0.03, 0.0, 0.0], 3.0, 0), contact([0.0; 3], 5.0, 2)]);
        let e = libm::exp(-1.0);
        let expected = [(0.25 + 0.75 * e + 1.0) / 2.0, (0.25 * e + 0.75 + e) / 2.0];
        for (value, expected) in values.expect("valid").iter().zip(expected) {
            assert!((value - expected).abs() < 1e-15);
        }
    }

    #[test]
    fn order_and_scale_of_forces_do_not_matter() {
        let contacts =
            [contact([0.01, 0.0, 0.0], 1.0, 0), contact([0.0, 0.02, 0.0], 3.0, 0), contact([0.0; 3], 5.0, 1)];
        let reversed: Vec<_> = contacts.iter().rev().copied().collect();
        let scaled: Vec<_> = contacts.iter().map(|c| Contact { force_newtons: 4.0 * c.force_newtons, ..*c }).collect();
        let values = of(&contacts).expect("valid");
        for other in [of(&reversed).expect("valid"), of(&scaled).expect("valid")] {
            assert!(values.iter().zip(&other).all(|(a, b)| (a - b).abs() < 1e-14));
        }
    }

    #[test]
    fn no_feature_rather_than_nan() {
        assert_eq!(of(&[]), Err(Fault::NoContact));
        for bad in [
            contact([f64::NAN, 0.0, 0.0], 1.0, 0),
            contact([0.0; 3], 0.0, 0),
            contact([0.0; 3], -1.0, 0),
            contact([0.0; 3], f64::INFINITY, 0),
            contact([0.0; 3], 1.0, 32),
        ] {
            assert_eq!(of(&[contact([0.0; 3], 1.0, 0), bad]), Err(Fault::InvalidValue));
        }
        assert_eq!(of(&[contact([0.0; 3], 1.7e308, 0); 2]), Err(Fault::InvalidValue));
    }
}
