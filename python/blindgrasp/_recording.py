"""Recordings (MCAP) as grasps in numpy arrays.

A recording is read in order, one chunk at a time, so that memory holds the frames of one grasp, and the labels and
decisions of all. What is not done here: repair (`blindgrasp info --repair`), contacts, features and predictions
(`blindgrasp export`), and recordings in several files, which are read one by one.
"""

from __future__ import annotations

import dataclasses
import json
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from operator import index
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, overload

import mcap.exceptions
import numpy as np
import zstandard
from mcap.reader import make_reader
from numpy.typing import NDArray

from ._cdr import decoder
from ._tables import cell_names, check_pandas, label_columns, mean_of_rows, table_of
from ._types import WHILE_LIFTING, Decision, Label

if TYPE_CHECKING:
    import pandas

MAGIC = b"\x89MCAP0\r\n"
# The footer: operation code, length, start of the summary, start of its offsets, checksum.
FOOTER = "<BQQQI"

FRAMES = "blindgrasp_msgs/msg/TactileFrame"
LABELS = "blindgrasp_msgs/msg/GraspTruth"
DECISIONS = "blindgrasp_msgs/msg/LiftDecision"
PREDICTIONS = "blindgrasp_msgs/msg/Prediction"
OUTCOMES = "blindgrasp_msgs/msg/LiftOutcome"

# The codes of crates/messages, as operators/blindgrasp_messages.py has them.
PHASES = (
    "open", "closing", "settled", "ended", "squeezing", "squeezed", "test_lifting", "test_lifted", "kept", "dropped",
    "lifting",
)  # fmt: skip
ACTIONS = {0: "hold", 1: "lift", 3: "squeeze", 4: "test_lift", 5: "tighten", 6: "set_down", 7: "go_on"}
REASONS = (
    "stable", "unstable", "no_agreement", "missing", "out_of_order", "stale", "no_contact", "invalid", "self_collision",
    "wrong_hand", "wrong_model", "out_of_distribution", "unsure", "link_down", "promising", "missing_reading",
    "no_baseline", "unlike_day", "sensor_fault", "promise_withdrawn", "slipping",
)  # fmt: skip

# The errors of the readers of MCAP and of CDR about content that is not as it should be.
DAMAGE = (mcap.exceptions.McapError, zstandard.ZstdError, struct.error, ValueError, KeyError, IndexError, EOFError)

Key = tuple[int, int]
"""The epoch and number of a grasp."""


class RecordingError(ValueError):
    """A file is no recording, is damaged, or has grasps that cannot be told apart."""


@dataclasses.dataclass
class Grasp:
    """The frames of one grasp in the order in which they were recorded, its label, and the decisions about it.

    A frame that lacks numbers that other frames of the grasp have, holds NaN in their place.
    """

    grasp_id: int
    epoch: int
    """The generation of the source."""
    seq: NDArray[np.uint64]
    """(n_frames,): the frames' numbers. A jump is a frame that was lost."""
    stamp_nanos: NDArray[np.int64]
    """(n_frames,): when the source took the frames, nanoseconds of its clock."""
    phase: NDArray[np.str_]
    """(n_frames,): `open`, `closing`, `settled`, `ended` and others (docs/messages.md)."""
    joints: NDArray[np.float64]
    """(n_frames, n_joints): radians in the hand's order; metres for a joint that slides."""
    cells_newtons: NDArray[np.float64]
    """(n_frames, n_cells): newtons, pad after pad; raw counts for a hand with `cell_unit: counts`."""
    senses: dict[str, NDArray[np.float64]] = dataclasses.field(default_factory=dict)
    """What the robot senses beside joints and cells, by the name that docs/messages.md gives it, like `gravity_m_per_s2`:
    (n_frames, n_values), in the palm frame. A sense that no frame of the grasp has is not there."""
    hand_id: str = ""
    """The identity of the hand, 16 hexadecimal digits; empty if it is not known."""
    day: int = 0
    """The recording day, like 20261124; 0 if it is not known."""
    label: Label | None = None
    """What is known to be true of the grasp; None if nothing was recorded."""
    decisions: tuple[Decision, ...] = ()
    """The recorded decisions. Several are recorded of a grasp that was probed, or watched while the arm lifted."""
    probability_stable: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.empty(0))
    """(n_frames,): the recorded predictions of the frames, from 0 to 1; NaN where the graph predicted nothing."""
    outcome: dict[str, Any] | None = None
    """What became of the grasp, the fields of LiftOutcome in docs/messages.md; None if nothing was recorded."""

    def __repr__(self) -> str:
        (n_frames, n_cells), n_joints = self.cells_newtons.shape, self.joints.shape[1]
        said = f"{n_frames} frames of {n_joints} joints and {n_cells} cells"
        if self.label is not None:
            said += f", label {'stable' if self.label.is_stable else 'unstable'}"
            said += f" ({self.label.object_id})" if self.label.object_id else ""
        if self.decision is not None:
            said += f", decision {self.decision.action} ({self.decision.reason})"
        return f"Grasp({self.grasp_id}: {said})"

    @property
    def decision(self) -> Decision | None:
        """The last decision about the grasp before the arm lifts; None if none was recorded."""
        before = [decision for decision in self.decisions if decision.action not in WHILE_LIFTING]
        return before[-1] if before else None


