"""An operator of blindgrasp in Python: a stage that answers samples, or a source that has samples of its own.

    DESCRIPTION = Description("mine", "Judges each frame", ("feature", GraspFeature), ("prediction", Prediction))

    def start(params):                    # once, before anything else; slow imports and loading belong here
        def answer(head, values):         # for each sample: its head, its items; returns the answer's head, or (head, items)
            return PredictionHead(grasp_id=head.grasp_id, phase=head.phase, fault=head.fault)
        return Stage(answer)

    run(DESCRIPTION, start)

A process of blindgrasp has the operator's ports and gives it the samples over two pipes, so that it can be killed, stopped,
restarted and swapped without a sample being lost, repeated or re-ordered (docs/operators.md). Needs nothing
but Python; items are numpy arrays if numpy is there. If there is a folder `.venv` beside the program and no environment is
active, the program runs in it.
"""

from __future__ import annotations

import ctypes
import dataclasses
import gc
import json
import logging
import os
import struct
import sys
import threading
import traceback
from pathlib import Path
from typing import Any, Callable, Sequence

from blindgrasp_messages import Fault, Message

PROTOCOL = 5
PIPES_VARIABLE = "BLINDGRASP_HOST"

# Kinds of messages from the host, and to it: crates/operator/src/host/protocol.rs.
VERSION = 1
START, RESTORE, SAMPLE, SILENCE, END, CUT_OFF, SET, NEXT, RESUME, OPEN, CLOSE, CHECK = range(1, 13)
READY, DONE, REFUSED, FAILED, LOG, COUNTS, ONE_BY_ONE = range(1, 8)
MORE, HAS_STATE = 1, 2
NOTHING_YET, FINISHED = 1, 2
_FRAME, _WORK, _PART = struct.Struct("=II"), struct.Struct("=QII"), struct.Struct("=4I")

