"""Recordings as Parquet files and as LeRobot datasets, and back. Both need pyarrow.

The recordings are read twice, because all grasps get the same columns. Memory holds some thousand frames.
"""

from __future__ import annotations

import contextlib
import importlib
import itertools
import json
import os
import re
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._model import SENSES
from ._program import ProgramError, answer_of
from ._recording import PHASES, Grasp, Recording
from ._tables import cell_names
from ._types import Label

Source = str | PathLike[str] | Recording

# What became of a grasp: the fields of LiftOutcome, and their types in Arrow.
OUTCOME = {
    "trial": "uint64", "attempt": "uint64", "lifted": "bool", "held": "bool", "has_quality": "bool", "slip_m": "float64",
    "turn_rad": "float64", "epsilon": "float64", "volume": "float64", "mass_kg": "float64", "friction": "float64",
    "thing": "string", "group": "string", "probed": "bool", "disturbed": "bool",
}  # fmt: skip
# The columns of those fields.
OUTCOMES = {f"outcome_{name}": kind for name, kind in OUTCOME.items()}
# The value of a field of an outcome that is not known, by its type.
MISSING_OF: dict[str, Any] = {"bool": False, "uint64": 0, "float64": None, "string": ""}
# What is equal for all frames of a grasp.
OF_GRASP = {
    "recording": "string", "hand": "string", "hand_id": "string", "model": "string", "day": "int64", "epoch": "uint64",
    "grasp_id": "uint64", "stable": "bool", "label": "string", "object": "string", "object_class": "string", "epsilon": "float64",
    "volume": "float64", "action": "string", "reason": "string", "probability_stable": "float64",
    **OUTCOMES,
}  # fmt: skip
# Those without which a grasp cannot be read back.
NEEDED = ("hand_id", "epoch", "grasp_id", "stable")
# Frames that are written together: a reader needs some kilobytes for each column of such a group.
ROWS_TOGETHER = 10_000
# LeRobot's number of files in a folder.
FILES_IN_CHUNK = 1000
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


