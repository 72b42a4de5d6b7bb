"""LIBSVM for bench-svm and check-libsvm: Debian's library, unpacked into target/bench-svm (nothing is installed), with a
small program around it that times training and prediction alone, without reading files. Needs apt-get, dpkg and g++."""

import json
import subprocess
import sys
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent
FOLDER = PROJECT / "target" / "bench-svm"
PROGRAM = FOLDER / "libsvm"
SOURCE = r"""
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <sstream>
#include <vector>
#include <libsvm/svm.h>

static double now() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

int main(int argc, char** argv) {
    if (argc == 1) { printf("%d\n", libsvm_version); return 0; }
    bool train = argv[1][0] == 't';
    std::ifstream file(argv[train ? 2 : 3]);
    std::string line;
    std::vector<double> y;
    std::vector<std::vector<svm_node>> rows;
    while (std::getline(file, line)) {
        std::istringstream words(line);
        std::string word;
        words >> word;
        y.push_back(atof(word.c_str()));
        rows.emplace_back();
        while (words >> word) {
            char* end;
            int index = strtol(word.c_str(), &end, 10);
            rows.back().push_back({index, strtod(end + 1, nullptr)});
        }
        rows.back().push_back({-1, 0});
    }
    if (train) {  // train PROBLEM C GAMMA TOLERANCE CACHE_MB OUT [WEIGHT_OF_1]
        std::vector<svm_node*> x;
        for (auto& row : rows) x.push_back(row.data());
        svm_problem problem = {(int)y.size(), y.data(), x.data()};
        svm_parameter p = {};
        p.svm_type = C_SVC; p.kernel_type = RBF; p.shrinking = 1;
        p.C = atof(argv[3]); p.gamma = atof(argv[4]); p.eps = atof(argv[5]); p.cache_size = atof(argv[6]);
        int label = 1;
        double weight = argc > 8 ? atof(argv[8]) : 1;
        p.nr_weight = 1; p.weight_label = &label; p.weight = &weight;
        double start = now();
        svm_model* model = svm_train(&problem, &p);
        double secs = now() - start;
        svm_save_model(argv[7], model);
        printf("\n{\"secs\": %.9g, \"n_support_vectors\": %d}\n", secs, svm_get_nr_sv(model));
    } else {  // predict MODEL PROBLEM N
        svm_model* model = svm_load_model(argv[2]);
        if (!model) return 1;
        size_t n = std::min(rows.size(), (size_t)atoi(argv[4]));
        std::vector<double> values(n), probabilities(n);
        double estimates[2];
        bool has_probability = svm_check_probability_model(model);
        for (size_t i = 0; i < n; i++) {
            if (has_probability) svm_predict_probability(model, rows[i].data(), estimates);
            else svm_predict_values(model, rows[i].data(), &values[i]);
            probabilities[i] = has_probability ? estimates[0] : 0;
        }
        double start = now();
        for (size_t i = 0; i < n; i++) svm_predict_values(model, rows[i].data(), &values[i]);
        double secs = (now() - start) / n;
        printf("\n{\"secs\": %.9g, \"n_support_vectors\": %d, \"decision_values\": [", secs, svm_get_nr_sv(model));
        for (size_t i = 0; i < n; i++) printf("%s%.17g", i ? ", " : "", values[i]);
        printf("], \"probabilities\": [");
        for (size_t i = 0; has_probability && i < n; i++) printf("%s%.17g", i ? ", " : "", probabilities[i]);
        printf("]}\n");
    }
}
"""


def build():
    """Gets LIBSVM and compiles the program, unless it is there."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    source = FOLDER / "libsvm.cpp"
    if PROGRAM.exists() and source.read_text() == SOURCE:
        return
    print(f"unpacking Debian's libsvm-dev into {FOLDER}", file=sys.stderr)
    subprocess.run(["apt-get", "download", "-qq", "libsvm-dev"], cwd=FOLDER, check=True, stderr=subprocess.DEVNULL)
    (package,) = FOLDER.glob("libsvm-dev_*.deb")
    subprocess.run(["dpkg", "-x", package.name, "debian"], cwd=FOLDER, check=True)
    source.write_text(SOURCE)
    (library,) = (FOLDER / "debian" / "usr" / "lib").glob("*/libsvm.a")
    include = FOLDER / "debian" / "usr" / "include"
    command = ["g++", "-O2", "-I", include, source.name, library, "-o", PROGRAM]
    subprocess.run(command, cwd=FOLDER, check=True)


def run(*arguments):
    """What LIBSVM says, with the objective that it prints after training."""
    output = subprocess.run([PROGRAM, *map(str, arguments)], check=True, capture_output=True, text=True).stdout
    result = json.loads(output.strip().splitlines()[-1])
    for line in output.splitlines():
        if line.startswith("obj = "):
            objective, rho = line.split(",")
            result |= {"objective": float(objective.split("=")[1]), "rho": float(rho.split("=")[1])}
        if "#iter" in line:
            result["n_iterations"] = int(line.split("=")[1])
    return result


def version():
    return subprocess.run([PROGRAM], check=True, capture_output=True, text=True).stdout.strip()


def ours(*arguments):
    """What our bench program says to the same."""
    command = ["cargo", "bench", "--quiet", "--bench", "svm", "--", *map(str, arguments)]
    return json.loads(subprocess.run(command, cwd=PROJECT, check=True, stdout=subprocess.PIPE, text=True).stdout)


def blindgrasp(*arguments):
    command = ["cargo", "run", "--release", "--quiet", "--bin", "blindgrasp", "--", *map(str, arguments)]
    subprocess.run(command, cwd=PROJECT, check=True, stdout=sys.stderr)


def paper_model():
    """A model by the paper's recipe: of the few grasps of the project's recording, for its dictionary and its form."""
    model = FOLDER / "paper.json"
    if not model.exists():
        recording = PROJECT / "recordings" / "held-out.mcap"
        blindgrasp("train", recording, "--recipe", "paper", "--overwrite", "--out", model)
    return model


def problem(n_samples):
    """The paper's feature of that many simulated grasps."""
    path = FOLDER / f"problem-{n_samples}.txt"
    if not path.exists():
        recording = FOLDER / f"grasps-{n_samples}.mcap"
        # Some 17 % of blind grasps are not felt and have no feature.
        n_grasps = n_samples * 5 // 4 + 100
        blindgrasp("simulate", "--objects", "train", "--grasps", n_grasps, "--seed", 1, "--overwrite", "--out", recording)
        written = ours("features", recording, paper_model(), n_samples, path)
        if written["n_samples"] != n_samples:
            path.unlink()
            sys.exit(f"only {written['n_samples']} of {n_grasps} grasps were felt, expected {n_samples}")
    return path


def gamma_scale(path):
    """scikit-learn's gamma='scale': 1 / (n_features · variance of all features)."""
    n, total, squares, n_features = 0, 0.0, 0.0, 0
    for line in path.read_text().splitlines():
        n += 1
        for word in line.split()[1:]:
            index, value = word.split(":")
            n_features = max(n_features, int(index))
            total += float(value)
            squares += float(value) ** 2
    count = n * n_features
    return 1 / (n_features * (squares / count - (total / count) ** 2))
