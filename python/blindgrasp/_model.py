"""Models: what they are made of, and what they predict of grasps."""

from __future__ import annotations

import dataclasses
import json
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from operator import index
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._program import Process, answer_of
from ._recording import Grasp, Recording
from ._tables import cell_names, check_pandas, label_columns, labels_of, table_of
from ._types import Label

if TYPE_CHECKING:
    import pandas


@dataclasses.dataclass(frozen=True)
class PredictedGrasp:
    """What a model predicts of one grasp: a row of `Predictions`, whose fields say what each is."""

    file: str
    grasp_id: int
    probability_stable: float
    action: str
    reason: str
    label: Label | None = None

    @property
    def is_lifted(self) -> bool:
        """Whether the action is `lift`."""
        return self.action == "lift"


@dataclasses.dataclass(repr=False)
class Predictions:
    """What a model predicts of grasps: element i of each array is about the i-th grasp.

    `predictions[3]` is one grasp. A slice, a mask or a list of places gives the predictions of those grasps.
    """

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

    def __repr__(self) -> str:
        n_lifted = int(self.is_lifted.sum())
        said = f"{len(self)} grasps, {n_lifted} lifted, {len(self) - n_lifted} held"
        if self.accuracy is not None:
            said += f", accuracy {self.accuracy:.1%} of {self.is_labelled.sum()} labelled"
        return f"Predictions({said})"

    def __iter__(self) -> Iterator[PredictedGrasp]:
        return (self[place] for place in range(len(self)))

    @overload
    def __getitem__(self, place: int) -> PredictedGrasp: ...

    @overload
    def __getitem__(self, place: slice | NDArray[Any] | list[int] | list[bool]) -> Predictions: ...

    def __getitem__(self, place: Any) -> PredictedGrasp | Predictions:
        # This raises IndexError as numpy does.
        places = np.arange(len(self))[place]
        if np.ndim(places) == 0:
            idx = index(places)
            return PredictedGrasp(
                file=str(self.file[idx]),
                grasp_id=int(self.grasp_id[idx]),
                probability_stable=float(self.probability_stable[idx]),
                action=str(self.action[idx]),
                reason=str(self.reason[idx]),
                label=self.labels[idx],
            )
        return Predictions(
            file=self.file[places],
            grasp_id=self.grasp_id[places],
            probability_stable=self.probability_stable[places],
            action=self.action[places],
            reason=self.reason[places],
            labels=[self.labels[idx] for idx in places],
        )

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

    @property
    def accuracy(self) -> float | None:
        """The share of right decisions among the labelled grasps; None if none is labelled."""
        is_right = self.is_lifted == self.is_stable
        return float(is_right[self.is_labelled].mean()) if self.is_labelled.any() else None

    @property
    def false_positives(self) -> int | None:
        """The number of labelled grasps that are lifted and unstable; None if none is labelled."""
        is_wrong = self.is_labelled & self.is_lifted & ~self.is_stable
        return int(is_wrong.sum()) if self.is_labelled.any() else None

    def to_frame(self) -> pandas.DataFrame:
        """A table (pandas) with a row for each grasp.

        Its columns are `file`, `grasp_id`, `probability_stable`, `action`, `reason`, and of the label `stable`,
        `object`, `class`, `epsilon` and `volume`. Raises ModuleNotFoundError without pandas.
        """
        check_pandas()
        names = ("file", "grasp_id", "probability_stable", "action", "reason")
        columns = {name: getattr(self, name) for name in names}
        return table_of(columns | label_columns(self.labels))


Source = str | PathLike[str] | Recording | Grasp
# Between two grasps that were given as arrays.
PAUSE_NANOS = 1_000_000_000
# Between two frames that were given without a time: 100 Hz, the rate of the simulated hand.
PERIOD_NANOS = 10_000_000
# So many settled frames decide a grasp (`votes` of the lift arbiter, docs/dataflow.md).
N_VOTES = 3
# The reasons of decisions that a probability made.
DECIDED_BY_PROBABILITY = ("stable", "unstable", "unsure")
# What a robot may sense beside joints and cells (docs/messages.md).
SENSES = ("gravity_m_per_s2", "wrist_wrench", "joint_torques")


