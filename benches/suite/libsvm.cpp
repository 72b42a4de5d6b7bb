// LIBSVM for the subjects svm and libsvm: it times training and prediction alone, without reading files.
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
