"""Table (CSV) of a LeRobot dataset, for blindgrasp import: one grasp an episode.

    python3 -P -m blindgrasp.lerobot DATASET table.csv --cells observation.tactile.left,observation.tactile.right \\
        --joints 'observation.state/gripper*' --label next.success --at -2 --hand parallel-gripper

It needs the package pyarrow (pip install pyarrow). DATASET is a folder on this machine, of format v2.0, v2.1 or v3.0.
At its end the command prints the blindgrasp import command that reads the table.

Cells and joints are features of frames, separated by commas. Their order is that of the hand's pads and joints. A feature
of several dimensions is read row by row. FEATURE/ELEMENTS takes a part of a feature: the name that meta/info.json gives an
element, a pattern with *, an index from 0, or BEGIN:END:STEP as in Python. FEATURE/2::3 is z of cells that measure x, y, z.
Joints are in radians (metres if they slide) after --joint-scale and --joint-offset; degrees need --joint-scale 0.0174533.

Label, object, class, day and --at name a field: a column of the file --episodes, a field of the episodes in meta, or a feature of
frames, whichever is found first. A feature counts with its value in the last frame of the episode: next.success must be
true there if the object was kept. Booleans are the texts true and false. Episodes without a label are left out.

The table has the last frames up to the moment of --at or --settled, as frames of the settled hand. The fingers must have
closed by then, and the lift must not have begun. A dataset does not say when that is, and it is not checked. Datasets of
blindgrasp.to_lerobot have it in the feature phase; blindgrasp.from_parquet reads all of them back.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import math
import os
import re
import shlex
import sys
import time
import zlib
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

__all__ = ["main"]

# The import takes names of up to 64 bytes.
MAX_NAME_BYTES = 64
# The elements of a feature: a dataset that names more would take all memory.
MAX_ELEMENTS = 1_000_000
# The size limit of the texts of a dataset, as of a table in the import.
MAX_TEXT_BYTES = 1 << 30
# The fields of data_path; a width of any size would take all memory.
PLACE = r"\{(episode_index|episode_chunk|chunk_index|file_index)(:0?\d{1,2}d)?\}"
# Names that a table may have, and the options of the import for them.
NAMED = {"day": "--day-column", "class": "--class"}
# LeRobot's tolerance of timestamps.
TOLERANCE_S = 1e-4


class _Refused(ValueError):
    """An error with words for the user."""


class _LeftOut(Exception):
    """An episode has no grasp, for this reason."""


@contextlib.contextmanager
def _expecting(where, wanted: str):
    """Errors of content that is not as it should be are told in these words."""
    try:
        yield
    except _Refused:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError, OSError, csv.Error) as error:
        found = f"no {error}" if isinstance(error, KeyError) else error
        raise _Refused(f"{where}: expected {wanted}; found: {found}") from error


class _Dataset:
    """The content of the folder meta, and of the file of the user's fields."""

    def __init__(self, root: Path, fields_file: Path | None):
        self.info_path = root / "meta/info.json"
        with _expecting(self.info_path, "a LeRobot dataset's JSON with codebase_version, data_path, features"):
            info = json.loads(_text(self.info_path))
            version, data_path, chunk = str(info["codebase_version"]), info["data_path"], int(info.get("chunks_size", 1000))
            if re.search(r"[{}]", re.sub(PLACE, "", data_path)):
                raise _Refused(f"{self.info_path}: expected fields like {{file_index:03d}} in data_path, found {data_path!r}")
            # Images and videos are no cells.
            features = {name: spec for name, spec in info["features"].items() if spec["dtype"] not in ("image", "video")}
            self.sizes = {name: math.prod(map(int, spec["shape"])) for name, spec in features.items()}
            if max(self.sizes.values(), default=0) > MAX_ELEMENTS:
                raise _Refused(f"{self.info_path}: expected features of at most {MAX_ELEMENTS} elements, found {self.sizes}")
            self.names = {name: _names(spec.get("names"), self.sizes[name]) for name, spec in features.items()}
        if not version.startswith(("v2.", "v3.")):
            raise _Refused(f"{self.info_path}: expected format v2.0, v2.1 or v3.0, found {version}: convert it with LeRobot")
        is_v2 = version.startswith("v2.")
        paths = [root / "meta/episodes.jsonl"] if is_v2 else sorted((root / "meta/episodes").glob("*/*.parquet"))
        self.tasks_path = root / ("meta/tasks.jsonl" if is_v2 else "meta/tasks.parquet")
        self.fields: dict[int, dict] = {}
        for path in paths:
            with _expecting(path, "a whole number episode_index in each row"):
                self.fields |= {int(row["episode_index"]): row for row in _rows(path)}
        if not self.fields:
            raise _Refused(f"{root / 'meta'}: expected episodes, found none: download the whole folder")
        # The episodes of each data file.
        self.files: dict[Path, list[int]] = defaultdict(list)
        for episode, fields in sorted(self.fields.items()):
            with _expecting(root / "meta", f"the path of episode {episode} by data_path '{data_path}'"):
                places = {f"{kind}_index": fields.get(f"data/{kind}_index") for kind in ("chunk", "file")}
                path = data_path.format(episode_index=episode, episode_chunk=episode // chunk if chunk else 0, **places)
                self.files[root / path].append(episode)
        if fields_file:
            with _expecting(fields_file, "CSV in UTF-8 with a column episode_index that has episodes of the dataset"):
                for row in csv.DictReader(io.StringIO(_text(fields_file, "utf-8-sig"))):
                    self.fields[int(row["episode_index"])].update((name, text) for name, text in row.items() if name)
        self.known = {name for fields in self.fields.values() for name in fields}

    def tasks(self) -> dict[str, str]:
        with _expecting(self.tasks_path, "task_index and task in each row"):
            # In Parquet the text is the index of a pandas table, which has a name or not.
            rows = _rows(self.tasks_path)
            return {_word(row["task_index"]): row["task" if "task" in row else "__index_level_0__"] for row in rows}

    def need(self, option: str, name: str, others=frozenset()) -> None:
        """Refuses a name that is no feature of numbers or texts, and none of the others."""
        if name not in self.sizes and name not in others:
            known = ", ".join(self.sizes) + (f"; fields of episodes: {', '.join(sorted(others))}" if others else "")
            raise _Refused(f"{self.info_path}: {option}: found no '{name}', or only images; expected one of: {known}")

    def part(self, kind: str, text: str, nth: int) -> tuple[str, list[int], list[str]]:
        """A feature, elements of it, and their columns in the table."""
        name, _, wanted = (text, "", "") if text in self.sizes else text.partition("/")
        self.need(f"--{kind}", name)
        names, found = self.names[name], list(range(self.sizes[name]))
        if wanted in names:
            found = [names.index(wanted)]
        elif re.fullmatch(r"\d+", wanted):
            found = found[int(wanted) : int(wanted) + 1]
        elif re.fullmatch(r"-?\d*:-?\d*(:[1-9]\d*)?", wanted):
            found = found[slice(*(int(number) if number else None for number in wanted.split(":")))]
        elif wanted:
            pattern = ".*".join(map(re.escape, wanted.split("*")))
            found = [idx for idx, element in enumerate(names) if re.fullmatch(pattern, element)]
        if not found:
            there = f"{self.sizes[name]} elements, names: {', '.join(names) or 'none'}"
            raise _Refused(f"{self.info_path}: --{kind}: found no element '{wanted}' of '{name}'; expected one of {there}")
        ends = {idx: "." + re.sub(r"[^\w-]", "_", element) for idx, element in enumerate(names)}
        return name, found, [f"{kind}{nth}.{idx}{ends.get(idx, '')}" for idx in found]


class _Conversion:
    def __init__(self, given: argparse.Namespace):
        self.given, self.data = given, _Dataset(given.dataset, given.episodes)
        self.parts = {
            kind: [self.data.part(kind, part, nth) for nth, part in enumerate(text.split(","), 1)]
            for kind, text in (("joints", given.joints), ("cells", given.cells)) if text
        }  # fmt: skip
        n_joints = sum(len(found) for _, found, _ in self.parts.get("joints", []))
        with _expecting("--joint-scale, --joint-offset", f"one number, or one for each of {n_joints} joints, with commas"):
            self.scale, self.offset = (
                np.broadcast_to(np.array(text.split(","), float), n_joints) for text in (given.joint_scale, given.joint_offset)
            )
        known = self.data.known
        self.tasks = self.data.tasks() if given.object == "task" and "task" not in known else None
        self.asked = {"label": given.label, "object": given.object if self.tasks is None else "task_index"}
        self.asked |= {name: getattr(given, name) for name in NAMED if getattr(given, name)}
        self.asked |= {"at": given.at} if given.at and not _is_number(given.at) else {}
        for option, name in self.asked.items():
            self.data.need(f"--{option}", name, known)
        self.settled, _, self.settled_value = (given.settled or "timestamp=").rpartition("=")
        self.data.need("--at, --settled FEATURE=VALUE", self.settled)
        self.from_frames = {name for name in self.asked.values() if name not in known}
        names = {name for parts in self.parts.values() for name, _, _ in parts} | self.from_frames
        self.names = sorted(names | {"episode_index", "frame_index", "timestamp", self.settled})
        self.left_out, self.labels, self.objects = Counter(), Counter(), Counter()

    def write(self, stream) -> None:
        columns = [column for parts in self.parts.values() for _, _, columns in parts for column in columns]
        writer = csv.writer(stream, lineterminator="\n")
        more = [name for name in NAMED if getattr(self.given, name)]
        writer.writerow(["grasp", "object", "label", *more, *columns])
        n, n_done, told = len(self.data.fields), 0, time.monotonic()
        for path, episodes in self.data.files.items():
            # Columns of images are not read.
            table = _read(path, self.names)
            with _expecting(path, "whole numbers in the columns episode_index and frame_index"):
                of_rows = table.column("episode_index").to_numpy()
                order = np.lexsort((table.column("frame_index").to_numpy(), of_rows))
                bounds = [np.searchsorted(of_rows[order], episodes, side) for side in ("left", "right")]
            for episode, begin, end in zip(episodes, *bounds):
                try:
                    writer.writerows(self._grasp(table, episode, order[begin:end].tolist()))
                except _LeftOut as reason:
                    self.left_out[str(reason)] += 1
                except _Refused as error:
                    if not self.given.skip_bad:
                        raise _Refused(f"{path}: episode {episode}: {error}; --skip-bad leaves such episodes out") from error
                    print(f"{path}: episode {episode}: {error}", file=sys.stderr)
                    self.left_out["bad values"] += 1
                n_done += 1
                if time.monotonic() - told > 2:
                    told = time.monotonic()
                    print(f"{n_done} of {n} episodes", file=sys.stderr)
        for reason, n_left_out in self.left_out.items():
            print(f"{n_left_out} of {n} episodes left out: {reason}", file=sys.stderr)
        stable = self.given.stable_value
        if len(self.labels) != 2 or stable not in self.labels:
            found = ", ".join(f"'{text}' in {count}" for text, count in sorted(self.labels.items())) or "no episodes"
            wanted = f"two values, one of them '{stable}' (--stable-value)"
            raise _Refused(f"{self.given.dataset}: --label {self.given.label}: expected {wanted}; found {found}")
        if len(self.objects) == 1:
            only = next(iter(self.objects))
            print(f"all grasps have the object '{only}': training needs the names of objects (--object)", file=sys.stderr)

    def _grasp(self, table, episode: int, rows: list[int]) -> list[list]:
        """The lines of a grasp."""
        if not rows:
            raise _Refused("expected frames, found none: download the file again")
        value = lambda name, row: table.column(name)[row].as_py()  # noqa: E731
        fields, words = self.data.fields[episode], {}
        for option, name in self.asked.items():
            words[option] = _word(value(name, rows[-1]) if name in self.from_frames else fields.get(name))
        if self.tasks is not None:
            words["object"] = _word(self.tasks.get(words["object"]))
        for option, word in words.items():
            if not word and option in ("label", "at"):
                raise _LeftOut(f"no value of '{self.asked[option]}' (--{option})")
            if not word:
                raise _Refused(f"expected a name in '{getattr(self.given, option)}' (--{option}), found none")
        named = [_short(words["object"]), words["label"], *(_short(words[name]) for name in NAMED if name in words)]
        lines = []
        for row in self._settled_rows(value, rows, words.get("at", self.given.at)):
            numbers = {kind: self._numbers(value, parts, row) for kind, parts in self.parts.items()}
            if "joints" in numbers:
                numbers["joints"] = numbers["joints"] * self.scale + self.offset
            lines.append([episode, *named, *(float(number) for of_kind in numbers.values() for number in of_kind)])
        self.labels[words["label"]] += 1
        self.objects[words["object"]] += 1
        return lines

    def _settled_rows(self, value, rows: list[int], at: str | None) -> list[int]:
        n = self.given.frames
        if at is None:
            hits = [_word(value(self.settled, row)) == self.settled_value for row in rows] + [False]
            if True not in hits:
                raise _LeftOut(f"no frame has {self.given.settled}")
            # The first frames that follow each other.
            begin = hits.index(True)
            rows = rows[begin : hits.index(False, begin)]
        else:
            with _expecting(f"--at {self.given.at}", "seconds, and numbers in the column timestamp"):
                times = np.array([value("timestamp", row) for row in rows], float)
                moment = float(at) + (times[-1] if at.startswith("-") else times[0])
            if not times[0] - TOLERANCE_S <= moment <= times[-1] + TOLERANCE_S:
                raise _LeftOut(f"--at {self.given.at} is outside of the episode")
            rows = [row for row, is_before in zip(rows, times <= moment + TOLERANCE_S) if is_before]
        if len(rows) < n:
            raise _LeftOut(f"fewer than {n} settled frames (--frames)")
        return rows[-n:]

    def _numbers(self, value, parts, row: int) -> np.ndarray:
        numbers = []
        for name, found, _ in parts:
            n, where = self.data.sizes[name], f"frame {value('frame_index', row)}: {name}"
            with _expecting(where, f"{n} numbers, as in meta/info.json"):
                flat = np.asarray(value(name, row), float).reshape(n)[found]
            if not np.isfinite(flat).all():
                bad = int(np.argmin(np.isfinite(flat)))
                raise _Refused(f"{where}: expected numbers, found {flat[bad]} in element {found[bad]}")
            numbers.append(flat)
        return np.concatenate(numbers)

    def command(self) -> str:
        """The import that reads the table."""
        given = self.given
        patterns = {kind: ",".join(f"{kind}{nth}.*" for nth, _ in enumerate(parts, 1)) for kind, parts in self.parts.items()}
        words = ["blindgrasp", "import", str(given.table), "--hand", given.hand, "--grasp-column", "grasp"]
        words += ["--cells", patterns["cells"]]
        words += ["--joint-columns", patterns["joints"]] if given.joints else ["--joints", "NAME=VALUE"]
        words += ["--label", "label", "--stable-value", given.stable_value, "--group", "object"]
        for name, option in NAMED.items():
            words += [option, name] if getattr(given, name) else []
        return shlex.join([*words, "--out", str(given.table.with_suffix(".mcap"))])


def _names(names, n: int) -> list[str]:
    """Names of elements: a list, a list in a list or an object, or an object of name and index. None if they do not fit."""
    if isinstance(names, dict):
        is_index = all(isinstance(index, int) for index in names.values())
        names = sorted(names, key=names.get) if is_index else next(iter(names.values()))
    if isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        names = names[0]
    texts = list(map(str, names)) if isinstance(names, list) else []
    return texts if len(texts) == n == len(set(texts)) else []


def _is_number(text: str) -> bool:
    with contextlib.suppress(ValueError):
        return math.isfinite(float(text))
    return False


def _word(value) -> str:
    """A value of a field as the table has it; empty if it is missing."""
    if isinstance(value, list):
        return "; ".join(filter(None, map(_word, value)))
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    text = str(value).lower() if isinstance(value, bool) else f"{value:.9g}" if isinstance(value, float) else str(value)
    return " ".join(text.split())


def _short(name: str) -> str:
    """A name that the import takes: of a long one the beginning and a checksum."""
    whole = name.encode()
    begin = whole[: MAX_NAME_BYTES - 9].decode(errors="ignore")
    return name if len(whole) <= MAX_NAME_BYTES else f"{begin}~{zlib.crc32(whole):08x}"


def _text(path: Path, encoding: str = "utf-8") -> str:
    """The text of a file. A pipe or a device may have no end."""
    if path.exists() and not path.is_file():
        raise OSError("no regular file")
    if path.stat().st_size > MAX_TEXT_BYTES:
        raise OSError(f"more than {MAX_TEXT_BYTES >> 30} GiB")
    return path.read_text(encoding=encoding)


def _rows(path: Path) -> list[dict]:
    """The rows of a file of the folder meta."""
    if path.suffix == ".parquet":
        return _read(path, None).to_pylist()
    rows = []
    for nth, line in enumerate(_text(path).split("\n"), 1):
        if line.strip():
            with _expecting(f"{path}, line {nth}", "JSON"):
                rows.append(json.loads(line))
    return rows


def _read(path: Path, names: list[str] | None):
    """Columns of a Parquet file, or all but statistics and places of videos."""
    import pyarrow
    import pyarrow.parquet

    if not path.is_file():
        raise _Refused(f"{path}: expected a file, found none: download the folders meta and data of the dataset")
    try:
        with pyarrow.parquet.ParquetFile(path) as file:
            there = file.schema_arrow.names
            names = names or [name for name in there if not name.startswith(("stats/", "videos/"))]
            if missing := sorted(set(names) - set(there)):
                raise _Refused(f"{path}: expected a column '{missing[0]}'; found columns: {', '.join(there)}")
            return file.read(columns=names)
    except (pyarrow.ArrowException, OSError) as error:
        raise _Refused(f"{path}: expected a Parquet file (git lfs pull fetches one); found: {error}") from error


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python3 -P -m blindgrasp.lerobot", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("dataset", type=Path, metavar="DATASET", help="folder of the dataset, with meta and data")
    add("table", type=Path, metavar="TABLE", help="where to write the table (CSV)")
    add("--cells", required=True, metavar="FEATURES", help="features of the cells, in the order of the hand's pads")
    add("--joints", metavar="FEATURES", help="features of the joints, in the hand's order [default: one posture]")
    add("--joint-scale", default="1", metavar="X", help="radians a unit of the joints; or one for each [default: 1]")
    add("--joint-offset", default="0", metavar="X", help="added after the scale, as --joint-offset=-1.57,0 [default: 0]")
    add("--label", required=True, metavar="FIELD", help="how the grasp ended, one of two values")
    add("--stable-value", default="true", metavar="TEXT", help="the label's value that means kept [default: true]")
    add("--object", default="task", metavar="FIELD", help="the object [default: task, the text of the task]")
    add("--class", metavar="FIELD", help="the object's class [default: the object]")
    add("--day", metavar="FIELD", help="the recording session, a date or a name")
    add("--episodes", type=Path, metavar="FILE", help="more fields of episodes: CSV with a column episode_index")
    moment = parser.add_mutually_exclusive_group(required=True)
    moment.add_argument("--at", metavar="SECONDS", help="from the episode's start, or its end if negative; or its field")
    moment.add_argument("--settled", metavar="FEATURE=VALUE", help="the last frames of the first run with this value")
    add("--frames", type=int, default=3, metavar="N", help="settled frames of each grasp [default: 3]")
    add("--hand", default="HAND", help="the hand of the command that is printed")
    add("--skip-bad", action="store_true", help="leave out episodes with bad values, and list them")
    add("--overwrite", action="store_true", help="replace a file of this name")
    given = parser.parse_args()
    try:
        import pyarrow  # noqa: F401

        if given.frames < 1:
            raise _Refused(f"--frames: expected 1 or more, found {given.frames}")
        if given.table.exists() and not given.overwrite:
            raise _Refused(f"{given.table}: the file exists; --overwrite replaces it")
        with _expecting(f"TABLE {given.table}", "the name of a file to write"):
            written = given.table.with_name(f".{given.table.name}.{os.getpid()}.tmp")
        conversion = _Conversion(given)
        try:
            with written.open("x", encoding="utf-8") as stream:
                conversion.write(stream)
            os.replace(written, given.table)
        finally:
            with contextlib.suppress(OSError):
                written.unlink()
    except ImportError as error:
        print(f"the package pyarrow is missing: pip install pyarrow ({error})", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"{given.table}: expected a file that can be written; found: {error.strerror}", file=sys.stderr)
        return 1
    except ValueError as error:
        print(error, file=sys.stderr)
        return 1
    n_grasps, n = sum(conversion.labels.values()), len(conversion.data.fields)
    print(f"{given.table}: {n_grasps} grasps of {n} episodes; now\n{conversion.command()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
