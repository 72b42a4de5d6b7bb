"""Models: what they are made of, and what they predict of grasps."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from ._program import Process, answer_of
from ._recording import Grasp, Recording
from ._types import Label


@dataclasses.dataclass
class Predictions:
    """What a model predicts of grasps: element i of each array is about the i-th grasp."""

    file: NDArray[np.str_]
    """(n_grasps,): the file that the grasp is from; `-` for grasps that were given as arrays."""
    grasp_id: NDArray[np.int64]
    """(n_grasps,)"""
    probability_stable: NDArray[np.float64]
    """(n_grasps,): the calibrated probability that decided, from 0 to 1; 0 if none did."""
    action: NDArray[np.str_]
    """(n_grasps,): `lift` or `hold`."""
    reason: NDArray[np.str_]
    """(n_grasps,): why, like `stable` (docs/messages.md)."""
    labels: list[Label | None]
    """What is known to be true of each grasp; None if nothing is."""

    def __len__(self) -> int:
        return len(self.grasp_id)

    @property
    def is_labelled(self) -> NDArray[np.bool_]:
        """(n_grasps,): whether the grasp has a label."""
        return np.array([label is not None for label in self.labels], bool)

    @property
    def is_stable(self) -> NDArray[np.bool_]:
        """(n_grasps,): what the labels say; False for a grasp without one."""
        return np.array([label is not None and label.is_stable for label in self.labels], bool)

    @property
    def is_lifted(self) -> NDArray[np.bool_]:
        """(n_grasps,): whether the action is `lift`."""
        return self.action == "lift"


class Model:
    """A model, as `blindgrasp model show` describes it.

    Raises FileNotFoundError if there is no file, ProgramError if it is no model, and ProgramNotFoundError.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(fspath(path))
        if not self.path.is_file():
            raise FileNotFoundError(f"{self.path}: there is no such model file")
        info = answer_of(["model", "show", str(self.path.absolute()), "--json"])
        self.info: dict[str, Any] = info
        """All that `blindgrasp model show --json` prints."""
        self.hand: str = info["hand"]
        """The name of the hand that it was trained for."""
        self.hand_id: str = info["hand_id"]
        """The identity of that hand's layout, 16 hexadecimal digits."""
        self.recipe: str = info["recipe"]["name"]
        """The name of the recipe, like `boosted`."""
        self.threshold_probability: float = info["threshold_probability"]
        """A grasp is called stable from this probability."""
        self.objects: tuple[str, ...] = tuple((info["training"].get("trained_on") or {}).get("objects") or ())
        """The names of the objects that it was trained on."""
        self.checksum: str = info["checksum"]
        """The checksum that the file holds."""

    def __repr__(self) -> str:
        return f"Model({str(self.path)!r}, hand={self.hand!r}, recipe={self.recipe!r})"

    def predict(self, source: Source) -> Predictions:
        """Decides grasps as a graph with this model would (`blindgrasp predict`).

        `source` is a recording's path, a Recording, several paths, or grasps: one Grasp, or any number of them. Grasps may
        be made by hand from arrays of your own.

        Raises ProgramError if a recording cannot be read or is of another hand.
        """
        if isinstance(source, Recording):
            source = source.path
        if isinstance(source, (str, PathLike)):
            source = [source]
        elif isinstance(source, Grasp):
            source = [source]
        items = iter(source)
        first = next(items, None)
        if first is None:
            return _predictions([], [])
        command = ["predict", "--json", str(self.path.absolute())]
        if isinstance(first, (str, PathLike)):
            paths = [str(Path(fspath(path)).absolute()) for path in [first, *items]]
            with Process([*command, *paths]) as process:
                return _predictions(process.lines(), [])
        # A file and not a pipe: the program may print answers before it has read all frames.
        with tempfile.TemporaryFile() as frames:
            labels = []
            for grasp in (first, *items):
                frames.writelines(_frame_lines(grasp))
                labels.append(grasp.label)
            frames.seek(0)
            with Process([*command, "-"], stdin=frames) as process:
                return _predictions(process.lines(), labels)


Source = str | PathLike[str] | Recording | Grasp | Iterable[str] | Iterable[PathLike[str]] | Iterable[Grasp]


def _predictions(lines: Iterable[dict[str, Any]], labels: list[Label | None]) -> Predictions:
    """The lines of `predict`; `labels` are those of grasps that were given as arrays, one for each line, else empty."""
    found = list(lines)
    if labels and len(labels) != len(found):
        raise ValueError(f"{len(found)} predictions of {len(labels)} grasps: neighbours need different grasp_ids")
    return Predictions(
        file=np.array([line["file"] for line in found], str),
        grasp_id=np.array([line["grasp_id"] for line in found], np.int64),
        probability_stable=np.array([line["probability_stable"] for line in found], np.float64),
        action=np.array([line["action"] for line in found], str),
        reason=np.array([line["reason"] for line in found], str),
        labels=labels or [Label.from_json(line.get("label")) for line in found],
    )


def _frame_lines(grasp: Grasp) -> Iterator[bytes]:
    """The frames of a grasp as `blindgrasp export --topic /tactile` writes them."""
    lists = ("joints_rad", "cells_newtons", "gravity_m_per_s2", "wrist_wrench", "joint_torques")
    for idx in range(len(grasp.seq)):
        data = {name: _numbers(getattr(grasp, name)[idx]) for name in lists}
        data |= {"grasp_id": int(grasp.grasp_id), "phase": str(grasp.phase[idx]), "day": int(grasp.day)}
        line = {"topic": "/tactile", "seq": int(grasp.seq[idx]), "stamp_nanos": int(grasp.stamp_nanos[idx]), "data": data}
        yield json.dumps(line).encode() + b"\n"


def _numbers(row: NDArray[np.float64]) -> list[float | None]:
    """A row as JSON has it: NaN and infinity are null, and a row of nothing but NaN is a reading that did not come."""
    if np.isnan(row).all():
        return []
    return [float(value) if np.isfinite(value) else None for value in row]
