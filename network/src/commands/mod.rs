//! The commands of the network's house, one file each.

mod keys;

use blindgrasp_cli::{Outcome, print_line};
use blindgrasp_session::output::write_out;

blindgrasp_cli::program! {
    Keys keys; hidden;
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
