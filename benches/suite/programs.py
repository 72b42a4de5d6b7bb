"""The project's programs: how they are built and asked, and what processes take."""

import contextlib
import functools
import json
import os
import platform
import re
import subprocess
import sys
import venv
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent.parent
RELEASE = PROJECT / "target" / "release"
EXAMPLES = RELEASE / "examples"
# What the suite keeps between runs: data sets, LIBSVM, packages of Python.
KEPT = PROJECT / "target" / "benchsuite"
# BLINDGRASP names another program.
BLINDGRASP = Path(os.environ.get("BLINDGRASP", RELEASE / "blindgrasp"))
HAND = PROJECT / "hands" / "barrett-bh8-280.yaml"
MODEL = PROJECT / "models" / "barrett-bh8-280.json"
HELD_OUT = PROJECT / "recordings" / "held-out.mcap"


def build(examples):
    words = [word for example in sorted(examples) for word in ("--example", example)]
    subprocess.run(["cargo", "build", "--release", "--workspace", "--quiet", "--bins", *words], cwd=PROJECT, check=True, stdout=sys.stderr)


def output(*command):
    """What a command prints. It must succeed."""
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=PROJECT, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"{' '.join(words)} ended with exit code {done.returncode}:\n{done.stderr}")
    return done.stdout.strip()


def blindgrasp(*arguments):
    return output(BLINDGRASP, *arguments)


@functools.cache
def bench_program(name):
    """The program of benches/, built."""
    command = ["cargo", "bench", "--workspace", "--quiet", "--no-run", "--bench", name, "--message-format", "json"]
    for line in output(*command).splitlines():
        message = json.loads(line)
        if message.get("executable") and message["target"]["name"] == name:
            return message["executable"]
    sys.exit(f"cargo bench --workspace --bench {name} has built no program")


def use_packages(names):
    """Starts this program again with a Python that has these packages of PyPI, unless it runs in it already.

    `names` are the packages by the names to import.
    """
    folder = KEPT / "python"
    python = folder / "bin" / "python"
    if Path(sys.prefix) != folder:
        if not python.exists():
            venv.create(folder, with_pip=True)
        can_import = [python, "-P", "-c", f"import {', '.join(names)}"]
        if subprocess.run(can_import, stderr=subprocess.DEVNULL).returncode != 0:
            print(f"installing {', '.join(names.values())} into {folder}", file=sys.stderr)
            subprocess.run([python, "-P", "-m", "pip", "install", "--quiet", *names.values()], check=True, stdout=sys.stderr)
        os.execv(python, [str(python), *sys.argv])


def test_python():
    """The Python of the tests, which has scikit-learn and selenium."""
    return Path(output(PROJECT / "scripts" / "python-env")) / "bin" / "python"


def describe_machine():
    cpus = [line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    lock = (PROJECT / "Cargo.lock").read_text()
    versions = [output("rustc", "--version")]
    for crate in ("iceoryx2", "zenoh"):
        versions.append(f"{crate} " + re.search(rf'name = "{crate}"\nversion = "(.*)"', lock)[1])
    return {
        "machine": f"{os.cpu_count()} cores of {cpus[0] if cpus else platform.machine()}",
        "system": platform.platform(),
        "versions": ", ".join(versions),
        "load": f"{os.getloadavg()[0]:.1f}",
    }


def descendants(parent):
    """The processes that a process has started, and those that these have started."""
    children = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        children.setdefault(int(fields[1]), []).append(int(stat.parent.name))
    found = list(children.get(parent, []))
    for pid in found:
        found += children.get(pid, [])
    return found


def cpu_nanos(pids):
    """The processor time of all threads that live, to the nanosecond."""
    nanos = 0
    for task in (task for pid in pids for task in Path(f"/proc/{pid}/task").glob("*/schedstat")):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            nanos += int(task.read_text().split()[0])
    return nanos


def pss_mib(pids):
    """Resident memory, of which shared pages count in parts."""
    texts = [Path(f"/proc/{pid}/smaps_rollup").read_text() for pid in pids]
    return sum(int(re.search(r"^Pss: +(\d+) kB", text, re.MULTILINE)[1]) for text in texts) / 1024
