"""Graphs: started, watched and ended."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterable, Iterator, Mapping
from os import PathLike, fspath
from typing import Any

from ._program import Process, answer_of
from ._types import WHILE_LIFTING, Decision

# The time between two looks whether a graph runs. A look takes some milliseconds.
LOOK_PAUSE_SECS = 0.05

# Numbers the replays of this process, so that each graph has a name of its own.
REPLAY_NUMBERS = itertools.count()


class Run:
    """A running graph. It is made by `run`, and iterates over the graph's decisions."""

    def __init__(self, arguments: list[str]) -> None:
        self._arguments = arguments
        self._process: Process | None = None
        self.name: str | None = None
        """The graph's name, for `echo` and the commands; None if the graph ended before it was seen running."""
        self.summary: dict[str, Any] | None = None
        """The sums at the end, as `blindgrasp run --json` prints them; None before."""
        self.outcomes: list[dict[str, Any]] = []
        """The outcomes of lifts (LiftOutcome of docs/messages.md) that have come, of a graph that reports them."""
        self.stderr = ""
        """All that the program printed to stderr; empty before the block has ended."""

    def __enter__(self) -> Run:
        self._process = Process(self._arguments)
        try:
            self._wait_until_it_runs(self._process)
        except BaseException:
            self._process.end()
            raise
        return self

    def _wait_until_it_runs(self, process: Process) -> None:
        while (code := process.exit_code()) is None:
            has_decided = process.has_printed()
            for graph in answer_of(["ps", "--json"])["graphs"]:
                if graph["pid"] == process.pid and graph["state"] == "running":
                    self.name = graph["graph"]
                    return
            # A short graph has ended between two looks, and waits until its decisions are read.
            if has_decided:
                return
            time.sleep(LOOK_PAUSE_SECS)
        process.check(code)

    def __iter__(self) -> Iterator[Decision]:
        """The decisions as they come, until the graph ends.

        The graph does not wait. It leaves decisions out if more than 65,536 wait to be read, and says so in `stderr`.

        Raises ProgramError if the graph fails (exit code 1) or loses samples (exit code 3).
        """
        if self._process is None:
            raise RuntimeError("the graph does not run: iterate within `with blindgrasp.run(…) as graph:`")
        for line in self._process.lines():
            if not self._is_taken(line):
                yield Decision.from_json(line)

    def _is_taken(self, line: dict[str, Any]) -> bool:
        """Takes a line that is no decision."""
        if "summary" in line:
            self.summary = line["summary"]
        elif "outcome" in line:
            self.outcomes.append(line["outcome"])
        return "grasp_id" not in line

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        for line in process.end():
            self._is_taken(line)
        self.stderr = process.stderr()
        if kind is None:
            process.check(process.exit_code() or 0)


def run(
    dataflow: str | PathLike[str] = "dataflow.yaml",
    *,
    set: Mapping[str, Any] | None = None,
    name: str | None = None,
    recording: str | PathLike[str] | None = None,
) -> Run:
    """A context manager that starts a graph (`blindgrasp run`), waits until it runs, and ends it.

    `set` has values of parameters in the place of the file's, like `{"recorded_source.rate": "max"}`. `name` is the
    name of the running graph. `recording` is a new file to which every edge is recorded.

    At the end of the block the graph is asked to end (SIGINT), decides what is in flight, and is waited for. Decisions
    that were not read are left out. A graph that does not start, fails or loses samples raises ProgramError with its
    stderr.
    """
    arguments = ["run", fspath(dataflow), "--json", *_set_words(set)]
    if name is not None:
        arguments += ["--name", name]
    if recording is not None:
        arguments += ["--record", fspath(recording)]
    return Run(arguments)


