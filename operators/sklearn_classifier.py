#!/usr/bin/env python3
"""Predicts from each frame's feature whether the grasp is stable, by a scikit-learn model of `train_sklearn.py`.

In a running graph: blindgrasp swap classifier --run operators/sklearn_classifier.py --set model=forest.joblib
Needs operators/requirements.txt. A model file is a pickle: load none that you don't trust.
"""

# This import comes first: it restarts the program in .venv, which has the others.
from blindgrasp_operator import Description, Param, Stage, fault_of, run
from blindgrasp_messages import Fault, GraspFeature, Prediction, PredictionHead

import math
import os

FORMAT = "blindgrasp-sklearn/1"

DESCRIPTION = Description(
    "sklearn_classifier",
    "Predicts from each frame's feature whether the grasp is stable, by a scikit-learn model",
    input=("feature", GraspFeature),
    output=("prediction", Prediction),
    params=[Param("model", "path", "The model file (joblib) that train_sklearn.py has made")],
)


def load(path):
    """Reads a model file: a dict with the classifier and its training data's identity."""
    # For one sample at a time, several threads would only wait for each other.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    import joblib
    import sklearn

    try:
        model = joblib.load(path)
    except Exception as error:
        raise RuntimeError(f"{path}: not a model of train_sklearn.py ({type(error).__name__}: {error})") from error
    found = model.get("format") if isinstance(model, dict) else type(model).__name__
    if found != FORMAT:
        raise RuntimeError(f"{path}: its format is {found!r}, expected {FORMAT!r}: train it with train_sklearn.py")
    if model["sklearn_version"] != sklearn.__version__:
        raise RuntimeError(
            f"{path}: made with scikit-learn {model['sklearn_version']}, and this is {sklearn.__version__}, which may read it "
            "wrongly: train it again, or install that version"
        )
    # The operators before this one have checked each sample.
    sklearn.set_config(assume_finite=True, skip_parameter_validation=True)
    return model


def start(params):
    import numpy as np

    model = load(params["model"])
    classifier, threshold = model["classifier"], model["threshold_probability"]
    hand_id, dictionary_id = int(model["hand_id"], 16), int(model["dictionary_id"], 16)
    stable_column = list(classifier.classes_).index(1)

    def fault(head, values):
        """Why a sample cannot be judged, as operators/classifier.rs says it."""
        if (given := fault_of(head)) == Fault.MALFORMED:
            return given
        if head.header.hand_id != hand_id:
            return Fault.WRONG_HAND
        if head.dictionary_id != dictionary_id:
            return Fault.WRONG_MODEL
        if given != Fault.NONE:
            return given
        if len(values) != model["n_values"]:
            return Fault.WRONG_LENGTH
        return Fault.NONE if np.isfinite(values).all() else Fault.INVALID_VALUE

    def answer_many(heads, values):
        faults = [fault(*sample) for sample in zip(heads, values)]
        judged = [values[idx] for idx, fault in enumerate(faults) if fault == Fault.NONE]
        probabilities = iter(classifier.predict_proba(np.stack(judged))[:, stable_column].tolist() if judged else [])
        answers = []
        for head, fault_code in zip(heads, faults):
            answer = PredictionHead(grasp_id=head.grasp_id, phase=head.phase, fault=fault_code)
            if fault_code == Fault.NONE:
                answer.probability_stable = probability = next(probabilities)
                answer.decision_value = logit(probability)
                answer.stable = probability >= threshold
            answers.append(answer)
        return answers

    # The first prediction takes long: not while a sample waits.
    classifier.predict_proba(np.zeros((1, model["n_values"])))
    return Stage(answer_many=answer_many, identity={"hand": model["hand_id"], "dictionary": model["dictionary_id"]})


def logit(probability):
    """Positive on the stable side, finite."""
    bounded = min(max(probability, 1e-9), 1 - 1e-9)
    return math.log(bounded / (1 - bounded))


if __name__ == "__main__":
    run(DESCRIPTION, start)
