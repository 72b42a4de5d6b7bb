//! The operators that come with blindgrasp: `blindgrasp operator NAME` runs one in a process of its own.
//!
//! Each file describes an operator's ports and parameters and joins a stage or source to them; the work itself is done by
//! the library crates.

#[cfg(test)]
mod allocations;
pub mod beginning;
mod classifier;
pub mod connection;
mod contacts;
mod encoder;
pub mod fit;
pub mod houses;
mod lift_arbiter;
mod recorded_source;
mod ros2_markers;
mod senses;
pub mod tactile_source;

pub use ros2_markers::{cell_points, hand_markers};

use std::path::Path;

use blindgrasp_graph::operators::{LINK_OPERATOR, Operators};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;

use crate::beginning::FileNode;
use crate::houses::OTHER_HOUSES;

/// The module for operators in Python, and the messages that it knows.
pub const PYTHON_OPERATOR: &str = include_str!("blindgrasp_operator.py");
pub const PYTHON_MESSAGES: &str = include_str!("blindgrasp_messages.py");

/// An operator that comes with blindgrasp.
#[derive(Debug, Clone, Copy)]
pub struct Shipped {
    pub name: &'static str,
    pub form: Form,
    /// Whether several can run in one process: they answer samples, and have no source or device of their own.
    pub can_share_process: bool,
    /// Other forms, by the argument after the name.
    pub variants: &'static [(&'static str, Form)],
}

/// What an operator is and does.
#[derive(Debug, Clone, Copy)]
pub struct Form {
    pub describe: fn() -> OperatorDescription,
    pub work: fn(&Operator) -> anyhow::Result<()>,
    /// Finds the mistakes in params and files with which `work` would fail at once.
    pub check: CheckNode,
}

/// See [`Form::check`].
pub type CheckNode = fn(&FileNode) -> anyhow::Result<()>;

/// Those of the robot's program. A new one is its file and a line here.
pub const SHIPPED: [Shipped; 7] = [
    recorded_source::SHIPPED,
    Shipped::new("tactile_source", tactile_source::describe, tactile_source::work, tactile_source::check),
    Shipped::new("senses", senses::describe, senses::work, senses::check).sharing_process(),
    Shipped::new("contacts", contacts::describe, contacts::work, contacts::check).sharing_process(),
    Shipped::new("encoder", encoder::describe, encoder::work, encoder::check).sharing_process(),
    Shipped::new("classifier", classifier::describe, classifier::work, classifier::check).sharing_process(),
    Shipped::new("lift_arbiter", lift_arbiter::describe, lift_arbiter::work, lift_arbiter::check).sharing_process(),
];

/// The operator of this name with these arguments, if it is one of these.
pub fn form_named(shipped: &[Shipped], name: &str, arguments: &[&str]) -> Option<Form> {
    shipped.iter().find(|shipped| shipped.name == name)?.with_arguments(arguments)
}

/// The operator that the robot's program runs itself with these arguments, `operator NAME [VARIANT]`; `None` for those of another program.
pub fn form_of(args: &[String]) -> Option<Form> {
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    match args.as_slice() {
        ["operator", name, arguments @ ..] => form_named(&SHIPPED, name, arguments),
        _ => None,
    }
}

/// The operators of all houses as a dataflow file can name them. `program` must run each as `PROGRAM operator NAME`, as
/// blindgrasp does; those of the other houses are run by their programs, where these lie beside it.
pub fn operators_of(program: &Path) -> Operators {
    let mut operators = installed_operators_of(program);
    for (name, _) in OTHER_HOUSES {
        if operators.get(name).is_none() && name != LINK_OPERATOR {
            // It says how to get the program of its house.
            operators = operators.with(name, program);
        }
    }
    operators
}

/// As [`operators_of`], without those whose programs do not lie beside `program`.
pub fn installed_operators_of(program: &Path) -> Operators {
    let mut operators = Operators::of_program(program, SHIPPED.iter().map(|shipped| shipped.name));
    for (name, house) in OTHER_HOUSES {
        let beside = program.with_file_name(house);
        if beside.is_file() {
            operators = operators.with(name, &beside);
        }
    }
    operators.sharing(SHIPPED.iter().filter(|shipped| shipped.can_share_process).map(|shipped| shipped.name))
}

impl Shipped {
    pub const fn new(
        name: &'static str,
        describe: fn() -> OperatorDescription,
        work: fn(&Operator) -> anyhow::Result<()>,
        check: CheckNode,
    ) -> Shipped {
        Shipped { name, form: Form { describe, work, check }, can_share_process: false, variants: &[] }
    }

    const fn sharing_process(self) -> Shipped {
        Shipped { can_share_process: true, ..self }
    }

    /// Its form with these arguments after its name, if there is one.
    pub fn with_arguments(&self, arguments: &[&str]) -> Option<Form> {
        match arguments {
            [] => Some(self.form),
            [argument] => self.variants.iter().find(|(known, _)| known == argument).map(|(_, form)| *form),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A source would not let the others of its group have a turn.
    #[test]
    fn the_operators_that_can_share_a_process_answer_samples() {
        for operator in SHIPPED.iter().filter(|operator| operator.can_share_process) {
            let inputs = (operator.form.describe)().inputs;
            assert!(inputs.iter().any(|input| !input.feedback), "{}", operator.name);
        }
    }

    #[test]
    fn every_operator_describes_itself_under_its_own_name() {
        for operator in SHIPPED {
            let described = (operator.form.describe)();
            let variants = operator.variants.iter().map(|(_, form)| (form.describe)());
            for description in variants.chain([described]) {
                assert_eq!(description.operator, operator.name);
                description.validate().expect("a description without contradictions");
            }
            for (argument, form) in operator.variants {
                assert_eq!((form.describe)().outputs[0].name, *argument);
            }
        }
    }
}
