"""Whether lifts in physics come out the same with half the time step: of the whole simulation, and of the lift alone.

Lifts are the same if they have the same candidate number: the simulations differ in the time step only, and have the
options of benches/lifts.yaml.
"""

import json
import tempfile
from pathlib import Path

from . import figures, programs
from .options import Option

OPTIONS = {
    "lifts": Option(1000, "number of lifts", quick=10, least=1),
    "seed": Option(201, "of the lifts"),
}
USUAL = programs.PROJECT / "benches" / "lifts.yaml"
STEPS = {
    "half, from the approach on": "step_secs: 0.0025",
    "half, in the lift alone": "lift_step_secs: 0.0025",
}


def measure(options):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        usual = outcomes(simulate(folder / "usual", USUAL, options))
        compared = {}
        for side, step in STEPS.items():
            file = folder / "options.yaml"
            file.write_text(USUAL.read_text().replace("lift:\n", f"lift:\n  {step}\n", 1))
            compared[side] = compare(usual, outcomes(simulate(folder / side, file, options)))
    return compared


def simulate(out, options_file, options):
    figures.progress(out.name)
    words = ["--label", "lift", "--objects", "train", "--stable-fraction", "natural", "--options", options_file]
    programs.blindgrasp("simulate", *words, "--seed", options.seed, "--grasps", options.lifts, "--out", out)
    return sorted(out.glob("part-*.mcap"))


def outcomes(recordings):
    """Whether each candidate's lift kept the object."""
    kept = {}
    for recording in recordings:
        lines = programs.blindgrasp("export", recording, "--topic", "/truth", "--topic", "/scene").splitlines()
        of_topic = {"/truth": {}, "/scene": {}}
        for line in map(json.loads, lines):
            of_topic[line["topic"]][line["data"]["grasp_id"]] = line["data"]
        for grasp_id, scene in of_topic["/scene"].items():
            kept[scene["candidate"]] = of_topic["/truth"][grasp_id]["stable"]
    return kept


def compare(first, second):
    both = sorted(first.keys() & second.keys())
    return {
        "n_lifts": len(both),
        "kept_before": sum(first[candidate] for candidate in both),
        "kept_after": sum(second[candidate] for candidate in both),
        "kept_only_before": sum(first[candidate] and not second[candidate] for candidate in both),
        "kept_only_after": sum(second[candidate] and not first[candidate] for candidate in both),
    }


def show(result):
    figures.table(["time step", *next(iter(result.values()))], [[side, *found.values()] for side, found in result.items()])
