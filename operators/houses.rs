//! The operators that other programs of blindgrasp run, so that the robot's has neither Zenoh nor physics in it.

use blindgrasp_graph::operators::LINK_OPERATOR;
use blindgrasp_operator::wiring::WIRING_VARIABLE;
use serde_json::{Map, Value};

pub const LAB_PROGRAM: &str = "blindgrasp-lab";
pub const NETWORK_PROGRAM: &str = "blindgrasp-network";

/// Asks `PROGRAM operator NAME` whether a node could begin, as [`check_from_stdin`](crate::beginning::check_from_stdin) says.
pub const CHECK: &str = "--check";

/// Their names, each with its program.
pub const OTHER_HOUSES: [(&str, &str); 3] =
    [("simulated_hand", LAB_PROGRAM), ("zenoh", NETWORK_PROGRAM), (LINK_OPERATOR, NETWORK_PROGRAM)];

/// The other program that runs an operator with these params; `None` for one of the robot's and for an unknown name.
pub fn house_of(name: &str, params: Option<&Map<String, Value>>) -> Option<&'static str> {
    let driver = params.and_then(|params| params.get("driver")?.as_str());
    if name == "tactile_source" && driver == Some("zenoh") {
        return Some(NETWORK_PROGRAM);
    }
    OTHER_HOUSES.iter().find(|(other, _)| *other == name).map(|(_, program)| *program)
}

/// The other program that is to run `operator NAME ARGUMENTS…` in the place of this process, if there is one. The params are
/// those of its wiring.
pub fn house_of_process(name: &str, arguments: &[String]) -> Option<&'static str> {
    // A source with a driver of the robot is checked without a process (beginning.rs).
    if name == "tactile_source" && arguments.iter().any(|argument| argument == CHECK) {
        return Some(NETWORK_PROGRAM);
    }
    let wiring: Option<Value> = std::env::var(WIRING_VARIABLE).ok().and_then(|text| serde_json::from_str(&text).ok());
    house_of(name, wiring.as_ref().and_then(|wiring| wiring["params"].as_object()))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_driver_of_a_source_says_whose_it_is() {
        let house = |params: Value| house_of("tactile_source", params.as_object());
        assert_eq!(house(json!({"driver": "zenoh"})), Some(NETWORK_PROGRAM));
        assert_eq!(house(json!({"driver": "listen"})), None);
        assert_eq!((house_of("tactile_source", None), house_of("contacts", None)), (None, None));
        assert_eq!(house_of("simulated_hand", None), Some(LAB_PROGRAM));
    }
}