Port = tuple[str, type[Message]]


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

    Give `input` and `output`, or lists: `inputs` and `outputs`, either of which may be empty. After the message of an input may
    stand the words "optional", "feedback" and "partner". After the message of an output may stand the name of an input: the
    output answers each sample of that input under the number of the sample. All other outputs of an operator with several
    ports are numbered one by one, and need not answer each sample.
    """

    operator: str
    summary: str
    input: Port | None = None
    output: Port | None = None
    params: Sequence[Param] = ()
    version: str = "0.1.0"
    answers_each: bool | None = None
    """It answers each sample with one of the same number on each output. The default is True for an operator with one input
    and an output. Set it to False for a stage with `state` that does not answer each."""
    inputs: Sequence[tuple] = ()
    outputs: Sequence[tuple] = ()
    uses_network: bool = False

    def __post_init__(self) -> None:
        if (self.input and self.inputs) or (self.output and self.outputs):
            raise ValueError("a Description has one port and a list of them: expected `input` or `inputs`, `output` or `outputs`")
        self.inputs = [self.input] if self.input else list(self.inputs)
        self.outputs = [self.output] if self.output else list(self.outputs)
        for name, _, *words in self.inputs:
            if wrong := set(words) - {"optional", "feedback", "partner"}:
                raise ValueError(f"input {name} is {', '.join(wrong)}: expected optional, feedback or partner, or nothing")
        names = [name for name, *_ in self.inputs]
        self.answers: dict[str, str] = {output[0]: output[2] for output in self.outputs if len(output) > 2}
        """By output, the input whose samples it answers."""
        for output, answered in self.answers.items():
            if answered not in names:
                raise ValueError(f"output {output} answers the input {answered}, which {self.operator} does not have")
        n_main = sum("partner" not in words for _, _, *words in self.inputs)
        if self.answers_each is None:
            is_fed = any("feedback" not in words for _, _, *words in self.inputs)
            self.answers_each = n_main == 1 and is_fed and bool(self.outputs)
        if self.answers_each and n_main != 1:
            raise ValueError(
                f"{self.operator} has {n_main} inputs and answers_each=True: expected one input, because the nodes before it "
                "would take the numbers of one input for those of another; leave answers_each out"
            )
        for ports in (names, [name for name, *_ in self.outputs]):
            if len(set(ports)) < len(ports):
                raise ValueError(f"{self.operator} has two ports of one name, expected different names: {', '.join(ports)}")

    def to_json(self) -> dict[str, Any]:
        def given(param: Param) -> dict[str, Any]:
            fields = {key: value for key, value in vars(param).items() if value is not None and value != ""}
            for word in ("live", "optional"):
                if not fields[word]:
                    del fields[word]
            return fields | ({"default": param.default} if param.default is not None else {})

        return {
            "protocol": PROTOCOL,
            "operator": self.operator,
            "version": self.version,
            "summary": self.summary,
            "inputs": [{"name": name, "type": message.TYPE_NAME} | dict.fromkeys(words, True) for name, message, *words in self.inputs],
            "outputs": [{"name": name, "type": message.TYPE_NAME} for name, message, *_ in self.outputs],
            "params": [given(param) for param in self.params],
            "answers_each": self.answers_each,
            "uses_network": self.uses_network,
            "hosted": True,
        }


@dataclasses.dataclass
class Stage:
    """The work of an operator on samples.

    `answer` gets a sample's head and items, both its own copies, and returns the answer's head, or head and items; a head that
    came with a sample has its `items`. It must answer a sample the same whenever it is asked: after a restart, some are asked
    again. With several inputs it gets the name of the sample's input before head and items. Of each partner input it gets
    `(head, items)`, or None, as an argument of that name. With several outputs it returns a dict of answers by output, and
    may leave out outputs that need not answer each sample.
    """

    answer: Callable[..., Any] | None = None
    answer_many: Callable[[list[Any], list[Any]], list[Any]] | None = None
    """Instead of `answer`, for models that judge many samples in about the time of one: it gets all samples that have come, and
    returns as many answers in the same order. For operators with one input and without state."""
    max_batch: int = 32
    """The most samples that `answer_many` gets."""
    max_items: int | dict[str, int] | None = None
    """The most items that an answer has; of several outputs, a number for all or a dict. Without it, memory grows."""
    identity: dict[str, str] = dataclasses.field(default_factory=dict)
    """Its neighbours, and an instance that takes its place, must have the same values, like {"hand": "0123456789abcdef"}."""
    set: Callable[[dict[str, Any]], None] | None = None
    """Called with the new values of live parameters before `start`'s params are updated; an exception refuses them."""
    state: Callable[[], bytes] | None = None
    """With state: the bytes on which the next answer depends, saved after each sample. With the answers that readers may still
    need, they may take 256 KiB. With `answers_each=False`, `answer` may return None, and with one input and one output give a
    header of its own; without one the answer gets that of the sample."""
    restore: Callable[[bytes | None], None] | None = None
    """With state: takes over the bytes that `state` returned, here or in another process, or begins anew."""
    deadline: Callable[[], int | None] | None = None
    """The time (CLOCK_BOOTTIME, nanoseconds) at which `on_silence` is called if no sample comes before."""
    on_silence: Callable[[int], Any] | None = None
    """Gets the time, and returns what `answer` returns. Its answers need headers, and the stage a state and `answers_each=False`."""
    on_end: Callable[[], Any] | None = None
    """Called when the stream is over; otherwise as `on_silence`."""
    on_cut_off: Callable[[], Any] | None = None
    """Called when the link to the machine that sends the samples is cut off; otherwise as `on_silence`."""
    before_sending: Callable[[Any, int], None] | None = None
    """Gets the head of an answer right before it is sent, and the time, and may change the head. Costs a second message."""

    def __post_init__(self) -> None:
        if (self.answer is None) == (self.answer_many is None):
            raise ValueError("a Stage has neither or both of `answer` and `answer_many`: expected one of them")
        if (self.state is None) != (self.restore is None) or (self.state and self.answer_many):
            raise ValueError("a Stage with a state has `answer`, `state` and `restore`: expected all of them, and no `answer_many`")


@dataclasses.dataclass
class Source:
    """The samples of an operator without an input, or with feedback inputs alone.

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
    resume: Callable[[dict[str, tuple[int, int] | None]], None] | None = None
    """Goes back, before the first call of `next` and whenever another instance was active: it gets the epoch and number of the
    last sample of each output that readers have, or None, and `next` goes on with that sample or any before it."""
    state: Callable[[], bytes] | None = None
    """Without `resume`: the bytes on which the next sample depends, saved with each sample. With the samples that readers may
    still need, they may take 256 KiB."""
    restore: Callable[[bytes | None], None] | None = None
    """Takes over the bytes that `state` returned, here or in another process, or begins anew."""
    receive: Callable[[str, Any, Any], None] | None = None
    """Gets the samples of feedback inputs: the input's name, head, items."""
    open: Callable[[], None] | None = None
    """Called before anything else when the instance becomes active: opens a device, for example."""
    close: Callable[[], None] | None = None
    """Lets go of what another instance needs, such as a device: called when another instance takes over, and at the end."""
    max_items: int | dict[str, int] | None = None
    """As of a Stage."""
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


