//! The ROS 2 message definitions of our messages, as recordings carry them.

use blindgrasp_messages::{LiftOutcome, Recorded};

const HEADER: &str = "\
================================================================================
MSG: blindgrasp_msgs/Header
# Which sample it is and where it comes from.
uint64 seq
# When the source took it, nanoseconds of the source's clock.
uint64 stamp_nanos
# Generation of the source.
uint64 epoch
# Identity of the hand, 0 if unknown.
uint64 hand_id
";

const PHASE: &str = "\
# 0 open, 1 closing, 2 settled, 3 ended
uint32 phase
";

const FAULT: &str = "\
# 0 none, 1 no_contact, 2 wrong_length, 3 invalid_value, 4 wrong_hand, 5 self_collision, 6 malformed, 7 wrong_model,
# 8 out_of_distribution
uint32 fault
";

/// The definition of a message, with those it is made of.
pub(super) fn definition<M: Recorded>() -> String {
    let body = match M::TOPIC {
        "/tactile" => format!(
            "blindgrasp_msgs/Header header\nuint64 grasp_id\n{PHASE}# Radians, in the hand's order.\nfloat64[] joints_rad\n\
             # Newtons, pad after pad.\nfloat64[] cells_newtons\n"
        ),
        "/contacts" => format!(
            "blindgrasp_msgs/Header header\nuint64 grasp_id\n{PHASE}# Radians, in the hand's order.\nfloat64[] joints_rad\n\
             Contact[] contacts\nuint32 n_pads_in_contact\nbool self_collision\n# Active cells that feel another link: left out.\nuint32 n_self_contacts\n{FAULT}"
        ),
        "/histogram" => {
            format!(
                "blindgrasp_msgs/Header header\nuint64 grasp_id\n{PHASE}float64[] values\nuint32 n_pads_in_contact\n\
             # Identity of the dictionary that made it.\nuint64 dictionary_id\n{FAULT}"
            )
        }
        "/prediction" => format!(
            "blindgrasp_msgs/Header header\nuint64 grasp_id\n{PHASE}float64 decision_value\nfloat64 probability_stable\n\
             bool stable\nbool unsure\n{FAULT}"
        ),
        "/decision" => "blindgrasp_msgs/Header header\nuint64 grasp_id\n# 0 hold, 1 lift, 2 regrasp: hold, and grasp as the advice says\nuint32 action\n\
             # 0 stable, 1 unstable, 2 no_agreement, 3 missing, 4 out_of_order, 5 stale, 6 no_contact, 7 invalid,\n\
             # 8 self_collision, 9 wrong_hand, 10 wrong_model, 11 out_of_distribution,\n# 12 unsure, 13 link_down\nuint32 reason\nfloat64 probability_stable\n"
            .into(),
        "/scene" => "blindgrasp_msgs/Header header\nuint64 grasp_id\n# With the seed, identifies the grasp.\nuint64 candidate\n\
             # Palm frame; x, y, z, w.\nfloat64[3] object_position_m\nfloat64[4] object_rotation_xyzw\n\
             float64[3] centre_of_mass_m\nfloat64 max_radius_m\nfloat64 mass_kg\nfloat64 friction\n\
             # Exactly, as no encoder says them.\nfloat64[] joints_rad\nbool self_collision\nSceneContact[] contacts\n"
            .into(),
        "/outcome" => "blindgrasp_msgs/Header header\nuint64 grasp_id\nuint64 trial\nuint32 attempt\nbool lifted\nbool held\n\
             # Whether epsilon and volume are known.\nbool has_quality\nbool advised\nfloat64 slip_m\nfloat64 turn_rad\n\
             float64 epsilon\nfloat64 volume\nfloat64 mass_kg\nfloat64 friction\nstring thing\nstring group\n"
            .into(),
        "/advice" => "blindgrasp_msgs/Header header\nuint64 grasp_id\n# The best one first.\nRegraspProposal[] proposals\n".into(),
        _ => "blindgrasp_msgs/Header header\nuint64 grasp_id\nfloat64 epsilon\nfloat64 volume\nbool stable\nstring object\n\
              string class\n"
            .into(),
    };
    let part = match M::TOPIC {
        "/contacts" => {
            "================================================================================\n\
             MSG: blindgrasp_msgs/Contact\n# Palm frame, metres.\nfloat64[3] position_m\n\
             # The pad's outward normal, palm frame.\nfloat64[3] normal\nfloat64 force_newtons\nuint32 pad\n\
             # Index on its pad.\nuint32 cell\n"
        }
        "/scene" => {
            "================================================================================\n\
             MSG: blindgrasp_msgs/SceneContact\nuint32 link\n# -1 for the object\nint32 other_link\n\
             # Palm frame, metres.\nfloat64[3] point_m\n# Into the object, palm frame.\nfloat64[3] inward_normal\n\
             float64[3] tangent\nfloat64 force_newtons\n# The part that cells feel.\nfloat64 felt_newtons\n\
             float64 torsion_m\n"
        }
        "/advice" => {
            "================================================================================\n\
             MSG: blindgrasp_msgs/RegraspProposal\n# The next palm in the palm frame, metres; x, y, z, w.\n\
             float64[3] palm_position_m\nfloat64[4] palm_rotation_xyzw\n# Radians, in the hand's order.\n\
             float64[] open_joints_rad\nfloat64 probability_held\n"
        }
        _ => "",
    };
    format!("{body}{HEADER}{part}")
}

/// The definition of an earlier version whose messages are read as they are, if there is one.
pub(super) fn earlier_definition<M: Recorded>() -> Option<String> {
    // `advised` lies where messages without it have a byte of padding, which is 0.
    (M::TOPIC == LiftOutcome::TOPIC).then(|| definition::<M>().replace("bool advised\n", ""))
}

/// What a message consists of, in words that change with its fields and with nothing else.
pub fn signature<M: Recorded>() -> String {
    significant_lines(&definition::<M>()).collect::<Vec<_>>().join("\n")
}

/// The first line in which two definitions differ, as found and as expected; comments and blank space aside. A line
/// that one of them lacks is empty.
pub(super) fn first_difference(found: &str, expected: &str) -> Option<(String, String)> {
    let (mut found, mut expected) = (significant_lines(found), significant_lines(expected));
    loop {
        match (found.next(), expected.next()) {
            (None, None) => return None,
            (found, expected) if found != expected => {
                return Some((found.unwrap_or_default(), expected.unwrap_or_default()));
            }
            _ => {}
        }
    }
}

/// What our types' full names begin with.
const PACKAGE: &str = "blindgrasp_msgs/";

fn significant_lines(definition: &str) -> impl Iterator<Item = String> {
    definition.lines().filter_map(|line| {
        let code = line.split('#').next().unwrap_or_default();
        // A type of the same package may be named with it or without.
        let words: Vec<&str> = code.split_whitespace().map(|word| word.strip_prefix(PACKAGE).unwrap_or(word)).collect();
        (!words.is_empty()).then(|| words.join(" "))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn definitions_differ_by_their_fields_only() {
        let ours = "# what\nuint64  seq\n\nfloat64[] values # in order\n";
        assert_eq!(first_difference("uint64 seq\nfloat64[] values\n", ours), None);
        assert_eq!(first_difference("Header header", "blindgrasp_msgs/Header header"), None);
        let other = first_difference("uint64 seq\nfloat32[] values", ours);
        assert_eq!(other, Some(("float32[] values".into(), "float64[] values".into())));
        assert_eq!(first_difference("uint64 seq", ours), Some((String::new(), "float64[] values".into())));
    }
}
