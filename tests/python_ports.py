#!/usr/bin/env python3
"""Operators in Python with several ports for the tests. Each notices if a sample does not come once and in order.

A standby may miss samples before it takes over, so that the active instance alone counts: an instance that takes over
what it has saved fails if a sample was missing there.

split: gives each frame twice. join: takes both streams and the truths, passes on the frames of one, and counts the truths.
check: reads what join has counted.
"""

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "operators"))
from blindgrasp_messages import ContactSet, GraspFeature, GraspFeatureHead, GraspTruth, TactileFrame
from blindgrasp_operator import Description, Stage, run

SPLIT = Description(
    "split", "Gives each frame twice", ("tactile", TactileFrame), outputs=[("a", TactileFrame), ("b", TactileFrame)]
)
JOIN = Description(
    "join",
    "Passes on one of two streams and counts truths",
    inputs=[("a", TactileFrame), ("b", TactileFrame), ("truth", GraspTruth)],
    outputs=[("tactile", TactileFrame, "a"), ("counted", GraspFeature)],
)
CHECK = Description("check", "Checks what was counted", ("counted", GraspFeature), ("contacts", ContactSet), answers_each=False)


class Numbers:
    """The number of samples of each port so far, and what was irregular, as the state of a stage."""

    def __init__(self):
        self.next, self.irregular = {}, ""

    def check(self, port, seq):
        expected = self.next.get(port, 0)
        if seq != expected:
            self.irregular = f"port {port}: sample {seq} came, expected {expected}"
        self.next[port] = seq + 1

    def state(self):
        return json.dumps([self.next, self.irregular]).encode()

    def restore(self, state):
        self.next, self.irregular = json.loads(state) if state else ({}, "")
        if self.irregular:
            raise RuntimeError(self.irregular)


def split(_params):
    return Stage(lambda head, items: {"a": (head, items), "b": (head, head.joints)}, max_items=160)


def join(_params):
    numbers = Numbers()

    def answer(port, head, items):
        numbers.check(port, head.header.seq)
        if port == "truth":
            counted = 0 if numbers.irregular else numbers.next[port]
            return {"counted": GraspFeatureHead(grasp_id=head.grasp_id, dictionary_id=counted)}
        return {"tactile": (head, items)} if port == "a" else None

    return Stage(answer, state=numbers.state, restore=numbers.restore, max_items={"tactile": 160})


def check(_params):
    numbers = Numbers()

    def answer(head, _items):
        numbers.check("counted", head.header.seq)
        if head.dictionary_id != head.header.seq + 1:
            raise RuntimeError(f"sample {head.header.seq} counts {head.dictionary_id} truths")

    return Stage(answer, state=numbers.state, restore=numbers.restore)


if __name__ == "__main__":
    run(*{"split": (SPLIT, split), "join": (JOIN, join), "check": (CHECK, check)}[sys.argv[1]])
