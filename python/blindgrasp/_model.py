"""Models: what they are made of, and what they predict of grasps."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Iterable, Iterator
from os import PathLike, fspath
from pathlib import Path
from typing import Any

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
        return np.equal(self.action, "lift")


Source = str | PathLike[str] | Recording | Grasp
# Between two grasps that were given as arrays.
PAUSE_NANOS = 1_000_000_000


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

    def predict(self, source: Source | Iterable[Source]) -> Predictions:
        """Decides grasps as a graph with this model would (`blindgrasp predict`).

        `source` is a recording (its path or a Recording), a Grasp, or several of one kind. A Grasp may be made by hand
        from arrays of your own. Recordings are read by the program, one grasp at a time. Grasps are decided as if each
        followed the one before it; a frame that is missing inside a grasp holds it, and so does another `hand_id`.

        Raises ProgramError if a recording cannot be read or is of another hand.
        """
        sources = [source] if isinstance(source, (str, PathLike, Recording, Grasp)) else list(source)
        grasps = [source for source in sources if isinstance(source, Grasp)]
        others = [source for source in sources if not isinstance(source, Grasp)]
        paths = [source.path if isinstance(source, Recording) else Path(source) for source in others]
        if grasps and paths:
            raise TypeError("predict takes recordings or grasps, not both at once")
        if not sources:
            return _predictions([], None)
        files = ["-"] if grasps else [str(path.absolute()) for path in paths]
        # The frames are in a file and not in a pipe: the program may answer before it has read all of them.
        with tempfile.TemporaryFile() as frames:
            frames.writelines(_frame_lines(grasps))
            frames.seek(0)
            with Process(["predict", "--json", str(self.path.absolute()), *files], stdin=frames) as process:
                return _predictions(list(process.lines()), [grasp.label for grasp in grasps] if grasps else None)


def _predictions(lines: list[dict[str, Any]], labels: list[Label | None] | None) -> Predictions:
    """The lines of `predict` as arrays; `labels` are those of grasps that were given as arrays."""
    if labels is not None and len(labels) != len(lines):
        raise ValueError(f"{len(lines)} predictions of {len(labels)} grasps: neighbours need different grasp_ids")
    return Predictions(
        file=np.array([line["file"] for line in lines], str),
        grasp_id=np.array([line["grasp_id"] for line in lines], np.int64),
        probability_stable=np.array([line["probability_stable"] for line in lines], np.float64),
        action=np.array([line["action"] for line in lines], str),
        reason=np.array([line["reason"] for line in lines], str),
        labels=[Label.from_json(line.get("truth")) for line in lines] if labels is None else labels,
    )


def _frame_lines(grasps: list[Grasp]) -> Iterator[bytes]:
    """The frames of the grasps as `blindgrasp export --topic /tactile` writes them, each grasp after the one before."""
    next_seq, next_stamp = 0, 0
    for grasp in grasps:
        if len(grasp.phase) == 0:
            raise ValueError(f"grasp {grasp.grasp_id} has no frames: there is nothing to decide on")
        seqs, stamps = ([int(number) for number in numbers] for numbers in (grasp.seq, grasp.stamp_nanos))
        for idx, phase in enumerate(grasp.phase):
            lists = {"joints": grasp.joints, "cells_newtons": grasp.cells_newtons} | grasp.senses
            data: dict[str, Any] = {name: _numbers(rows[idx]) for name, rows in lists.items()}
            data |= {"grasp_id": int(grasp.grasp_id), "phase": str(phase), "day": int(grasp.day)}
            seq = next_seq + seqs[idx] - min(seqs)
            stamp_nanos = next_stamp + stamps[idx] - min(stamps)
            line: dict[str, Any] = {"topic": "/tactile", "seq": seq, "stamp_nanos": stamp_nanos, "data": data}
            if grasp.hand_id:
                line["hand_id"] = grasp.hand_id
            yield json.dumps(line).encode() + b"\n"
        next_seq += max(seqs) - min(seqs) + 1
        next_stamp += max(stamps) - min(stamps) + PAUSE_NANOS


def _numbers(row: NDArray[np.float64]) -> list[float | None]:
    """A row as JSON has it: NaN and infinity are null, and a row of nothing but NaN is a reading that did not come."""
    if np.isnan(row).all():
        return []
    return [float(value) if np.isfinite(value) else None for value in row]
