//! `blindgrasp quality`

use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::{Outcome, number_in, print_line};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_simulator::case_file::parse_cases;
use blindgrasp_simulator::quality_metrics::{Load, Metrics, all_metrics};
use blindgrasp_simulator::wrench_space::{GraspCase, Quality, QualityError, is_stable, quality};

/// Judge grasps by their contacts: epsilon and volume of the grasp wrench space, and further qualities.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp quality grasps.json --json\n\n\
                  A case: {\"centre_of_mass_m\", \"max_radius_m\", \"contacts\": [{\"point_m\", \"inward_normal\", \
                  \"tangent\", \"friction\", \"torsion_m\"}]}; docs/quality.md explains it. A case that fails is said, \
                  the others are judged all the same, and the exit code is 1.")]
pub(super) struct Arguments {
    /// JSON file with a grasp case, a list of cases, or a case per line; - is stdin.
    file: PathBuf,
    /// Which qualities: the label alone (a few microseconds each), epsilon and volume, or all of docs/quality.md.
    #[arg(long, value_enum, default_value_t = MetricSet::Basic)]
    metrics: MetricSet,
    /// With --metrics all: the object's mass, for the normal force that holds it whichever way is down.
    #[arg(long, value_name = "KG", requires = "metrics", allow_negative_numbers = true,
          value_parser = |text: &str| number_in(text, 1e-9..=1e9))]
    mass: Option<f64>,
    /// With --mass: the way down, X,Y,Z in the frame of the contacts, for the force that holds it this way.
    #[arg(long, value_name = "X,Y,Z", requires = "mass", allow_hyphen_values = true, value_parser = direction)]
    gravity: Option<Direction>,
    /// Print a JSON object per case.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum MetricSet {
    Label,
    Basic,
    All,
}

#[derive(Debug, Clone, Copy)]
struct Direction([f64; 3]);

/// A line of JSON.
#[derive(Serialize)]
struct Row<'a> {
    case: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<&'a str>,
    #[serde(flatten)]
    found: Found,
}

#[derive(Serialize)]
#[serde(untagged)]
enum Found {
    Failed {
        error: String,
    },
    Label {
        stable: bool,
    },
    Basic {
        #[serde(flatten)]
        quality: Quality,
        stable: bool,
    },
    All {
        #[serde(flatten)]
        metrics: Metrics,
        stable: bool,
    },
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let path = &arguments.file;
    if arguments.mass.is_some() && arguments.metrics != MetricSet::All {
        bail!("--mass needs --metrics all: the others don't depend on it");
    }
    let cases = parse_cases(&read(path)?).with_context(|| shown(path))?;
    if !arguments.json {
        print_line(&header(arguments))?;
    }
    let n_cases = cases.len();
    let mut n_failed = 0;
    for (case_idx, named) in cases.into_iter().enumerate() {
        let judged = named.case.map_err(anyhow::Error::from).and_then(|case| Ok(judge(&case, arguments)?));
        let found = judged.unwrap_or_else(|error| {
            print_diagnostic(&format!("{}: case {case_idx}: {error:#}", shown(path)));
            n_failed += 1;
            Found::Failed { error: format!("{error:#}") }
        });
        let row = Row { case: case_idx, name: named.name.as_deref(), found };
        print_line(&if arguments.json { serde_json::to_string(&row)? } else { table_row(&row, arguments) })?;
    }
    if n_failed > 0 {
        bail!("{}: {n_failed} of {n_cases} cases have no quality, as said above", shown(path));
    }
    Ok(Outcome::Done)
}

fn read(path: &Path) -> anyhow::Result<String> {
    let mut text = String::new();
    let read = if path == Path::new("-") {
        std::io::stdin().lock().read_to_string(&mut text)
    } else {
        std::fs::File::open(path).and_then(|mut file| file.read_to_string(&mut text))
    };
    read.with_context(|| shown(path))?;
    Ok(text)
}

fn shown(path: &Path) -> String {
    if path == Path::new("-") { "stdin".into() } else { path.display().to_string() }
}

fn judge(case: &GraspCase, arguments: &Arguments) -> Result<Found, QualityError> {
    match arguments.metrics {
        MetricSet::Label => is_stable(case).map(|stable| Found::Label { stable }),
        MetricSet::Basic => quality(case).map(|quality| Found::Basic { stable: quality.is_stable(), quality }),
        MetricSet::All => {
            let load = arguments
                .mass
                .map(|mass_kg| Load { mass_kg, gravity_direction: arguments.gravity.map(|Direction(down)| down) });
            let metrics = all_metrics(case, load.as_ref())?;
            Ok(Found::All { stable: metrics.quality.is_stable(), metrics })
        }
    }
}

fn header(arguments: &Arguments) -> String {
    if arguments.metrics == MetricSet::Label {
        return "   case  stable  name".into();
    }
    let mut line = "   case    epsilon      volume  wrenches  closure  stable".to_owned();
    if arguments.metrics == MetricSet::All {
        line += "   linf eps   ellipsoid  least sv";
    }
    if arguments.mass.is_some() {
        line += "  gravity N";
    }
    if arguments.gravity.is_some() {
        line += "    along N";
    }
    line + "  name"
}

fn table_row(row: &Row<'_>, arguments: &Arguments) -> String {
    let yes_no = |so| if so { "yes" } else { "no" };
    let basic = |quality: &Quality, stable| {
        let Quality { epsilon, volume, n_wrenches, force_closure, .. } = quality;
        let (closure, stable) = (yes_no(*force_closure), yes_no(stable));
        format!("{epsilon:>10.6}  {volume:>10.6}  {n_wrenches:>8}  {closure:>7}  {stable:>6}")
    };
    let mut line = format!("{:>7} ", row.case);
    line += &match &row.found {
        Found::Failed { .. } => format!("{:>10}", "failed"),
        Found::Label { stable } => format!("{:>7}", yes_no(*stable)),
        Found::Basic { quality, stable } => basic(quality, *stable),
        Found::All { metrics, stable } => {
            let Metrics { quality, linf_epsilon, ellipsoid_volume, smallest_singular_value, .. } = metrics;
            let newtons = |force: Option<f64>| force.map_or("-".into(), |newtons| format!("{newtons:.3}"));
            let mut all = basic(quality, *stable);
            all += &format!("  {linf_epsilon:>9.6}  {ellipsoid_volume:>10.4}  {smallest_singular_value:>8.5}");
            if arguments.mass.is_some() {
                all += &format!("  {:>9}", newtons(metrics.gravity_force_newtons));
            }
            if arguments.gravity.is_some() {
                all += &format!("  {:>9}", newtons(metrics.gravity_force_along_newtons));
            }
            all
        }
    };
    line += &format!("  {}", row.name.unwrap_or_default());
    line.trim_end().into()
}

fn direction(text: &str) -> Result<Direction, String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|part| part.trim().parse().ok()).collect();
    let numbers: Option<[f64; 3]> = numbers.and_then(|numbers| numbers.try_into().ok());
    numbers
        .filter(|numbers| numbers.iter().all(|x| x.is_finite()) && numbers.iter().any(|x| x.abs() > 1e-100))
        .map(Direction)
        .ok_or("expected three numbers X,Y,Z, not all 0".into())
}
