"""The program `blindgrasp`: where it is, and how it is called."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import termios
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

PROGRAM_VARIABLE = "BLINDGRASP_PROGRAM"

# A program that is asked to end gets this long: three times what `blindgrasp run` gives its operators to drain and then
# to exit (--grace, 10 s each).
END_LIMIT_SECS = 60.0


class ProgramNotFoundError(FileNotFoundError):
    """The program `blindgrasp` was not found."""


class ProgramError(RuntimeError):
    """The program failed."""

    def __init__(self, command: list[str], exit_code: int, stderr: str) -> None:
        said = stderr.strip() or "it printed no error"
        super().__init__(f"`blindgrasp {' '.join(command[1:])}` exited with {exit_code}: {said}")
        self.exit_code = exit_code
        """1 failed, 2 usage, 3 finished with loss; negative: the signal that killed it."""
        self.stderr = stderr
        """All that it printed to stderr."""


def program() -> Path:
    """The program: the one that BLINDGRASP_PROGRAM names, else the one in this package, else the one on PATH.

    Raises ProgramNotFoundError if there is none.
    """
    named = os.environ.get(PROGRAM_VARIABLE)
    if named:
        if not _is_executable(Path(named)):
            raise ProgramNotFoundError(f"{PROGRAM_VARIABLE} is {named}, which is no executable file")
        return Path(named).absolute()
    packaged = Path(__file__).parent / "bin" / "blindgrasp"
    if _is_executable(packaged):
        return packaged
    found = shutil.which("blindgrasp")
    if found is None:
        raise ProgramNotFoundError(
            f"the program blindgrasp was not found: {PROGRAM_VARIABLE} is not set, this package has no copy of it, and "
            "it is not on PATH; build it (cargo build --release --workspace) and set "
            f"{PROGRAM_VARIABLE}=target/release/blindgrasp"
        )
    return Path(found).absolute()


def _is_executable(path: Path) -> bool:
    return path.is_file() and os.access(path, os.X_OK)


class Process:
    """A run of the program that prints a JSON object a line. As a context manager it ends the program.

    Relative paths in its arguments begin at `folder`, or at the current folder. The program has a session of its own:
    Ctrl-C reaches it once, from here, and not also from the terminal.
    """

    def __init__(
        self, arguments: list[str], stdin: IO[bytes] | None = None, folder: str | os.PathLike[str] | None = None
    ) -> None:
        self.command = [str(program()), *arguments]
        # A file takes any amount of text while nobody reads it.
        self._stderr = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            self.command,
            stdin=subprocess.DEVNULL if stdin is None else stdin,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            cwd=folder,
            start_new_session=True,
        )
        self.pid = self._process.pid
        self._said = ""
        self._may_fail = True

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def lines(self) -> Iterator[dict[str, Any]]:
        """The objects that it prints, until it ends.

        Raises ProgramError if it ends with another exit code than 0.
        """
        assert self._process.stdout is not None
        for line in self._process.stdout:
            yield json.loads(line)
        self.check(self._process.wait())

    def has_printed(self) -> bool:
        """Whether output waits to be read."""
        assert self._process.stdout is not None
        n_bytes = fcntl.ioctl(self._process.stdout, termios.FIONREAD, bytes(4))
        return int.from_bytes(n_bytes, sys.byteorder) > 0

    def exit_code(self) -> int | None:
        """Its exit code, None while it runs."""
        return self._process.poll()

    def check(self, exit_code: int) -> None:
        """Raises ProgramError if this exit code of the program is not 0, but only once."""
        if exit_code and self._may_fail:
            self._may_fail = False
            raise ProgramError(self.command, exit_code, self.stderr())

    def stderr(self) -> str:
        """What it has printed to stderr so far."""
        if not self._stderr.closed:
            # The program writes at the file's position, which pread leaves where it is.
            n_bytes = os.fstat(self._stderr.fileno()).st_size
            self._said = os.pread(self._stderr.fileno(), n_bytes, 0).decode(errors="replace")
        return self._said

    def end(self) -> list[dict[str, Any]]:
        """Asks it to end (SIGINT), and kills it after END_LIMIT_SECS. Returns the objects that were not read."""
        assert self._process.stdout is not None
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        killer = threading.Timer(END_LIMIT_SECS, self._process.kill)
        killer.start()
        try:
            unread = self._process.stdout.readlines()
            self._process.wait()
        finally:
            killer.cancel()
        self._process.stdout.close()
        self.stderr()
        self._stderr.close()
        return [json.loads(line) for line in unread if line.endswith(b"\n")]


def answer_of(arguments: list[str]) -> Any:
    """The one JSON value that a command prints, over one line or several.

    Raises ProgramError if the command fails.
    """
    command = [str(program()), *arguments]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    if done.returncode:
        raise ProgramError(command, done.returncode, done.stderr.decode(errors="replace"))
    return json.loads(done.stdout)
