"""Our support vector machine beside LIBSVM on the features of simulated grasps, training and single predictions.

Both run in turn; times are medians of the rounds, of training and prediction alone, without reading files. LIBSVM has
one thread and, by default, as much cache as ours, 1000 MB (its own default is 100); ours has all cores for training and
one for a prediction. Both predict with our model. The first run simulates the grasps.
"""

import statistics

from . import figures
from . import libsvm_peer as libsvm
from .options import Option

OPTIONS = {
    "samples": Option(24640, "samples to train on", quick=400, least=100),
    "rounds": Option(3, "how often each side trains and predicts", quick=1, least=1),
    "cases": Option(("1:scale", "100:0.3"), "C:GAMMA, GAMMA a number or 'scale' (scikit-learn's)"),
    "tolerance": Option(1e-3, "of training", least=1e-12),
    "cache_mb": Option(1000.0, "LIBSVM's cache", least=1),
}
PAGE = {"samples": 6000}


def measure(options):
    libsvm.build()
    problem = libsvm.problem(options.samples)
    return {"libsvm": libsvm.version(), "cases": [of_case(problem, case, options) for case in options.cases]}


def of_case(problem, case, options):
    c, gamma = case.split(":")
    c, gamma = float(c), libsvm.gamma_scale(problem) if gamma == "scale" else float(gamma)
    machine = libsvm.FOLDER / "ours.model"
    trained = (problem, c, gamma, options.tolerance)
    sides = {
        "train, ours": lambda: libsvm.ours("train", *trained, machine),
        "train, LIBSVM": lambda: libsvm.run("train", *trained, options.cache_mb, libsvm.FOLDER / "libsvm.model"),
        "predict, ours": lambda: libsvm.ours("predict", machine.with_suffix(".json"), problem),
        "predict, LIBSVM": lambda: libsvm.run("predict", machine, problem, 200),
    }
    runs = figures.in_turn(options.rounds, sides)
    values = [runs[f"predict, {side}"][0]["decision_values"] for side in ("ours", "LIBSVM")]
    result = {"c": c, "gamma": gamma}
    result["largest_difference"] = max(abs(ours - others) for ours, others in zip(*values, strict=True))
    for side, rounds in runs.items():
        kept = {name: value for name, value in rounds[0].items() if isinstance(value, (int, float))}
        secs = [one["secs"] for one in rounds]
        result[side] = kept | {"secs": statistics.median(secs), "all_secs": secs}
    return result


def show(result):
    print(f"LIBSVM {result['libsvm']}")
    for case in result["cases"]:
        print(f"\nc {case['c']:g}, gamma {case['gamma']:.6g}")
        train = [case["train, ours"], case["train, LIBSVM"]]
        predict = [case["predict, ours"], case["predict, LIBSVM"]]
        rows = [
            ["train, s", *(f"{one['secs']:.2f}" for one in train), f"{train[1]['secs'] / train[0]['secs']:.1f}"],
            ["predict, µs", *(f"{1e6 * one['secs']:.2f}" for one in predict), f"{predict[1]['secs'] / predict[0]['secs']:.1f}"],
            ["objective", *(f"{one['objective']:.3f}" for one in train), ""],
            ["steps", *(one["n_iterations"] for one in train), ""],
            ["support vectors", *(one["n_support_vectors"] for one in train), ""],
        ]
        figures.table(["", "ours", "LIBSVM", "times as fast"], rows)
        print(f"decision values differ by at most {case['largest_difference']:.1e}")


def page(result):
    for case in result["cases"]:
        name = f"C {case['c']:g}, gamma {case['gamma']:.3g}"
        for what, words in (("train", "training an SVM"), ("predict", "predictions of an SVM")):
            yield f"{words}, {name}", "LIBSVM", case[f"{what}, ours"]["secs"] / case[f"{what}, LIBSVM"]["secs"]
