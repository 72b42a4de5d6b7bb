"""Graphs: started, watched and ended."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from os import PathLike, fspath
from typing import Any, Self

from ._program import Process, answer_of
from ._types import Decision

# The time between two looks whether a graph runs. A look takes some milliseconds.
LOOK_PAUSE_SECS = 0.05


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

    def __enter__(self) -> Self:
        self._process = Process(self._arguments)
        try:
            self._wait_until_it_runs(self._process)
        except BaseException:
            self._process.end()
            raise
        return self

    def _wait_until_it_runs(self, process: Process) -> None:
        while (code := process.exit_code()) is None:
            for graph in answer_of(["ps", "--json"])["graphs"]:
                if graph["pid"] == process.pid and graph["state"] == "running":
                    self.name = graph["graph"]
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
    arguments = ["run", fspath(dataflow), "--json"]
    for parameter, value in (set or {}).items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        arguments += ["--set", f"{parameter}={text}"]
    if name is not None:
        arguments += ["--name", name]
    if recording is not None:
        arguments += ["--record", fspath(recording)]
    return Run(arguments)


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