class Model:
    """A model, as `blindgrasp model show` describes it.

    `hand` is the pad layout of its hand, if that is not built in. Raises FileNotFoundError if there is no file,
    ProgramError if it is no model, and ProgramNotFoundError.
    """

    def __init__(self, path: str | PathLike[str], hand: str | PathLike[str] | None = None) -> None:
        self.path = Path(fspath(path))
        self._hand_words = [] if hand is None else ["--hand", fspath(hand)]
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

    def predict(
        self, source: Source | Iterable[Source] | pandas.DataFrame | ArrayLike, cells_newtons: ArrayLike | None = None
    ) -> Predictions:
        """Decides grasps as a graph with this model would (`blindgrasp predict`).

        `source` is a recording (its path or a Recording), a Grasp, or several of one kind. A Grasp may be made by hand
        from arrays of your own. Recordings are read by the program, one grasp at a time. Grasps are decided as if each
        followed the one before it; a frame that is missing inside a grasp holds it, and so does another `hand_id`.

        `source` may also be a table of `Recording.to_frame`; or the joints, if `cells_newtons` is given: arrays
        (n_grasps, n_joints) and (n_grasps, n_cells) of a settled frame, or (n_grasps, n_frames, n_joints) and
        (n_grasps, n_frames, n_cells) of several. `grasp_id` is then the row. The last frame is repeated if there are
        fewer than three, which is how many the arbiter asks for. The labels are those of the table.

        Raises ProgramError if a recording cannot be read or is of another hand, and ValueError if arrays or tables have
        other numbers of joints or cells than the hand.
        """
        if cells_newtons is not None:
            return self._predict_settled(_settled_grasps({"joints": source, "cells_newtons": cells_newtons}))
        if hasattr(source, "columns"):
            grasps = _settled_grasps(_arrays_of_table(source, self._cell_columns))
            labelled = zip(grasps, labels_of(source), strict=True)
            return self._predict_settled([dataclasses.replace(grasp, label=label) for grasp, label in labelled])
        if isinstance(source, np.ndarray):
            raise TypeError("one array: expected two, the joints and the cells")
        given: Any = [source] if isinstance(source, (str, PathLike, Recording, Grasp)) else source
        sources = list(given)
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
            arguments = ["predict", "--json", *self._hand_words, str(self.path.absolute()), *files]
            with Process(arguments, stdin=frames) as process:
                return _predictions(list(process.lines()), [grasp.label for grasp in grasps] if grasps else None)

    def _predict_settled(self, grasps: list[Grasp]) -> Predictions:
        predictions = self.predict(grasps)
        # A reading that is NaN holds its grasp; sizes that are wrong are so in all of them.
        is_finite = [np.isfinite(grasp.joints).all() and np.isfinite(grasp.cells_newtons).all() for grasp in grasps]
        if any(is_finite) and (predictions.reason == "invalid").all():
            n_joints, n_cells = grasps[0].joints.shape[1], grasps[0].cells_newtons.shape[1]
            raise ValueError(
                f"all grasps are invalid ({n_joints} joints and {n_cells} cells): expected as many as the hand {self.hand} "
                "has, no force below 0, and joints within their limits"
            )
        return predictions

    def _cell_columns(self) -> list[str]:
        """The columns of cells that are named by pads, in the hand's order."""
        hand = self._hand_words[-1] if self._hand_words else self.hand
        return [f"cell_{name}" for name in cell_names(hand)]

    def predict_proba(
        self, source: Source | Iterable[Source] | pandas.DataFrame | ArrayLike, cells_newtons: ArrayLike | None = None
    ) -> NDArray[np.float64]:
        """The probability that each grasp is unstable, and that it is stable: (n_grasps, 2), as in scikit-learn.

        `source` and errors are those of `predict`. The second column is its `probability_stable`: the lowest among the
        settled frames that decided. These are the first three frames, if they agree. A row is NaN if no probability
        decided: no cell feels the object, the grasp is out of distribution, its frames do not agree, or frames are
        missing or faulty. The reason is in `predict`. The arbiter holds such a grasp, so
        `np.nan_to_num(model.predict_proba(source)[:, 1])` ranks it last.
        """
        predictions = self.predict(source, cells_newtons)
        is_decided = np.isin(predictions.reason, DECIDED_BY_PROBABILITY)
        stable = np.where(is_decided, predictions.probability_stable, np.nan)
        return np.column_stack([1 - stable, stable])


