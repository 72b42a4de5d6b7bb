//! Damaged grasp cases, as `tests/fuzz` damages the robot's files: each text is read or refused, and nothing panics.

#[path = "../../../tests/fuzz/damage.rs"]
mod damage;
#[path = "../../../tests/fuzz/seeds.rs"]
mod seeds;

use blindgrasp_simulator::case_file::parse_cases;

#[test]
fn grasp_cases() {
    let cases =
        br#"[{"centre_of_mass_m": [0, 0, 0], "max_radius_m": 0.05, "contacts": [{"point_m": [0, 0, 0.02], "normal":
                  [0, 0, 1], "friction": 0.5, "torsion_m": 0.001}]}]"#;
    damage::check(20_000, cases, |bytes| parse_cases(&String::from_utf8_lossy(bytes)).is_ok());
}
