"""How models judge real grasps of another day: the tables of docs/results.md.

`tables` is a folder with the tables of the BioTac SP Stability Set v2 (bts3v2_palm_down.csv, …) and
other-day-palm_side.csv, whose columns are the same and whose grasps are of other objects and another day.
"""

import csv
import json
import random
import statistics
import tempfile
from pathlib import Path

from . import figures, programs
from .options import REQUIRED, Option

OPTIONS = {
    "tables": Option(REQUIRED, "the folder of the tables"),
    "orders": Option(20, "random orders of the grasps of the other day", quick=1, least=1),
    "quarters": Option(3, "quarters of the objects that are new in turn, at most 4", quick=1, least=1),
}
PITCH_RAD = {"bts3v2_palm_down": 0.0, "bts3v2_palm_45": 0.7854, "bts3v2_palm_side": 1.5708}
OTHER = "other-day-palm_side"
N_LABELLED = 30
FIGURES = ("accuracy", "false_positive_rate", "recall", "calibration_error", "roc_area")


def measure(options):
    with tempfile.TemporaryDirectory() as folder:
        study = Study(options.tables, Path(folder))
        return {"rows": [*other_day(study, options), *left_out_table(study, options)]}


class Study:
    """Tables that become recordings, models and judgements in a folder."""

    def __init__(self, tables, folder):
        self.tables, self.folder = tables, folder

    def rows(self, name):
        with (self.tables / f"{name}.csv").open(newline="") as file:
            header, *rows = csv.reader(file)
        return header, rows

    def record(self, name, header, rows, pitch_rad, day, first_id):
        table, out = self.folder / "table.csv", self.folder / f"{name}.mcap"
        with table.open("w", newline="") as file:
            csv.writer(file).writerows([header, *rows])
        columns = ["--cells", "ff_biotac_*,mf_biotac_*,th_biotac_*", "--label", "slipped", "--stable-value", "0"]
        columns += ["--group", "object", "--joints", f"palm_pitch={pitch_rad}", "--grasp-id-start", first_id]
        if day:
            columns += ["--day", day]
        programs.blindgrasp("import", table, "--hand", "shadow-biotac-sp", *columns, "--overwrite", "--out", out)
        return out

    def train(self, name, recordings, *options):
        out = self.folder / f"{name}.json"
        programs.blindgrasp("train", *recordings, "--overwrite", "--out", out, *options)
        return out

    def judge(self, model, recording):
        report = json.loads(programs.blindgrasp("evaluate", model, recording, "--json"))
        score, judge = report["score_judged"], report["judges"][0]
        found = {"n_judged": score["n_grasps"]} | dict.fromkeys(FIGURES)
        if found["n_judged"] == 0:
            return found | {"reasons": report["by_reason"]}
        return found | {
            "accuracy": score["accuracy"],
            "false_positive_rate": score["false_positive_rate"],
            "recall": score["n_true_positive"] / score["n_stable"],
            "calibration_error": judge["reliability"]["ece"],
            "roc_area": judge["roc_auc"],
            "intervals": {name: judge["judged"][name]["interval"] for name in FIGURES[:2]},
            "reasons": report["by_reason"],
        }

    def judge_in_order(self, model, header, rows, pitch_rad, day):
        """Without labels, and after the first grasps with labels."""
        whole = self.record("whole", header, rows, pitch_rad, day, 50_000)
        first = self.record("first", header, rows[:N_LABELLED], pitch_rad, day, 50_000)
        rest = self.record("rest", header, rows[N_LABELLED:], pitch_rad, day, 50_000 + N_LABELLED)
        corrected = self.folder / "corrected.json"
        programs.blindgrasp("model", "adapt", model, first, "--overwrite", "--out", corrected)
        return {"no labels": self.judge(model, whole), f"{N_LABELLED} labels": self.judge(corrected, rest)}