def _arrays_of_table(table: Any, cell_columns: Callable[[], list[str]]) -> dict[str, Any]:
    """The joints, cells and senses of a table of `Recording.to_frame`, by their names in a Grasp.

    The order of the columns does not matter. `cell_columns` gives the names of cells that are named by pads, in order.
    """
    patterns = {"joints": r"joint_\d+", "cells_newtons": r"cell_.+"} | {sense: rf"{sense}_\d+" for sense in SENSES}
    columns = {
        name: [column for column in table.columns if re.fullmatch(pattern, str(column))]
        for name, pattern in patterns.items()
    }
    if not columns["joints"] or not columns["cells_newtons"]:
        raise ValueError("the table has no columns joint_0, … and cell_0, …: expected one of Recording.to_frame")
    for name, found in columns.items():
        if all(re.fullmatch(r".*_\d+", column) for column in found) and (name != "cells_newtons" or _is_numbered(found)):
            found.sort(key=lambda column: int(column.rpartition("_")[2]))
            if any(int(column.rpartition("_")[2]) != place for place, column in enumerate(found)):
                raise ValueError(f"the columns {found[0]}, … are not numbered from 0 without a gap")
        else:
            expected = cell_columns()
            if set(found) != set(expected):
                odd = sorted(set(found) ^ set(expected))
                raise ValueError(f"the table's cells are not those of the model's hand: {', '.join(odd[:5])}")
            found[:] = expected
    return {name: table[found].to_numpy(float) for name, found in columns.items() if found}


def _is_numbered(cells: list[str]) -> bool:
    return all(re.fullmatch(r"cell_\d+", cell) for cell in cells)


def _settled_grasps(given: dict[str, Any]) -> list[Grasp]:
    """Grasps of settled frames, from arrays (n_grasps, n_values) or (n_grasps, n_frames, n_values)."""
    arrays = {name: np.asarray(array, float) for name, array in given.items()}
    arrays = {name: array[:, np.newaxis] if array.ndim == 2 else array for name, array in arrays.items()}
    shapes = {array.shape[:2] for array in arrays.values()}
    if len(shapes) != 1 or any(array.ndim != 3 for array in arrays.values()):
        found = ", ".join(f"{name} {np.shape(array)}" for name, array in given.items())
        raise ValueError(
            f"expected (n_grasps, n_values) or (n_grasps, n_frames, n_values), with as many grasps and frames in each "
            f"array, found {found}"
        )
    ((n_grasps, n_frames),) = shapes
    if n_frames == 0:
        raise ValueError("the grasps have no frames: there is nothing to decide on")
    frames = np.minimum(np.arange(max(n_frames, N_VOTES)), n_frames - 1)
    numbers = np.arange(len(frames))
    return [
        Grasp(
            grasp_id=place,
            epoch=0,
            seq=numbers.astype(np.uint64),
            stamp_nanos=numbers * PERIOD_NANOS,
            phase=np.full(len(frames), "settled"),
            joints=arrays["joints"][place][frames],
            cells_newtons=arrays["cells_newtons"][place][frames],
            senses={name: array[place][frames] for name, array in arrays.items() if name in SENSES},
        )
        for place in range(n_grasps)
    ]


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
