#!/usr/bin/env python3
"""Trains a scikit-learn classifier on the features of recorded grasps, for sklearn_classifier.py.

    blindgrasp export data/train --features models/barrett-bh8-280.json --out features.csv
    operators/train_sklearn.py features.csv --out forest.joblib

Any classifier of scikit-learn can be named, with its parameters: --classifier sklearn.svm.SVC --param C=10. Its
probabilities are calibrated, and everything is validated, on folds that keep each object on one side.
"""

import argparse
import csv
import importlib
import json
import os
import sys
from pathlib import Path

COLUMNS = ["recording", "grasp_id", "object", "object_class", "stable", "hand_id", "dictionary_id"]


def main():
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("features", type=Path, nargs="+", help="tables of `blindgrasp export --features`, all of one model")
    options.add_argument("--out", type=Path, required=True, help="where to write the model (joblib)")
    options.add_argument("--classifier", default="sklearn.ensemble.HistGradientBoostingClassifier")
    options.add_argument("--param", action="append", default=[], metavar="NAME=VALUE", help="a parameter of the classifier")
    options.add_argument("--calibration", choices=["sigmoid", "isotonic", "none"], default="sigmoid")
    options.add_argument("--threshold", type=float, default=0.5, help="stable from here on (0.5)")
    options.add_argument("--folds", type=int, default=5)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--json", action="store_true", help="print JSON")
    arguments = options.parse_args()
    if not 0 < arguments.threshold <= 1 or arguments.folds < 2:
        options.error("expected 0 < --threshold <= 1, --folds at least 2")
    try:
        summary = train(arguments)
    except (OSError, ValueError, TypeError, ImportError, AttributeError) as error:
        sys.exit(f"train_sklearn.py: {error}")
    if arguments.json:
        print(json.dumps(summary))
    else:
        print(f"{arguments.out}: {summary['classifier']} on {summary['n_grasps']} grasps of {summary['n_objects']} objects")
        print(
            f"cross-validated over {arguments.folds} folds of objects: accuracy {summary['accuracy']:.1%}, "
            f"false positives {summary['false_positive_share']:.1%} of the grasps, Brier score {summary['brier']:.4f}"
        )


def read(paths):
    """The tables: values, stable, objects, and the one hand and dictionary that they are of."""
    import numpy as np

    values, stable, objects, identities = [], [], [], set()
    for path in paths:
        with open(path, newline="") as file:
            rows = csv.reader(file)
            header = next(rows, [])
            if header[: len(COLUMNS)] != COLUMNS:
                raise ValueError(f"{path}: its columns are not those of `blindgrasp export --features`")
            for row in rows:
                objects.append(row[2])
                stable.append(int(row[4]))
                identities.add((row[5], row[6]))
                values.append(row[len(COLUMNS) :])
    if len(identities) != 1:
        raise ValueError(f"expected features of one model, found {len(identities)}: {sorted(identities)}")
    values, stable = np.array(values, dtype=float), np.array(stable)
    if len(set(stable)) != 2 or len(set(objects)) < 2:
        raise ValueError("expected stable and unstable grasps of at least two objects")
    return values, stable, np.array(objects), *identities.pop()


def build(arguments, folds):
    """The classifier, calibrated on folds of objects."""
    from sklearn.calibration import CalibratedClassifierCV

    module, _, name = arguments.classifier.rpartition(".")
    params = dict(param.split("=", 1) for param in arguments.param)
    params = {key: number_or_text(value) for key, value in params.items()}
    classifier = getattr(importlib.import_module(module or "sklearn.ensemble"), name)(**params)
    if "random_state" in classifier.get_params() and "random_state" not in params:
        classifier.set_params(random_state=arguments.seed)
    if arguments.calibration == "none":
        return classifier
    # One machine that has seen all, and not one for each fold: a prediction takes no longer than without calibration.
    return CalibratedClassifierCV(classifier, method=arguments.calibration, cv=folds, ensemble=False)


def number_or_text(text):
    try:
        return json.loads(text)
    except ValueError:
        return text


def train(arguments):
    # Threads that wait for each other by spinning make it many times slower on a machine that has other work.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    import joblib
    import numpy as np
    import sklearn
    from sklearn.model_selection import StratifiedGroupKFold
    from sklearn_classifier import FORMAT

    values, stable, objects, hand_id, dictionary_id = read(arguments.features)
    n_folds = min(arguments.folds, len(set(objects)))

    def folds_of(idx):
        splits = StratifiedGroupKFold(n_folds, shuffle=True, random_state=arguments.seed)
        return list(splits.split(values[idx], stable[idx], objects[idx]))

    everything = np.arange(len(stable))
    probabilities = np.zeros(len(stable))
    for train_idx, test_idx in folds_of(everything):
        machine = build(arguments, folds_of(train_idx)).fit(values[train_idx], stable[train_idx])
        probabilities[test_idx] = machine.predict_proba(values[test_idx])[:, 1]
    machine = build(arguments, folds_of(everything)).fit(values, stable)
    called = probabilities >= arguments.threshold
    summary = {
        "classifier": arguments.classifier,
        "n_grasps": len(stable),
        "n_objects": len(set(objects)),
        "accuracy": float(np.mean(called == stable)),
        "false_positive_share": float(np.mean(called & (stable == 0))),
        "brier": float(np.mean((probabilities - stable) ** 2)),
    }
    model = {
        "format": FORMAT,
        "classifier": machine,
        "hand_id": hand_id,
        "dictionary_id": dictionary_id,
        "n_values": values.shape[1],
        "threshold_probability": arguments.threshold,
        "sklearn_version": sklearn.__version__,
        "training": summary,
    }
    partial = arguments.out.with_name(arguments.out.name + ".partial")
    joblib.dump(model, partial)
    os.replace(partial, arguments.out)
    return summary


if __name__ == "__main__":
    main()
