"""Our 6-D hull beside Qhull (SciPy) on the wrenches of simulated grasps, on one thread each, and whether they agree.

Both go through the same grasps in small chunks, in turn, so that whatever else the machine does hits both alike. Each
grasp's time is the median of its repeats.
"""

import json
import statistics
import subprocess
import sys
import time

from . import figures, programs
from .options import Option

OPTIONS = {
    "grasps": Option(1000, "number of grasps", quick=40, least=1),
    "seed": Option(0, "seed of the grasps"),
    "repeats": Option(5, "how often each hull is computed", quick=1, least=1),
}
PACKAGES = {"numpy": "numpy", "scipy": "scipy"}
PAGE = {}
# As the ground truth's reference values: triangulated facets, exact handling of degenerate input instead of joggling.
QHULL_OPTIONS = "Qt Qx"
CHUNK = 20


def measure(options):
    import numpy
    import scipy

    command = [programs.bench_program("hull"), "--serve", "--grasps", str(options.grasps), "--seed", str(options.seed)]
    served = subprocess.Popen(command, cwd=programs.PROJECT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    first_line = served.stdout.readline()
    if not first_line:
        sys.exit(f"'{' '.join(command)}' ended with exit code {served.wait()} before it gave any wrenches")
    wrenches = [numpy.array(points) for points in json.loads(first_line)["wrenches"]]
    found = {"ours": [[] for _ in wrenches], "qhull": [[] for _ in wrenches]}
    for _ in range(options.repeats):
        for first in range(0, len(wrenches), CHUNK):
            end = min(first + CHUNK, len(wrenches))
            served.stdin.write(f"{first} {end}\n")
            served.stdin.flush()
            for idx, result in enumerate(json.loads(served.stdout.readline()), first):
                found["ours"][idx].append(result)
            for idx in range(first, end):
                found["qhull"][idx].append(qhull(wrenches[idx]))
    served.stdin.close()
    served.wait()
    versions = {"scipy": scipy.__version__, "numpy": numpy.__version__, "python": sys.version.split()[0]}
    return {"versions": versions} | summary(found)


def qhull(points):
    from scipy.spatial import ConvexHull, QhullError

    begin = time.perf_counter()
    try:
        hull = ConvexHull(points, qhull_options=QHULL_OPTIONS)
    except QhullError:
        return {"seconds": time.perf_counter() - begin, "error": "QhullError"}
    seconds = time.perf_counter() - begin
    # Qhull's equations are n·x + offset <= 0.
    return {"seconds": seconds, "least_offset": -hull.equations[:, -1].max(), "volume": hull.volume}


def summary(found):
    n_grasps = len(found["ours"])
    both = [idx for idx in range(n_grasps) if not any("error" in of[idx][0] for of in found.values())]
    if not both:
        sys.exit("no grasp has a hull in both")
    millis = {side: [1e3 * statistics.median(one["seconds"] for one in of[idx]) for idx in both] for side, of in found.items()}
    over = [theirs / ours for ours, theirs in zip(millis["ours"], millis["qhull"])]
    return {
        "n_grasps": n_grasps,
        "n_hulls_of_both": len(both),
        "n_without_hull": {side: sum("error" in results[0] for results in of) for side, of in found.items()},
        "milliseconds_per_hull": {side: quantiles(values) for side, values in millis.items()},
        "qhull_over_ours": {
            **quantiles(over),
            "of_medians": statistics.median(millis["qhull"]) / statistics.median(millis["ours"]),
            "of_sums": sum(millis["qhull"]) / sum(millis["ours"]),
        },
        "largest_relative_difference": {
            "epsilon": largest_difference(found, both, epsilon),
            "volume": largest_difference(found, both, lambda result: result["volume"]),
        },
    }


def epsilon(result):
    """-1 when the origin is outside."""
    return result["least_offset"] if result["least_offset"] > 1e-9 else -1.0


def largest_difference(found, both, value):
    pairs = [(value(found["ours"][idx][0]), value(found["qhull"][idx][0])) for idx in both]
    return max(abs(ours - theirs) / abs(theirs) for ours, theirs in pairs)


def quantiles(values):
    shares = {"p10": 0.1, "median": 0.5, "p90": 0.9, "max": 1.0}
    return {name: figures.quantile(values, share) for name, share in shares.items()}


def show(result):
    print(f"scipy {result['versions']['scipy']}, {QHULL_OPTIONS}; {result['n_grasps']} grasps, {result['n_hulls_of_both']} hulls")
    millis = result["milliseconds_per_hull"]
    rows = {"ours, ms": millis["ours"], "Qhull, ms": millis["qhull"], "Qhull / ours": result["qhull_over_ours"]}
    names = ["p10", "median", "p90", "max"]
    figures.table(["", *names], [[title, *(f"{of[name]:.2f}" for name in names)] for title, of in rows.items()])
    differences = result["largest_relative_difference"]
    print(f"largest relative difference: epsilon {differences['epsilon']:.1e}, volume {differences['volume']:.1e}")


def page(result):
    yield "6-D hull, median of grasps", "Qhull (SciPy)", 1 / result["qhull_over_ours"]["of_medians"]
