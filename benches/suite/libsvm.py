"""Whether our support vector machine agrees with LIBSVM and scikit-learn; the exit code is 1 if not.

It trains on the same features with both and compares the dual objectives (to 1e-3); exports a model and compares
decision values (to 1e-6) and probabilities with what LIBSVM and scikit-learn make of the file. The last lines are LIBSVM's numbers for the test `agrees_with_libsvm`.
"""

import json

from . import figures
from . import libsvm_peer as libsvm
from .options import Option

OPTIONS = {"samples": Option(2000, "samples to train on", quick=200, least=100)}
PACKAGES = {"numpy": "numpy", "sklearn": "scikit-learn"}


def measure(options):
    libsvm.build()
    problem = libsvm.problem(options.samples)
    checks = []

    def check(what, difference, limit):
        checks.append({"what": what, "difference": float(difference), "limit": limit, "is_good": bool(difference <= limit)})

    for c, gamma, tolerance in [(1, libsvm.gamma_scale(problem), 1e-3), (100, 0.3, 1e-3), (10, 3, 1e-4)]:
        name = f"c {c}, gamma {gamma:.4g}, tolerance {tolerance:g}"
        trained = libsvm.FOLDER / "trained.model"
        ours = libsvm.ours("train", problem, c, gamma, tolerance, trained)
        theirs = libsvm.run("train", problem, c, gamma, tolerance, 100, libsvm.FOLDER / "libsvm.model")
        check(f"objective, {name}", abs(ours["objective"] / theirs["objective"] - 1), 1e-3)
        compare_values(check, name, trained, problem)

    model = libsvm.paper_model()
    exported = libsvm.FOLDER / "exported.model"
    libsvm.ours("export", model, exported)
    machine = json.loads(model.read_text())["classifier"]["predictor"]["svm"]
    exported.with_suffix(".json").write_text(json.dumps(machine))
    compare_values(check, "a model by the paper's recipe", exported, problem)
    return {"checks": checks, "oracle": oracle()}


def compare_values(check, name, file, problem):
    import numpy

    ours = numpy.array(libsvm.ours("predict", file.with_suffix(".json"), problem)["decision_values"])
    theirs = libsvm.run("predict", file, problem, len(ours))
    check(f"decision values, LIBSVM, {name}", numpy.abs(ours - theirs["decision_values"]).max(), 1e-6)
    header, decision_function, n_features = scikit_learn_machine(file)
    samples = read_samples(problem.read_text().splitlines()[: len(ours)], n_features)
    check(f"decision values, scikit-learn, {name}", numpy.abs(ours - decision_function(samples)).max(), 1e-6)
    if theirs["probabilities"]:
        a, b = float(header["probA"]), float(header["probB"])
        expected = 1 / (1 + numpy.exp(a * ours + b))
        # LIBSVM keeps probabilities 1e-7 away from 0 and 1.
        check(f"probabilities, LIBSVM, {name}", numpy.abs(expected - theirs["probabilities"]).max(), 2e-7)


def read_samples(lines, n_features):
    import numpy

    samples = numpy.zeros((len(lines), n_features))
    for row, line in zip(samples, lines, strict=True):
        for word in line.split()[1:]:
            index, value = word.split(":")
            row[int(index) - 1] = float(value)
    return samples


def scikit_learn_machine(file):
    """scikit-learn's decision function with the numbers of LIBSVM's model file, which it cannot read itself."""
    import numpy
    from sklearn.svm import SVC

    head, _, support = file.read_text().partition("SV\n")
    header = dict(line.split(" ", 1) for line in head.splitlines())
    lines = support.splitlines()
    n_features = max(int(word.split(":")[0]) for line in lines for word in line.split()[1:])
    machine = SVC(gamma=float(header["gamma"])).fit(numpy.eye(2, n_features), [-1, 1])
    machine.support_vectors_ = read_samples(lines, n_features)
    machine.support_ = numpy.arange(len(lines), dtype=numpy.int32)
    machine._n_support = numpy.array([int(n) for n in header["nr_sv"].split()], dtype=numpy.int32)
    machine._dual_coef_ = machine.dual_coef_ = numpy.array([[float(line.split(" ", 1)[0]) for line in lines]])
    machine._intercept_ = machine.intercept_ = numpy.array([-float(header["rho"])])
    # scikit-learn turns LIBSVM's sign round for two classes, because its classes are sorted, the positive one last.
    # Its first class is the file's first label here, so it is turned back.
    return header, lambda samples: -machine._decision_function(samples), n_features


def oracle():
    """LIBSVM's objective and rho on made-up features, at tolerance 1e-5."""
    path = libsvm.FOLDER / "oracle.txt"
    with path.open("w") as file:
        for i in range(1500):
            features = [oracle_feature(i, column) for column in range(6)]
            positive = ((features[0] - 0.5) * (features[1] - 0.5) > 0) != (i % 10 == 5)
            words = " ".join(f"{column}:{feature!r}" for column, feature in enumerate(features, 1))
            file.write(f"{'+1' if positive else '-1'} {words}\n")
    # A negative sample first would make -1 LIBSVM's first label.
    assert path.read_text().startswith("+1")
    cases = []
    for c, gamma, weight in [(1.0, 0.5, 1.0), (100.0, 3.0, 1.0), (10.0, 2.0, 2.5)]:
        found = libsvm.run("train", path, c, gamma, 1e-5, 100, libsvm.FOLDER / "oracle.model", weight)
        cases.append([c, gamma, weight, found["objective"], found["rho"]])
    return cases


def oracle_feature(i, column):
    return ((i * i * (column + 1) * 37 + i * 101 * (column + 2)) % 1009) / 1009


def verdict(result):
    bad = [check["what"] for check in result["checks"] if not check["is_good"]]
    return f"disagreement: {'; '.join(bad)}" if bad else None


def show(result):
    rows = []
    for check in result["checks"]:
        rows.append([check["what"], f"{check['difference']:.1e}", f"{check['limit']:.0e}", "" if check["is_good"] else "FAIL"])
    figures.table(["difference of", "found", "at most", ""], rows)
    for case in result["oracle"]:
        print(f"({', '.join(map(repr, case))}),")
