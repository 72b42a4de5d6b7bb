#!/usr/bin/env python3
"""Stands for the program `blindgrasp` in tests: it answers `predict` by a rule, and leaves all else to STUB_FOR.

The rule: a grasp is lifted if its settled cells feel more than 2 N together, in the first settled frame.
"""

import json
import os
import subprocess
import sys

LIMIT_NEWTONS = 2.0

if sys.argv[1] != "predict":
    os.execv(os.environ["STUB_FOR"], [os.environ["STUB_FOR"], *sys.argv[1:]])
model, *files = [argument for argument in sys.argv[2:] if argument != "--json"]
assert os.path.isfile(model), model
for file in files:
    labels = {}
    if file == "-":
        lines = sys.stdin
    else:
        topics = ["--topic", "/tactile", "--topic", "/truth"]
        exported = subprocess.run([os.environ["STUB_FOR"], "export", file, *topics], stdout=subprocess.PIPE)
        if exported.returncode:
            sys.exit(exported.returncode)
        lines = exported.stdout.splitlines()
    frames = {}
    for line in map(json.loads, lines):
        data = line["data"]
        if line["topic"] == "/truth":
            label = {"is_stable": data["stable"], "object_id": data["object"], "class": data["class"]}
            labels[data["grasp_id"]] = label
        elif data["phase"] == "settled":
            frames.setdefault(data["grasp_id"], data["cells_newtons"])
    for grasp_id, cells_newtons in frames.items():
        is_lifted = sum(newtons or 0.0 for newtons in cells_newtons) > LIMIT_NEWTONS
        answer = {
            "file": file,
            "grasp_id": grasp_id,
            "action": "lift" if is_lifted else "hold",
            "reason": "stable" if is_lifted else "unstable",
            "probability_stable": 0.9 if is_lifted else 0.1,
            "label": labels.get(grasp_id),
        }
        print(json.dumps(answer))
