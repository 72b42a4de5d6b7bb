"""An operator of blindgrasp in Python: a stage that answers samples, or a source that has samples of its own.

    DESCRIPTION = Description("mine", "Judges each frame", ("feature", GraspFeature), ("prediction", Prediction))

    def start(params):                    # once, before anything else; slow imports and loading belong here
        def answer(head, values):         # for each sample: its head, its items; returns the answer's head, or (head, items)
            return PredictionHead(grasp_id=head.grasp_id, phase=head.phase, fault=head.fault)
        return Stage(answer)

    run(DESCRIPTION, start)

With several inputs, `answer` gets the name of the input first. With several outputs, it returns a dict with an answer by
output. A source has no input, and `start` returns a `Source` whose `next` returns samples.

`run` does what an operator in Rust does: it can be killed, stopped, restarted and swapped without a sample being lost,
repeated or re-ordered. The protocol is described in docs/operators.md. Needs `iceoryx2` (requirements.txt), and gives items as
numpy arrays if numpy is there. What it does not do: partner inputs, optional inputs, feedback, operators without an output,
answers when nothing comes. If there is a folder `.venv` beside the program and no environment is active, the program runs in
it.
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
from typing import Any, Callable, Iterable, Iterator, Sequence

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
# The largest saved state of a node, with the samples that readers may still need.
STATE_BYTES = 64 << 10

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
    """The description of an operator. A port is its name and its message.

    Give `input` and `output`, or lists: `inputs`, which is empty for a source, and `outputs`. The name of an input may follow
    the message of an output, like `("tactile", TactileFrame, "hand")`: that output answers each sample of this input under the
    number of the sample. All other outputs of an operator with several ports are numbered one by one, and need not answer
    each sample.
    """

    operator: str
    summary: str
    input: tuple[str, type[Message]] | None = None
    output: tuple[str, type[Message]] | None = None
    params: Sequence[Param] = ()
    version: str = "0.1.0"
    answers_each: bool | None = None
    """It answers each sample with one of the same number on each output, and has no state. The default is True for an operator
    with one input. Set it to False for a stage with `state`."""
    inputs: Sequence[tuple[str, type[Message]]] = ()
    outputs: Sequence[tuple[str, type[Message]] | tuple[str, type[Message], str]] = ()

    def __post_init__(self) -> None:
        if (self.input and self.inputs) or (self.output and self.outputs):
            raise ValueError("a Description has one port and a list of them: expected `input` or `inputs`, `output` or `outputs`")
        self.inputs = [self.input] if self.input else list(self.inputs)
        outputs = [self.output] if self.output else list(self.outputs)
        self.outputs = [output[:2] for output in outputs]
        self.answered_inputs: dict[str, str | None] = {output[0]: output[2] if len(output) > 2 else None for output in outputs}
        """By output, the input that it answers each sample of."""
        if not self.outputs:
            raise ValueError(f"{self.operator} has no output: expected at least one")
        for ports in (self.inputs, self.outputs):
            names = [name for name, _ in ports]
            if len(set(names)) < len(names):
                raise ValueError(f"{self.operator} has two ports of one name, expected different names: {', '.join(names)}")
        for output, answered in self.answered_inputs.items():
            if answered is not None and answered not in [name for name, _ in self.inputs]:
                raise ValueError(f"output {output} answers the input {answered}, which {self.operator} does not have")
        if self.answers_each is None:
            self.answers_each = len(self.inputs) == 1
        if self.answers_each and len(self.inputs) != 1:
            raise ValueError(
                f"{self.operator} has {len(self.inputs)} inputs and answers_each=True: expected one input, because the nodes "
                "before it would take the numbers of one input for those of another; leave answers_each out"
            )

    def to_json(self) -> dict[str, Any]:
        port = lambda name, message: {"name": name, "type": message.TYPE_NAME}  # noqa: E731
        given = lambda param: {key: value for key, value in vars(param).items() if value is not None and value is not False and value != ""}  # noqa: E731
        params = [given(param) | ({"default": param.default} if param.default is not None else {}) for param in self.params]
        return {
            "protocol": PROTOCOL,
            "operator": self.operator,
            "version": self.version,
            "summary": self.summary,
            "inputs": [port(*one) for one in self.inputs],
            "outputs": [port(*one) for one in self.outputs],
            "params": params,
        } | ({"answers_each": True} if self.answers_each else {})


@dataclasses.dataclass
class Stage:
    """The work of an operator on samples.

    `answer` gets a sample's head and items, both its own copies, and returns the answer's head, or head and items. The
    answer's `header` is filled in. It must answer a sample the same whenever it is asked: after a restart, some are asked again.

    With several inputs, `answer` gets the name of the sample's input before head and items. With several outputs, it returns a
    dict of answers by output, and may leave out outputs that need not answer each sample.
    """

    answer: Callable[..., Any] | None = None
    answer_many: Callable[[list[Any], list[Any]], list[Any]] | None = None
    """Instead of `answer`, for models that judge many samples in about the time of one: it gets all samples that have come, and
    returns as many answers in the same order. For operators with one input."""
    max_batch: int = 32
    """The most samples that `answer_many` gets."""
    max_items: int | dict[str, int] = 0
    """The most items that an answer has; of several outputs, a number for all or a dict."""
    identity: dict[str, str] = dataclasses.field(default_factory=dict)
    """Its neighbours, and an instance that takes its place, must have the same values, like {"hand": "0123456789abcdef"}."""
    set: Callable[[dict[str, Any]], None] | None = None
    """Called with the new values of live parameters before `start`'s params are updated; an exception refuses them."""
    state: Callable[[], bytes] | None = None
    """With state: the bytes on which the next answer depends, saved after each sample. With the answers that readers may still
    need, they may take 64 KiB. `answer` may then return None for no answer, and with one input and one output it numbers the
    headers of its answers itself."""
    restore: Callable[[bytes | None], None] | None = None
    """With state: takes over the bytes that `state` returned, here or in another process, or begins anew."""