def to_parquet(
    recordings: Source | Sequence[Source],
    out: str | PathLike[str],
    *,
    hand: str | PathLike[str] | None = None,
    overwrite: bool = False,
) -> None:
    """Writes the frames of recordings to a Parquet file, a row for each frame.

    `recordings` is a recording, a folder of recordings, or several of either, of one hand. The columns are those of the
    grasp: `recording`, `hand`, `hand_id`, `model`, `day`, `epoch`, `grasp_id`, and its label, decision and outcome; then
    `grasp` (its running number in the file), `seq`, `stamp_nanos`, `phase` and `predicted` (the probability that the
    graph predicted of the frame); then `joint_0`, …, `cell_0`, … (with `hand`, as in `Recording.to_frame`,
    `cell_palm_0`) and the other senses. Unknown values are missing. `from_parquet` reads it back.
    `overwrite` replaces a file that is there.

    Raises ModuleNotFoundError without pyarrow, FileExistsError if the file exists, ValueError if it is one of the recordings,
    if they are of different hands or one is given twice, and ProgramError if a folder is not whole.
    """
    pa = _pyarrow()
    path = Path(fspath(out))
    if os.path.lexists(path) and not overwrite:
        raise FileExistsError(f"{path}: the file exists: name another one, or say overwrite=True")
    found = _recordings(recordings, hand)
    if path.exists() and any(path.samefile(recording.path) for recording in found):
        raise ValueError(f"{path} is an input: writing there would destroy it")
    data = _DataSet(found, hand)
    kinds = OF_GRASP | {"grasp": "int64", "seq": "uint64", "stamp_nanos": "int64", "phase": "string"}
    kinds["predicted"] = "float64"
    names = {sense: [f"{sense}_{name}" for name in data.names(sense)] for sense in data.widths}
    kinds |= {name: "float64" for of_sense in names.values() for name in of_sense}
    schema = pa.schema([(name, pa.type_for_alias(kind)) for name, kind in kinds.items()])

    def tables() -> Iterator[Any]:
        n_grasps = 0
        for recording_name, recording in data.recordings.items():
            for grasp in recording:
                columns: dict[str, Any] = {
                    name: [value] * len(grasp.seq) for name, value in _of_grasp(recording_name, recording, grasp).items()
                }
                columns |= {"seq": grasp.seq, "stamp_nanos": grasp.stamp_nanos, "phase": grasp.phase.tolist()}
                columns["predicted"] = grasp.probability_stable
                columns["grasp"] = [n_grasps] * len(grasp.seq)
                n_grasps += 1
                for sense, of_sense in names.items():
                    columns |= dict(zip(of_sense, data.rows(grasp, sense).T))
                yield pa.table(columns, schema)

    partial = _partial(path)
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
    (the cells), other senses like `observation.gravity_m_per_s2`, `phase`, `seq`, `stamp_nanos`, `predicted` and `stable`
    (`true`, `false`, or nothing without a label). The task is the object's name. What else is known of the grasp is in the
    fields of its episode (meta/episodes), which LeRobot's own splits drop. `timestamp` has the whole number of frames a
    second that is nearest to the first grasp's. `from_parquet` reads the dataset back.

    Raises as `to_parquet`, and FileExistsError if the folder exists.
    """
    pa = _pyarrow()
    root = Path(fspath(out))
    if os.path.lexists(root):
        raise FileExistsError(f"{root} exists: name another folder")
    dataset = _LeRobot(pa, _DataSet(_recordings(recordings, hand), hand))
    partial = _partial(root)
    partial.mkdir()
    try:
        dataset.write(partial)
        os.rename(partial, root)
    except BaseException:
        shutil.rmtree(partial)
        raise


def from_parquet(
    source: str | PathLike[str], out: str | PathLike[str], *, hand: str | PathLike[str] | None = None, overwrite: bool = False
) -> list[Recording]:
    """Writes the recordings of a file of `to_parquet`, or of a dataset of `to_lerobot`, to the folder `out`, and returns them.

    Each has its name, the same frames with their numbers and times, and the same labels and outcomes. A label gets the time
    of the grasp's first frame, and an outcome that of the last one. Scenes, decisions and predictions are not written: a
    graph or `blindgrasp predict` makes the last two. A recording without grasps has no rows, and so does not come back.
    Columns that `to_parquet` does not write are not read. `hand` is the layout of a hand that is not built in. It warns of
    frames that are not in order. After an error there is no new recording.

    Raises ModuleNotFoundError without pyarrow, FileExistsError if a recording exists, ValueError if the source is not written
    so, is not whole, or has values that cannot be, and ProgramError if the hand is another one.
    """
    pa = _pyarrow()
    path, folder = Path(fspath(source)), Path(fspath(out))
    rows = _rows_of_dataset(pa, path) if path.is_dir() else _rows_of_file(pa, path, hand)
    is_new = not folder.exists()
    try:
        names = _write_recordings(path, rows, folder, hand, overwrite)
    except BaseException:
        if is_new:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    return [Recording(folder / name) for name in names]


def _write_recordings(
    path: Path, rows: Iterator[dict[str, Any]], folder: Path, hand: str | PathLike[str] | None, overwrite: bool
) -> list[str]:
    """Writes the recordings of the rows to the folder, all or none, and returns their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names: list[str] = []
    with tempfile.TemporaryDirectory() as lines_in, tempfile.TemporaryDirectory(prefix=".blindgrasp-", dir=folder) as unfinished:
        for name, of_recording in itertools.groupby(rows, lambda row: row["recording"]):
            if not isinstance(name, str) or not name or Path(name).is_absolute() or ".." in Path(name).parts or name in names:
                raise ValueError(f"{path}: expected the names of different files in the column recording, found {name!r}")
            if (folder / name).exists() and not overwrite:
                raise FileExistsError(f"{folder / name}: the file exists: name another folder, or say overwrite=True")
            # The recording says that it was made of a file of this name.
            lines, to = Path(lines_in) / Path(name).name, Path(unfinished) / name
            to.parent.mkdir(parents=True, exist_ok=True)
            with _named(lines), lines.open("w", encoding="utf-8") as stream:
                layout = _write_lines(path, of_recording, stream)
            words = ["--lines", "--json", f"--hand={layout if hand is None else fspath(hand)}", f"--out={to}"]
            try:
                answer_of(["import", str(lines), *words])
            except ProgramError as error:
                raise _placed(error, lines, f"{path}, recording {name}") or error from None
            names.append(name)
        if not names:
            raise ValueError(f"{path}: expected frames, found none")
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(Path(unfinished) / name, folder / name)
    return names


