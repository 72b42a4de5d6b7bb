//! The operators of the lab.

pub(crate) mod simulated_hand;

use blindgrasp_operators::Shipped;

pub(crate) const SHIPPED: [Shipped; 1] =
    [Shipped::new("simulated_hand", simulated_hand::describe, simulated_hand::work, simulated_hand::check)];

#[cfg(test)]
mod tests {
    use blindgrasp_operators::houses::{LAB_PROGRAM, OTHER_HOUSES};

    #[test]
    fn the_operator_describes_itself_under_the_name_that_the_robots_program_knows() {
        let description = super::simulated_hand::describe();
        description.validate().expect("a description without contradictions");
        assert!(OTHER_HOUSES.contains(&(description.operator.as_str(), LAB_PROGRAM)));
    }
}