@dataclasses.dataclass
class _Known:
    """What a recording knows of its grasps, and its predictions by epoch and number of the frame."""

    labels: dict[Key, Label] = dataclasses.field(default_factory=dict)
    decisions: dict[Key, list[Decision]] = dataclasses.field(default_factory=lambda: defaultdict(list))
    predictions: dict[Key, float] = dataclasses.field(default_factory=dict)
    outcomes: dict[Key, dict[str, Any]] = dataclasses.field(default_factory=dict)


class Recording:
    """A recording: its metadata at once, and its grasps by iteration or by their places, as often as wanted.

    `topic` is the topic of the frames; the rest is read from `/truth`, `/decision`, `/prediction` and `/outcome`. Raises
    FileNotFoundError if there is no file, and RecordingError if it is no recording, was cut off, or has no frames on
    that topic. Damage inside is found, and raised, when the grasps are read.
    """

    def __init__(self, path: str | PathLike[str], topic: str = "/tactile") -> None:
        self.path = Path(fspath(path))
        self.topic = topic
        with self.path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise RecordingError(f"{self.path} is not a recording: expected an MCAP file")
            try:
                _check_summary(stream)
                stream.seek(0)
                reader = make_reader(stream)
                summary = reader.get_summary()
                found = {metadata.name: metadata.metadata for metadata in reader.iter_metadata()}
            except DAMAGE as error:
                raise self._damaged(error) from error
        if summary is None or summary.statistics is None:
            raise self._damaged("it has no summary")
        self.metadata: dict[str, dict[str, str]] = found
        """The metadata by name, as the table of docs/messages.md has it."""
        self.topics: dict[str, int] = {channel.topic: 0 for channel in summary.channels.values()}
        """The number of samples of each topic."""
        for idx, channel in summary.channels.items():
            self.topics[channel.topic] += summary.statistics.channel_message_counts.get(idx, 0)
        self._types = {
            channel.topic: summary.schemas[channel.schema_id].name if channel.schema_id in summary.schemas else ""
            for channel in summary.channels.values()
        }
        if self._types.get(topic) != FRAMES:
            there = ", ".join(name for name, kind in sorted(self._types.items()) if kind == FRAMES) or "none"
            raise RecordingError(f"{self.path} has no frames on the topic {topic}: topics with frames: {there}")
        ours = found.get("blindgrasp", {})
        self.hand: str = ours.get("hand", "unknown")
        """The hand's name."""
        self.hand_id: str = ours.get("hand_id", "")
        """The identity of the hand's layout, 16 hexadecimal digits."""
        self._n_grasps: int | None = None

    @property
    def label_kind(self) -> str | None:
        """What stable means in its labels: `wrench-space` (the paper's), `lift`, or None if the recording does not say."""
        if kind := self.metadata.get("truth", {}).get("label"):
            return kind
        report = self.metadata.get("simulation", {}).get("report")
        return report and json.loads(report).get("label", "wrench-space")

    def __repr__(self) -> str:
        return f"Recording({str(self.path)!r}, hand={self.hand!r}, n_frames={self.topics[self.topic]})"

    def __iter__(self) -> Iterator[Grasp]:
        """The grasps in order. The file is read twice: for what is known of the grasps, then for the frames.

        Raises RecordingError if the file is damaged, or if frames of a grasp lie on both sides of another grasp.
        """
        known = self._known()
        for frames in self._frames_of_grasps():
            yield self._grasp(frames, known)

    def __len__(self) -> int:
        """The number of grasps.

        The first call reads all frames, because no index of the file has the number. It is kept. `list(recording)` asks
        for it as well; `blindgrasp.read` does not.
        """
        if self._n_grasps is None:
            self._n_grasps = sum(1 for _ in self._frames_of_grasps())
        return self._n_grasps

    @overload
    def __getitem__(self, place: int) -> Grasp: ...

    @overload
    def __getitem__(self, place: slice) -> list[Grasp]: ...

    def __getitem__(self, place: int | slice) -> Grasp | list[Grasp]:
        """The grasp at a place, from 0, or -1 for the last one; a slice is a list.

        A place is not a `grasp_id`. The file is read from its beginning to that place, each time: iterate to see all
        grasps, or keep them with `blindgrasp.read`.
        """
        if isinstance(place, slice):
            wanted = range(len(self))[place]
            n_read = max(wanted, default=-1) + 1
            found = {idx: grasp for idx, grasp in enumerate(islice(self, n_read)) if idx in wanted}
            return [found[idx] for idx in wanted]
        idx = index(place)
        if idx < 0:
            idx += len(self)
        grasp = next(islice(self, idx, None), None) if idx >= 0 else None
        if grasp is None:
            raise IndexError(f"{self.path} has {len(self)} grasps: there is none at the place {place}")
        return grasp

    def to_frame(self, hand: str | PathLike[str] | None = None) -> pandas.DataFrame:
        """A table (pandas) with a row for each grasp.

        Its columns are `grasp_id` and `n_frames`; the mean over the settled frames of each joint (`joint_0`, …), cell
        (`cell_0`, …) and other sense (`gravity_m_per_s2_0`, …); `stable`, `object`, `object_class`, `epsilon` and `volume` of
        the label; `action`, `reason` and `probability_stable` of the decision. A reading that is NaN is in no mean.
        What is not known of a grasp is missing in its row.

        With `hand`, the name of a built-in hand or the path of a pad layout, the columns of cells have the name of the
        pad, like `cell_palm_0`; the program tells it. Memory holds the table, and the frames of one grasp.

        Raises ModuleNotFoundError without pandas, and ValueError if the hand has another number of cells.
        """
        check_pandas()
        names = None if hand is None else cell_names(fspath(hand))
        # Of each sense, the mean by the place of the grasp.
        means: dict[str, dict[int, NDArray[np.float64]]] = defaultdict(dict)
        ids, n_frames, labels, decisions = [], [], [], []
        for place, grasp in enumerate(self):
            for sense, rows in ({"joint": grasp.joints, "cell": grasp.cells_newtons} | grasp.senses).items():
                means[sense][place] = mean_of_rows(rows[grasp.phase == "settled"])
            ids.append(grasp.grasp_id)
            n_frames.append(len(grasp.phase))
            labels.append(grasp.label)
            decisions.append(grasp.decision)
        columns: dict[str, Any] = {"grasp_id": ids, "n_frames": n_frames}
        for sense, found in means.items():
            table = _table([found.get(place, np.empty(0)) for place in range(len(ids))])
            numbers = [str(idx) for idx in range(table.shape[1])]
            if sense == "cell" and names is not None and len(names) != len(numbers):
                raise ValueError(
                    f"{self.path} has {len(numbers)} cells and the hand {hand} has {len(names)}: "
                    f"expected the pad layout of the hand {self.hand}"
                )
            of_sense = names if sense == "cell" and names is not None else numbers
            columns |= {f"{sense}_{name}": table[:, idx] for idx, name in enumerate(of_sense)}
        columns |= label_columns(labels)
        columns["action"] = [decision and decision.action for decision in decisions]
        columns["reason"] = [decision and decision.reason for decision in decisions]
        columns["probability_stable"] = [decision.probability_stable if decision else np.nan for decision in decisions]
        return table_of(columns)

    def _frames_of_grasps(self) -> Iterator[list[Any]]:
        """The frames of each grasp. The number of grasps is known at the end."""
        frames: list[Any] = []
        seen: set[Key] = set()
        for _, frame in self._messages([self.topic]):
            key = _key(frame)
            if not frames or key != _key(frames[0]):
                if frames:
                    yield frames
                frames = []
                if key in seen:
                    raise RecordingError(f"{self.path}: frames of another grasp lie between those of grasp {key[1]}")
                seen.add(key)
            frames.append(frame)
        if frames:
            yield frames
        self._n_grasps = len(seen)

    def _messages(self, topics: Sequence[str]) -> Iterator[tuple[str, Any]]:
        """The topics and messages in the order of the file, which is the order in which they came."""
        with self.path.open("rb") as stream:
            decoders: dict[str, Callable[[bytes], Any]] = {}
            messages = make_reader(stream, validate_crcs=True).iter_messages(topics, log_time_order=False)
            while True:
                try:
                    item = next(messages, None)
                    if item is None:
                        return
                    schema, channel, message = item
                    if channel.topic not in decoders:
                        decoders[channel.topic] = decoder(schema.data.decode() if schema else "")
                    decoded = decoders[channel.topic](message.data)
                except DAMAGE as error:
                    raise self._damaged(error) from error
                yield channel.topic, decoded

    def _known(self) -> _Known:
        known = _Known()
        labels = known.labels
        wanted = (("/truth", LABELS), ("/decision", DECISIONS), ("/prediction", PREDICTIONS), ("/outcome", OUTCOMES))
        topics = [topic for topic, kind in wanted if self._types.get(topic) == kind]
        for topic, message in self._messages(topics) if topics else ():
            key = _key(message)
            if topic == "/decision":
                known.decisions[key].append(_decision(message))
            elif topic == "/prediction":
                # A prediction has the number of its frame.
                if message.fault == 0:
                    known.predictions[message.header.epoch, message.header.seq] = message.probability_stable
            elif topic == "/outcome":
                # Of two outcomes of a grasp, a drop counts.
                if key not in known.outcomes or known.outcomes[key]["held"] or not known.outcomes[key]["lifted"]:
                    known.outcomes[key] = {name: value for name, value in vars(message).items() if name != "header"}
            elif key in labels and not (labels[key].is_stable and not message.stable):
                raise RecordingError(f"{self.path}: grasp {key[1]} has two labels (/truth)")
            else:
                fields = vars(message)
                # Recordings of earlier versions name it `class`.
                object_class = fields["object_class"] if "object_class" in fields else fields["class"]
                labels[key] = Label(message.stable, message.epsilon, message.volume, message.object, object_class)
        return known

    def _grasp(self, frames: list[Any], known: _Known) -> Grasp:
        key = _key(frames[0])
        numbers = [(key[0], frame.header.seq) for frame in frames]
        lists = [name for name, value in vars(frames[0]).items() if isinstance(value, np.ndarray)]
        tables = {name: _table([getattr(frame, name) for frame in frames]) for name in lists}
        if missing := {"joints", "cells_newtons"} - tables.keys():
            raise RecordingError(f"{self.path}: its frames have no {min(missing)}: another version of blindgrasp wrote it")
        joints, cells_newtons = tables.pop("joints"), tables.pop("cells_newtons")
        return Grasp(
            grasp_id=key[1],
            epoch=key[0],
            seq=np.array([frame.header.seq for frame in frames], np.uint64),
            stamp_nanos=np.array([frame.header.stamp_nanos for frame in frames], np.int64),
            phase=np.array([_word(PHASES, frame.phase) for frame in frames]),
            joints=joints,
            cells_newtons=cells_newtons,
            senses={name: table for name, table in tables.items() if table.shape[1] > 0},
            hand_id=f"{frames[0].header.hand_id:016x}",
            day=frames[0].day,
            label=known.labels.get(key),
            decisions=tuple(known.decisions.get(key, ())),
            probability_stable=np.array([known.predictions.get(number, np.nan) for number in numbers]),
            outcome=known.outcomes.get(key),
        )

    def _damaged(self, reason: object) -> RecordingError:
        return RecordingError(
            f"{self.path} was cut off or is damaged ({reason}): `blindgrasp info {self.path} --repair` recovers what "
            "is whole in it"
        )