def counted(**counts: int) -> None:
    """Says how often something has happened since the start, besides samples: `ps`, `top` and the metrics show it."""
    _HOST[0].send(COUNTS, json.dumps({name: int(n) for name, n in counts.items()}).encode())


def run(description: Description, start: Callable[[dict[str, Any]], Stage | Source]) -> None:
    """The `main` of an operator: answers `--describe`, or works for its host until that ends."""
    if "--describe" in sys.argv[1:]:
        print(json.dumps(description.to_json()))
        sys.exit(0)
    if PIPES_VARIABLE not in os.environ:
        print(
            f"{description.operator}: {description.summary}\n\nThis is an operator: blindgrasp starts it as part of a graph "
            "(blindgrasp run dataflow.yaml).\nWith --describe it prints its ports and parameters.",
            file=sys.stderr,
        )
        sys.exit(2)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    host = _Host(*map(int, os.environ.pop(PIPES_VARIABLE).split(",")))
    _HOST.append(host)
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[_LogHandler()])
    logging.captureWarnings(True)
    try:
        _work(host, description, start)
    except BrokenPipeError:
        # The host has died.
        sys.exit(1)
    except Exception as error:
        logging.getLogger("blindgrasp").info("%s", traceback.format_exc())
        host.send(FAILED, _in_words(error).encode())
        sys.exit(1)


def _in_words(error: Exception) -> str:
    """The text of an error for a person."""
    if isinstance(error, ModuleNotFoundError):
        return f"{error}; install it for {sys.executable}: pip install -r requirements.txt"
    text = str(error)
    return text if isinstance(error, (OSError, RuntimeError)) and text else f"{type(error).__name__}: {text}"


class _LogHandler(logging.Handler):
    """Python's logging as lines of the operator's log."""

    LEVELS = ((logging.ERROR, "error"), (logging.WARNING, "warn"), (logging.INFO, "info"), (logging.DEBUG, "debug"))

    def emit(self, record: logging.LogRecord) -> None:
        level = next((word for least, word in self.LEVELS if record.levelno >= least), "trace")
        line = {"level": level, "message": self.format(record), "fields": {"logger": record.name}}
        _HOST[0].send(LOG, json.dumps(line).encode())


class _Host:
    """The pipes to the host."""

    def __init__(self, from_host: int, to_host: int) -> None:
        # A program that this one runs must not hold them.
        os.set_inheritable(from_host, False)
        os.set_inheritable(to_host, False)
        self.input = open(from_host, "rb", buffering=1 << 16)
        self.to_host = to_host
        # Another thread may log.
        self.lock = threading.Lock()

    def send(self, kind: int, *body: bytes) -> None:
        message = b"".join((_FRAME.pack(sum(map(len, body)), kind), *body))
        with self.lock:
            n_sent = os.write(self.to_host, message)
            while n_sent < len(message):
                n_sent += os.write(self.to_host, message[n_sent:])

    def receive(self) -> tuple[int, bytes]:
        """The next message; kind 0 at the end."""
        frame = self.input.read(_FRAME.size)
        if len(frame) < _FRAME.size:
            return 0, b""
        n_bytes, kind = _FRAME.unpack(frame)
        return kind, self.input.read(n_bytes)


_HOST: list[_Host] = []