def _placed(error: ProgramError, lines: Path, place: str) -> ValueError | None:
    """The error of a line of a file that is deleted, as one of its grasp."""
    found = re.search(rf"{re.escape(str(lines))}, line (\d+): (.*)", error.stderr, re.DOTALL)
    if not found:
        return None
    line = json.loads(lines.read_text(encoding="utf-8").splitlines()[int(found[1]) - 1])
    return ValueError(f"{place}, grasp {line['data']['grasp_id']} ({line['topic']}): {found[2].strip()}")


def _rows_of_file(pa: Any, path: Path, hand: str | PathLike[str] | None) -> Iterator[dict[str, Any]]:
    """Frames as dicts: the values of the grasp, `seq`, `stamp_nanos`, `phase`, and the values of each sense as a list."""
    with _opened(pa, path) as file:
        found = file.schema_arrow.names
        _check(path, {*NEEDED, "recording", "hand", "grasp", "seq", "stamp_nanos", "phase"}, found)
        columns: dict[str, list[str]] = {}
        for sense in ("joint", "cell", *SENSES):
            numbered = [name for name in found if re.fullmatch(rf"{sense}_\d+", name)]
            columns[sense] = sorted(numbered, key=lambda name: int(name.rpartition("_")[2]))
        for batch in file.iter_batches(1000):
            for row in batch.to_pylist():
                if not columns["cell"]:
                    try:
                        names = cell_names(row["hand"] if hand is None else fspath(hand))
                    except (ProgramError, TypeError) as error:
                        if hand is not None:
                            raise
                        raise ValueError(f"{path}: its cells have names: give the layout of its hand {row['hand']!r} (hand=)") from error
                    columns["cell"] = [f"cell_{name}" for name in names]
                    _check(path, set(columns["cell"]), found)
                yield row | {"senses": {sense: [row[name] for name in names] for sense, names in columns.items()}}


def _rows_of_dataset(pa: Any, root: Path) -> Iterator[dict[str, Any]]:
    """As `_rows_of_file`."""
    episodes: dict[int, dict[str, Any]] = {}
    for path in sorted(root.glob("meta/episodes/*/*.parquet")):
        table = pa.parquet.read_table(path)
        _check(path, {*NEEDED, "recording", "hand", "episode_index", "length"}, table.column_names)
        episodes |= {row["episode_index"]: row for row in table.to_pylist()}
    files = sorted(root.glob("data/*/*.parquet"))
    n_frames, n_expected = (sum(pa.parquet.read_metadata(path).num_rows for path in files), sum(row["length"] for row in episodes.values()))
    try:
        n_episodes = json.loads((root / "meta/info.json").read_text(encoding="utf-8"))["total_episodes"]
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"{root}: expected a dataset with meta/info.json, found {error!r}") from error
    if (n_frames, len(episodes)) != (n_expected, n_episodes):
        raise ValueError(
            f"{root}: expected {n_episodes} episodes with {n_expected} frames, found {len(episodes)} with {n_frames}: is a file of "
            "data or meta/episodes missing or cut?"
        )
    sense_of = {"observation.state": "joint", "observation.tactile": "cell"}
    for path in files:
        with _opened(pa, path) as file:
            _check(path, {"episode_index", "seq", "stamp_nanos", "phase"}, file.schema_arrow.names)
            for batch in file.iter_batches(1000):
                for row in batch.to_pylist():
                    if row["episode_index"] not in episodes:
                        raise ValueError(f"{root}: expected episode {row['episode_index']} in meta/episodes, found none")
                    observed = {name: value for name, value in row.items() if name.startswith("observation.")}
                    values = {name: value if isinstance(value, list) else [value] for name, value in observed.items()}
                    senses = {sense_of.get(name, name.removeprefix("observation.")): value for name, value in values.items()}
                    yield row | episodes[row["episode_index"]] | {"grasp": row["episode_index"], "senses": senses}


def _opened(pa: Any, path: Path) -> Any:
    try:
        return pa.parquet.ParquetFile(path)
    except pa.ArrowInvalid as error:
        raise ValueError(f"{path}: expected a Parquet file: {error}") from error


def _check(path: Path, expected: set[str], found: Sequence[str]) -> None:
    if missing := sorted(expected - set(found)):
        raise ValueError(f"{path}: expected the columns of to_parquet or to_lerobot; it has no {missing[0]!r}")


