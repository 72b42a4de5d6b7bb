"""Recordings as Parquet files and as LeRobot datasets. Both need pyarrow.

The recordings are read twice, because all grasps get the same columns. Memory holds some thousand frames.
"""

from __future__ import annotations

import importlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._recording import Grasp, Recording
from ._tables import cell_names
from ._types import Label

Source = str | PathLike[str] | Recording

# What became of a grasp: the fields of LiftOutcome that are columns, and their types in Arrow.
OUTCOME = {
    "lifted": "bool", "held": "bool", "slip_m": "float64", "turn_rad": "float64", "mass_kg": "float64",
    "friction": "float64",
}  # fmt: skip
# What is equal for all frames of a grasp.
OF_GRASP = {
    "recording": "string", "hand": "string", "hand_id": "string", "model": "string", "day": "int64", "epoch": "uint64",
    "grasp_id": "uint64", "stable": "bool", "object": "string", "object_class": "string", "epsilon": "float64",
    "volume": "float64", "action": "string", "reason": "string", "probability_stable": "float64",
    **{f"outcome_{name}": kind for name, kind in OUTCOME.items()},
}  # fmt: skip
# Frames that are written together: a reader needs some kilobytes for each column of such a group.
ROWS_TOGETHER = 10_000
# LeRobot's number of files in a folder.
FILES_IN_CHUNK = 1000
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


def to_parquet(
    recordings: Source | Sequence[Source], out: str | PathLike[str], *, hand: str | PathLike[str] | None = None
) -> None:
    """Writes the frames of recordings to a Parquet file, a row for each frame.

    `recordings` is a recording, a folder of recordings, or several of either, of one hand. The columns are those of the
    grasp: `recording`, `hand`, `hand_id`, `model`, `day`, `epoch`, `grasp_id`, and its label, decision and outcome; then
    `grasp` (its running number in the file), `seq`, `stamp_nanos`, `phase` and `predicted` (the probability that the
    graph predicted of the frame); then `joint_0`, …, `cell_0`, … (with `hand`, as in `Recording.to_frame`,
    `cell_palm_0`) and the other senses. What is not known is missing. `from_table` with `grasp_column="grasp"` and
    `phase_column="phase"` reads it back.

    Raises ModuleNotFoundError without pyarrow, and ValueError if the recordings are of different hands.
    """
    pa = _pyarrow()
    data = _DataSet(recordings, hand)
    kinds = OF_GRASP | {"grasp": "int64", "seq": "uint64", "stamp_nanos": "int64", "phase": "string"}
    kinds["predicted"] = "float64"
    names = {sense: [f"{sense}_{name}" for name in data.names(sense)] for sense in data.widths}
    kinds |= {name: "float64" for of_sense in names.values() for name in of_sense}
    schema = pa.schema([(name, pa.type_for_alias(kind)) for name, kind in kinds.items()])

    def tables() -> Iterator[Any]:
        n_grasps = 0
        for recording in data.recordings:
            for grasp in recording:
                columns: dict[str, Any] = {
                    name: [value] * len(grasp.seq) for name, value in _of_grasp(recording, grasp).items()
                }
                columns |= {"seq": grasp.seq, "stamp_nanos": grasp.stamp_nanos, "phase": grasp.phase.tolist()}
                columns["predicted"] = grasp.probability_stable
                columns["grasp"] = [n_grasps] * len(grasp.seq)
                n_grasps += 1
                for sense, of_sense in names.items():
                    columns |= dict(zip(of_sense, data.rows(grasp, sense).T))
                yield pa.table(columns, schema)

    path = Path(fspath(out))
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        _write(partial, schema, tables())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def to_lerobot(
    recordings: Source | Sequence[Source], out: str | PathLike[str], *, hand: str | PathLike[str] | None = None
) -> None:
    """Writes recordings to a new folder as a LeRobot dataset of format v3.0, an episode for each grasp.

    `recordings` and `hand` are those of `to_parquet`. Features are `observation.state` (the joints), `observation.tactile`
    (the cells), other senses like `observation.gravity_m_per_s2`, `phase`, `stamp_nanos`, `predicted` and `stable` (`true`,
    `false`, or nothing without a label). The task is the object's name. What else is known of the grasp is in the fields of its
    episode (meta/episodes), which LeRobot's own splits drop. `timestamp` has the whole
    number of frames a second that is nearest to the first grasp's. `python3 -P -m blindgrasp.lerobot` reads the dataset
    back with `--cells observation.tactile --joints observation.state --label stable --phase phase --class object_class`.

    Raises as `to_parquet`, and FileExistsError if the folder exists.
    """
    pa = _pyarrow()
    dataset = _LeRobot(pa, _DataSet(recordings, hand))
    root = Path(fspath(out))
    root.mkdir()
    try:
        dataset.write(root)
    except BaseException:
        shutil.rmtree(root)
        raise


def _pyarrow() -> Any:
    try:
        importlib.import_module("pyarrow.parquet")
    except ModuleNotFoundError as error:
        missing = "Parquet needs pyarrow, which is not installed: pip install pyarrow"
        raise ModuleNotFoundError(missing, name=error.name) from error
    return importlib.import_module("pyarrow")