class ReplayedDecisions(Mapping[int, Decision]):
    """The decisions of a replay by `grasp_id`, each the last one before the arm lifts: `decisions[3].action`.

    A grasp that was not decided is not there.
    """

    def __init__(self, every: Iterable[Decision], summary: dict[str, Any], stderr: str) -> None:
        self.every = tuple(every)
        """All decisions in order, also those that ask for a probe, and those that come while the arm lifts."""
        self.summary = summary
        """The sums at the end, as `blindgrasp replay --json` prints them."""
        self.stderr = stderr
        """All that the program printed to stderr, such as a warning that the recording is of another hand."""
        before = (decision for decision in self.every if decision.action not in WHILE_LIFTING)
        self._by_grasp = {decision.grasp_id: decision for decision in before}

    def __getitem__(self, grasp_id: int) -> Decision:
        return self._by_grasp[grasp_id]

    def __iter__(self) -> Iterator[int]:
        return iter(self._by_grasp)

    def __len__(self) -> int:
        return len(self._by_grasp)

    def __repr__(self) -> str:
        n_lifted = sum(decision.action == "lift" for decision in self.values())
        said = f"{len(self)} grasps, {n_lifted} lifted, {len(self) - n_lifted} held"
        if self.accuracy is not None:
            said += f", accuracy {self.accuracy:.1%}, {self.false_positives} false positives"
        return f"ReplayedDecisions({said})"

    @property
    def accuracy(self) -> float | None:
        """The share of right decisions among the labelled grasps; None if none is labelled."""
        accuracy: float | None = self.summary["accuracy"] if self.summary["with_truth"] else None
        return accuracy

    @property
    def false_positives(self) -> int | None:
        """The number of labelled grasps that are lifted and unstable; None if none is labelled."""
        n_wrong: int | None = self.summary["false_positives"] if self.summary["with_truth"] else None
        return n_wrong


def replay(
    recording: str | PathLike[str],
    dataflow: str | PathLike[str] = "dataflow.yaml",
    *,
    set: Mapping[str, Any] | None = None,
    grasps: Iterable[int] | None = None,
) -> ReplayedDecisions:
    """Plays a recording through a graph in the place of its source, as fast as the graph can (`blindgrasp replay`).

    `set` has values of parameters in the place of the file's, like `{"lift_arbiter.votes": 2}`. Without `grasps`, all
    grasps are played. The same recording and graph give the same decisions on every machine, however busy it is.

    Raises ProgramError if the graph does not start, fails or loses samples.
    """
    return replay_in(None, recording, dataflow, set=set, grasps=grasps)


def replay_in(
    folder: str | PathLike[str] | None,
    recording: str | PathLike[str],
    dataflow: str | PathLike[str] = "dataflow.yaml",
    *,
    set: Mapping[str, Any] | None = None,
    grasps: Iterable[int] | None = None,
) -> ReplayedDecisions:
    """As `replay`, but relative paths, also those in `set`, begin at `folder`."""
    name = f"replay-{os.getpid()}-{next(REPLAY_NUMBERS)}"
    arguments = ["replay", fspath(recording), "--dataflow", fspath(dataflow), "--rate", "max", "--name", name, "--json"]
    arguments += _set_words(set)
    if grasps is not None:
        arguments += ["--grasps", ",".join(str(grasp_id) for grasp_id in grasps)]
    with Process(arguments, folder=folder) as process:
        lines = list(process.lines())
        stderr = process.stderr()
    summary = next(line["summary"] for line in lines if "summary" in line)
    return ReplayedDecisions((Decision.from_json(line) for line in lines if "grasp_id" in line), summary, stderr)


def _set_words(given: Mapping[str, Any] | None) -> list[str]:
    words = []
    for parameter, value in (given or {}).items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        words += ["--set", f"{parameter}={text}"]
    return words


def echo(graph: str, *edges: str, samples: int | None = None) -> Iterator[dict[str, Any]]:
    """The samples of a running graph as they come: topic, seq, stamp_nanos and data, as `blindgrasp export` has them.

    `edges` are outputs, like `lift_arbiter/decision`; without any, all are read. It ends after so many `samples`, or
    with the graph. The graph does not wait for a reader that is too slow.

    Raises ProgramError if there is no such graph or edge, and at the end if samples were left out.
    """
    arguments = ["echo", *edges, "--graph", graph]
    if samples is not None:
        arguments += ["--samples", str(samples)]
    with Process(arguments) as process:
        yield from process.lines()