def _write_lines(path: Path, rows: Iterator[dict[str, Any]], stream: Any) -> str:
    """Writes frames, labels and outcomes as `blindgrasp export` does, and returns the name of the hand."""
    n_labels = n_outcomes = 0
    seen: set[tuple[int, int]] = set()

    def write(topic: str, seq: int, row: dict[str, Any], data: dict[str, Any], **more: str) -> None:
        header = {"topic": topic, "seq": seq, "hand_id": row["hand_id"], "epoch": row["epoch"], "stamp_nanos": row["stamp_nanos"]}
        print(json.dumps(header | more | {"data": {"grasp_id": row["grasp_id"]} | data}), file=stream)

    for number, of_grasp in itertools.groupby(rows, lambda row: row["grasp"]):
        place = f"{path}, grasp {number}"
        first = row = _checked(place, next(of_grasp))
        key = (first["epoch"], first["grasp_id"])
        if key in seen:
            where = f"{path}: {first['recording']}, grasp {first['grasp_id']}"
            raise ValueError(f"{where}: expected its frames together, and recordings with different names")
        seen.add(key)
        if first["stable"] is not None:
            label = {"stable": first["stable"], "epsilon": first.get("epsilon"), "volume": first.get("volume")}
            label |= {name: first[name] or "" for name in ("object", "object_class")}
            write("/truth", n_labels, first, label, **({"label": first["label"]} if first.get("label") else {}))
            n_labels += 1
        is_in_order = True
        for next_row in itertools.chain([first], (_checked(place, row) for row in of_grasp)):
            for name in (*NEEDED, "hand", "day", "label", "object", "object_class", "epsilon", "volume", *OUTCOMES):
                if next_row.get(name) != first.get(name):
                    raise ValueError(f"{place}: {name} changes from {first.get(name)!r} to {next_row.get(name)!r} within the grasp")
            if is_in_order and next_row["seq"] < row["seq"]:
                is_in_order = False
                warnings.warn(f"{place}: frame {next_row['seq']} comes after frame {row['seq']}", stacklevel=4)
            row = next_row
            frame = {"joints": row["senses"].pop("joint"), "cells_newtons": row["senses"].pop("cell"), "phase": row["phase"]}
            # A grasp that lacks a sense has no number of it.
            frame |= {sense: values for sense, values in row["senses"].items() if not np.isnan(np.array(values, float)).all()}
            write("/tactile", row["seq"], row, frame | {"day": row["day"]})
        if first.get("outcome_lifted") is not None:
            write("/outcome", n_outcomes, row, {name: first[f"outcome_{name}"] for name in OUTCOME})
            n_outcomes += 1
    return first["hand"]


def _checked(place: str, row: dict[str, Any]) -> dict[str, Any]:
    """The row with values of the right kinds. pandas makes floats of whole numbers and booleans beside missing ones.

    Raises ValueError that names the column.
    """

    def value(name: str, kind: str, missing: Any) -> Any:
        found = row.get(name)
        if found is None or found != found:
            return missing
        if kind == "string" and isinstance(found, str):
            return found
        if kind == "float64" and isinstance(found, (int, float)):
            return found
        if kind == "bool" and found in (True, False):
            return bool(found)
        if kind == "uint64" and isinstance(found, (int, float)) and 0 <= found < 2**64 and found == int(found):
            return int(found)
        expected = {"bool": "true, false or nothing", "string": "text", "float64": "a number"}.get(kind, "a whole number")
        raise ValueError(f"{place}: the column {name} has {found!r}, expected {expected}")

    known = {name: value(name, "uint64", None) for name in ("seq", "stamp_nanos", "epoch", "grasp_id")}
    known |= {name: value(name, "string", None) for name in ("hand", "hand_id", "phase")}
    for name, found in known.items():
        if found is None:
            raise ValueError(f"{place}: the column {name} lacks a value")
    if known["phase"] not in PHASES:
        raise ValueError(f"{place}: the column phase has {known['phase']!r}, expected one of {', '.join(PHASES)}")
    known |= {name: value(name, "string", None) for name in ("object", "object_class", "label")}
    known |= {name: value(name, "float64", None) for name in ("epsilon", "volume")}
    known |= {"stable": value("stable", "bool", None), "day": value("day", "uint64", 0)}
    lifted = value("outcome_lifted", "bool", None)
    known |= dict.fromkeys(OUTCOMES)
    if lifted is not None:
        known |= {f"outcome_{name}": value(f"outcome_{name}", kind, MISSING_OF[kind]) for name, kind in OUTCOME.items()}
        if lifted and value("outcome_held", "bool", None) is None:
            raise ValueError(f"{place}: the column outcome_held lacks a value, and outcome_lifted is true")
    return row | known | {"outcome_lifted": lifted}


