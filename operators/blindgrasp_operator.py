"""An operator of blindgrasp in Python: takes samples from one input, answers each on one output.

    DESCRIPTION = Description("mine", "Judges each frame", ("feature", GraspFeature), ("prediction", Prediction))

    def start(params):                    # once, before anything else; slow imports and loading belong here
        def answer(head, values):         # for each sample: its head, its items; returns the answer's head, or (head, items)
            return PredictionHead(grasp_id=head.grasp_id, phase=head.phase, fault=head.fault)
        return Stage(answer)

    run(DESCRIPTION, start)

`run` does what an operator in Rust does: it can be killed, stopped, restarted and swapped without a sample being lost,
repeated or re-ordered. The protocol is described in docs/operators.md. Needs `iceoryx2` (requirements.txt), and gives items as
numpy arrays if numpy is there. What it does not do: sources, operators with several inputs or outputs, answers when nothing
comes. If there is a folder `.venv` beside the program and no environment is active, the program runs in it.
"""

from __future__ import annotations

import ctypes
import dataclasses
import fcntl
import gc
import hashlib
import json
import logging
import mmap
import os
import platform
import select
import shutil
import signal
import socket
import struct
import sys
import threading
import time
import traceback
from collections import deque
from pathlib import Path
from typing import Any, Callable, Iterator, Sequence

from blindgrasp_messages import Fault, Message

PROTOCOL = 3
# The cell of the bell of the command that compares an operator with its replacement.
COMPARE_BELL = 1
WIRING_VARIABLE = "BLINDGRASP_WIRING"

# The longest time that an operator waits before it gives a sign of life.
TICK_NANOS = 100_000_000
# An early sample waits so long for those before it.
HOLD_LIMIT_NANOS = 50_000_000
START_HOLD_LIMIT_NANOS = 2_000_000_000
# A writer that waits for its readers sleeps so long between looks, and looks so often for readers that have come back.
RETRY_PAUSE_SECS = 50e-6
LOOK_PAUSE_NANOS = 1_000_000
# A longer pause between two tries to send counts as this much: while the whole machine stands still, no guest is slow.
LONGEST_TRY_NANOS = 5_000_000
# An operator whose launcher has died gets this long to end of its own accord.
ORPHAN_LIMIT_SECS = 3
# A standby reports that it is warm after so many samples.
N_WARM = 8

log = logging.getLogger("blindgrasp")


def _now_nanos() -> int:
    """The clock of the graph's processes: it counts the time for which the machine was suspended."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


Key = tuple[int, int]
"""The number of a sample in a stream: epoch, sequence number."""


@dataclasses.dataclass
class Param:
    """A parameter. `kind` is path, string, boolean, integer, number or choice; without a default it must be given."""

    name: str
    kind: str
    summary: str = ""
    default: Any = None
    live: bool = False
    """It can be changed while the operator runs."""
    optional: bool = False
    min: float | None = None
    max: float | None = None
    above: float | None = None
    words: Sequence[str] | None = None
    """Words that may stand instead of a number."""
    values: Sequence[str] | None = None
    """The words of a choice."""
    must_exist: bool | None = None
    """Of a path; true by default."""


@dataclasses.dataclass
class Description:
    """The description of an operator."""

    operator: str
    summary: str
    input: tuple[str, type[Message]]
    """The input port's name and message."""
    output: tuple[str, type[Message]]
    """The output port's name and message."""
    params: Sequence[Param] = ()
    version: str = "0.1.0"
    answers_each: bool = True
    """It answers each sample with one of the same number and has no state. Set it to False for a stage with `state`."""

    def to_json(self) -> dict[str, Any]:
        port = lambda name, message: {"name": name, "type": message.TYPE_NAME}  # noqa: E731
        given = lambda param: {key: value for key, value in vars(param).items() if value is not None and value is not False and value != ""}  # noqa: E731
        params = [given(param) | ({"default": param.default} if param.default is not None else {}) for param in self.params]
        return {
            "protocol": PROTOCOL,
            "operator": self.operator,
            "version": self.version,
            "summary": self.summary,
            "inputs": [port(*self.input)],
            "outputs": [port(*self.output)],
            "params": params,
        } | ({"answers_each": True} if self.answers_each else {})


@dataclasses.dataclass
class Stage:
    """The work of an operator on samples.

    `answer` gets a sample's head and items, both its own copies, and returns the answer's head, or head and items. The
    answer's `header` is filled in. It must answer a sample the same whenever it is asked: after a restart, some are asked again.
    """

    answer: Callable[[Any, Any], Any] | None = None
    answer_many: Callable[[list[Any], list[Any]], list[Any]] | None = None
    """Instead of `answer`, for models that judge many samples in about the time of one: it gets all samples that have come, and
    returns as many answers in the same order."""
    max_batch: int = 32
    """The most samples that `answer_many` gets."""
    max_items: int = 0
    """The most items that an answer has."""
    identity: dict[str, str] = dataclasses.field(default_factory=dict)
    """Its neighbours, and an instance that takes its place, must have the same values, like {"hand": "0123456789abcdef"}."""
    set: Callable[[dict[str, Any]], None] | None = None
    """Called with the new values of live parameters before `start`'s params are updated; an exception refuses them."""
    state: Callable[[], bytes] | None = None
    """With state: the bytes on which the next answer depends, saved after each sample; at most 64 KiB. `answer` may then
    return None for no answer, and numbers the headers of its answers itself."""
    restore: Callable[[bytes | None], None] | None = None
    """With state: takes over the bytes that `state` returned, here or in another process, or begins anew."""


def fault_of(head: Any) -> Fault:
    """The fault of a sample; an unknown code is MALFORMED."""
    try:
        return Fault(head.fault)
    except ValueError:
        return Fault.MALFORMED


def run(description: Description, start: Callable[[dict[str, Any]], Stage]) -> None:
    """The `main` of an operator: answers `--describe`, or joins the graph and works until it is asked to end."""
    if "--describe" in sys.argv[1:]:
        print(json.dumps(description.to_json()))
        sys.exit(0)
    if WIRING_VARIABLE not in os.environ:
        print(
            f"{description.operator}: {description.summary}\n\nThis is an operator: blindgrasp starts it as part of a graph "
            "(blindgrasp run dataflow.yaml).\nWith --describe it prints its ports and parameters.",
            file=sys.stderr,
        )
        sys.exit(2)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[_ReportHandler()])
    logging.captureWarnings(True)
    try:
        _join_and_work(description, start)
    except Exception as error:
        log.info("%s", traceback.format_exc())
        _report("failed", message=_in_words(error))
        sys.exit(1)


