//! The commands of the lab's house, one file each.

mod approaches;
mod completions;
mod evaluate;
mod hand;
mod import;
mod learn;
mod mesh;
mod model;
mod new;
mod object_list;
mod sensors;
mod simulate;
mod train;
mod trials;

use blindgrasp_cli::{Outcome, number_in, print_line, print_text, stop_requests, word};
use blindgrasp_session::output::{check_new, check_output, check_page, write_out, write_report};
use blindgrasp_session::text_table::percent;

blindgrasp_cli::program! {
    Learn learn, Simulate simulate, Import import, Train train, Evaluate evaluate, Trials trials, Model model, Sensors sensors, New new;
    hidden Mesh mesh;
    operators crate::operators::SHIPPED; others &[]
}

#[cfg(test)]
mod tests {
    use std::ffi::OsString;
    use std::path::Path;

    use blindgrasp_cli::hints::with_hint;
    use blindgrasp_cli::houses::LAB;
    use blindgrasp_cli::testing::{mistakes_in_docs, mistakes_in_table};

    use super::*;

    #[test]
    fn the_table_of_houses_and_the_docs_name_these_commands() {
        assert_eq!(mistakes_in_table(LAB.commands, &command()), [""; 0]);
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the project");
        let (n, mistakes) = mistakes_in_docs(root, &command(), Some(&LAB));
        assert!(mistakes.is_empty() && n > 30, "{n} commands\n{}", mistakes.join("\n"));
    }

    #[test]
    fn mistakes_get_a_hint_where_there_is_one() {
        for (line, expected) in [
            ("simulate --zzz 1", "tip: --print-options"),
            ("simulate --grasps many --out x.mcap", "expected a whole number"),
            ("model list", "unrecognized subcommand 'list'\n\nUsage"),
        ] {
            let words: Vec<OsString> =
                std::iter::once("blindgrasp").chain(line.split(' ')).map(OsString::from).collect();
            let error = command().try_get_matches_from(&words).expect_err("a mistake");
            let text = with_hint(error, command(), &words).to_string();
            assert!(text.contains(expected) && !text.contains("as a value"), "blindgrasp {line}: {text}");
        }
    }
}