def _pyarrow() -> Any:
    try:
        importlib.import_module("pyarrow.parquet")
    except ModuleNotFoundError as error:
        missing = "Parquet needs pyarrow, which is not installed: pip install pyarrow"
        raise ModuleNotFoundError(missing, name=error.name) from error
    return importlib.import_module("pyarrow")


def _partial(path: Path) -> Path:
    """Where a file or folder is written that gets its name when it is whole."""
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Names the file in errors of the disk that do not."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror or str(error), fspath(path)) from error


def _write(path: Path, schema: Any, tables: Iterator[Any]) -> None:
    pa = _pyarrow()
    path.parent.mkdir(parents=True, exist_ok=True)
    with _named(path), pa.parquet.ParquetWriter(path, schema) as writer:
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


def _of_grasp(name: str, recording: Recording, grasp: Grasp) -> dict[str, Any]:
    """The values of OF_GRASP. `name` is the recording's in the data set."""
    label, decision, outcome = grasp.label or Label(False), grasp.decision, grasp.outcome or {}
    return {
        "recording": name,
        "hand": recording.hand,
        "hand_id": grasp.hand_id,
        "model": recording.metadata.get("graph", {}).get("models"),
        "day": grasp.day,
        "epoch": grasp.epoch,
        "grasp_id": grasp.grasp_id,
        "stable": grasp.label and label.is_stable,
        "label": grasp.label and recording.label_kind,
        "object": label.object_id or None,
        "object_class": label.object_class or None,
        "epsilon": label.epsilon,
        "volume": label.volume,
        "action": decision and decision.action,
        "reason": decision and decision.reason,
        "probability_stable": decision and decision.probability_stable,
        **{f"outcome_{name}": outcome.get(name) for name in OUTCOME},
    }


def _recordings(recordings: Source | Sequence[Source], hand: str | PathLike[str] | None) -> list[Recording]:
    """The recordings that are named. The program lists those of folders, and refuses folders that are not whole."""
    given = [recordings] if isinstance(recordings, (str, PathLike, Recording)) else recordings
    opened = {fspath(source.path): source for source in given if isinstance(source, Recording)}
    paths = [fspath(source.path if isinstance(source, Recording) else source) for source in given]
    if any(map(os.path.isdir, paths)):
        words = [] if hand is None else [f"--hand={fspath(hand)}"]
        paths = answer_of(["info", "--json", *words, "--", *paths])["recordings"]
    return [opened[path] if path in opened else Recording(path) for path in paths]