def _in_words(error: Exception) -> str:
    """The text of an error for a person."""
    if isinstance(error, ModuleNotFoundError):
        return f"{error}; install it for {sys.executable}: pip install -r requirements.txt"
    text = str(error)
    return text if isinstance(error, (OSError, RuntimeError)) and text else f"{type(error).__name__}: {text}"


def _report(report: str, **fields: Any) -> None:
    """Writes a line to the launcher in one go. A launcher that is gone hears nothing."""
    line = f"@blindgrasp {json.dumps({'report': report, **fields})}\n"
    try:
        sys.stdout.flush()
        os.write(1, line.encode())
    except OSError:
        pass


class _ReportHandler(logging.Handler):
    """Python's logging as reports to the launcher."""

    LEVELS = ((logging.ERROR, "error"), (logging.WARNING, "warn"), (logging.INFO, "info"), (logging.DEBUG, "debug"))

    def emit(self, record: logging.LogRecord) -> None:
        level = next((word for least, word in self.LEVELS if record.levelno >= least), "trace")
        _report("log", level=level, message=self.format(record), fields={"logger": record.name})


_LIBC = ctypes.CDLL(None, use_errno=True)
_SYS_FUTEX, _FUTEX_WAIT, _FUTEX_WAKE = 202, 0, 1