class _Operator:
    """An operator between its host and the user's functions."""

    def __init__(self, host: _Host, description: Description, work: Stage | Source, params: dict[str, Any]) -> None:
        self.host, self.work, self.params = host, work, params
        self.inputs, self.outputs = list(description.inputs), list(description.outputs)
        self.partners = [name for name, _, *words in self.inputs if "partner" in words]
        self.has_names = len(self.inputs) - len(self.partners) > 1
        self.waiting: list[tuple[Any, Any]] = []

    def ready(self, description: Description) -> dict[str, Any]:
        work, most = self.work, self.work.max_items
        said: dict[str, Any] = {"identity": work.identity, "has_state": work.state is not None, "answers": description.answers}
        said["max_items"] = most if isinstance(most, dict) else {} if most is None else {port[0]: most for port in self.outputs}
        if isinstance(work, Source):
            return said | {"is_source": True, "resumes": work.resume is not None, "pause_secs": work.pause_secs}
        hears = {"end": work.on_end, "cut_off": work.on_cut_off, "check": work.before_sending}
        said["hears"] = [word for word, function in hears.items() if function is not None]
        return said | {"batch": work.max_batch if work.answer_many else 1}

    def obey(self, kind: int, body: bytes) -> None:
        work, host = self.work, self.host
        if kind == SAMPLE:
            self.sample(body)
        elif kind == SET:
            params = json.loads(body)
            try:
                if work.set is not None:
                    work.set(params)
            except Exception as refusal:
                return host.send(REFUSED, _in_words(refusal).encode())
            self.params.update(params)
            self.done()
        elif kind == RESTORE:
            _, flags, n_state = _WORK.unpack_from(body)
            work.restore(body[_WORK.size :][:n_state] if flags & HAS_STATE else None)  # type: ignore[misc]
            self.done()
        elif kind == NEXT:
            self.next()
        elif kind == RESUME:
            work.resume({port: None if key is None else tuple(key) for port, key in json.loads(body).items()})  # type: ignore
            self.done()
        elif kind == CHECK:
            port, head, _ = self.parts(body, self.outputs)[0]
            work.before_sending(head, _WORK.unpack_from(body)[0])  # type: ignore[union-attr, misc]
            self.done({port: head} if len(self.outputs) > 1 else head)
        elif kind == SILENCE:
            self.done(None if work.on_silence is None else work.on_silence(_WORK.unpack_from(body)[0]))  # type: ignore
        else:
            function = {OPEN: "open", CLOSE: "close", END: "on_end", CUT_OFF: "on_cut_off"}[kind]
            function = getattr(work, function)
            self.done(None if function is None else function())

    def parts(self, body: bytes, ports: Sequence[tuple]) -> list[tuple[str, Any, Any]]:
        """The samples in a message: port, head, items."""
        parts, at = [], _WORK.size
        while at < len(body):
            port, _, n_head, n_items = _PART.unpack_from(body, at)
            at += _PART.size
            name, message = ports[port][:2]
            head = message.Head.from_buffer_copy(body, at)
            head.items = _items(message.Item, bytearray(body[at + n_head : at + n_head + n_items]))
            at += n_head + n_items
            parts.append((name, head, head.items))
        return parts

    def sample(self, body: bytes) -> None:
        work = self.work
        (port, head, items), *others = self.parts(body, self.inputs)
        if isinstance(work, Source):
            if work.receive is not None:
                work.receive(port, head, items)
            return self.done()
        if work.answer is not None:
            partners = dict.fromkeys(self.partners) | {name: (head, items) for name, head, items in others}
            said = work.answer(port, head, items, **partners) if self.has_names else work.answer(head, items, **partners)
            return self.done(said)
        self.waiting.append((head, items))
        if _WORK.unpack_from(body)[1] & MORE:
            return
        waiting, self.waiting = self.waiting, []
        try:
            said = work.answer_many([head for head, _ in waiting], [items for _, items in waiting])  # type: ignore[misc]
        except Exception:
            if len(waiting) == 1:
                raise
            # To find the one that it fails on.
            return self.host.send(ONE_BY_ONE)
        if len(said) != len(waiting):
            raise RuntimeError(f"answer_many returned {len(said)} answers to {len(waiting)} samples")
        for answer in said:
            self.done(answer)

    def next(self) -> None:
        try:
            said = self.work.next()  # type: ignore[union-attr]
        except StopIteration:
            return self.done(flags=FINISHED)
        self.done(said, flags=NOTHING_YET if said is None else 0)

    def done(self, said: Any = None, flags: int = 0) -> None:
        """Answers the host with what the user's function has returned."""
        work = self.work
        state = b"" if work.state is None else bytes(work.state())
        deadline = work.deadline() if isinstance(work, Stage) and work.deadline else None
        self.host.send(DONE, _WORK.pack(deadline or 0, flags, len(state)), state, *self.packed(said))

    def packed(self, said: Any) -> list[bytes]:
        """What a stage or a source has returned, as parts of a message."""
        if said is None:
            return []
        names = [port[0] for port in self.outputs]
        if not isinstance(said, dict):
            if len(names) != 1:
                raise RuntimeError(f"it returned {type(said).__name__}, expected a dict with a sample by output: {', '.join(names)}")
            said = {names[0]: said}
        packed = []
        for port, sample in said.items():
            if port not in names:
                raise RuntimeError(f"it returned a sample for the output {port!r}, expected one of {', '.join(names)}")
            if sample is None:
                continue
            idx = names.index(port)
            head, items = sample if isinstance(sample, tuple) else (sample, getattr(sample, "items", None))
            message = self.outputs[idx][1]
            if not isinstance(head, message.Head):
                raise RuntimeError(f"a head for the output {port} is {type(head).__name__}, expected {message.Head.__name__}")
            raw_head, raw_items = bytes(head), _raw(message.Item, items)
            packed += [_PART.pack(idx, self.lost_before(port), len(raw_head), len(raw_items)), raw_head, raw_items]
        return packed

    def lost_before(self, port: str) -> int:
        """The numbers that a source leaves out before its next sample of an output."""
        if not isinstance(self.work, Source) or not self.work._n_lost:
            return 0
        n_lost = self.work._n_lost
        for name in [port[0] for port in self.outputs]:
            n_lost[name] = n_lost.get(name, 0) + n_lost.get(None, 0)
        n_lost.pop(None, None)
        return n_lost.pop(port, 0)


