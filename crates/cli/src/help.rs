//! The list of commands in `--help`, in groups.

use clap::Command;

use crate::houses::GROUPS;

const TEMPLATE: &str = "{about-with-newline}\n{usage-heading} {usage}\n\n{before-help}Options:\n{options}{after-help}";

/// The command with its subcommands listed in groups.
pub fn grouped(command: Command) -> Command {
    let mut list = String::new();
    for (group, names) in GROUPS {
        let commands: Vec<&Command> = names.iter().filter_map(|name| command.find_subcommand(name)).collect();
        if commands.is_empty() {
            continue;
        }
        list += &format!("{group}:\n");
        for command in commands {
            let about = command.get_about().map(ToString::to_string).unwrap_or_default();
            list += &format!("  {:<12} {}\n", command.get_name(), about.trim_end_matches('.'));
        }
        list += "\n";
    }
    // The list brings its own end of line.
    command.help_template(TEMPLATE).before_help(list.trim_end().to_owned())
}
