"""How well a real fingertip tells a resting contact from a sliding one: the table of docs/results.md.

`sequences` is the folder csvs of the public set BioTacSP-DoS: a folder for each kind of contact (t: it rests; n, e, s,
w, cw, aw: it slides), with a table of 24 electrodes at 100 Hz for each sequence of 3 s, named after the object and a
number. Each sequence becomes a grasp: six settled frames, 0.2 s of movement, and six frames after it, the first of which
is in the middle.
"""

import csv
import json
import re
import shutil
import sys
import tempfile
from pathlib import Path

from . import figures, programs
from .options import REQUIRED, Option

OPTIONS = {"sequences": Option(REQUIRED, "the folder csvs of BioTacSP-DoS")}
N_STILL, N_MOVING = 6, 20
# Two spellings of one object.
OBJECTS = {"strippes": "striped"}
LOOKS = {
    "earlier_alone": "the earlier reading",
    "later_alone": "the later reading",
    "with_movement": "both, and the 0.2 s between",
}


def measure(options):
    sequences = sorted(options.sequences.glob("*/*.csv"))
    if not sequences:
        sys.exit(f"{options.sequences}: no table in its folders; expected the folder csvs of BioTacSP-DoS")
    areas = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        hand = one_fingertip(folder)
        for later_alone in (False, True):
            training = train(sequences, hand, folder, later_alone)
            for policy in training["policies"]:
                look = "earlier_alone" if policy["look"] == "settled" else "with_movement"
                areas["later_alone" if later_alone else look] = policy["roc_area"]
    counts = {name: training[name] for name in ("n_grasps", "n_objects", "n_stable")}
    return counts | {"roc_area": areas}


def one_fingertip(folder):
    """The layout of the middle finger alone."""
    pads = re.compile(r"  - \{name: (first|thumb), .*\n")
    hands = programs.PROJECT / "hands"
    text = pads.sub("", (hands / "shadow-biotac-sp.yaml").read_text())
    layout = folder / "fingertip.yaml"
    layout.write_text(text.replace("name: shadow-biotac-sp", "name: biotac-sp-fingertip"))
    shutil.copy(hands / "shadow-biotac-sp.urdf", folder)
    return layout


def train(sequences, hand, folder, later_alone):
    """What a model says of its training."""
    table, recording, model = folder / "frames.csv", folder / "frames.mcap", folder / "model.json"
    write_table(sequences, table, later_alone)
    columns = ["--cells", "e*", "--label", "contact", "--stable-value", "rests", "--group", "object"]
    columns += ["--grasp-column", "grasp", "--phase-column", "phase", "--joints", "palm_pitch=0"]
    programs.blindgrasp("import", table, "--hand", hand, *columns, "--overwrite", "--out", recording)
    # The cost of a drop chooses thresholds, which do not matter here: the areas do not depend on them.
    words = ["--words", 8, "--drop-costs", 40, "--overwrite", "--out", model]
    programs.blindgrasp("train", recording, "--hand", hand, *words)
    return json.loads(model.read_text())["training"]


def write_table(sequences, table, later_alone):
    """One row a frame, up to the middle of each sequence; or only the later frames, as settled ones."""
    n_grasps = 0
    with table.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["grasp", "object", "contact", "phase", *(f"e{number}" for number in range(1, 25))])
        for path in sequences:
            rows = frames_of(path, later_alone)
            n_grasps += bool(rows)
            out.writerows(rows)
    if n_grasps == 0:
        sys.exit(f"{sequences[0].parent.parent}: no sequence is long enough")


def frames_of(path, later_alone):
    """The rows of a sequence; none if it is too short."""
    phases = ["settled"] * N_STILL + ["squeezing"] * N_MOVING + ["squeezed"] * N_STILL
    with path.open(newline="") as sequence:
        _, *readings = csv.reader(sequence)
    begin = len(readings) // 2 - N_STILL - N_MOVING
    if begin < 0 or len(readings) < begin + len(phases):
        expected = len(phases) + N_MOVING
        figures.progress(f"{path}: {len(readings)} readings, expected {expected} or more: left out")
        return []
    name = re.sub(r"\d+$", "", path.stem)
    contact = "rests" if path.parent.name == "t" else "slides"
    head = [f"{path.parent.name}/{path.stem}", OBJECTS.get(name, name), contact]
    frames = list(zip(phases, readings[begin:]))
    if later_alone:
        return [[*head, "settled", *reading] for _, reading in frames[N_STILL + N_MOVING :]]
    return [[*head, phase, *reading] for phase, reading in frames]


def show(result):
    print(f"{result['n_grasps']} contacts of {result['n_objects']} objects, {result['n_stable']} at rest; recipe boosted")
    figures.table(["", "ROC area, by object"], [[words, f"{result['roc_area'][look]:.3f}"] for look, words in LOOKS.items()])