def other_day(study, options):
    header, rows = study.rows(OTHER)
    pitch = PITCH_RAD["bts3v2_palm_side"]
    yield from as_recorded(study, header, rows, pitch, with_days=False)
    yield from as_recorded(study, header, rows, pitch, with_days=True)
    for order, is_by_object in ("in random order", False), ("object by object", True):
        judged = []
        for seed in range(100, 100 + options.orders):
            shuffled = in_order(rows, random.Random(seed), is_by_object)
            model = study.folder / "baseline-blend.json"
            judged.append(study.judge_in_order(model, header, shuffled, pitch, OTHER))
        yield from means(f"other day, {order}", judged)


def as_recorded(study, header, rows, pitch_rad, with_days):
    recordings = []
    for idx, (name, pitch) in enumerate(PITCH_RAD.items()):
        recordings.append(study.record(name, *study.rows(name), pitch, name if with_days else None, 10_000 * idx))
    whole = study.record("other-day", header, rows, pitch_rad, OTHER if with_days else None, 50_000)
    grasps = "other day, as recorded"
    for recipe in ("blend", "raw", "boosted"):
        figures.progress(f"{grasps}, {recipe}")
        plain = study.train("plain", recordings, "--recipe", recipe)
        known = "days known" if with_days else "days not known"
        yield row(grasps, recipe, known, study.judge(plain, whole))
        if with_days:
            model = study.train(f"baseline-{recipe}", recordings, "--recipe", recipe, "--day-baseline")
            yield row(grasps, recipe, "baseline", study.judge(model, whole))


def in_order(rows, chance, is_by_object):
    shuffled = chance.sample(rows, len(rows))
    if is_by_object:
        names = sorted({row[0] for row in rows})
        objects = chance.sample(names, len(names))
        shuffled.sort(key=lambda row: objects.index(row[0]))
    return shuffled


def left_out_table(study, options):
    """A table as the other day: two tables without a quarter of the objects to train on, that quarter of the third to judge."""
    tables = {name: study.rows(name) for name in PITCH_RAD}
    objects = sorted({row[0] for _, rows in tables.values() for row in rows})
    random.Random(7).shuffle(objects)
    judged = {"in random order": [], "object by object": []}
    for left_out in PITCH_RAD:
        for quarter in range(options.quarters):
            figures.progress(f"{left_out} left out, quarter {quarter + 1}")
            new = set(objects[quarter::4])
            # One posture for all: a posture that was not trained on is held.
            recordings = []
            for idx, name in enumerate(PITCH_RAD):
                if name != left_out:
                    header, rows = tables[name]
                    known = [row for row in rows if row[0] not in new]
                    recordings.append(study.record(name, header, known, 0, name, 10_000 * idx))
            model = study.train("left-out", recordings, "--recipe", "blend", "--day-baseline")
            header, rows = tables[left_out]
            rows = [row for row in rows if row[0] in new]
            for order, of_order in judged.items():
                shuffled = in_order(rows, random.Random(quarter), order == "object by object")
                of_order.append(study.judge_in_order(model, header, shuffled, 0, left_out))
    for order, of_order in judged.items():
        yield from means(f"a table left out, new objects, {order}", of_order)


def means(grasps, judged):
    for labels in judged[0]:
        found = [one[labels] for one in judged]
        mean = {key: round(statistics.mean(one[key] for one in found), 4) for key in ("n_judged", *FIGURES)}
        yield row(f"{grasps}, mean of {len(found)}", "blend", f"baseline, {labels}", mean)


def row(grasps, recipe, model, found):
    return {"grasps": grasps, "recipe": recipe, "model": model, **found}


def show(result):
    rows = []
    for found in result["rows"]:
        cells = []
        for name in FIGURES:
            interval = found.get("intervals", {}).get(name)
            ends = " ({low:.2f}..{high:.2f})".format(**interval) if interval else ""
            cells.append("" if found[name] is None else f"{found[name]:.3f}{ends}")
        reasons = ", ".join(f"{reason} {n}" for reason, n in found.get("reasons", {}).items())
        rows.append([f"{found['grasps']}: {found['recipe']}, {found['model']}", found["n_judged"], *cells, reasons])
    figures.table(["grasps: recipe, model", "judged", *(name.replace("_", " ") for name in FIGURES), "held"], rows)
