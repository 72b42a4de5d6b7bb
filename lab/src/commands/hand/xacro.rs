//! Expands xacro files by the program xacro, also where there is no ROS that knows the packages of `$(find NAME)`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use anyhow::{Context, bail};
use blindgrasp_simulator::trial::python_path;
use blindgrasp_stages::hand::{decode_urdf, find_package};

/// A stand-in for the module of ROS 2 by which xacro finds packages. Packages are sought by [`find_package`], also where ROS is
/// sourced: a package that is only checked out is none for ROS.
const AMENT_INDEX: &str = "import json, os\n\
    class PackageNotFoundError(KeyError):\n    pass\n\
    def get_package_share_directory(package, print_warning=True):\n    \
        found = json.loads(os.environ['BLINDGRASP_PACKAGES'])\n    \
        if package not in found:\n        \
            raise PackageNotFoundError('blindgrasp looks for the package <<' + package + '>>')\n    \
        return found[package]\n";
/// Most packages that a file may name.
const MAX_PACKAGES: usize = 50;

/// `NAME:=VALUE`, as xacro takes it. `NAME=VALUE` means the same.
pub(super) fn argument(text: &str) -> Result<String, String> {
    match text.split_once(":=").or_else(|| text.split_once('=')) {
        Some((name, value)) if !name.is_empty() => Ok(format!("{name}:={value}")),
        _ => Err("expected NAME:=VALUE, as in side:=left".into()),
    }
}

/// The URDF that a xacro file describes. `$(find NAME)` is the folder of a package as `package://NAME` finds it.
pub(super) fn expanded(path: &Path, arguments: &[String]) -> anyhow::Result<String> {
    let folder = tempfile::tempdir().context("cannot make a folder for xacro")?;
    let module = folder.path().join("ament_index_python");
    std::fs::create_dir(&module)
        .and_then(|()| std::fs::write(module.join("__init__.py"), "from .packages import *\n"))
        .and_then(|()| std::fs::write(module.join("packages.py"), AMENT_INDEX))
        .context("cannot write for xacro")?;
    let mut packages: BTreeMap<String, PathBuf> = BTreeMap::new();
    loop {
        let output = run(path, arguments, folder.path(), &packages)?;
        let said = String::from_utf8_lossy(&output.stderr);
        if output.status.success() {
            let urdf = decode_urdf(&output.stdout);
            if !urdf.contains("<link") {
                bail!(
                    "{}: it makes no link: it defines macros only; give the file that uses them, or their arguments with \
                     --xacro-arg",
                    path.display()
                );
            }
            return Ok(urdf);
        }
        let wanted =
            said.split_once("<<").and_then(|(_, after)| after.split_once(">>")).map(|(name, _)| name.to_owned());
        let Some(package) = wanted.filter(|package| packages.len() < MAX_PACKAGES && !packages.contains_key(package))
        else {
            bail!("xacro {}: {}{}", path.display(), said.trim(), advice(&said));
        };
        let from = path.parent().unwrap_or(Path::new(""));
        let Some(found) = find_package(&package, from).next() else {
            bail!(
                "xacro {}: $(find {package}): no package '{package}' above the file or beside one of these folders: put it \
                 there, or source ROS",
                path.display()
            );
        };
        packages.insert(package, found);
    }
}

fn run(
    path: &Path,
    arguments: &[String],
    stand_in: &Path,
    packages: &BTreeMap<String, PathBuf>,
) -> anyhow::Result<Output> {
    let places = std::env::join_paths([vec![stand_in.to_path_buf()], python_path()].concat())?;
    let output = Command::new("xacro")
        .arg(path)
        .args(arguments)
        .env("PYTHONPATH", places)
        .env("BLINDGRASP_PACKAGES", serde_json::to_string(packages)?)
        .output();
    output.map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => {
            anyhow::anyhow!("{}: the program xacro is not installed: pip install xacro, or source ROS", path.display())
        }
        _ => anyhow::anyhow!("cannot run xacro: {error}"),
    })
}

fn advice(said: &str) -> &'static str {
    if said.contains("xacro:arg: missing attribute 'default'") {
        "\nxacro wants a default: write default=\"\" into that <xacro:arg>, and give its value with --xacro-arg NAME:=VALUE"
    } else if said.contains("Undefined substitution argument") {
        "\ngive the argument with --xacro-arg NAME:=VALUE"
    } else {
        ""
    }
}
