"""The simulator: grasps per second, peak memory, and Qhull's time for the same candidates.

SciPy's Qhull computes the hulls of a sample of the grasps' wrenches. Its time for all candidates is its mean over the
sample times the number of candidates that touched. A run takes tens of minutes.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from . import figures, programs
from .options import Option

OPTIONS = {
    "grasps": Option(36960, "grasps of the built-in objects", quick=200, least=1),
    "meshes": Option(Path(), "a folder of meshes to simulate too"),
    "memory": Option(100_000, "grasps of the memory run; 0 leaves it out", quick=0, least=0),
    "sample": Option(500, "hulls that Qhull computes", quick=10, least=1),
}
PACKAGES = {"numpy": "numpy", "scipy": "scipy"}


def measure(options):
    import numpy
    import scipy

    runs = [("built-in objects", "builtin", options.grasps)]
    if options.meshes != Path():
        runs.append((options.meshes.name, options.meshes, options.grasps))
    if options.memory:
        runs.append(("built-in, memory", "builtin", options.memory))
    versions = {"scipy": scipy.__version__, "numpy": numpy.__version__}
    return {"versions": versions, "runs": [of_run(*run, options.sample) for run in runs]}


def of_run(name, objects, n_grasps, n_sample):
    figures.progress(f"{name}: {n_grasps} grasps")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "data"
        found = simulate(["--objects", objects, "--grasps", n_grasps, "--seed", 1, "--out", out])
        mean_secs, n_failed = qhull_mean_secs(out / "part-00000.mcap", n_sample)
    return found | {
        "name": name,
        "grasps_per_sec": found["n_grasps"] / found["secs"],
        "qhull_mean_millis": 1e3 * mean_secs,
        "qhull_secs": mean_secs * found["n_judged"],
        "qhull_failed": n_failed,
    }


def simulate(arguments):
    begin = time.monotonic()
    command = [programs.BLINDGRASP, "simulate", *map(str, arguments), "--json"]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    said = child.stdout.read()
    _, status, usage = os.wait4(child.pid, 0)
    if status != 0:
        sys.exit(f"simulate ended with exit code {os.waitstatus_to_exitcode(status)}")
    report = json.loads(said)
    return {
        "secs": time.monotonic() - begin,
        "cpu_secs": usage.ru_utime + usage.ru_stime,
        "peak_mib": usage.ru_maxrss / 1024,
        **{name: report[name] for name in ("n_grasps", "n_candidates", "n_judged")},
    }


def wrenches(scene):
    """The edge wrenches of a recorded scene, as lab/crates/simulator/src/wrench_space.rs defines them."""
    import numpy as np

    rows = []
    for contact in scene["contacts"]:
        if contact["other_link"] >= 0:
            continue
        normal, tangent = np.array(contact["inward_normal"]), np.array(contact["tangent"])
        second = np.cross(normal, tangent)
        arm = np.array(contact["point_m"]) - np.array(scene["centre_of_mass_m"])
        torsion, friction = contact["torsion_m"], scene["friction"]
        latitudes = [(90, 1), (45, 5), (0, 8), (-45, 5), (-90, 1)] if torsion > 0 else [(0, 8)]
        for latitude, n in latitudes:
            lat = np.deg2rad(latitude)
            for k in range(n):
                long = 2 * np.pi * k / n
                e0, e1, e5 = np.cos(lat) * np.cos(long), np.cos(lat) * np.sin(long), np.sin(lat) * torsion
                force = normal + friction * (e0 * tangent + e1 * second)
                torque = (np.cross(arm, force) + friction * e5 * normal) / scene["max_radius_m"]
                rows.append(np.concatenate([force, torque]))
    return np.array(rows)


def qhull_mean_secs(recording, n_sample):
    """Qhull's mean time over the first grasps with two contacts or more, and how often it failed."""
    from scipy.spatial import ConvexHull, QhullError

    export = subprocess.Popen(
        [programs.BLINDGRASP, "export", recording, "--topic", "/scene"], stdout=subprocess.PIPE, text=True
    )
    secs, n_failed = [], 0
    for line in export.stdout:
        points = wrenches(json.loads(line)["data"])
        if len(points) < 16:
            secs.append(0.0)
            continue
        begin = time.perf_counter()
        try:
            ConvexHull(points, qhull_options="Qt Qx")
        except QhullError:
            n_failed += 1
        secs.append(time.perf_counter() - begin)
        if len(secs) == n_sample:
            break
    export.kill()
    export.wait()
    return sum(secs) / len(secs), n_failed


def show(result):
    print(f"NumPy {result['versions']['numpy']}, SciPy {result['versions']['scipy']}")
    titles = ["objects", "grasps", "candidates", "s", "CPU s", "grasps/s", "peak MiB", "Qhull alone, CPU s", "ms each", "failed"]
    names = ["n_grasps", "n_candidates", "secs", "cpu_secs", "grasps_per_sec", "peak_mib", "qhull_secs"]
    rows = []
    for run in result["runs"]:
        row = [run["name"], *(f"{run[name]:.0f}" for name in names)]
        rows.append([*row, f"{run['qhull_mean_millis']:.1f}", run["qhull_failed"]])
    figures.table(titles, rows)