@dataclasses.dataclass
class Source:
    """The samples of an operator without an input.

    `next` returns a head, or head and items, or a dict of these by output; None if it has nothing yet; and raises
    StopIteration at the end, like the `__next__` of a generator. It is asked from one thread and must not take longer than the
    node's heartbeat. The time at which a sample is sent is filled in.

    A source is one of two kinds:

    * With `resume` it can give its samples again, like a recording. It numbers them itself: `header.seq` grows within an
      `epoch`. It has to give the same samples again, and those that readers have are dropped.
    * Without `resume`, its samples come once, like those of a device. They are numbered one by one, and each is saved before
      it is sent, until all readers have answered it. An instance that takes over goes on after the last number.
    """

    next: Callable[[], Any]
    resume: Callable[[dict[str, Key | None]], None] | None = None
    """Goes back, before the first call of `next` and whenever another instance was active: it gets the epoch and number of the
    last sample of each output that readers have, or None, and `next` goes on with that sample or any before it."""
    state: Callable[[], bytes] | None = None
    """Without `resume`: the bytes on which the next sample depends, saved with each sample. With the samples that readers may
    still need, they may take 64 KiB."""
    restore: Callable[[bytes | None], None] | None = None
    """Takes over the bytes that `state` returned, here or in another process, or begins anew."""
    open: Callable[[], None] | None = None
    """Called before anything else when the instance becomes active: opens a device, for example."""
    close: Callable[[], None] | None = None
    """Lets go of what another instance needs, such as a device: called when another instance takes over, and at the end."""
    max_items: int | dict[str, int] = 0
    """The most items that a sample has; of several outputs, a number for all or a dict."""
    identity: dict[str, str] = dataclasses.field(default_factory=dict)
    """As of a Stage."""
    set: Callable[[dict[str, Any]], None] | None = None
    """As of a Stage."""
    pause_secs: float = 0.005
    """After None, `next` is called again after so long."""

    def __post_init__(self) -> None:
        self._n_lost: dict[str | None, int] = {}
        if self.resume is not None and (self.state is not None or self.restore is not None):
            raise ValueError("a Source has `resume` and a state: expected one of them, because `resume` says where it goes on")
        if (self.state is None) != (self.restore is None):
            raise ValueError("a Source has one of `state` and `restore`: expected both or neither")

    def lost(self, n: int = 1, port: str | None = None) -> None:
        """Leaves out numbers before the next sample of an output, or of all: readings were lost, and readers find a gap."""
        if self.resume is not None:
            raise RuntimeError("a source with `resume` numbers its samples itself: leave out a number for what was lost")
        self._n_lost[port] = self._n_lost.get(port, 0) + n


def fault_of(head: Any) -> Fault:
    """The fault of a sample; an unknown code is MALFORMED."""
    try:
        return Fault(head.fault)
    except ValueError:
        return Fault.MALFORMED


