//! The operators that speak Zenoh.

mod link;
mod publishing;
mod tactile_source;
mod zenoh;

use blindgrasp_graph::operators::LINK_OPERATOR;
use blindgrasp_operators::{Shipped, tactile_source as source};

/// All of them. `tactile_source` is the robot's; here it has the driver zenoh as well.
pub(crate) const SHIPPED: [Shipped; 3] = [
    Shipped::new("tactile_source", source::describe, tactile_source::work, tactile_source::check),
    Shipped::new("zenoh", zenoh::describe, zenoh::work, zenoh::check),
    // The launcher adds it and gives it its params.
    Shipped::new(LINK_OPERATOR, link::describe, link::work, |_| Ok(())),
];

#[cfg(test)]
mod tests {
    use blindgrasp_operators::houses::{NETWORK_PROGRAM, OTHER_HOUSES};

    use super::*;

    #[test]
    fn every_operator_describes_itself_under_the_name_that_the_robots_program_knows() {
        let described = SHIPPED.map(|shipped| (shipped.form.describe)());
        for (description, shipped) in described.iter().zip(&SHIPPED) {
            assert_eq!(description.operator, shipped.name);
            description.validate().expect("a description without contradictions");
        }
        let known = OTHER_HOUSES.into_iter().filter(|(_, program)| *program == NETWORK_PROGRAM);
        assert!(SHIPPED[1..].iter().map(|shipped| shipped.name).eq(known.map(|(name, _)| name)));
    }
}