class _DataSet:
    """Recordings of one hand, and the number of values that each sense has in them."""

    def __init__(self, found: list[Recording], hand: str | PathLike[str] | None) -> None:
        # Files of one name, as parts of several folders, have the names of their folders before it.
        paths = [recording.path.resolve() for recording in found]
        names = [recording.path.name for recording in found]
        if len(set(names)) < len(names) and len(set(paths)) == len(paths):
            above = os.path.commonpath([path.parent for path in paths])
            names = [path.relative_to(above).as_posix() for path in paths]
        self.recordings = dict(zip(names, found))
        """By their names."""
        if len(self.recordings) < len(found):
            raise ValueError(f"expected different recordings, found {max(names, key=names.count)} twice")
        hands = sorted({f"{recording.hand} ({recording.hand_id})" for recording in found})
        if len(hands) != 1:
            raise ValueError(f"expected recordings of one hand, found {', '.join(hands) or 'none'}")
        self.widths: dict[str, int] = {}
        self.frames_per_second = 0
        for recording in found:
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
        shapes |= {"phase": (1, "string"), "stable": (1, "string"), "predicted": (1, "float64"), "timestamp": (1, "float32")}
        shapes |= {name: (1, "int64") for name in ("seq", "stamp_nanos", "frame_index", "episode_index", "index", "task_index")}
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
        for idx, (name, recording) in enumerate(self.data.recordings.items()):
            place = {"chunk_index": idx // FILES_IN_CHUNK, "file_index": idx % FILES_IN_CHUNK}
            _write(root / DATA_PATH.format(**place), self.schema, self._tables(name, recording, place))
        pa = self.pa
        names = ["episode_index", "length", "dataset_from_index", "dataset_to_index"]
        names += [f"{folder}/{kind}_index" for folder in ("data", "meta/episodes") for kind in ("chunk", "file")]
        types = [(name, pa.int64()) for name in names] + [("tasks", pa.list_(pa.string()))]
        # LeRobot's tools make the statistics of a part of the episodes from these.
        of_episode = {key: pa.list_(pa.float64()) for key in ("min", "max", "mean", "std")} | {"count": pa.list_(pa.int64())}
        types += [(f"stats/{name}/{key}", kind) for name in self.stats for key, kind in of_episode.items()]
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
            "robot_type": next(iter(self.data.recordings.values())).hand,
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
        stats = {name: _statistics(sums, self.n_frames) for name, sums in self.stats.items()}
        for name, content in (("info", info), ("stats", stats)):
            (root / f"meta/{name}.json").write_text(json.dumps(content, indent=4), encoding="utf-8")

    def _tables(self, name: str, recording: Recording, place: dict[str, int]) -> Iterator[Any]:
        for grasp in recording:
            n, known = len(grasp.seq), _of_grasp(name, recording, grasp)
            task = known["object"] or known["outcome_thing"] or "unknown"
            task_idx = self.tasks.setdefault(task, len(self.tasks))
            episode = {"episode_index": len(self.episodes), "length": n, "tasks": [task]}
            episode |= {"dataset_from_index": self.n_frames, "dataset_to_index": self.n_frames + n}
            episode |= {f"data/{key}": idx for key, idx in place.items()}
            episode |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0} | known
            self.episodes.append(episode)
            frames = np.arange(n)
            columns: dict[str, Any] = {
                "phase": grasp.phase.tolist(),
                "stable": [{True: "true", False: "false"}.get(known["stable"], "")] * n,
                "seq": grasp.seq,
                "stamp_nanos": grasp.stamp_nanos,
                "predicted": grasp.probability_stable,
                "timestamp": (frames / (self.data.frames_per_second or 1)).astype(np.float32),
                "frame_index": frames,
                "episode_index": np.full(n, episode["episode_index"]),
                "index": frames + self.n_frames,
                "task_index": np.full(n, task_idx),
            }
            for sense, feature in self.feature_of.items():
                rows = self.data.rows(grasp, sense)
                sums = _sums(rows)
                self.stats[feature] = _both(self.stats[feature], sums) if feature in self.stats else sums
                episode |= {f"stats/{feature}/{key}": value for key, value in _statistics(sums, n).items()}
                values = self.pa.array(rows.ravel())
                columns[feature] = values if rows.shape[1] == 1 else self.pa.FixedSizeListArray.from_arrays(values, rows.shape[1])
            self.n_frames += n
            yield self.pa.table(columns, self.schema)


def _sums(rows: NDArray[np.float64]) -> dict[str, Any]:
    """The sums of rows, of which `_statistics` makes their statistics; NaN counts for nothing."""
    found = {"n": np.sum(~np.isnan(rows), axis=0), "sum": np.nansum(rows, axis=0), "squares": np.nansum(rows**2, axis=0)}
    return found | {"min": np.fmin.reduce(rows), "max": np.fmax.reduce(rows)}


def _both(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    how = {"min": np.fmin, "max": np.fmax}
    return {key: how.get(key, np.add)(value, other[key]) for key, value in one.items()}


def _statistics(sums: dict[str, Any], n_frames: int) -> dict[str, Any]:
    # NaN of a value that nothing was read of.
    n = np.where(sums["n"] > 0, sums["n"], np.nan)
    mean = sums["sum"] / n
    std = np.sqrt(np.maximum(sums["squares"] / n - mean**2, 0.0))
    found = {"min": sums["min"], "max": sums["max"], "mean": mean, "std": std}
    return {key: value.tolist() for key, value in found.items()} | {"count": [n_frames]}
