//! `blindgrasp operator`

use std::ffi::OsString;
use std::process::ExitCode;

use blindgrasp_graph::operators::HOST_OPERATOR;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::host;
use blindgrasp_operator::operator::{self, GroupMember, name_process};
use blindgrasp_operators::beginning::check_from_stdin;
use blindgrasp_operators::houses::{CHECK, OTHER_HOUSES};
use blindgrasp_operators::{SHIPPED, Shipped, form_named};
use clap::Args;
use clap::builder::PossibleValuesParser;

/// The process of several operators, which their wiring names.
const GROUP: &str = "group";

/// Run an operator that comes with blindgrasp, as the processes of a graph do.
///
/// The launcher starts this command for each node of a dataflow file that names the operator (run: NAME), so there is
/// seldom a reason to start it by hand. The process bears the operator's name in ps, pgrep and top.
#[derive(Debug, Args)]
#[command(
    hide = true,
    after_help = "Examples:\n  \
                  blindgrasp operator contacts --describe              # its ports and parameters as JSON\n  \
                  blindgrasp operator recorded_source feature --describe"
)]
pub struct Arguments {
    /// The operator.
    #[arg(value_parser = names())]
    name: String,
    /// Arguments of the operator: of recorded_source, the output that it publishes; --describe prints what a graph may connect
    /// and set.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENT")]
    arguments: Vec<String>,
}

/// Runs the operator of these `shipped` ones until it ends. It tells the launcher itself why it failed.
pub fn run(arguments: &Arguments, shipped: &[Shipped]) -> ExitCode {
    let name = &arguments.name;
    if name == GROUP {
        name_process(GROUP);
        return operator::run_group(member);
    }
    if name == HOST_OPERATOR {
        let words: Vec<OsString> = arguments.arguments.iter().map(OsString::from).collect();
        let Some((program, rest)) = words.split_first() else {
            print_diagnostic("blindgrasp operator host: it has no program, expected one and its arguments");
            return ExitCode::from(2);
        };
        return host::run(program, rest);
    }
    let is_check = arguments.arguments.iter().any(|text| text == CHECK);
    let given: Vec<&str> =
        arguments.arguments.iter().map(String::as_str).filter(|text| !["--describe", CHECK].contains(text)).collect();
    if !shipped.iter().any(|shipped| shipped.name == name) {
        print_diagnostic(&format!("{name} is an operator of another program: expected 'blindgrasp operator {name}'"));
        return ExitCode::from(2);
    }
    let Some(form) = form_named(shipped, name, &given) else {
        let variants = shipped.iter().filter(|shipped| shipped.name == name).flat_map(|shipped| shipped.variants);
        let known: Vec<&str> = variants.map(|(argument, _)| *argument).collect();
        let known =
            if known.is_empty() { "no argument".into() } else { format!("one of {}, or nothing", known.join(", ")) };
        let given = given.join(" ");
        print_diagnostic(&format!("blindgrasp operator {name}: unknown argument '{given}': expected {known}"));
        return ExitCode::from(2);
    };
    if is_check {
        return check_from_stdin(form);
    }
    name_process(name);
    operator::run(&(form.describe)(), form.work)
}

/// An operator of a group by the arguments that a dataflow file gives it.
fn member(args: &[String]) -> Option<GroupMember> {
    let (name, arguments) = args.split_first()?;
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let form = form_named(&SHIPPED, name, &arguments)?;
    Some(((form.describe)(), form.work))
}

fn names() -> PossibleValuesParser {
    let own = SHIPPED.iter().map(|shipped| shipped.name);
    PossibleValuesParser::new(own.chain(OTHER_HOUSES.map(|(name, _)| name)).chain([GROUP, HOST_OPERATOR]))
}
