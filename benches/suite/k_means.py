"""Our K-means beside scikit-learn's on the contacts of simulated grasps, and their inertias.

Both run in turn with the same number of threads; times are of learning alone, without reading files. Each round has its
own seed. Where other programs take the cores, scikit-learn's threads wait for each other: there, compare with
--threads 1.

Restarts of K-means end in local minima whose inertias are percents apart, so that only runs from the same words can be
compared closely: in a second part both start from our seeds, restart by restart, with scikit-learn spared the seeding.
There positions have at least a micrometre of noise: contacts of one cell coincide, words start on them, and which of
two equally near words a cell's contacts then join is left to rounding.

The first run simulates the grasps. `positions` is a file of little-endian doubles x, y, z to take instead.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from . import figures, programs
from .options import Option

OPTIONS = {
    "contacts": Option(199_835, "as many as Dang & Allen had", quick=2000, least=1),
    "clusters": Option(64, "number of words", least=1),
    "restarts": Option(10, "how often each learns from new words", quick=2, least=1),
    "rounds": Option(3, "how often each side learns", quick=1, least=1),
    "noise": Option(0.0, "of positions, metres: standard deviation per axis", least=0),
    "threads": Option(os.cpu_count(), "of either", least=1),
    "positions": Option(Path(), "a file of positions"),
}
PACKAGES = {"numpy": "numpy", "sklearn": "scikit-learn"}
PAGE = {"contacts": 20_000}
FOLDER = programs.KEPT / "k-means"
# scikit-learn's defaults.
TOLERANCE, MAX_ITER = 1e-4, 300
LEAST_NOISE_M = 1e-6
FIGURES = {"secs": ("time", "s", 2), "inertia": ("inertia", "m²", 4), "n_iter": ("iterations of the best", "", 0)}


def measure(options):
    import numpy
    import sklearn
    from threadpoolctl import threadpool_limits

    FOLDER.mkdir(parents=True, exist_ok=True)
    path = options.positions if options.positions != Path() else simulated_contacts(options.contacts)
    contacts = numpy.fromfile(path, dtype="<f8").reshape(-1, 3)
    with threadpool_limits(options.threads):
        restarted = from_own_starts(with_noise(contacts, options.noise), options)
        same_start = from_same_starts(with_noise(contacts, max(options.noise, LEAST_NOISE_M)), options)
    return {
        "versions": {"scikit-learn": sklearn.__version__, "numpy": numpy.__version__, "python": sys.version.split()[0]},
        "n_positions": len(contacts),
        "n_distinct": len(numpy.unique(with_noise(contacts, options.noise), axis=0)),
        "restarted": restarted,
        "same_start": same_start,
    }


def from_own_starts(positions, options):
    runs = {"ours": [], "scikit-learn": []}
    for seed in range(1, options.rounds + 1):
        runs["ours"].append(ours(positions, options, options.restarts, MAX_ITER, seed))
        runs["scikit-learn"].append(scikit_learn(positions, options, options.restarts, "k-means++", seed))
    for one in runs["ours"]:
        one.pop("words_m")
    medians = figures.medians(runs)
    return {
        "medians": medians,
        "times_as_fast": medians["scikit-learn"]["secs"] / medians["ours"]["secs"],
        "inertia_ratio": medians["ours"]["inertia"] / medians["scikit-learn"]["inertia"],
        "rounds": runs,
    }


def from_same_starts(positions, options):
    import numpy

    pairs = []
    for seed in range(1, options.restarts + 1):
        start = numpy.array(ours(positions, options, 1, 0, seed)["words_m"])
        mine = ours(positions, options, 1, MAX_ITER, seed)
        mine.pop("words_m")
        pairs.append({"ours": mine, "scikit-learn": scikit_learn(positions, options, 1, start, seed)})
    secs = {side: sum(pair[side]["secs"] for pair in pairs) for side in pairs[0]}
    inertia = {side: min(pair[side]["inertia"] for pair in pairs) for side in pairs[0]}
    return {
        "secs": secs,
        "times_as_fast": secs["scikit-learn"] / secs["ours"],
        "best_inertia": inertia,
        "inertia_ratio": inertia["ours"] / inertia["scikit-learn"],
        "largest_difference": max(abs(pair["ours"]["inertia"] / pair["scikit-learn"]["inertia"] - 1) for pair in pairs),
        "restarts": pairs,
    }


def with_noise(contacts, noise_m):
    import numpy

    if noise_m == 0:
        return contacts
    return contacts + numpy.random.default_rng(0).normal(0, noise_m, contacts.shape)


def ours(positions, options, n_init, max_iter, seed):
    path = FOLDER / "positions.f64"
    positions.astype("<f8").tofile(path)
    return bench("learn", path, options.clusters, n_init, TOLERANCE, max_iter, seed, threads=options.threads)


def scikit_learn(positions, options, n_init, init, seed):
    from sklearn.cluster import KMeans

    k_means = KMeans(options.clusters, n_init=n_init, init=init, tol=TOLERANCE, max_iter=MAX_ITER, random_state=seed)
    begin = time.perf_counter()
    k_means.fit(positions)
    return {"secs": time.perf_counter() - begin, "inertia": k_means.inertia_, "n_iter": k_means.n_iter_}


def bench(*arguments, threads):
    command = [programs.bench_program("k_means"), *map(str, arguments)]
    environment = os.environ | {"RAYON_NUM_THREADS": str(threads)}
    done = subprocess.run(command, cwd=programs.PROJECT, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout)


def simulated_contacts(n_contacts):
    path = FOLDER / f"contacts-{n_contacts}.f64"
    if not path.exists():
        grasps = FOLDER / f"grasps-{n_contacts}"
        # A blind grasp has some 3.5 contacts.
        n_grasps = n_contacts * 3 // 10 + 500
        words = ["--seed", 1, "--objects", "train", "--grasps", n_grasps, "--overwrite", "--out", grasps]
        programs.blindgrasp("simulate", *words)
        written = bench("contacts", n_contacts, path, *sorted(grasps.glob("*.mcap")), threads=1)
        if written["n_positions"] != n_contacts:
            path.unlink()
            sys.exit(f"{n_grasps} grasps have only {written['n_positions']} contacts, expected {n_contacts}")
    return path


def show(result):
    print(f"scikit-learn {result['versions']['scikit-learn']}; {result['n_positions']} positions ({result['n_distinct']} distinct)")
    restarted, same = result["restarted"], result["same_start"]
    figures.sides_table("medians of the rounds", FIGURES, restarted["medians"])
    print(f"{restarted['times_as_fast']:.1f} times as fast, inertia ratio {restarted['inertia_ratio']:.4f}")
    print("\nfrom the same starts (ours with its seeding, scikit-learn without):")
    rows = [[side, f"{same['secs'][side]:.2f} s", f"{same['best_inertia'][side]:.6f} m²"] for side in same["secs"]]
    figures.table(["", "time", "best inertia"], rows)
    print(f"{same['times_as_fast']:.1f} times as fast, inertia ratio {same['inertia_ratio']:.6f}, ", end="")
    print(f"largest relative difference of a restart's inertias {same['largest_difference']:.1e}")


def page(result):
    yield "K-means from the same start", "scikit-learn", 1 / result["same_start"]["times_as_fast"]