def _write(path: Path, schema: Any, tables: Iterator[Any]) -> None:
    pa = _pyarrow()
    path.parent.mkdir(parents=True, exist_ok=True)
    with pa.parquet.ParquetWriter(path, schema) as writer:
        waiting, n_waiting = [schema.empty_table()], 0
        for table in tables:
            waiting.append(table)
            n_waiting += len(table)
            if n_waiting >= ROWS_TOGETHER:
                writer.write_table(pa.concat_tables(waiting))
                waiting, n_waiting = [], 0
        if waiting:
            writer.write_table(pa.concat_tables(waiting))


def _senses(grasp: Grasp) -> dict[str, NDArray[np.float64]]:
    return {"joint": grasp.joints, "cell": grasp.cells_newtons} | grasp.senses


def _of_grasp(recording: Recording, grasp: Grasp) -> dict[str, Any]:
    """The values of OF_GRASP."""
    label, decision, outcome = grasp.label or Label(False), grasp.decision, grasp.outcome or {}
    return {
        "recording": recording.path.name,
        "hand": recording.hand,
        "hand_id": grasp.hand_id,
        "model": recording.metadata.get("graph", {}).get("models"),
        "day": grasp.day,
        "epoch": grasp.epoch,
        "grasp_id": grasp.grasp_id,
        "stable": grasp.label and label.is_stable,
        "object": label.object_id or None,
        "object_class": label.object_class or None,
        "epsilon": label.epsilon,
        "volume": label.volume,
        "action": decision and decision.action,
        "reason": decision and decision.reason,
        "probability_stable": decision and decision.probability_stable,
        **{f"outcome_{name}": outcome.get(name) for name in OUTCOME},
    }


class _DataSet:
    """Recordings of one hand, and the number of values that each sense has in them."""

    def __init__(self, recordings: Source | Sequence[Source], hand: str | PathLike[str] | None) -> None:
        given = [recordings] if isinstance(recordings, (str, PathLike, Recording)) else recordings
        self.recordings: list[Recording] = []
        for source in given:
            if isinstance(source, Recording):
                self.recordings.append(source)
                continue
            path = Path(fspath(source))
            self.recordings += map(Recording, sorted(path.glob("*.mcap")) if path.is_dir() else [path])
        hands = sorted({f"{recording.hand} ({recording.hand_id})" for recording in self.recordings})
        if len(hands) != 1:
            raise ValueError(f"expected recordings of one hand, found {', '.join(hands) or 'none'}")
        self.widths: dict[str, int] = {}
        self.frames_per_second = 0
        for recording in self.recordings:
            for grasp in recording:
                for sense, rows in _senses(grasp).items():
                    self.widths[sense] = max(self.widths.get(sense, 0), rows.shape[1])
                if not self.frames_per_second and len(grasp.seq) > 1:
                    nanos = float(np.median(np.diff(grasp.stamp_nanos)))
                    self.frames_per_second = max(1, round(1e9 / max(nanos, 1.0)))
        self.cell_names = None if hand is None else cell_names(fspath(hand))
        n_cells = self.widths.get("cell", 0)
        if self.cell_names is not None and len(self.cell_names) != n_cells:
            raise ValueError(f"the recordings have {n_cells} cells and the hand {hand} has {len(self.cell_names)}")

    def names(self, sense: str) -> list[str]:
        """The names of a sense's values."""
        if sense == "cell" and self.cell_names is not None:
            return self.cell_names
        return [str(idx) for idx in range(self.widths[sense])]

    def rows(self, grasp: Grasp, sense: str) -> NDArray[np.float64]:
        """(n_frames, width): the values of a sense, NaN where the grasp lacks them."""
        rows = _senses(grasp).get(sense, np.empty((len(grasp.seq), 0)))
        return np.pad(rows, ((0, 0), (0, self.widths[sense] - rows.shape[1])), constant_values=np.nan)