class _Timespec(ctypes.Structure):
    _fields_ = [("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long)]


class _Board:
    """The graph's board: a file of 64-bit numbers in shared memory, one cell to each port and instance.

    A number is read and written whole. Their order, as x86-64 keeps it, is that of the program. The cell of a port holds a
    turn and two records, written in turn: record `turn % 2` is valid. The turn changes last, so a process that is killed
    leaves the record before or the record after.
    """

    HEADER_BYTES, CELL_BYTES, STATE_BYTES, SLOTS_AT = 4096, 128, 64 << 10, 4096
    REGION_BYTES = SLOTS_AT + 2 * STATE_BYTES
    MAGIC, LAYOUT = int.from_bytes(b"bg-board", "big"), 4
    N_AGE_BUCKETS = 384
    NO_SEQ = (1 << 64) - 1

    def __init__(self, path: str) -> None:
        if platform.machine() != "x86_64":
            raise RuntimeError(f"operators in Python need a processor that keeps the order of writes (x86_64), not {platform.machine()}")
        self.file = open(path, "r+b")
        self.bytes = mmap.mmap(self.file.fileno(), 0)
        self.words = memoryview(self.bytes).cast("Q")
        if list(self.words[:2]) != [self.MAGIC, self.LAYOUT]:
            raise RuntimeError(f"{path} is not a board of this version of blindgrasp: take its operators' modules as well")
        self.n_cells = self.words[2]
        self._fence = threading.Lock()

    def cell(self, idx: int) -> int:
        """Where a cell begins, in words."""
        return (self.HEADER_BYTES + idx * self.CELL_BYTES) // 8

    def _record(self, cell: int, n_words: int) -> list[int]:
        """The valid record: epoch, number, counts. The number is NO_SEQ before the first sample."""
        words, at = self.words, self.cell(cell)
        while True:
            turn = words[at]
            if turn == 0:
                return [0, self.NO_SEQ] + [0] * (n_words - 2)
            begin = at + 1 + turn % 2 * n_words
            record = list(words[begin : begin + n_words])
            if words[at] == turn:
                return record

    def _commit(self, cell: int, record: Sequence[int]) -> None:
        words, at = self.words, self.cell(cell)
        turn = words[at] + 1
        begin = at + 1 + turn % 2 * len(record)
        for idx, value in enumerate(record):
            words[begin + idx] = value
        words[at] = turn

    def answered(self, cell: int) -> tuple[Key | None, list[int]]:
        """Of an input: the last sample answered, None before the first; received, missing, repeated, reordered, late."""
        epoch, seq, *counts = self._record(cell, 7)
        return (None if seq == self.NO_SEQ else (epoch, seq)), counts

    def commit_answered(self, cell: int, key: Key | None, counts: Sequence[int]) -> None:
        self._commit(cell, [*(key or (0, self.NO_SEQ)), *counts])

    def sent(self, cell: int) -> Key | None:
        """Of an output: the last sample sent; None before the first."""
        epoch, seq, *_ = self._record(cell, 5)
        return None if seq == self.NO_SEQ else (epoch, seq)

    def is_given_up(self, cell: int) -> bool:
        """Whether no process reads on."""
        return self.words[self.cell(cell) + 15] != 0

    def give_up(self, cell: int) -> None:
        self.words[self.cell(cell) + 15] = 1

    def count_age(self, cell: int, age_nanos: int) -> None:
        """Counts the age of a sample on arrival, in the cells behind the input's: 16 buckets to a doubling, from 256 ns."""
        units = age_nanos // 256
        bucket = units
        if units >= 16:
            octave = units.bit_length() - 4
            bucket = min(octave * 16 + (units >> (octave - 1)) % 16, self.N_AGE_BUCKETS - 1)
        self.words[self.cell(cell + 1) + bucket] += 1

    def count_sent(self, cell: int, key: Key) -> None:
        epoch, seq, n_sent, n_resent, blocked_nanos = self._record(cell, 5)
        if seq != self.NO_SEQ and epoch == key[0] and key[1] <= seq:
            self._commit(cell, [epoch, seq, n_sent, n_resent + 1, blocked_nanos])
        else:
            self._commit(cell, [*key, n_sent + 1, n_resent, blocked_nanos])

    def add_blocked(self, cell: int, nanos: int) -> None:
        *record, blocked_nanos = self._record(cell, 5)
        self._commit(cell, [*record, blocked_nanos + nanos])

    def beat(self, cell: int) -> None:
        """Gives a sign of life."""
        self.words[self.cell(cell)] = _now_nanos()

    def take_bell(self, cell: int) -> None:
        """Takes the bell of an instance. Its reader always counts as asleep: writers then make a futex call for each ring."""
        self.words[self.cell(cell) + 8] = 1 | 1 << 32

    def ring(self, cell: int) -> None:
        """Wakes a reader. What it is to find must be stored before."""
        word = self._futex_word(cell)
        word.value = 1
        _LIBC.syscall(_SYS_FUTEX, ctypes.byref(word), _FUTEX_WAKE, 1, None, None, 0)

    def wait_for_ring(self, cell: int, limit_nanos: int) -> None:
        """Sleeps until the bell is rung, a signal comes or the time is over, and clears the bell."""
        word = self._futex_word(cell)
        limit = _Timespec(*divmod(max(0, limit_nanos), 1_000_000_000))
        _LIBC.syscall(_SYS_FUTEX, ctypes.byref(word), _FUTEX_WAIT, 0, ctypes.byref(limit), None, 0)
        word.value = 0
        # A lock is a fence: the reader looks at its queues only after the bell is cleared.
        with self._fence:
            pass

    def _futex_word(self, cell: int) -> ctypes.c_uint32:
        return ctypes.c_uint32.from_buffer(self.bytes, self.HEADER_BYTES + cell * self.CELL_BYTES + 64)

    def works_on(self, cell: int, key: Key | None) -> None:
        """Names the sample that an instance works on, for the launcher if the process dies of it."""
        if key is not None:
            self.words[self.cell(cell) + 1] = key[0]
        self.words[self.cell(cell) + 2] = 0 if key is None else key[1] + 1

    def _region(self, region: int) -> int:
        cells_end = self.HEADER_BYTES + self.n_cells * self.CELL_BYTES
        return -(-cells_end // 4096) * 4096 + region * self.REGION_BYTES

    def reserve_state(self, region: int) -> None:
        """Takes the memory now, so that saving cannot fail later."""
        os.posix_fallocate(self.file.fileno(), self._region(region), self.REGION_BYTES)

    def save_state(self, region: int, state: bytes) -> None:
        if len(state) > self.STATE_BYTES:
            raise RuntimeError(f"its state takes {len(state)} bytes, more than the {self.STATE_BYTES} that are there")
        at = self._region(region)
        n_saved = self.words[at // 8] + 1
        slot = n_saved % 2
        slot_at = at + self.SLOTS_AT + slot * self.STATE_BYTES
        self.bytes[slot_at : slot_at + len(state)] = state
        self.words[at // 8 + 1 + slot] = len(state)
        self.words[at // 8] = n_saved

    def state(self, region: int) -> bytes | None:
        at = self._region(region)
        while True:
            n_saved = self.words[at // 8]
            if n_saved == 0:
                return None
            slot = n_saved % 2
            slot_at = at + self.SLOTS_AT + slot * self.STATE_BYTES
            state = self.bytes[slot_at : slot_at + min(self.words[at // 8 + 1 + slot], self.STATE_BYTES)]
            if self.words[at // 8] == n_saved:
                return state


class _Operator:
    """An operator in a running graph: commands of the launcher, signals, signs of life."""

    def __init__(self, wiring: dict[str, Any], description: Description) -> None:
        import iceoryx2 as iox2

        self._program = _identity_of_program(description, wiring["params"])
        self.has_params(wiring["params"])

        self.iox2 = iox2
        self.wiring = wiring
        self.board = _Board(wiring["domain"]["board"])
        self.commands: deque[dict[str, Any]] = deque()
        self.is_to_stop = self.is_to_quit = False
        self._cell: int = wiring["instance_cell"]
        self.board.take_bell(self._cell)
        iox2.set_log_level(iox2.LogLevel.Fatal)
        self.node = self._join(wiring["domain"], wiring["node"])
        # A thread rings the bell when a command or a signal comes.
        wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)
        signal.set_wakeup_fd(wake[1], warn_on_full_buffer=False)
        threading.Thread(target=self._listen, args=[wake[0]], daemon=True).start()

    def _join(self, domain: dict[str, str], node: str) -> Any:
        iox2 = self.iox2
        # The global configuration would read ./config/iceoryx2.toml from the current folder.
        config = iox2.config.default()
        config.global_cfg.prefix = iox2.FileName.new(domain["prefix"])
        config.global_cfg.root_path = iox2.Path.new(domain["root_path"])
        # The launcher alone finds dead processes and frees their memory.
        config.global_cfg.node.cleanup_dead_nodes_on_creation = False
        config.global_cfg.node.cleanup_dead_nodes_on_destruction = False
        config.global_cfg.service.cleanup_dead_nodes_on_open = False
        builder = iox2.NodeBuilder.new().name(iox2.NodeName.new(node)).config(config)
        return builder.signal_handling_mode(iox2.SignalHandlingMode.Disabled).create(iox2.ServiceType.Ipc)

    def _on_signal(self, _number: int, _frame: Any) -> None:
        self.is_to_stop = True

    def beat(self) -> None:
        self.board.beat(self.wiring["instance_cell"])

    def has_params(self, params: dict[str, Any]) -> None:
        """Takes the values of the parameters into its identity."""
        self._identity = _identity_of(self._program, json.dumps(params, sort_keys=True))

    def made_by(self, before: int) -> int:
        """The identity of the samples that this operator makes of samples that were made by others: it changes with the
        program, its parameters and the files that they name."""
        return _identity_of(before, self._identity)

    def _listen(self, wake: int) -> None:
        """Takes in the commands of the launcher, and rings the bell for them and for signals."""
        sources = select.poll()
        sources.register(0, select.POLLIN | select.POLLHUP)
        sources.register(wake, select.POLLIN)
        unread = b""
        while True:
            for fd, _ in sources.poll():
                content = os.read(fd, 1 << 16)
                if fd != 0:
                    continue
                if not content:
                    # The end of stdin.
                    self.is_to_quit = True
                    sources.unregister(0)
                *lines, unread = (unread + content).split(b"\n")
                for line in lines:
                    try:
                        command = json.loads(line)
                        self.commands.append({"command": command["command"], **command})
                    except (ValueError, TypeError, KeyError):
                        log.warning("not a command of this version: %s", line.decode(errors="replace"))
            self.board.ring(self._cell)

    def has_command(self) -> bool:
        """Whether a command of the launcher is not carried out yet."""
        return bool(self.commands)

    def is_to_give_way(self) -> bool:
        """Whether a writer that waits for its readers should give up."""
        self.beat()
        return self.is_to_quit or any(command["command"] == "hand_over" for command in self.commands)

    def should_stop(self) -> bool:
        return self.is_to_stop or self.is_to_quit

    def wait(self, deadline_nanos: int | None = None) -> None:
        """Waits until a sample, the launcher or a signal wakes it, at most until the deadline or the next sign of life."""
        self.beat()
        limit = TICK_NANOS
        if deadline_nanos is not None:
            limit = min(limit, deadline_nanos - _now_nanos())
        self.board.wait_for_ring(self._cell, limit)
        self.beat()

    def drained(self, look: Callable[[], None]) -> None:
        """Keeps the ports open until the launcher needs nothing more: unread samples would be lost with them.

        A reader that is restarted meanwhile needs their history: `look` must look for readers at each output.
        """
        _report("drained")
        while not self.is_to_quit:
            look()
            self.wait()


def _identity_of_program(description: Description, params: dict[str, Any]) -> int:
    program = Path(sys.argv[0])
    paths = [params.get(param.name) for param in description.params if param.kind == "path"]
    files = [Path(path) for path in [program, *filter(None, paths)] if Path(path).is_file()]
    return _identity_of(description.operator, sys.argv, *(file.read_bytes() for file in files))


def _identity_of(*parts: Any) -> int:
    digest = hashlib.sha256(repr(parts).encode()).digest()
    # 0 says that nothing is known.
    return max(1, int.from_bytes(digest[:8], "big"))


def _end_with_launcher(launcher: int) -> None:
    """Ends this process and its children some seconds after the launcher has died, whatever the operator hangs in."""
    while os.getppid() == launcher:
        time.sleep(0.5)
    time.sleep(ORPHAN_LIMIT_SECS)
    os.killpg(0, signal.SIGKILL)


class _Service:
    """The service of one port. The first process to come creates it, so all ask for the same: the wiring decides."""

    def __init__(self, operator: _Operator, wiring: dict[str, Any], message: type[Message]) -> None:
        iox2 = operator.iox2
        self.name: str = wiring["name"]
        self.message = message
        if wiring["type_name"] != message.TYPE_NAME:
            raise RuntimeError(f"port {self.name} carries {wiring['type_name']}, expected {message.TYPE_NAME}")
        self.pub_sub = (
            operator.node.service_builder(iox2.ServiceName.new(self.name))
            .publish_subscribe(iox2.Slice[message.Item])
            .user_header(message.Head)
            .enable_safe_overflow(True)
            .subscriber_max_buffer_size(wiring["max_capacity"])
            .subscriber_max_borrowed_samples(wiring["max_borrowed"])
            .history_size(wiring["history"])
            .max_publishers(wiring["max_publishers"])
            .max_subscribers(wiring["max_subscribers"])
            .max_nodes(wiring["max_nodes"])
            .open_or_create()
        )


@dataclasses.dataclass
class _Sample:
    """A sample, copied out of shared memory."""

    head: Any
    raw_items: bytes
    key: Key
    counts: tuple[int, ...] = ()
    """The counts when it was delivered, itself included."""


class _Sequencer:
    """Puts the samples of one input in order, each once, whichever publisher sent them.

    After a crash, or while one instance of the writer hands over to another, samples come again or early: repeated samples are
    dropped, early ones are held for a bounded time until their turn, samples that do not come are counted as missing. A place
    is the generation of a sample's epoch, which counts the epochs of the stream, and its number.
    """

    N_PUBLISHERS = 16
    """The number of publishers whose last sample is remembered."""

    def __init__(self, may_hold: bool) -> None:
        """The order of a reader that begins with whatever sample comes first."""
        self.may_hold = may_hold
        # The last sample that was sent before this reader began, and until when those up to it are awaited: each publisher gives a
        # reader the samples that it kept once it has noticed the reader.
        self.awaited: tuple[Key, int] | None = None
        self.epochs: list[int] = []
        self.last: Key | None = None
        self.answered: Key | None = None
        self.counted: Key | None = None
        self.begins_at_zero = False
        self.publishers: dict[int, Key] = {}
        self.held: dict[Key, tuple[_Sample, int]] = {}
        self.n_received = self.n_missing = self.n_repeated = self.n_reordered = self.n_late = 0

    def resume(self, answered: Key | None, counted: Key | None, counts: Sequence[int]) -> _Sequencer:
        """The order of a reader that goes on where an earlier instance left off. That one has answered and counted the samples up
        to `counted`; readers have received the answers up to `answered`. The samples between are answered again."""
        if counted is not None:
            self.epochs = [counted[0]]
            self.counted = (0, counted[1])
            if answered is not None and answered[0] == counted[0]:
                self.last = self.answered = (0, min(answered[1], counted[1]))
        self.begins_at_zero = True
        self.n_received, self.n_missing, self.n_repeated, self.n_reordered, self.n_late = counts
        return self

    def counts(self) -> tuple[int, ...]:
        return self.n_received, self.n_missing, self.n_repeated, self.n_reordered, self.n_late

    def _place(self, key: Key) -> Key:
        if key[0] not in self.epochs:
            self.epochs.append(key[0])
        return self.epochs.index(key[0]), key[1]

    def push(self, sample: _Sample, publisher: int, has_other_publishers: Callable[[], bool]) -> bool:
        """Takes a sample; true if it is its turn."""
        place = self._place(sample.key)
        before = self.publishers.get(publisher)
        if before is not None and place <= before:
            # No restart or swap explains this: the stage sees the sample as it is.
            self.n_repeated += 1
            return True
        if before is None and len(self.publishers) >= self.N_PUBLISHERS:
            self.publishers.pop(next(iter(self.publishers)))
        self.publishers[publisher] = place
        if (self.last is not None and place <= self.last) or place in self.held:
            self.n_repeated += self.answered is None or place > self.answered
            return False
        n_before = self._n_before(place)
        is_early = n_before > 0 or (bool(self.held) and min(self.held) < place)
        # A publisher skips no number that it or another publisher has: only before its first sample may be samples of another.
        may_be_elsewhere = n_before > 0 and before is None
        if is_early and self.may_hold:
            if self.held or (may_be_elsewhere and (len(self.publishers) > 1 or has_other_publishers())):
                self.held[place] = (sample, _now_nanos())
                return False
        self._deliver(place, n_before)
        return True

    def next_in_order(self) -> _Sample | None:
        if not self.held or self._n_before(min(self.held)):
            return None
        self.n_reordered += 1
        return self._first_held()

    def next_overdue(self) -> _Sample | None:
        """A held sample whose wait is over. Ask for it only when no more samples have come."""
        deadline = self.deadline()
        return self._first_held() if deadline is not None and _now_nanos() >= deadline else None

    def _first_held(self) -> _Sample:
        place = min(self.held)
        sample, _ = self.held.pop(place)
        self._deliver(place, self._n_before(place))
        return sample

    def hold_again(self, samples: Sequence[_Sample]) -> None:
        """Takes over the samples that an earlier order of the same reader has received and not answered."""
        last, now = self.last or self.counted, _now_nanos()
        places = [(self._place(sample.key), sample) for sample in samples]
        self.held.update({place: (sample, now) for place, sample in places if last is None or place > last})

    def deadline(self) -> int | None:
        if not self.held:
            return None
        deadline = self.held[min(self.held)][1] + HOLD_LIMIT_NANOS
        if self.awaited is None:
            return deadline
        (epoch, seq), until = self.awaited
        has_all = self.last is not None and epoch in self.epochs and (self.epochs.index(epoch), seq) <= self.last
        return deadline if has_all else max(deadline, until)

    def _n_before(self, place: Key) -> int:
        """The number of samples before this place, which is after the last one, that have not come."""
        if self.last is None:
            return place[1] if self.begins_at_zero and self.counted is None else 0
        # A new epoch may begin at any number.
        return max(0, place[1] - self.last[1] - 1) if self.last[0] == place[0] else 0

    def _deliver(self, place: Key, n_missing: int) -> None:
        self.last = place
        if self.counted is not None and place <= self.counted:
            return
        if n_missing and self.counted is not None and self.counted[0] == place[0]:
            # Samples that an earlier instance counted are not missing, though they may not have come again.
            n_missing -= min(n_missing, max(0, self.counted[1] - (place[1] - n_missing - 1)))
        self.n_missing += n_missing
        self.n_received += 1


def _is_at_most(key: Key, other: Key | None) -> bool:
    """Whether a sample is `other` or before it in the same epoch."""
    return other is not None and key[0] == other[0] and key[1] <= other[1]


class _Subscriber:
    """The receiving end of an edge. With `is_onlooker` it has no cell on the board and only reads along."""

    def __init__(self, operator: _Operator, wiring: dict[str, Any], message: type[Message], is_onlooker: bool) -> None:
        service = wiring["service"]
        self.operator, self.board, self.message = operator, operator.board, message
        self.service = _Service(operator, service, message)
        self.may_hold = wiring["policy"] == "lossless"
        # A reader that comes back finds all that its writer keeps; the board limits how much may be unanswered.
        most = service["max_capacity"]
        capacity = most if self.may_hold else min(wiring["capacity"], most)
        self.subscriber = self.service.pub_sub.subscriber_builder().buffer_size(capacity).create()
        self.cell: int | None = None if is_onlooker else wiring["cell"]
        self.writer_cell: int = wiring["writer_cell"]
        self.deadline_nanos: int | None = wiring["deadline_nanos"]
        self.on_late: str = wiring.get("on_late", "count")
        self.put_back: list[_Sample] = []
        self.sequencer = _Sequencer(self.may_hold)

    def close(self) -> None:
        self.subscriber.delete()

    def connect(self) -> None:
        """Connects to its publishers: samples that come before may be dropped."""
        self.subscriber.has_samples()

    def begin_with(self, sequencer: _Sequencer) -> None:
        before, self.sequencer = self.sequencer, sequencer
        sent = None if self.cell is None else self.board.sent(self.writer_cell)
        sequencer.awaited = None if sent is None else (sent, _now_nanos() + START_HOLD_LIMIT_NANOS)
        sequencer.hold_again([sample for sample, _ in before.held.values()] + self.put_back)
        self.put_back = []

    def take_over(self, answered: Key | None) -> None:
        """Goes on after the last sample that the node has answered, which the board names."""
        if self.cell is not None:
            counted, counts = self.board.answered(self.cell)
            self.begin_with(_Sequencer(self.may_hold).resume(answered, counted, counts))

    def take_over_at(self, last: Key | None, counts: Sequence[int]) -> None:
        """Goes on after `last`, the last sample that a saved state includes."""
        if self.cell is not None:
            self.board.commit_answered(self.cell, last, counts)
            self.begin_with(_Sequencer(self.may_hold).resume(last, last, counts))

    def is_caught_up(self) -> bool:
        """Whether all samples that its writer has sent are answered."""
        if self.cell is None:
            return True
        sent = self.board.sent(self.writer_cell)
        return sent is None or _is_at_most(sent, self.board.answered(self.cell)[0])

    def receive(self) -> _Sample | None:
        """The next sample in order, if one is there."""
        sequencer = self.sequencer
        sample = sequencer.next_in_order()
        while sample is None:
            taken = self.subscriber.receive()
            if taken is None:
                # Only now, because the samples that a held one waits for may have been in the queue.
                sample = sequencer.next_overdue()
                break
            head = self.message.Head()
            ctypes.memmove(ctypes.addressof(head), taken.user_header_ptr, ctypes.sizeof(head))
            info = taken.header
            n_bytes = info.number_of_elements * ctypes.sizeof(self.message.Item)
            raw_items = ctypes.string_at(taken.payload_ptr, n_bytes)
            taken.delete()
            copied = _Sample(head, raw_items, (head.header.epoch, head.header.seq))
            if sequencer.push(copied, info.publisher_id.value, self._has_other_publishers):
                sample = copied
        if sample is not None:
            self._count_age(sample)
            sample.counts = sequencer.counts()
        return sample

    def _has_other_publishers(self) -> bool:
        return self.service.pub_sub.dynamic_config.number_of_publishers > 1

    def _count_age(self, sample: _Sample) -> None:
        origin_nanos = sample.head.header.origin_nanos
        # A reader without a cell counts nothing, and a sample without a time has no age.
        if self.cell is not None and origin_nanos:
            age_nanos = max(0, _now_nanos() - origin_nanos)
            self.board.count_age(self.cell, age_nanos)
            if self.deadline_nanos is not None and age_nanos > self.deadline_nanos:
                self.sequencer.n_late += 1
                self._judge_lateness(sample, age_nanos)

    def _judge_lateness(self, sample: _Sample, age_nanos: int) -> None:
        if self.on_late == "count" or self.operator.wiring["clock"] != "machine":
            return
        # It has expired, and with it its answer: the arbiter holds.
        sample.head.header.valid_nanos = 1
        if self.on_late == "stop":
            # Once is enough.
            self.on_late = "hold"
            said = f"got sample {sample.key[1]} after {age_nanos / 1e6:.1f} ms, too late, and 'on_late' is 'stop'"
            _report("unfit", message=said)

    def commit(self, sample: _Sample) -> None:
        """Marks all samples up to this one as answered."""
        if self.cell is not None:
            last, _ = self.board.answered(self.cell)
            # A sample that goes back in order is answered, but does not move the cursor.
            key = last if _is_at_most(sample.key, last) else sample.key
            self.board.commit_answered(self.cell, key, sample.counts)


class _Sender:
    """A publisher that does not wait for readers: the output of a standby, for comparison."""

    def __init__(self, operator: _Operator, wiring: dict[str, Any], bells: Sequence[int], message: type[Message], max_items: int) -> None:
        iox2 = operator.iox2
        self.board, self.bells = operator.board, bells
        self.service = _Service(operator, wiring, message)
        self.max_items = max(1, max_items)
        self.publisher = (
            self.service.pub_sub.publisher_builder()
            .initial_max_slice_len(self.max_items)
            .allocation_strategy(iox2.AllocationStrategy.Static)
            .backpressure_strategy(iox2.BackpressureStrategy.DiscardData)
            .create()
        )
        self.n_subscribers = 0

    def close(self) -> None:
        self.publisher.delete()

    def send(self, head: Any, raw_items: bytes) -> None:
        n_items = len(raw_items) // ctypes.sizeof(self.service.message.Item)
        if n_items > self.max_items:
            raise RuntimeError(f"an answer has {n_items} items, more than Stage(max_items={self.max_items}) says")
        sample = self.publisher.loan_slice_uninit(n_items)
        ctypes.memmove(sample.user_header_ptr, ctypes.addressof(head), ctypes.sizeof(head))
        ctypes.memmove(sample.payload_ptr, raw_items, len(raw_items))
        sample.assume_init().send()
        self.ring()

    def ring(self) -> None:
        for cell in self.bells:
            self.board.ring(cell)

    def look_for_readers(self) -> None:
        """Gives the history to readers that have come since the last sample, and wakes them."""
        n_subscribers = self.service.pub_sub.dynamic_config.number_of_subscribers
        self.publisher.update_connections()
        if n_subscribers != self.n_subscribers:
            self.n_subscribers = n_subscribers
            self.ring()


class _Publisher:
    """The sending end of an edge: it never gets further ahead of a reader than the reader has room for."""

    def __init__(self, operator: _Operator, wiring: dict[str, Any], message: type[Message], max_items: int) -> None:
        self.operator, self.board = operator, operator.board
        self.sender = _Sender(operator, wiring["service"], wiring["bells"], message, max_items)
        self.cell: int = wiring["cell"]
        self.consumers: list[dict[str, Any]] = wiring["consumers"]
        self.history: int = wiring["service"]["history"]
        self.wait_limit_millis: int = wiring["wait_limit_millis"]
        # The last sample that this instance, and not an earlier one, has sent.
        self.own_first: Key | None = None
        self.own_last: Key | None = None

    def last(self) -> Key | None:
        """The last sample that any instance of the node has sent."""
        return self.board.sent(self.cell)

    def _places(self, readers: Sequence[dict[str, Any]]) -> Iterator[Key | None]:
        """How far the readers have come, and those behind them that read their answers."""
        for reader in readers:
            if not self.board.is_given_up(reader["cell"]):
                yield self.board.answered(reader["cell"])[0]
                yield from self._places(reader.get("behind", []))

    def answered_by_readers(self) -> tuple[bool, Key | None]:
        """Whether there is a reader, and the last sample that all of them have answered."""
        last, places = self.last(), list(self._places(self.consumers))
        if not places or None in places:
            return bool(places), None
        # A reader in an earlier epoch is behind.
        behind = [place for place in places if last is None or place[0] != last[0]]  # type: ignore[index]
        return True, min(behind or places)  # type: ignore[type-var]

    def answered(self) -> Key | None:
        """The last sample that need not be sent again: an instance that takes over goes on after it."""
        last = self.last()
        has_readers, least = self.answered_by_readers()
        least = least if has_readers else last
        # The samples of this very instance lie in the readers' queues and in its history.
        if self.own_last is None or least is None:
            return least if least is not None else self.own_last
        if least[0] == self.own_last[0]:
            return max(least, self.own_last)
        return self.own_last if last is not None and last[0] == self.own_last[0] else least

    def send(self, head: Any, raw_items: bytes) -> bool:
        """Sends once every reader has room; false if it was asked to give way meanwhile."""
        key = (head.header.epoch, head.header.seq)
        if not self._has_room(key) and not self._wait_for_room(key):
            return False
        # It is counted first: a publisher that is killed in between sends it again, and it is counted once.
        self.board.count_sent(self.cell, key)
        self.sender.send(head, raw_items)
        self.own_first = self.own_first if self.own_first and self.own_first[0] == key[0] else key
        self.own_last = key
        return True

    def _has_room(self, key: Key) -> bool:
        return all(self._has_room_at(key, consumer) for consumer in self.consumers)

    def _has_room_at(self, key: Key, reader: dict[str, Any]) -> bool:
        if "capacity" in reader:
            # The samples of an earlier publisher lie in a queue of their own, or have died with it.
            own_first = self.own_first[1] if self.own_first and self.own_first[0] == key[0] else key[1]
            limit: int = reader["capacity"]
        else:
            # It reads answers: if those who give them die, this publisher must still have their samples.
            own_first, limit = 0, self.history
        place, last = self.board.answered(reader["cell"])[0], self.last()
        first_unanswered = place[1] + 1 if place else 0
        is_within = key[1] - max(first_unanswered, own_first) < limit
        if place is not None and place[0] == key[0]:
            # A reader that has answered all samples has room for one more, however far the numbers jump.
            is_near = is_within or last == place
        elif last is None or place is not None:
            # A new epoch begins when every reader has answered the one before.
            is_near = last is None or place == last
        else:
            is_near = last[0] == key[0] and is_within
        has_room = is_near and all(self._has_room_at(key, behind) for behind in reader.get("behind", []))
        return has_room or self.board.is_given_up(reader["cell"])

    def _give_up_guests(self, key: Key, waited_nanos: int) -> None:
        """Gives up the guests that have had no room for longer than their time, with all their readers: a recorder must not
        stop the graph."""
        for consumer in self.consumers:
            is_over = waited_nanos > consumer.get("guest_limit_millis", 0) * 1_000_000
            guest_cells = consumer.get("guest_cells", [])
            if guest_cells and is_over and not self._has_room_at(key, consumer):
                for cell in guest_cells:
                    self.board.give_up(cell)

    def _wait_for_room(self, key: Key) -> bool:
        start = last_look = last_try = _now_nanos()
        waited = 0
        try:
            while not self._has_room(key):
                if self.operator.is_to_give_way():
                    return False
                now = _now_nanos()
                # While the whole machine stands still, no guest is slow.
                waited += min(now - last_try, LONGEST_TRY_NANOS)
                last_try = now
                self._give_up_guests(key, waited)
                if now - start > self.wait_limit_millis * 1_000_000:
                    raise RuntimeError(
                        f"port {self.sender.service.name}: sample {key[1]} could not be delivered within "
                        f"{self.wait_limit_millis} ms: a reader is stopped or too slow"
                    )
                if now - last_look > LOOK_PAUSE_NANOS:
                    last_look = now
                    self.sender.look_for_readers()
                time.sleep(RETRY_PAUSE_SECS)
        finally:
            self.board.add_blocked(self.cell, _now_nanos() - start)
        return True


class _Worker:
    """A stage between its ports, active or standby."""

    def __init__(self, operator: _Operator, description: Description, stage: Stage, params: dict[str, Any]) -> None:
        self.operator, self.stage, self.params = operator, stage, params
        (input_port, self.message_in), (output_port, self.message_out) = description.input, description.output
        self.input_wiring = operator.wiring["inputs"][input_port]
        self.output_wiring = operator.wiring["outputs"][output_port]
        self.subscriber = _Subscriber(operator, self.input_wiring, self.message_in, is_onlooker=False)
        self.publisher = _Publisher(operator, self.output_wiring, self.message_out, stage.max_items)
        self.shadow: tuple[_Subscriber, _Sender] | None = None
        self.n_looked_on = 0
        self.last: Key | None = None
        # The answers of a stage with state, as head and items: they are saved with it until all readers have answered them.
        self.outbox: deque[tuple[bytes, bytes]] = deque()
        self.n_sent = 0
        self.region: int = operator.wiring["state_region"]
        self.has_state = stage.state is not None
        if self.has_state:
            operator.board.reserve_state(self.region)
        self.skip = {(sample["epoch"], sample["seq"]) for sample in operator.wiring.get("skip", [])}
        """Samples that have killed earlier instances again and again."""
        self.is_active = not operator.wiring["standby"]
        if self.is_active:
            self.take_over(is_handed_over=False)
        else:
            onlooker = _Subscriber(operator, self.input_wiring, self.message_in, is_onlooker=True)
            last, _, _ = self.restore()
            if last is not None:
                onlooker.begin_with(_Sequencer(onlooker.may_hold).resume(last, last, [0] * 5))
            self.shadow = (onlooker, _Sender(operator, self.output_wiring["shadow"], [COMPARE_BELL], self.message_out, stage.max_items))
        self.subscriber.connect()

    def work_until_stopped(self) -> None:
        operator = self.operator
        _report("ready", identity=self.stage.identity, has_state=self.has_state)
        next_look = 0
        while True:
            # The request is read before the input: samples that were sent before the request are still answered.
            stop = operator.should_stop()
            while operator.has_command():
                self.obey(operator.commands.popleft())
            if self.is_active:
                self.work()
            elif self.shadow is not None:
                self.look_on(*self.shadow)
            if operator.is_to_quit or (stop and (not self.is_active or self.subscriber.is_caught_up())):
                break
            if _now_nanos() >= next_look:
                next_look = _now_nanos() + TICK_NANOS
                self.publisher.sender.look_for_readers()
                self.subscriber.connect()
            operator.wait(self.subscriber.sequencer.deadline() if self.is_active else None)
        operator.drained(self.publisher.sender.look_for_readers)

    def obey(self, command: dict[str, Any]) -> None:
        if command["command"] == "take_over":
            if self.shadow is not None:
                for port in self.shadow:
                    port.close()
                self.shadow = None
            self.take_over(command["is_handed_over"])
            self.is_active = True
            _report("took_over")
        elif command["command"] == "hand_over":
            self.is_active = False
            _report("handed_over")
        elif command["command"] == "set":
            error = None
            try:
                if self.stage.set is not None:
                    self.stage.set(command["params"])
                self.params.update(command["params"])
                self.operator.has_params(command["params"])
            except Exception as refusal:
                error = _in_words(refusal)
            from_seq = None if self.last is None else self.last[1] + 1
            _report("set", id=command["id"], from_seq=from_seq, error=error)

    def work(self) -> None:
        """Answers the samples that are there."""
        operator = self.operator
        if not self.send_outbox():
            return
        while not operator.has_command() and not operator.is_to_quit and (samples := self.take(self.subscriber)):
            operator.beat()
            for idx, (sample, answers) in enumerate(self.answers(samples)):
                if self.has_state:
                    # Saved first: a kill at any moment neither loses an answer nor makes another one under its number.
                    self.outbox.extend((bytes(head), raw_items) for head, raw_items in answers)
                    self.save(sample)
                    if not self.send_outbox():
                        return
                for head, raw_items in [] if self.has_state else answers:
                    if not self.publisher.send(head, raw_items):
                        # Another instance finds the sample in its own queue; this one finds it here if it is active again.
                        self.subscriber.put_back = samples[idx:]
                        return
                self.last = sample.key
                self.subscriber.commit(sample)

    def look_on(self, subscriber: _Subscriber, sender: _Sender) -> None:
        """Computes live samples beside the active instance."""
        operator = self.operator
        while not operator.has_command() and not operator.should_stop() and (samples := self.take(subscriber)):
            operator.beat()
            for _, answers in self.answers(samples):
                for head, raw_items in answers:
                    sender.send(head, raw_items)
                self.n_looked_on += 1
                if self.n_looked_on == N_WARM:
                    _report("warm", n_samples=N_WARM)

    def take(self, subscriber: _Subscriber) -> list[_Sample]:
        """The samples that are there, as many as are answered at once."""
        max_batch = self.stage.max_batch if self.stage.answer_many and not self.has_state else 1
        samples: list[_Sample] = []
        while len(samples) < max_batch and (sample := subscriber.receive()) is not None:
            samples.append(sample)
        return samples

    def said(self, samples: list[_Sample], heads: list[Any], items: list[Any]) -> list[Any]:
        """The answers of the stage to samples. The launcher learns on which of them the process dies."""
        cell = self.operator.wiring["instance_cell"]
        self.operator.board.works_on(cell, samples[0].key)
        try:
            if self.stage.answer_many is None:
                said = [self.stage.answer(head, values) for head, values in zip(heads, items)]  # type: ignore[misc]
            else:
                said = self.stage.answer_many(heads, items)
        except Exception:
            if len(samples) == 1:
                raise
            # One by one, to find the one that it fails on.
            one_by_one = [self.said([sample], [head], [values]) for sample, head, values in zip(samples, heads, items)]
            return [answer for answers in one_by_one for answer in answers]
        if len(said) != len(samples):
            raise RuntimeError(f"answer_many returned {len(said)} answers to {len(samples)} samples")
        self.operator.board.works_on(cell, None)
        return said

    def answers(self, samples: list[_Sample]) -> Iterator[tuple[_Sample, list[tuple[Any, bytes]]]]:
        """Each sample with the answer of the stage."""
        # These are copies: a change of a head by the user must not change the number of its answer.
        asked = [sample for sample in samples if sample.key not in self.skip]
        heads = [type(sample.head).from_buffer_copy(sample.head) for sample in asked]
        items = [_items(self.message_in.Item, sample.raw_items) for sample in asked]
        said = iter(self.said(asked, heads, items) if asked else [])
        for sample in samples:
            if sample.key in self.skip:
                # Readers find a gap: nothing is lifted on it.
                log.error("sample %d is not answered: it has killed this operator again and again", sample.key[1])
                yield sample, []
                continue
            answer = next(said)
            if answer is None:
                if not self.has_state:
                    raise RuntimeError("a stage without state answers every sample, with a fault where it has nothing to say")
                yield sample, []
                continue
            head, items_out = answer if isinstance(answer, tuple) else (answer, None)
            if not isinstance(head, self.message_out.Head):
                raise RuntimeError(f"an answer's head is {type(head).__name__}, expected {self.message_out.Head.__name__}")
            if not self.has_state:
                head.header = sample.head.header
            head.header.made_by = self.operator.made_by(sample.head.header.made_by)
            yield sample, [(head, _raw(self.message_out.Item, items_out))]

    def send_outbox(self) -> bool:
        """Sends the saved answers that were not sent; false if it was asked to give way meanwhile."""
        while self.n_sent < len(self.outbox):
            raw_head, raw_items = self.outbox[self.n_sent]
            if not self.publisher.send(self.message_out.Head.from_buffer_copy(raw_head), raw_items):
                return False
            self.n_sent += 1
        return True

    def _n_up_to(self, key: Key | None) -> int:
        """The number of saved answers up to that one. Answers are in order, and one that is not there is older than all."""
        for n in range(len(self.outbox), 0, -1):
            header = self.message_out.Head.from_buffer_copy(self.outbox[n - 1][0]).header
            if key == (header.epoch, header.seq):
                return n
        return 0

    def save(self, sample: _Sample) -> None:
        """Saves the state that includes this sample, and the answers that readers may still need."""
        has_readers, answered = self.publisher.answered_by_readers()
        for _ in range(min(self.n_sent, self._n_up_to(answered) if has_readers else self.n_sent)):
            self.outbox.popleft()
            self.n_sent -= 1
        state = self.stage.state()  # type: ignore[misc]
        parts = [struct.pack("<2Q5QQ", *sample.key, *sample.counts, len(self.outbox))]
        for raw_head, raw_items in self.outbox:
            parts += [struct.pack("<2Q", len(raw_head), len(raw_items)), raw_head, raw_items]
        self.operator.board.save_state(self.region, b"".join([*parts, state]))

    def take_over(self, is_handed_over: bool) -> None:
        known = self.publisher.last() if is_handed_over else self.publisher.answered()
        if self.has_state:
            self.last, counts, self.outbox = self.restore()
            self.subscriber.take_over_at(self.last, counts)
            self.n_sent = self._n_up_to(known)
        else:
            self.last = known
            self.subscriber.take_over(self.last)

    def restore(self) -> tuple[Key | None, Sequence[int], deque[tuple[bytes, bytes]]]:
        """Takes over the saved state; returns the last sample that it includes, the counts of that time, and the answers that
        readers may still need."""
        saved = self.operator.board.state(self.region) if self.has_state else None
        last, counts, outbox = None, [0] * 5, deque()
        state = None
        if saved is not None:
            epoch, seq, *counts, n_answers = struct.unpack_from("<8Q", saved)
            last, at = (epoch, seq), 64
            for _ in range(n_answers):
                n_head, n_items = struct.unpack_from("<2Q", saved, at)
                at += 16
                outbox.append((saved[at : at + n_head], saved[at + n_head : at + n_head + n_items]))
                at += n_head + n_items
            state = saved[at:]
        if self.stage.restore is not None:
            self.stage.restore(state)
        return last, counts, outbox


def _join_and_work(description: Description, start: Callable[[dict[str, Any]], Stage]) -> None:
    threading.Thread(target=_end_with_launcher, args=[os.getppid()], daemon=True).start()
    wiring = json.loads(os.environ[WIRING_VARIABLE])
    operator = _Operator(wiring, description)
    params = wiring["params"]
    stage = start(params)
    if stage.state is not None and description.answers_each:
        raise RuntimeError("its stage has a state: its Description needs answers_each=False")
    worker = _Worker(operator, description, stage, params)
    # The objects that exist by now stay: the collector need not look through them.
    gc.collect()
    gc.freeze()
    worker.work_until_stopped()
    _clear_orphaned(wiring)


def _clear_orphaned(wiring: dict[str, Any]) -> None:
    """Removes the files of a graph whose launcher has died, so that the last operator to end leaves none behind."""
    domain = wiring["domain"]
    try:
        file = open(domain["lock_file"], "rb")
    except OSError:
        # Another process has removed everything.
        return
    with file, socket.socket(socket.AF_UNIX) as lock:
        try:
            # The launcher holds it while it lives.
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            lock.bind(f"\0{domain['lock']}")
        except OSError:
            return
        for path in Path(domain["board"]).parent.glob(f"{domain['prefix']}*"):
            path.unlink(missing_ok=True)
        shutil.rmtree(domain["root_path"], ignore_errors=True)


def _items(item: Any, raw: bytes) -> Any:
    """Items as a numpy array, or as an array of ctypes."""
    numpy = _numpy()
    if numpy is not None:
        return numpy.frombuffer(raw, dtype=numpy.dtype(item))
    return (item * (len(raw) // ctypes.sizeof(item))).from_buffer_copy(raw)


def _raw(item: Any, items: Any) -> bytes:
    """The bytes of items given as bytes, as an array or as a sequence."""
    if items is None or isinstance(items, bytes):
        return items or b""
    if hasattr(items, "astype"):
        return items.astype(_numpy().dtype(item)).tobytes()
    return bytes(items if isinstance(items, ctypes.Array) else (item * len(items))(*items))


_NUMPY: list[Any] = []


def _numpy() -> Any:
    """numpy, or None; not before it is needed, because `--describe` should be quick."""
    if not _NUMPY:
        try:
            import numpy

            _NUMPY.append(numpy)
        except ModuleNotFoundError:
            _NUMPY.append(None)
    return _NUMPY[0]


def _use_own_environment() -> None:
    """Restarts the program in the environment `.venv` beside it, unless an environment is active."""
    python = Path(sys.argv[0]).resolve().parent / ".venv" / "bin" / "python"
    is_operator = WIRING_VARIABLE in os.environ or "--describe" in sys.argv[1:]
    if is_operator and sys.prefix == sys.base_prefix and python.exists():
        os.execv(python, [str(python), *sys.argv])


_use_own_environment()
