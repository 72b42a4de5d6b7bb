//! `blindgrasp-lab mesh`, which `blindgrasp view` calls to draw the object of a grasp.

use std::path::PathBuf;

use blindgrasp_objects::find_mesh;
use clap::Args;

use super::{Outcome, print_line};

/// Print the mesh of an object as JSON; null stands for an unknown object
#[derive(Debug, Args)]
#[command(hide = true)]
pub(super) struct Arguments {
    object: String,
    /// Folder of the objects' meshes [default: the built-in objects]
    #[arg(long)]
    objects: Option<PathBuf>,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let mesh = find_mesh(&arguments.object, arguments.objects.as_deref())?;
    print_line(&serde_json::to_string(&mesh)?)?;
    Ok(Outcome::Done)
}