def _work(host: _Host, description: Description, start: Callable[[dict[str, Any]], Stage | Source]) -> None:
    kind, body = host.receive()
    if kind != START:
        return
    message = json.loads(body)
    if message["version"] != VERSION:
        raise RuntimeError(f"its host speaks version {message['version']}, expected {VERSION}: copy blindgrasp_operator.py anew")
    params = message["params"]
    work = start(params)
    if isinstance(work, Stage) and work.answer_many is not None and len(description.inputs) > 1:
        raise RuntimeError(f"answer_many is for one input, and the operator has {len(description.inputs)}: expected `answer`")
    operator = _Operator(host, description, work, params)
    # Importing it takes longer than a sample may wait.
    _numpy()
    host.send(READY, json.dumps(operator.ready(description)).encode())
    # The objects that exist by now stay: the collector need not look through them.
    gc.collect()
    gc.freeze()
    while (message := host.receive())[0]:
        operator.obey(*message)


def _items(item: Any, raw: bytearray) -> Any:
    """Items as a numpy array, or as an array of ctypes."""
    numpy = _numpy()
    if numpy is not None:
        return numpy.frombuffer(raw, dtype=_dtype(item))
    return (item * (len(raw) // ctypes.sizeof(item))).from_buffer(raw)


def _raw(item: Any, items: Any) -> bytes:
    """The bytes of items given as bytes, as an array or as a sequence."""
    if items is None or isinstance(items, bytes):
        return items or b""
    if hasattr(items, "astype"):
        return items.astype(_dtype(item), copy=False).tobytes()
    return bytes(items if isinstance(items, ctypes.Array) else (item * len(items))(*items))


_NUMPY: list[Any] = []
_DTYPES: dict[Any, Any] = {}


def _numpy() -> Any:
    """numpy, or None; not before it is needed, because `--describe` should be quick."""
    if not _NUMPY:
        try:
            import numpy

            _NUMPY.append(numpy)
        except ModuleNotFoundError:
            _NUMPY.append(None)
    return _NUMPY[0]


def _dtype(item: Any) -> Any:
    if item not in _DTYPES:
        _DTYPES[item] = _numpy().dtype(item)
    return _DTYPES[item]


def _use_own_environment() -> None:
    """Restarts the program in the environment `.venv` beside it, unless an environment is active."""
    python = Path(sys.argv[0]).resolve().parent / ".venv" / "bin" / "python"
    is_operator = PIPES_VARIABLE in os.environ or "--describe" in sys.argv[1:]
    if is_operator and sys.prefix == sys.base_prefix and python.exists():
        os.execv(python, [str(python), *sys.argv])


_use_own_environment()
