#!/usr/bin/env python3
"""Operators in Python for the tests, of each kind that an operator in Rust can be.

senses: gives frames the senses of a partner input. watch: has no output, an optional input, and a state; it fails if a sample
is not there once and in order. hand: a source with a feedback input that sends the frames of a grasp when the grasp before is
decided. nag: answers silence and the end of the stream. plain: a classifier without a state. keeper: one that keeps the
state of the classifier in Rust. mortal: dies of one sample, of several that it gets at once.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "operators"))
sys.path.insert(0, str(Path(__file__).resolve().parent))
import python_source
from blindgrasp_messages import GraspFeature, LiftDecision, Prediction, PredictionHead, TactileFrame
from blindgrasp_operator import Description, Param, Source, Stage, counted, run
from python_ports import Numbers

SENSES = Description(
    "python_senses",
    "Gives frames the senses of another source",
    inputs=[("tactile", TactileFrame), ("senses", TactileFrame, "partner")],
    output=("tactile", TactileFrame),
    params=[Param("hand", "path")],
)
WATCH = Description(
    "watch",
    "Counts samples",
    inputs=[("prediction", Prediction), ("feature", GraspFeature, "optional"), ("other", LiftDecision, "optional")],
    params=[Param("told", "string", default="", live=True)],
)
HAND = Description(
    "python_hand",
    "Sends the frames of a grasp when the one before is decided",
    inputs=[("decision", LiftDecision, "feedback")],
    outputs=python_source.DESCRIPTION.outputs,
    params=python_source.DESCRIPTION.params,
)
NAG = Description("nag", "Answers silence", ("tactile", TactileFrame), ("prediction", Prediction), answers_each=False)
PLAIN = Description("plain", "Judges without a state", ("feature", GraspFeature), ("prediction", Prediction))
KEEPER = Description("keeper", "Keeps a state", ("feature", GraspFeature), ("prediction", Prediction))
MORTAL = Description("mortal", "Dies of a sample", ("feature", GraspFeature), ("prediction", Prediction))
# The grasp to which the answers of nag belong.
NAGS = 1_000_000


def senses(_params):
    def answer(frame, _items, senses):
        if senses is not None:
            frame.senses = frame.senses | senses[0].senses
        return frame

    return Stage(answer)


def watch(params):
    numbers = Numbers()

    def answer(port, head, _items):
        numbers.check(port, head.header.seq)
        if port == "prediction" and head.grasp_id == NAGS and head.decision_value == 0:
            raise RuntimeError("it was not looked at before it was sent")
        is_told = params["told"] == "yes"
        counted(**{f"n_{port}": numbers.next[port], "is_told": is_told})
        # From then on it is always behind, and its counts come all the same.
        time.sleep(0.002 * is_told)

    return Stage(answer, state=numbers.state, restore=numbers.restore)


def hand(params):
    """The place among the lines, and the last grasp that was decided."""
    with open(params["lines"]) as lines:
        samples = [python_source.sample_of(json.loads(line)) for line in lines]
    place, decided = 0, -1

    def next_sample():
        nonlocal place
        if place >= len(samples):
            raise StopIteration
        port, head, items = samples[place]
        # A grasp on which the votes do not agree is decided when the next one begins.
        if head.grasp_id > decided + 2:
            return None
        head.header.hand_id = int(params["hand_id"], 16)
        place += 1
        # A test that kills it must find it running.
        time.sleep(params["period_ms"] / 1e3)
        return {port: (head, items)}

    def receive(port, head, _items):
        nonlocal decided
        assert port == "decision", port
        decided = head.grasp_id

    def restore(state):
        nonlocal place, decided
        place, decided = json.loads(state) if state else (0, -1)

    state = lambda: json.dumps([place, decided]).encode()  # noqa: E731
    limits = {"tactile": params["max_items"], "truth": 128}
    identity = {"hand": params["hand_id"]}
    return Source(next_sample, receive=receive, state=state, restore=restore, max_items=limits, identity=identity, pause_secs=0.001)


def nag(_params):
    seen, said = 0, 0

    def answer(head, _items):
        nonlocal seen
        seen = head.header.stamp_nanos

    def say(now_nanos=0):
        nonlocal said
        made = PredictionHead(grasp_id=NAGS)
        made.header.epoch, made.header.seq, made.header.stamp_nanos = 1, said, seen
        made.header.origin_nanos = now_nanos
        said += 1
        return made

    def restore(state):
        nonlocal seen, said
        seen, said = json.loads(state) if state else (1, 0)

    deadline = lambda: time.clock_gettime_ns(time.CLOCK_BOOTTIME) + 20_000_000  # noqa: E731
    state = lambda: json.dumps([seen, said]).encode()  # noqa: E731
    look = lambda head, now_nanos: setattr(head, "decision_value", now_nanos)  # noqa: E731
    return Stage(
        answer, state=state, restore=restore, deadline=deadline, on_silence=say, on_end=say, before_sending=look
    )


def plain(_params):
    return Stage(lambda head, _items: PredictionHead(grasp_id=head.grasp_id, phase=head.phase, fault=head.fault))


def keeper(_params):
    kept = b""

    def restore(state):
        nonlocal kept
        if not state:
            raise ValueError("it has no state to keep")
        kept = state

    def answer(head, _items):
        return PredictionHead(grasp_id=head.grasp_id, phase=head.phase, fault=head.fault)

    return Stage(answer, state=lambda: kept, restore=restore)


def mortal(_params):
    """Answers several samples at once, and none of them if sample 100 is among them."""

    def answer_many(heads, _items):
        if any(head.header.seq == 100 for head in heads):
            os.kill(os.getpid(), signal.SIGSEGV)
        return [PredictionHead(grasp_id=head.grasp_id, phase=head.phase, fault=head.fault) for head in heads]

    return Stage(answer_many=answer_many)


if __name__ == "__main__":
    roles = {"senses": (SENSES, senses), "watch": (WATCH, watch), "hand": (HAND, hand), "nag": (NAG, nag),
             "plain": (PLAIN, plain), "keeper": (KEEPER, keeper), "mortal": (MORTAL, mortal)}
    run(*roles[sys.argv[1]])
