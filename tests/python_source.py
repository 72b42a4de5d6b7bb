#!/usr/bin/env python3
"""A source in Python for the tests: plays the lines of `blindgrasp export`, as a recording or as a device.

As a recording it can give its samples again (`resume`). As a device each sample comes once, and its place is its state.
"""

import ctypes
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "operators"))
from blindgrasp_messages import SENSES, GraspTruth, GraspTruthHead, Phase, TactileFrame, TactileFrameHead
from blindgrasp_operator import Description, Param, Source, run

DESCRIPTION = Description(
    "python_source",
    "Plays the lines of an export",
    outputs=[("tactile", TactileFrame), ("truth", GraspTruth)],
    params=[
        Param("lines", "path"),
        Param("hand_id", "string"),
        Param("like", "choice", values=["recording", "device"]),
        Param("period_ms", "number", default=1.0, min=0, live=True),
        Param("repeat", "number", default=1, min=1),
        Param("max_items", "integer", default=160),
    ],
)


def sample_of(line):
    """A line's port, head and items, numbered within its epoch."""
    data = line["data"]
    if line["topic"] == "/truth":
        names = [data["object"].encode(), data["object_class"].encode()]
        fields = {key: data[key] for key in ("grasp_id", "epsilon", "volume", "stable")}
        port, head, items = "truth", GraspTruthHead(n_object_bytes=len(names[0]), **fields), b"".join(names)
    else:
        lists = [data[key] for key in ("joints", *SENSES, "cells_newtons")]
        lengths = {"n_joints": len(lists[0]), "has_senses": sum(1 << bit for bit, key in enumerate(SENSES) if data[key])}
        phase = Phase[data["phase"].upper()]
        values = [float("nan") if value is None else value for values in lists for value in values]
        head = TactileFrameHead(grasp_id=data["grasp_id"], phase=phase, day=data["day"], **lengths)
        port, items = "tactile", bytes((ctypes.c_double * len(values))(*values))
    head.header.epoch, head.header.seq, head.header.stamp_nanos = 7, line["seq"], line["stamp_nanos"]
    return port, head, items


def start(params):
    with open(params["lines"]) as lines:
        samples = [sample_of(json.loads(line)) for line in lines]
    numbers = {name: 1 + max(head.header.seq for port, head, _ in samples if port == name) for name in ("tactile", "truth")}
    n_grasps = 1 + max(head.grasp_id for _, head, _ in samples)
    n_nanos = 1_000_000_000 + max(head.header.stamp_nanos for _, head, _ in samples)
    place, due = 0, 0.0

    def next_sample():
        nonlocal place, due
        pause = due - time.monotonic()
        if pause > 0:
            time.sleep(min(pause, 0.02))
            return None
        repetition, idx = divmod(place, len(samples))
        if repetition >= params["repeat"]:
            raise StopIteration
        port, head, items = samples[idx]
        head = type(head).from_buffer_copy(head)
        head.header.hand_id = int(params["hand_id"], 16)
        head.header.seq += repetition * numbers[port]
        head.header.stamp_nanos += repetition * n_nanos
        head.grasp_id += repetition * n_grasps
        due = max(due, time.monotonic() - 0.1) + params["period_ms"] / 1e3
        place += 1
        return {port: (head, items)}

    def resume(last):
        """Begins with the repetition in which the reader furthest behind is."""
        nonlocal place
        place = len(samples) * min(0 if key is None else key[1] // numbers[port] for port, key in last.items())

    def restore(state):
        nonlocal place
        place = int(state or 0)

    common = {"identity": {"hand": params["hand_id"]}, "max_items": {"tactile": params["max_items"], "truth": 128}}
    if params["like"] == "recording":
        return Source(next_sample, resume=resume, **common)
    return Source(next_sample, state=lambda: str(place).encode(), restore=restore, **common)


if __name__ == "__main__":
    run(DESCRIPTION, start)
