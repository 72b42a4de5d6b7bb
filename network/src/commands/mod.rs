//! The commands of the network's house, one file each.

mod diagnostics;
mod keys;
mod robot_description;

use blindgrasp_cli::{Outcome, completions, data_on_stdout, print_line, secs_in};
use blindgrasp_session::output::write_out;

blindgrasp_cli::program! {
    Diagnostics diagnostics, Keys keys; hidden RobotDescription robot_description;
    operators crate::operators::SHIPPED; others &[]
}

#[cfg(test)]
mod tests {
    use blindgrasp_cli::houses::NETWORK;
    use blindgrasp_cli::testing::mistakes_in_table;

    use super::*;

    #[test]
    fn the_table_of_houses_names_these_commands() {
        assert_eq!(mistakes_in_table(NETWORK.commands, &command()), [""; 0]);
    }
}