def _check_summary(stream: BinaryIO) -> None:
    """Checks the summary at the end of an MCAP file, as no reader does: https://mcap.dev/spec#footer-op0x02.

    Raises ValueError if the file does not end as MCAP does, or if the summary's checksum is wrong.
    """
    n_bytes = struct.calcsize(FOOTER) + len(MAGIC)
    end = stream.seek(0, 2)
    stream.seek(max(end - n_bytes, 0))
    tail = stream.read()
    if len(tail) < n_bytes or not tail.endswith(MAGIC):
        raise ValueError("it does not end as MCAP does")
    _, _, summary_start, _, checksum = struct.unpack_from(FOOTER, tail)
    # The checksum covers all of the footer but itself.
    n_covered = end - n_bytes + struct.calcsize(FOOTER) - 4 - summary_start
    stream.seek(min(summary_start, end))
    if n_covered < 0 or checksum and zlib.crc32(stream.read(n_covered)) != checksum:
        raise ValueError("its summary has a wrong checksum")


def read(path: str | PathLike[str]) -> list[Grasp]:
    """All grasps of a recording, in order. `Recording` takes less memory: it reads one grasp at a time.

    Raises FileNotFoundError or RecordingError, as `Recording` does.
    """
    # `list` would ask a Recording for its length, which reads the file once more.
    return list(iter(Recording(path)))


def _key(message: Any) -> Key:
    return message.header.epoch, message.grasp_id


def _word(words: Sequence[str], code: int) -> str:
    """The word of a code; a code that this version does not know is its number."""
    return words[code] if code < len(words) else str(code)


def _decision(message: Any) -> Decision:
    return Decision(
        grasp_id=message.grasp_id,
        action=ACTIONS.get(message.action, str(message.action)),
        reason=_word(REASONS, message.reason),
        probability_stable=message.probability_stable,
        seq=message.header.seq,
        stamp_nanos=message.header.stamp_nanos,
        epoch=message.header.epoch,
    )


def _table(rows: Sequence[Sequence[float] | NDArray[np.float64]]) -> NDArray[np.float64]:
    """Rows of numbers as an array; a row that is shorter than the longest one ends with NaN."""
    table = np.full((len(rows), max(map(len, rows))), np.nan)
    for row, values in zip(table, rows):
        row[: len(values)] = values
    return table
