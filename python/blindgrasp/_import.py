"""Tables of tactile readings as recordings, by `blindgrasp import`."""

from __future__ import annotations

import csv
import itertools
import tempfile
import warnings
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ._program import answer_of
from ._recording import Recording

if TYPE_CHECKING:
    import pandas

# Texts of values that are not known: None, and those of numpy and pandas.
MISSING = ("None", "nan", "NaT", "<NA>")


def from_table(
    table: pandas.DataFrame | Mapping[str, Sequence[object]] | Iterable[Mapping[str, object]],
    out: str | PathLike[str],
    *,
    hand: str | PathLike[str],
    cells: str | Sequence[str] = "cell_*",
    joint_columns: str | Sequence[str] = "joint_*",
    joints: Mapping[str, float] | None = None,
    label: str = "stable",
    stable_value: object = True,
    group: str = "object",
    class_column: str | None = None,
    day: object = None,
    day_column: str | None = None,
    grasp_column: str | None = None,
    phase_column: str | None = None,
    frames: int | None = None,
    grasp_id_start: int = 0,
    overwrite: bool = False,
) -> Recording:
    """Writes the grasps of a table to the recording `out`, and returns it.

    The table is a DataFrame of pandas, a dict of columns that are equally long, or rows that are dicts (`to_pylist()` of
    pyarrow, `iter_rows(named=True)` of polars). A row is a grasp; with `grasp_column`, a frame of the grasp that this
    column names. Columns that no argument names are not read, so a table of `Recording.to_frame` becomes a recording as
    it is.

    `cells` are the columns of the hand's cells in their order, names or patterns with `*`, in newtons (counts if the
    hand's cells read counts). `joint_columns` are those of its joints, in radians, or metres of a joint that slides;
    `joints` is one posture for all grasps in their place. `label` is the column that says how the grasp ended:
    `stable_value` is one of its two values. `group` is the column of the object, `class_column` of its class, `day` and
    `day_column` name the session (a time is of its date), and `phase_column` the phase of a frame. `frames` is how often the reading of a grasp
    that is one row is repeated (3). docs/learning.md has the rules.

    Raises ProgramError if the program refuses the table; line 2 in its text is the first row. Warns of what it warns of.
    """
    options = {
        "hand": fspath(hand),
        "cells": _listed(cells),
        "joint-columns": _listed(joint_columns) if joints is None else None,
        "joints": None if joints is None else ",".join(f"{name}={value}" for name, value in joints.items()),
        "label": label,
        "stable-value": str(stable_value),
        "group": group,
        "class": class_column,
        "day": day,
        "day-column": day_column,
        "grasp-column": grasp_column,
        "phase-column": phase_column,
        "frames": frames,
        "grasp-id-start": grasp_id_start,
        "out": fspath(out),
    }
    words = [f"--{name}={value}" for name, value in options.items() if value is not None]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.csv"
        _write(table, path)
        report = answer_of(["import", str(path), *words, "--json", *(["--overwrite"] if overwrite else [])])
    for warning in report["warnings"]:
        warnings.warn(warning, stacklevel=2)
    return Recording(out)


def _write(table: Any, path: Path) -> None:
    """Writes the table as the CSV that the import reads."""
    if hasattr(table, "itertuples"):
        names, rows = list(table.columns), table.itertuples(index=False, name=None)
    elif isinstance(table, Mapping):
        lengths = {name: len(values) for name, values in table.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"expected columns that are equally long; found lengths {lengths}")
        names, rows = list(table), zip(*table.values(), strict=True)
    else:
        dicts = iter(table)
        first = next(dicts, {})
        if not isinstance(first, Mapping):
            found = type(first).__name__
            raise TypeError(f"expected a DataFrame, a dict of columns, or rows that are dicts; found rows that are {found} (polars: iter_rows(named=True))")
        names = list(first)
        rows = ([row.get(name) for name in names] for row in itertools.chain([first] if names else [], dicts))
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(names)
        writer.writerows([_text(value) for value in row] for row in rows)


def _text(value: object) -> str:
    # A cell of MATLAB or HDF5 is an array of one value, and a text may be bytes.
    if getattr(value, "ndim", 0) and value.size == 1:
        value = value.item()
    if getattr(value, "ndim", 0) or isinstance(value, (list, tuple, dict)):
        raise TypeError(f"expected one value in each column of a row, found {value!r}")
    text = value.decode() if isinstance(value, bytes) else str(value)
    return "" if text in MISSING else text


def _listed(names: str | Sequence[object]) -> str:
    return names if isinstance(names, str) else ",".join(map(str, names))
