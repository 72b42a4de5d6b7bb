"""LIBSVM for the subjects svm and libsvm: Debian's library, unpacked into target/benchsuite/svm (nothing is installed),
with libsvm.cpp around it. It needs apt-get, dpkg and g++."""

import json
import subprocess
import sys
from pathlib import Path

from . import programs

FOLDER = programs.KEPT / "svm"
PROGRAM = FOLDER / "libsvm"
SOURCE = Path(__file__).with_name("libsvm.cpp")


def build():
    """Gets LIBSVM and compiles the program, unless it is there."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    built_from = FOLDER / SOURCE.name
    if PROGRAM.exists() and built_from.read_text() == SOURCE.read_text():
        return
    print(f"unpacking Debian's libsvm-dev into {FOLDER}", file=sys.stderr)
    subprocess.run(["apt-get", "download", "-qq", "libsvm-dev"], cwd=FOLDER, check=True, stderr=subprocess.DEVNULL)
    (package,) = FOLDER.glob("libsvm-dev_*.deb")
    subprocess.run(["dpkg", "-x", package.name, "debian"], cwd=FOLDER, check=True)
    built_from.write_text(SOURCE.read_text())
    (library,) = (FOLDER / "debian" / "usr" / "lib").glob("*/libsvm.a")
    include = FOLDER / "debian" / "usr" / "include"
    subprocess.run(["g++", "-O2", "-I", include, built_from, library, "-o", PROGRAM], check=True)


def run(*arguments):
    """What LIBSVM says, with the objective that it prints after training."""
    said = programs.output(PROGRAM, *arguments)
    result = json.loads(said.splitlines()[-1])
    for line in said.splitlines():
        if line.startswith("obj = "):
            objective, rho = line.split(",")
            result |= {"objective": float(objective.split("=")[1]), "rho": float(rho.split("=")[1])}
        if "#iter" in line:
            result["n_iterations"] = int(line.split("=")[1])
    return result


def version():
    return programs.output(PROGRAM)


def ours(*arguments):
    """What our bench program says to the same."""
    return json.loads(programs.output(programs.bench_program("svm"), *arguments))


def paper_model():
    """A model by the paper's recipe: of the few grasps of the project's recording, for its dictionary and its form."""
    model = FOLDER / "paper.json"
    if not model.exists():
        programs.blindgrasp("train", programs.HELD_OUT, "--recipe", "paper", "--overwrite", "--out", model)
    return model


def problem(n_samples):
    """The paper's feature of that many simulated grasps."""
    path = FOLDER / f"problem-{n_samples}.txt"
    if not path.exists():
        grasps = FOLDER / f"grasps-{n_samples}.mcap"
        # Some 17 % of blind grasps are not felt and have no feature.
        n_grasps = n_samples * 5 // 4 + 100
        words = ["--objects", "train", "--grasps", n_grasps, "--seed", 1, "--overwrite", "--out", grasps]
        programs.blindgrasp("simulate", *words)
        written = ours("features", grasps, paper_model(), n_samples, path)
        if written["n_samples"] != n_samples:
            path.unlink()
            sys.exit(f"only {written['n_samples']} of {n_grasps} grasps were felt, expected {n_samples}")
    return path


def gamma_scale(path):
    """scikit-learn's gamma='scale': 1 / (n_features · variance of all features)."""
    n, total, squares, n_features = 0, 0.0, 0.0, 0
    for line in path.read_text().splitlines():
        n += 1
        for word in line.split()[1:]:
            index, value = word.split(":")
            n_features = max(n_features, int(index))
            total += float(value)
            squares += float(value) ** 2
    count = n * n_features
    return 1 / (n_features * (squares / count - (total / count) ** 2))