def run(description: Description, start: Callable[[dict[str, Any]], Stage | Source]) -> None:
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

    HEADER_BYTES, CELL_BYTES, SLOTS_AT = 4096, 128, 4096
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
        if len(state) > STATE_BYTES:
            raise RuntimeError(f"its state takes {len(state)} bytes, more than the {STATE_BYTES} that are there")
        at = self._region(region)
        n_saved = self.words[at // 8] + 1
        slot = n_saved % 2
        slot_at = at + self.SLOTS_AT + slot * STATE_BYTES
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
            slot_at = at + self.SLOTS_AT + slot * STATE_BYTES
            state = self.bytes[slot_at : slot_at + min(self.words[at // 8 + 1 + slot], STATE_BYTES)]
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
        # A copy: the thread that listens may add one meanwhile.
        return self.is_to_quit or any(command["command"] == "hand_over" for command in list(self.commands))

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
            raise RuntimeError(f"a sample has {n_items} items, more than max_items={self.max_items} says")
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

    def give_up_guests_alone_at(self, key: Key, waited_nanos: int) -> bool:
        """Whether guests alone have not answered a sample that was sent. They are given up after their time."""
        last = self.last()

        def is_behind(place: Key | None) -> bool:
            if place is None or place[0] == key[0]:
                return not _is_at_most(key, place)
            # A reader in an earlier epoch is behind.
            return last is None or place[0] != last[0]

        behind = [consumer for consumer in self.consumers if any(map(is_behind, self._places([consumer])))]
        if not behind or not all(consumer.get("guest_cells") for consumer in behind):
            return False
        for consumer in behind:
            if waited_nanos > consumer.get("guest_limit_millis", 0) * 1_000_000:
                for cell in consumer["guest_cells"]:
                    self.board.give_up(cell)
        return True

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


class _Input:
    """An input of a stage: its reader, and how far the stage has come."""

    def __init__(self, operator: _Operator, port: str, message: type[Message], is_standby: bool) -> None:
        self.port, self.message = port, message
        wiring = operator.wiring["inputs"][port]
        self.subscriber = _Subscriber(operator, wiring, message, is_onlooker=False)
        self.onlooker = _Subscriber(operator, wiring, message, is_onlooker=True) if is_standby else None
        # The last sample that the stage has answered, with the counts of that time.
        self.last: Key | None = None
        self.counts: Sequence[int] = [0] * 5

    def has_answered(self, sample: _Sample) -> None:
        # A sample that goes back in order is answered, but does not move the cursor.
        self.last = self.last if _is_at_most(sample.key, self.last) else sample.key
        self.counts = sample.counts


class _Output:
    """An output: its publisher, and the samples that were saved before they were sent, until all readers have answered them."""

    def __init__(
        self, operator: _Operator, port: str, message: type[Message], max_items: int | dict[str, int], is_standby: bool
    ) -> None:
        self.port, self.message = port, message
        wiring = operator.wiring["outputs"][port]
        n_items = max_items.get(port, 0) if isinstance(max_items, dict) else max_items
        self.publisher = _Publisher(operator, wiring, message, n_items)
        self.shadow = _Sender(operator, wiring["shadow"], [COMPARE_BELL], message, n_items) if is_standby else None
        self.max_bytes = _ENTRY.size + ctypes.sizeof(message.Head) + self.publisher.sender.max_items * ctypes.sizeof(message.Item)
        # Up to this sample, readers have all that an earlier instance has sent.
        self.known: Key | None = None
        # The last sample that was saved.
        self.last: Key | None = None
        self.saved: deque[tuple[Key, bytes]] = deque()
        self.n_sent = 0

    def known_at(self, is_handed_over: bool) -> Key | None:
        """The last sample that need not be sent again."""
        return self.publisher.last() if is_handed_over else self.publisher.answered()

    def keep(self, head: Any, raw_items: bytes) -> None:
        """Takes a sample that is to be saved and then sent."""
        raw_head = bytes(head)
        self.last = (head.header.epoch, head.header.seq)
        self.saved.append((self.last, _ENTRY.pack(len(raw_head), len(raw_items)) + raw_head + raw_items))

    def send_saved(self) -> bool:
        """Sends the saved samples that were not sent; false if it was asked to give way meanwhile."""
        while self.n_sent < len(self.saved):
            packed = self.saved[self.n_sent][1]
            items_at = _ENTRY.size + _ENTRY.unpack_from(packed)[0]
            if not self.publisher.send(self.message.Head.from_buffer_copy(packed, _ENTRY.size), packed[items_at:]):
                return False
            self.n_sent += 1
        return True

    def forget(self) -> bool:
        """Drops the samples that were sent and that all readers have answered; true if there was one."""
        if not self.n_sent:
            return False
        has_readers, answered = self.publisher.answered_by_readers()
        n_forgotten = min(self.n_sent, self._n_up_to(answered) if has_readers else self.n_sent)
        for _ in range(n_forgotten):
            self.saved.popleft()
        self.n_sent -= n_forgotten
        return n_forgotten > 0

    def restore(self, saved: Sequence[bytes], last: Key | None, known: Key | None) -> None:
        """Takes over saved samples; those up to `known` need not be sent again."""
        header = lambda packed: self.message.Head.from_buffer_copy(packed, _ENTRY.size).header  # noqa: E731
        self.saved = deque(((header(packed).epoch, header(packed).seq), packed) for packed in saved)
        self.last, self.n_sent = last, self._n_up_to(known)

    def _n_up_to(self, key: Key | None) -> int:
        """The number of saved samples up to that one. They are in order, and one that is not there is older than all."""
        for n in range(len(self.saved), 0, -1):
            if self.saved[n - 1][0] == key:
                return n
        return 0


# Of a saved sample, the length of its head and of its items.
_ENTRY = struct.Struct("<2Q")


class _Instance:
    """An operator between its ports, active or standby."""

    def __init__(self, operator: _Operator, description: Description, work: Stage | Source, params: dict[str, Any]) -> None:
        self.operator, self.description, self.work, self.params = operator, description, work, params
        is_standby = operator.wiring["standby"]
        self.inputs = [_Input(operator, port, message, is_standby) for port, message in description.inputs]
        # A source that stands by sends nothing for comparison.
        is_compared = is_standby and bool(self.inputs)
        outputs = [_Output(operator, port, message, work.max_items, is_compared) for port, message in description.outputs]
        self.outputs = {output.port: output for output in outputs}
        self.is_active = not is_standby

    def obey(self, command: dict[str, Any]) -> None:
        if command["command"] == "take_over":
            for entry in self.inputs:
                if entry.onlooker is not None:
                    entry.onlooker.close()
                    entry.onlooker = None
            for output in self.outputs.values():
                if output.shadow is not None:
                    output.shadow.close()
                    output.shadow = None
            self.take_over(command["is_handed_over"])
            self.is_active = True
            _report("took_over")
        elif command["command"] == "hand_over":
            self.is_active = False
            self.hand_over()
            _report("handed_over")
        elif command["command"] == "set":
            from_seq, error = self.next_seq(), None
            try:
                if self.work.set is not None:
                    self.work.set(command["params"])
                self.params.update(command["params"])
                self.operator.has_params(command["params"])
            except Exception as refusal:
                error = _in_words(refusal)
            _report("set", id=command["id"], from_seq=from_seq, error=error)

    def take_over(self, is_handed_over: bool) -> None:
        raise NotImplementedError

    def hand_over(self) -> None:
        pass

    def next_seq(self) -> int | None:
        raise NotImplementedError

    def look(self) -> None:
        """Lets the publishers look for readers that have come back, and the subscribers for their writers."""
        for output in self.outputs.values():
            output.publisher.sender.look_for_readers()
        for entry in self.inputs:
            entry.subscriber.connect()

    def is_interrupted(self) -> bool:
        return self.operator.has_command() or self.operator.is_to_quit

    def by_output(self, said: Any) -> list[tuple[_Output, Any, bytes]]:
        """What a stage or a source has returned, as output, copy of the head, bytes of the items."""
        if said is None:
            return []
        if not isinstance(said, dict):
            if len(self.outputs) > 1:
                names = ", ".join(self.outputs)
                raise RuntimeError(f"it returned {type(said).__name__}, expected a dict with a sample by output: {names}")
            said = dict.fromkeys(self.outputs, said)
        samples = []
        for port, sample in said.items():
            output = self.outputs.get(port)
            if output is None:
                raise RuntimeError(f"it returned a sample for the output {port!r}, expected one of {', '.join(self.outputs)}")
            if sample is None:
                continue
            head, items = sample if isinstance(sample, tuple) else (sample, None)
            expected = output.message.Head
            if not isinstance(head, expected):
                raise RuntimeError(f"a head for the output {port} is {type(head).__name__}, expected {expected.__name__}")
            samples.append((output, expected.from_buffer_copy(head), _raw(output.message.Item, items)))
        return samples


class _Store:
    """What an instance saves for the one that takes over: how far it has come, samples that readers may still need, its state.

    It is saved as a whole, before the samples are sent: a kill at any moment neither loses a sample nor makes another one
    under its number.
    """

    MAGIC = b"bg-py-1\0"
    # The part of fixed length has so many bytes for each port: the name, the numbers, the counts.
    PORT_BYTES = 320

    def __init__(self, instance: _Instance, state: Callable[[], bytes] | None) -> None:
        self.operator, self.state = instance.operator, state
        self.inputs, self.outputs = instance.inputs, list(instance.outputs.values())
        self.region: int = self.operator.wiring["state_region"]
        self.n_head_bytes = 64 + self.PORT_BYTES * (len(self.inputs) + len(self.outputs))
        self.operator.board.reserve_state(self.region)

    def save(self, is_done: bool = False, may_give_way: bool = True) -> bool:
        """Saves all; false if it was asked to give way while it waited for readers of samples that must stay saved."""
        own = b"" if self.state is None else bytes(self.state())
        while True:
            for output in self.outputs:
                output.forget()
            inputs = {entry.port: [*(entry.last or (None, None)), *entry.counts] for entry in self.inputs}
            outputs = {output.port: [*(output.last or (None, None)), len(output.saved)] for output in self.outputs}
            head = json.dumps({"inputs": inputs, "outputs": outputs, "done": is_done}).encode().ljust(self.n_head_bytes)
            samples = [packed for output in self.outputs for _, packed in output.saved]
            content = b"".join([self.MAGIC, struct.pack("<Q", len(head)), head, *samples, own])
            if len(content) <= STATE_BYTES:
                self.operator.board.save_state(self.region, content)
                return True
            if not any(output.n_sent for output in self.outputs):
                raise RuntimeError(
                    f"its state takes {len(own)} bytes and the answers to one sample {sum(map(len, samples))}, expected at most "
                    f"{STATE_BYTES - self.n_head_bytes - 16} together"
                )
            if not self.wait_for_readers(may_give_way=may_give_way):
                return False

    def wait_for_room(self, n_bytes: int) -> bool:
        """Waits until samples of so many bytes may be saved; false if it was asked to give way or to stop meanwhile."""
        while True:
            n_saved = sum(len(packed) for output in self.outputs for _, packed in output.saved)
            if self.n_head_bytes + 16 + n_saved + n_bytes <= STATE_BYTES or not any(output.n_sent for output in self.outputs):
                return True
            if not self.wait_for_readers(may_stop=True):
                return False

    def wait_for_readers(self, may_stop: bool = False, may_give_way: bool = True) -> bool:
        """Waits until all readers have answered one of the saved samples; false if it was asked to give way meanwhile."""
        start = last_look = last_try = _now_nanos()
        slow = [output for output in self.outputs if output.n_sent]
        waited = [0] * len(slow)
        limit_millis = slow[0].publisher.wait_limit_millis
        try:
            while not any([output.forget() for output in slow]):
                gives_way = self.operator.is_to_give_way() and (may_give_way or self.operator.is_to_quit)
                if gives_way or (may_stop and self.operator.should_stop()):
                    return False
                now = _now_nanos()
                for idx, output in enumerate(slow):
                    is_guest = output.publisher.give_up_guests_alone_at(output.saved[0][0], waited[idx])
                    waited[idx] = waited[idx] + min(now - last_try, LONGEST_TRY_NANOS) if is_guest else 0
                last_try = now
                if now - start > limit_millis * 1_000_000:
                    names = ", ".join(output.publisher.sender.service.name for output in slow)
                    raise RuntimeError(
                        f"port {names}: no saved sample was answered within {limit_millis} ms: a reader is stopped or too slow"
                    )
                if now - last_look > LOOK_PAUSE_NANOS:
                    last_look = now
                    for output in slow:
                        output.publisher.sender.look_for_readers()
                time.sleep(RETRY_PAUSE_SECS)
        finally:
            for output in slow:
                output.publisher.board.add_blocked(output.publisher.cell, _now_nanos() - start)
        return True

    def send(self) -> bool:
        """Sends the saved samples that were not sent; false if it was asked to give way meanwhile."""
        return all(output.send_saved() for output in self.outputs)

    def restore(self, is_handed_over: bool) -> tuple[bytes | None, bool]:
        """Takes over what the node's active instance has saved last. Returns the bytes of its state, None if there are none,
        and whether its source had ended.

        What another operator has saved says nothing: a source then goes on after the last sample that was sent, a stage after
        the last one that was answered.
        """
        board = self.operator.board
        # The places come first: for a standby, the active instance goes on meanwhile, and what it has saved is never behind them.
        answered = {entry.port: self._answered(entry) for entry in self.inputs}
        sent = {output.port: output.publisher.last() for output in self.outputs}
        content = board.state(self.region)
        is_ours = content is not None and content[: len(self.MAGIC)] == self.MAGIC
        if content is not None and not is_ours and self.inputs:
            raise RuntimeError(
                "the node's state was saved by an operator in another language or of another version, expected one of this module: "
                "start the graph with this operator instead"
            )
        if is_ours:
            n_head, at = struct.unpack_from("<Q", content, 8)[0], 16 + struct.unpack_from("<Q", content, 8)[0]
            saved = json.loads(content[16 : 16 + n_head])
            if not self._is_old(saved, {port: key for port, (key, _) in answered.items()}, sent):
                for entry in self.inputs:
                    epoch, seq, *counts = saved["inputs"].get(entry.port, [None, None, 0, 0, 0, 0, 0])
                    entry.last, entry.counts = _key(epoch, seq), counts
                outputs = {output.port: output for output in self.outputs}
                for port, (epoch, seq, n_samples) in saved["outputs"].items():
                    samples = []
                    for _ in range(n_samples):
                        end = at + _ENTRY.size + sum(_ENTRY.unpack_from(content, at))
                        samples.append(content[at:end])
                        at = end
                    if port in outputs:
                        outputs[port].restore(samples, _key(epoch, seq), outputs[port].known_at(is_handed_over))
                return content[at:], saved["done"]
            log.info("the saved state is older than the last samples of this node: it begins anew")
        for entry in self.inputs:
            entry.last, entry.counts = answered[entry.port]
        for output in self.outputs:
            output.restore([], sent[output.port], None)
        return None, False

    def _answered(self, entry: _Input) -> tuple[Key | None, Sequence[int]]:
        cell = entry.subscriber.cell
        return (None, [0] * 5) if cell is None else self.operator.board.answered(cell)

    def _is_old(self, saved: dict[str, Any], answered: dict[str, Key | None], sent: dict[str, Key | None]) -> bool:
        """Whether another operator was active since, which does not save like this one."""
        for entry in self.inputs:
            epoch, seq, *_ = saved["inputs"].get(entry.port, [None, None])
            last, place = _key(epoch, seq), answered[entry.port]
            if place is not None and not _is_at_most(place, last):
                # A sample of the next epoch may have been saved and not marked as answered yet.
                written = self.operator.board.sent(entry.subscriber.writer_cell)
                if last is None or place[0] == last[0] or (written is not None and written[0] != last[0]):
                    return True
        for port, place in () if self.inputs else sent.items():
            epoch, seq, *_ = saved["outputs"].get(port, [None, None])
            if place is not None and not _is_at_most(place, _key(epoch, seq)):
                return True
        return False


def _key(epoch: int | None, seq: int | None) -> Key | None:
    return None if epoch is None or seq is None else (epoch, seq)


class _StageInstance(_Instance):
    """A stage between its ports."""

    work: Stage

    def __init__(self, operator: _Operator, description: Description, stage: Stage, params: dict[str, Any]) -> None:
        super().__init__(operator, description, stage, params)
        self.n_looked_on = 0
        self.last: Key | None = None
        self.skip = {(sample["epoch"], sample["seq"]) for sample in operator.wiring.get("skip", [])}
        """Samples that have killed earlier instances again and again."""

    def begin(self) -> None:
        if self.is_active:
            self.take_over(is_handed_over=False)
        else:
            self.stand_by()
        for entry in self.inputs:
            entry.subscriber.connect()

    def work_until_stopped(self) -> None:
        operator = self.operator
        self.begin()
        _report("ready", identity=self.work.identity, has_state=self.has_state)
        next_look = 0
        while True:
            # The request is read before the input: samples that were sent before the request are still answered.
            stop = operator.should_stop()
            while operator.has_command():
                self.obey(operator.commands.popleft())
            if self.is_active:
                self.answer_all()
            else:
                self.look_on()
            is_caught_up = not self.is_active or all(entry.subscriber.is_caught_up() for entry in self.inputs)
            if operator.is_to_quit or (stop and is_caught_up):
                break
            if _now_nanos() >= next_look:
                next_look = _now_nanos() + TICK_NANOS
                self.look()
            deadlines = [entry.subscriber.sequencer.deadline() for entry in self.inputs] if self.is_active else []
            operator.wait(min((deadline for deadline in deadlines if deadline is not None), default=None))
        operator.drained(self.look)

    has_state = False

    def stand_by(self) -> None:
        pass

    def answer_all(self) -> None:
        """Answers the samples that are there."""
        raise NotImplementedError

    def answers(self, entry: _Input, samples: list[_Sample]) -> Iterator[tuple[_Sample, list[tuple[_Output, Any, bytes]]]]:
        """Each sample with the answers of the stage."""
        raise NotImplementedError

    def next_seq(self) -> int | None:
        return None if self.last is None else self.last[1] + 1

    def look_on(self) -> None:
        """Computes live samples beside the active instance."""
        operator = self.operator
        is_over = lambda: operator.has_command() or operator.should_stop()  # noqa: E731
        for entry in self.inputs:
            while entry.onlooker is not None and not is_over() and (samples := self.take(entry.onlooker)):
                operator.beat()
                for _, answers in self.answers(entry, samples):
                    for output, head, raw_items in answers:
                        if output.shadow is not None:
                            output.shadow.send(head, raw_items)
                    self.n_looked_on += 1
                    if self.n_looked_on == N_WARM:
                        _report("warm", n_samples=N_WARM)

    def take(self, subscriber: _Subscriber) -> list[_Sample]:
        """The samples that are there, as many as are answered at once."""
        max_batch = self.work.max_batch if self.work.answer_many and not self.has_state else 1
        samples: list[_Sample] = []
        while len(samples) < max_batch and (sample := subscriber.receive()) is not None:
            samples.append(sample)
        return samples

    def name_of(self, entry: _Input, sample: _Sample) -> Key:
        """The name of a sample for the launcher, which knows nothing of inputs: two inputs may have samples of one number."""
        if len(self.inputs) == 1:
            return sample.key
        return sample.key[0] ^ _identity_of(entry.port), sample.key[1]

    def said(self, entry: _Input, samples: list[_Sample], heads: list[Any], items: list[Any]) -> list[Any]:
        """The answers of the stage to samples. The launcher learns on which of them the process dies."""
        cell = self.operator.wiring["instance_cell"]
        self.operator.board.works_on(cell, self.name_of(entry, samples[0]))
        port = [entry.port] if len(self.inputs) > 1 else []
        try:
            if self.work.answer_many is None:
                said = [self.work.answer(*port, head, values) for head, values in zip(heads, items)]  # type: ignore[misc]
            else:
                said = self.work.answer_many(heads, items)
        except Exception:
            if len(samples) == 1:
                raise
            # One by one, to find the one that it fails on.
            one_by_one = [self.said(entry, [sample], [head], [values]) for sample, head, values in zip(samples, heads, items)]
            return [answer for answers in one_by_one for answer in answers]
        if len(said) != len(samples):
            raise RuntimeError(f"answer_many returned {len(said)} answers to {len(samples)} samples")
        self.operator.board.works_on(cell, None)
        return said

    def said_of_each(self, entry: _Input, samples: list[_Sample]) -> Iterator[tuple[_Sample, bool, Any]]:
        """Each sample, whether it is to be left without an answer, and what the stage said."""
        # These are copies: a change of a head by the user must not change the number of its answer.
        asked = [sample for sample in samples if self.name_of(entry, sample) not in self.skip]
        heads = [type(sample.head).from_buffer_copy(sample.head) for sample in asked]
        items = [_items(entry.message.Item, sample.raw_items) for sample in asked]
        said = iter(self.said(entry, asked, heads, items) if asked else [])
        for sample in samples:
            is_skipped = self.name_of(entry, sample) in self.skip
            if is_skipped:
                # Readers find a gap: nothing is lifted on it.
                log.error("sample %d is not answered: it has killed this operator again and again", sample.key[1])
            yield sample, is_skipped, None if is_skipped else next(said)


class _AlikeStage(_StageInstance):
    """A stage without state and with one input: it answers each sample on each output, under the number of the sample."""

    def take_over(self, is_handed_over: bool) -> None:
        entry = self.inputs[0]
        for output in self.outputs.values():
            output.known = output.known_at(is_handed_over)
        self.last = self._least_known(entry)
        entry.subscriber.take_over(self.last)

    def _least_known(self, entry: _Input) -> Key | None:
        """The last sample whose answers all readers of all outputs have."""
        known = [output.known for output in self.outputs.values()]
        if None in known:
            return None
        # An output in an earlier epoch is behind.
        sent = self.operator.board.sent(entry.subscriber.writer_cell)
        behind = [key for key in known if sent is None or key[0] != sent[0]]  # type: ignore[index]
        return min(behind or known)  # type: ignore[type-var]

    def answer_all(self) -> None:
        operator, entry = self.operator, self.inputs[0]
        while not self.is_interrupted() and (samples := self.take(entry.subscriber)):
            operator.beat()
            for idx, (sample, answers) in enumerate(self.answers(entry, samples)):
                for output, head, raw_items in answers:
                    # One output may be ahead of another: its readers have this answer.
                    if len(self.outputs) > 1 and _is_at_most(sample.key, output.known):
                        continue
                    if not output.publisher.send(head, raw_items):
                        # Another instance finds the sample in its own queue; this one finds it here if it is active again.
                        entry.subscriber.put_back = samples[idx:]
                        return
                    output.known = None
                self.last = sample.key
                entry.subscriber.commit(sample)

    def answers(self, entry: _Input, samples: list[_Sample]) -> Iterator[tuple[_Sample, list[tuple[_Output, Any, bytes]]]]:
        for sample, is_skipped, said in self.said_of_each(entry, samples):
            answers = self.by_output(said)
            if not is_skipped and len(answers) < len(self.outputs):
                raise RuntimeError(
                    "a stage without state answers every sample on every output, with a fault where it has nothing to say"
                )
            for _, head, _ in answers:
                head.header = sample.head.header
                head.header.made_by = self.operator.made_by(sample.head.header.made_by)
            yield sample, answers


class _KeepingStage(_StageInstance):
    """A stage whose answers are saved before they are sent, together with its state and the places of all its inputs."""

    has_state = True

    def __init__(self, operator: _Operator, description: Description, stage: Stage, params: dict[str, Any]) -> None:
        super().__init__(operator, description, stage, params)
        # With one input and one output, such a stage numbers its answers itself.
        self.numbers_itself = len(self.inputs) == len(self.outputs) == 1
        self.store = _Store(self, stage.state)

    def stand_by(self) -> None:
        self.restore(is_handed_over=False)
        for entry in self.inputs:
            if entry.onlooker is not None and entry.last is not None:
                entry.onlooker.begin_with(_Sequencer(entry.onlooker.may_hold).resume(entry.last, entry.last, [0] * 5))

    def take_over(self, is_handed_over: bool) -> None:
        self.restore(is_handed_over)
        for entry in self.inputs:
            entry.subscriber.take_over_at(entry.last, entry.counts)

    def restore(self, is_handed_over: bool) -> None:
        state, _ = self.store.restore(is_handed_over)
        if self.work.restore is not None:
            self.work.restore(state)

    def answer_all(self) -> None:
        operator = self.operator
        if not self.store.send():
            return
        n_idle = 0
        while not self.is_interrupted() and n_idle < len(self.inputs):
            # In turn, so that no input waits for another.
            entry = self.inputs[0]
            self.inputs.append(self.inputs.pop(0))
            samples = self.take(entry.subscriber)
            n_idle = 0 if samples else n_idle + 1
            operator.beat()
            for sample, answers in self.answers(entry, samples):
                for output, head, raw_items in answers:
                    output.keep(head, raw_items)
                entry.has_answered(sample)
                # Saved first: a kill at any moment neither loses an answer nor makes another one under its number.
                if not (self.store.save() and self.store.send()):
                    # If it was not saved, this instance answers it again if it is active again.
                    entry.subscriber.put_back = [sample]
                    return
                self.last = sample.key
                entry.subscriber.commit(sample)

    def answers(self, entry: _Input, samples: list[_Sample]) -> Iterator[tuple[_Sample, list[tuple[_Output, Any, bytes]]]]:
        answered = self.description.answered_inputs
        for sample, is_skipped, said in self.said_of_each(entry, samples):
            answers = self.by_output(said)
            has_gap = is_skipped or sample.counts[1] > entry.counts[1]
            has_answer = {output.port for output, _, _ in answers}
            for port, output in self.outputs.items():
                of_input = answered[port]
                if of_input == entry.port and not is_skipped and port not in has_answer:
                    raise RuntimeError(f"it did not answer on the output {port}, expected an answer to each sample of {of_input}")
                if of_input not in (None, entry.port) and port in has_answer:
                    raise RuntimeError(f"it answered a sample of {entry.port} on the output {port}, expected one of {of_input}")
                if has_gap and of_input is None and output.last is not None and not self.numbers_itself:
                    # Readers of an output that counts must find the gap as well.
                    output.last = (output.last[0], output.last[1] + 1)
            made_by = self.operator.made_by(sample.head.header.made_by)
            for output, head, _ in answers:
                if answered[output.port] is not None:
                    head.header = sample.head.header
                elif not self.numbers_itself:
                    output.last = _next_key(output, self.outputs.values())
                    head.header = sample.head.header
                    head.header.epoch, head.header.seq = output.last
                head.header.made_by = made_by
            yield sample, answers


def _next_key(output: _Output, outputs: Iterable[_Output]) -> Key:
    """The number of the next sample of an output that counts."""
    if output.last is not None:
        return output.last[0], output.last[1] + 1
    # The first one of a node begins its epoch.
    return next((other.last[0] for other in outputs if other.last is not None), time.time_ns()), 0


class _SourceInstance(_Instance):
    """A source, active or standby."""

    work: Source

    def __init__(self, operator: _Operator, description: Description, source: Source, params: dict[str, Any]) -> None:
        super().__init__(operator, description, source, params)
        self.is_placed = self.is_done = self.is_handed_over = self.is_open = False
        self.has_reported_end = False
        # With `resume`: the last sample of each output that came from it, and the one after which it goes on.
        self.came: dict[str, Key] = {}
        self.store = None if source.resume else _Store(self, source.state)
        self.n_next_bytes = sum(output.max_bytes for output in self.outputs.values())
        if self.store is not None and self.store.n_head_bytes + 16 + self.n_next_bytes > STATE_BYTES:
            raise RuntimeError(
                f"its samples may take {self.n_next_bytes} bytes, expected at most {STATE_BYTES - self.store.n_head_bytes - 16}: "
                "more cannot be saved until readers have them; give a smaller max_items, or a `resume` that can give samples again"
            )

    def work_until_stopped(self) -> None:
        operator, source = self.operator, self.work
        if self.is_active:
            self.open()
        may_go, next_look = False, 0
        _report("ready", identity=source.identity, has_state=False)
        while not operator.should_stop():
            while operator.has_command():
                command = operator.commands.popleft()
                may_go |= command["command"] == "go"
                self.obey(command)
            operator.beat()
            # When to take the next step, if nothing happens before.
            until: int | None = None
            if self.is_active and may_go:
                if not self.is_placed:
                    self.place()
                until = self.step()
            if _now_nanos() >= next_look:
                next_look = _now_nanos() + TICK_NANOS
                self.look()
            if until != 0:
                operator.wait(until)
        self.close()
        operator.drained(self.look)

    def open(self) -> None:
        if not self.is_open:
            self.is_open = True
            if self.work.open is not None:
                self.work.open()

    def close(self) -> None:
        if self.is_open:
            self.is_open = False
            if self.work.close is not None:
                self.work.close()

    def take_over(self, is_handed_over: bool) -> None:
        self.open()
        self.is_handed_over, self.is_placed = is_handed_over, False

    def hand_over(self) -> None:
        self.is_placed = False
        self.close()

    def next_seq(self) -> int | None:
        last = next(iter(self.outputs.values())).publisher.last()
        return None if last is None else last[1] + 1

    def place(self) -> None:
        """Finds the place at which to go on."""
        self.is_done, self.came = False, {}
        if self.store is None:
            for output in self.outputs.values():
                output.known = output.known_at(self.is_handed_over)
            self.work.resume({port: output.known for port, output in self.outputs.items()})  # type: ignore[misc]
        else:
            state, self.is_done = self.store.restore(self.is_handed_over)
            if self.work.restore is not None:
                self.work.restore(state)
        self.is_placed = True

    def step(self) -> int | None:
        """Sends the next sample. Returns when to take the next step: 0 for at once, None for when something happens."""
        source, store = self.work, self.store
        if store is not None:
            n_state_bytes = 0 if source.state is None else len(source.state())
            if not (store.send() and (self.is_done or store.wait_for_room(self.n_next_bytes + n_state_bytes))):
                return 0
        if self.is_done:
            if not self.has_reported_end:
                self.has_reported_end = True
                _report("finished")
            return None
        try:
            said = source.next()
        except StopIteration:
            if store is None:
                self.check_end()
            elif not store.save(is_done=True):
                self.is_placed = False
                return 0
            self.is_done, self.has_reported_end = True, False
            return 0
        if said is None:
            return _now_nanos() + int(source.pause_secs * 1e9)
        samples = self.by_output(said)
        if store is None:
            self.is_placed = all(self.send_again(*sample) for sample in samples)
        else:
            self.is_placed = self.save_and_send(store, samples)
        return 0

    def save_and_send(self, store: _Store, samples: list[tuple[_Output, Any, bytes]]) -> bool:
        """Numbers samples, saves and sends them; false if they are not saved because the graph ends."""
        n_lost, self.work._n_lost = self.work._n_lost, {}
        for port, output in self.outputs.items():
            n_left_out = n_lost.get(None, 0) + n_lost.get(port, 0)
            if output.last is not None:
                output.last = (output.last[0], output.last[1] + n_left_out)
        for output, head, raw_items in samples:
            if len(raw_items) > output.publisher.sender.max_items * ctypes.sizeof(output.message.Item):
                raise RuntimeError(f"a sample has more items than max_items={output.publisher.sender.max_items} says")
            head.header.epoch, head.header.seq = _next_key(output, self.outputs.values())
            head.header.origin_nanos = _now_nanos()
            output.keep(head, raw_items)
        # A device cannot give a reading again: it is saved before another instance takes over, which then sends it.
        if not store.save(may_give_way=False):
            return False
        store.send()
        return True

    def send_again(self, output: _Output, head: Any, raw_items: bytes) -> bool:
        """Sends a sample unless readers have it; false if it was asked to give way."""
        key, before = (head.header.epoch, head.header.seq), self.came.get(output.port)
        if before is not None and _is_at_most(key, before):
            raise RuntimeError(f"sample {key[1]} of the output {output.port} came after {before[1]}, expected a greater number")
        self.came[output.port] = key
        if output.known is not None:
            is_past = key[0] == output.known[0] and key[1] >= output.known[1]
            is_known = not is_past or key == output.known
            output.known = None if is_past else output.known
            if is_known:
                return True
        head.header.origin_nanos = _now_nanos()
        return output.publisher.send(head, raw_items)

    def check_end(self) -> None:
        """Refuses an end before the sample after which it was to go on: it is not the same stream."""
        for port, output in self.outputs.items():
            if output.known is not None:
                raise RuntimeError(
                    f"it ended without sample {output.known[1]} of epoch {output.known[0]} of the output {port}, which readers "
                    "have: expected that after `resume`, `next` gives that sample or one before it, and then the same samples again"
                )


def _instance(operator: _Operator, description: Description, work: Stage | Source, params: dict[str, Any]) -> _Instance:
    """The operator that a `start` function has described. A combination that cannot keep its promises is refused."""
    n_inputs = len(description.inputs)
    if isinstance(work, Source):
        if n_inputs:
            raise RuntimeError(f"start returned a Source, and the operator has {n_inputs} inputs: expected a Stage, or no input")
        return _SourceInstance(operator, description, work, params)
    if not n_inputs:
        raise RuntimeError("the operator has no input: expected that start returns a Source")
    if work.answer is None and work.answer_many is None:
        raise RuntimeError("the Stage has neither `answer` nor `answer_many`: expected one of them")
    if n_inputs > 1 and work.answer_many is not None:
        raise RuntimeError(f"answer_many is for one input, and the operator has {n_inputs}: expected `answer`")
    if work.state is not None and description.answers_each:
        raise RuntimeError("its stage has a state: its Description needs answers_each=False")
    is_alike = work.state is None and n_inputs == 1 and (description.answers_each or len(description.outputs) == 1)
    return (_AlikeStage if is_alike else _KeepingStage)(operator, description, work, params)


def _join_and_work(description: Description, start: Callable[[dict[str, Any]], Stage | Source]) -> None:
    threading.Thread(target=_end_with_launcher, args=[os.getppid()], daemon=True).start()
    wiring = json.loads(os.environ[WIRING_VARIABLE])
    operator = _Operator(wiring, description)
    params = wiring["params"]
    worker = _instance(operator, description, start(params), params)
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