class _LeRobot:
    """A dataset in the layout that LeRobot's own reader takes."""

    def __init__(self, pa: Any, data: _DataSet) -> None:
        self.pa, self.data = pa, data
        named = {"joint": "observation.state", "cell": "observation.tactile"}
        self.feature_of = {sense: named.get(sense, f"observation.{sense}") for sense, width in data.widths.items() if width}
        shapes = {name: (data.widths[sense], "float64") for sense, name in self.feature_of.items()}
        shapes |= {"phase": (1, "string"), "stable": (1, "string"), "stamp_nanos": (1, "int64"), "predicted": (1, "float64"), "timestamp": (1, "float32")}
        shapes |= {name: (1, "int64") for name in ("frame_index", "episode_index", "index", "task_index")}
        self.features = {name: {"dtype": kind, "shape": [n], "names": None} for name, (n, kind) in shapes.items()}
        for sense, name in self.feature_of.items():
            self.features[name]["names"] = [f"{sense}_{value}" for value in data.names(sense)]
        # A feature of one element is no list.
        types = {name: pa.type_for_alias(kind) for name, (_, kind) in shapes.items()}
        self.schema = pa.schema([(name, types[name] if n == 1 else pa.list_(types[name], n)) for name, (n, _) in shapes.items()])
        self.tasks: dict[str, int] = {}
        self.episodes: list[dict[str, Any]] = []
        self.n_frames = 0
        self.stats: dict[str, dict[str, Any]] = {}

    def write(self, root: Path) -> None:
        for idx, recording in enumerate(self.data.recordings):
            place = {"chunk_index": idx // FILES_IN_CHUNK, "file_index": idx % FILES_IN_CHUNK}
            _write(root / DATA_PATH.format(**place), self.schema, self._tables(recording, place))
        pa = self.pa
        names = ["episode_index", "length", "dataset_from_index", "dataset_to_index"]
        names += [f"{folder}/{kind}_index" for folder in ("data", "meta/episodes") for kind in ("chunk", "file")]
        types = [(name, pa.int64()) for name in names] + [("tasks", pa.list_(pa.string()))]
        schema = pa.schema(types + [(name, pa.type_for_alias(kind)) for name, kind in OF_GRASP.items()])
        episodes = pa.Table.from_pylist(self.episodes, schema)
        _write(root / "meta/episodes/chunk-000/file-000.parquet", schema, iter([episodes]))
        # LeRobot reads the tasks with pandas, as the index.
        text = {"name": None, "field_name": "__index_level_0__", "pandas_type": "unicode", "numpy_type": "object"}
        index = {"index_columns": ["__index_level_0__"], "columns": [text | {"metadata": None}], "column_indexes": []}
        tasks = pa.table({"task_index": list(self.tasks.values()), "__index_level_0__": list(self.tasks)})
        tasks = tasks.replace_schema_metadata({"pandas": json.dumps(index)})
        _write(root / "meta/tasks.parquet", tasks.schema, iter([tasks]))
        info = {
            "codebase_version": "v3.0",
            "robot_type": self.data.recordings[0].hand,
            "total_episodes": len(self.episodes),
            "total_frames": self.n_frames,
            "total_tasks": len(self.tasks),
            "chunks_size": FILES_IN_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self.data.frames_per_second or 1,
            "splits": {"train": f"0:{len(self.episodes)}"},
            "data_path": DATA_PATH,
            "video_path": None,
            "features": self.features,
        }
        stats = {name: self._final(sums) for name, sums in self.stats.items()}
        for name, content in (("info", info), ("stats", stats)):
            (root / f"meta/{name}.json").write_text(json.dumps(content, indent=4), encoding="utf-8")

    def _tables(self, recording: Recording, place: dict[str, int]) -> Iterator[Any]:
        for grasp in recording:
            n, known = len(grasp.seq), _of_grasp(recording, grasp)
            task = known["object"] or "unknown"
            task_idx = self.tasks.setdefault(task, len(self.tasks))
            episode = {"episode_index": len(self.episodes), "length": n, "tasks": [task]}
            episode |= {"dataset_from_index": self.n_frames, "dataset_to_index": self.n_frames + n}
            episode |= {f"data/{name}": idx for name, idx in place.items()}
            self.episodes.append(episode | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0} | known)
            frames = np.arange(n)
            columns: dict[str, Any] = {
                "phase": grasp.phase.tolist(),
                "stable": [{True: "true", False: "false"}.get(known["stable"], "")] * n,
                "stamp_nanos": grasp.stamp_nanos,
                "predicted": grasp.probability_stable,
                "timestamp": (frames / (self.data.frames_per_second or 1)).astype(np.float32),
                "frame_index": frames,
                "episode_index": np.full(n, episode["episode_index"]),
                "index": frames + self.n_frames,
                "task_index": np.full(n, task_idx),
            }
            for sense, name in self.feature_of.items():
                rows = self.data.rows(grasp, sense)
                self._add(name, rows)
                values = self.pa.array(rows.ravel())
                columns[name] = values if rows.shape[1] == 1 else self.pa.FixedSizeListArray.from_arrays(values, rows.shape[1])
            self.n_frames += n
            yield self.pa.table(columns, self.schema)

    def _add(self, name: str, rows: NDArray[np.float64]) -> None:
        """Adds rows to the sums of a feature; NaN counts for nothing."""
        low, high = np.fmin.reduce(rows), np.fmax.reduce(rows)
        found = {"n": np.sum(~np.isnan(rows), axis=0), "sum": np.nansum(rows, axis=0), "squares": np.nansum(rows**2, axis=0)}
        before = self.stats.get(name)
        if before is not None:
            low, high = np.fmin(low, before["min"]), np.fmax(high, before["max"])
            found = {key: before[key] + value for key, value in found.items()}
        self.stats[name] = found | {"min": low, "max": high}

    def _final(self, sums: dict[str, Any]) -> dict[str, Any]:
        n = np.maximum(sums["n"], 1)
        mean = sums["sum"] / n
        std = np.sqrt(np.maximum(sums["squares"] / n - mean**2, 0.0))
        found = {"min": sums["min"], "max": sums["max"], "mean": mean, "std": std}
        return {key: value.tolist() for key, value in found.items()} | {"count": [self.n_frames]}
