"""The samples of blindgrasp as they lie in shared memory: heads, items, enums' codes.

Generated from crates/messages; do not edit. What each field means is said there and in docs/messages.md.
Needs nothing but Python.
"""

import ctypes
import enum
import typing

MAX_JOINTS = 32
MAX_PADS = 32
MAX_CELLS = 16384
MAX_FEATURES = 4096
MAX_NAME_BYTES = 64

# The senses of a frame in order, each with the number of its values; None: one for each joint.
SENSES: dict[str, int | None] = {"gravity_m_per_s2": 3, "wrist_wrench": 6, "joint_torques": None}


class Phase(enum.IntEnum):
    OPEN = 0
    CLOSING = 1
    SETTLED = 2
    ENDED = 3
    SQUEEZING = 4
    SQUEEZED = 5
    TEST_LIFTING = 6
    TEST_LIFTED = 7
    KEPT = 8
    DROPPED = 9
    LIFTING = 10


class Fault(enum.IntEnum):
    NONE = 0
    NO_CONTACT = 1
    WRONG_LENGTH = 2
    INVALID_VALUE = 3
    WRONG_HAND = 4
    SELF_COLLISION = 5
    MALFORMED = 6
    WRONG_MODEL = 7
    OUT_OF_DISTRIBUTION = 8
    MISSING_READING = 9
    NO_BASELINE = 10
    UNLIKE_DAY = 11
    SENSOR_FAULT = 12
    CHANGED = 13


class Action(enum.IntEnum):
    HOLD = 0
    LIFT = 1
    SQUEEZE = 3
    TEST_LIFT = 4
    TIGHTEN = 5
    SET_DOWN = 6
    GO_ON = 7


class Reason(enum.IntEnum):
    STABLE = 0
    UNSTABLE = 1
    NO_AGREEMENT = 2
    MISSING = 3
    OUT_OF_ORDER = 4
    STALE = 5
    NO_CONTACT = 6
    INVALID = 7
    SELF_COLLISION = 8
    WRONG_HAND = 9
    WRONG_MODEL = 10
    OUT_OF_DISTRIBUTION = 11
    UNSURE = 12
    LINK_DOWN = 13
    PROMISING = 14
    MISSING_READING = 15
    NO_BASELINE = 16
    UNLIKE_DAY = 17
    SENSOR_FAULT = 18
    PROMISE_WITHDRAWN = 19
    SLIPPING = 20


class Lists:
    """The lists among the items of a frame: `joints`, `cells`, and by name the `senses` that are there.

    Each can be set. A head that came with a sample has its `items`; give a head of your own its items first.
    """

    n_joints: int
    has_senses: int
    items: typing.Any

    def _spans(self) -> dict[str, slice]:
        if self.has_senses >> len(SENSES):
            raise ValueError(f"a frame has the unknown senses {self.has_senses}: expected at most {len(SENSES)} bits")
        spans, end = {"joints": slice(0, self.n_joints)}, self.n_joints
        for bit, (name, n_values) in enumerate(SENSES.items()):
            is_there = self.has_senses >> bit & 1
            start, end = end, end + is_there * (n_values or self.n_joints)
            spans[name] = slice(start, end)
        if end > len(self.items):
            raise ValueError(f"a frame of {len(self.items)} items says that it has {end} beside its cells: expected at most as many")
        spans["cells"] = slice(end, len(self.items))
        return spans

    def _set(self, lists: dict[str, typing.Any]) -> None:
        spans = self._spans()
        if all(len(values) == len(range(*spans[name].indices(len(self.items)))) for name, values in lists.items()):
            for name, values in lists.items():
                self.items[spans[name]] = values
            return
        parts = {name: lists.get(name, self.items[span]) for name, span in spans.items()}
        for name, n_values in SENSES.items():
            n_expected = n_values or len(parts["joints"])
            if len(parts[name]) not in (0, n_expected):
                raise ValueError(f"{name} has {len(parts[name])} values: expected {n_expected}, or none at all")
        values = [value for part in parts.values() for value in part]
        is_numpy = hasattr(self.items, "astype")
        self.items = type(self.items)(len(values)) if is_numpy else (ctypes.c_double * len(values))()
        self.items[:] = values
        self.n_joints = len(parts["joints"])
        self.has_senses = sum(1 << bit for bit, name in enumerate(SENSES) if len(parts[name]))

    @property
    def joints(self) -> typing.Any:
        """The joints' positions, in the hand's order: radians, and metres of joints that slide."""
        return self.items[self._spans()["joints"]]

    @joints.setter
    def joints(self, values: typing.Any) -> None:
        self._set({"joints": values})

    @property
    def cells(self) -> typing.Any:
        """The force on each cell, pad after pad."""
        return self.items[self._spans()["cells"]]

    @cells.setter
    def cells(self, values: typing.Any) -> None:
        self._set({"cells": values})

    @property
    def senses(self) -> dict[str, typing.Any]:
        """The lists of the other senses that the frame has, by name."""
        named = ((name, self.items[span]) for name, span in self._spans().items() if name not in ("joints", "cells"))
        return {name: values for name, values in named if len(values)}

    @senses.setter
    def senses(self, lists: dict[str, typing.Any]) -> None:
        unknown = lists.keys() - SENSES.keys()
        if unknown:
            raise ValueError(f"{', '.join(unknown)}: no such sense, expected some of {', '.join(SENSES)}")
        self._set({name: lists.get(name, ()) for name in SENSES})


class Header(ctypes.Structure):
    """On each sample: which one it is and where it comes from."""

    _fields_ = [
        ("seq", ctypes.c_uint64),
        ("stamp_nanos", ctypes.c_uint64),
        ("epoch", ctypes.c_uint64),
        ("hand_id", ctypes.c_uint64),
        ("origin_nanos", ctypes.c_uint64),
        ("valid_nanos", ctypes.c_uint64),
        ("made_by", ctypes.c_uint64),
    ]

    @staticmethod
    def type_name() -> str:
        return "blindgrasp/Header/2"


class Contact(ctypes.Structure):
    """One active cell, in the palm frame."""

    _fields_ = [
        ("position_m", ctypes.c_double * 3),
        ("normal", ctypes.c_double * 3),
        ("force_newtons", ctypes.c_double),
        ("pad", ctypes.c_uint32),
        ("cell", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "blindgrasp/Contact/1"


class TactileFrameHead(Lists, ctypes.Structure):
    """The items are the joints, the senses that `has_senses` names, and then the cells' forces."""

    _fields_ = [
        ("header", Header),
        ("grasp_id", ctypes.c_uint64),
        ("phase", ctypes.c_uint32),
        ("n_joints", ctypes.c_uint32),
        ("has_senses", ctypes.c_uint32),
        ("day", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "blindgrasp/TactileFrameHead/5"


class ContactSetHead(ctypes.Structure):
    """The items are the contacts. The first values of `senses` are those of the senses that `has_senses` names."""

    _fields_ = [
        ("header", Header),
        ("grasp_id", ctypes.c_uint64),
        ("phase", ctypes.c_uint32),
        ("n_pads_in_contact", ctypes.c_uint32),
        ("self_collision", ctypes.c_uint32),
        ("n_self_contacts", ctypes.c_uint32),
        ("fault", ctypes.c_uint32),
        ("n_joints", ctypes.c_uint32),
        ("has_senses", ctypes.c_uint32),
        ("day", ctypes.c_uint32),
        ("joints", ctypes.c_double * 32),
        ("senses", ctypes.c_double * 8 * 6),
    ]

    @staticmethod
    def type_name() -> str:
        return "blindgrasp/ContactSetHead/7"


class GraspFeatureHead(ctypes.Structure):
    """The items are the values, in the order of the model's feature blocks."""

    _fields_ = [
        ("header", Header),
        ("grasp_id", ctypes.c_uint64),
        ("dictionary_id", ctypes.c_uint64),
        ("phase", ctypes.c_uint32),
        ("n_pads_in_contact", ctypes.c_uint32),
        ("fault", ctypes.c_uint32),
        ("day", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "blindgrasp/GraspFeatureHead/4"


class PredictionHead(ctypes.Structure):
    """There are no items."""

    _fields_ = [
        ("header", Header),
        ("grasp_id", ctypes.c_uint64),
        ("decision_value", ctypes.c_double),
        ("probability_stable", ctypes.c_double),
        ("phase", ctypes.c_uint32),
        ("stable", ctypes.c_uint32),
        ("fault", ctypes.c_uint32),
        ("unsure", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "blindgrasp/PredictionHead/4"


class LiftDecisionHead(ctypes.Structure):
    """There are no items."""

    _fields_ = [
        ("header", Header),
        ("grasp_id", ctypes.c_uint64),
        ("probability_stable", ctypes.c_double),
        ("action", ctypes.c_uint32),
        ("reason", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "blindgrasp/LiftDecisionHead/3"


class GraspTruthHead(ctypes.Structure):
    """The items are the UTF-8 bytes of the object's name, then of its class."""

    _fields_ = [
        ("header", Header),
        ("grasp_id", ctypes.c_uint64),
        ("epsilon", ctypes.c_double),
        ("volume", ctypes.c_double),
        ("stable", ctypes.c_uint32),
        ("n_object_bytes", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "blindgrasp/GraspTruthHead/1"


class LiftOutcomeHead(ctypes.Structure):
    """The items are the UTF-8 bytes of the thing's name, then of its group."""

    _fields_ = [
        ("header", Header),
        ("grasp_id", ctypes.c_uint64),
        ("trial", ctypes.c_uint64),
        ("slip_m", ctypes.c_double),
        ("turn_rad", ctypes.c_double),
        ("epsilon", ctypes.c_double),
        ("volume", ctypes.c_double),
        ("mass_kg", ctypes.c_double),
        ("friction", ctypes.c_double),
        ("attempt", ctypes.c_uint32),
        ("lifted", ctypes.c_uint32),
        ("held", ctypes.c_uint32),
        ("has_quality", ctypes.c_uint32),
        ("n_thing_bytes", ctypes.c_uint32),
        ("probed", ctypes.c_uint32),
        ("disturbed", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "blindgrasp/LiftOutcomeHead/4"


class Message:
    """What travels along an edge: the name of its type, its head, an item."""

    TYPE_NAME: str
    Head: type[ctypes.Structure]
    Item: type


class TactileFrame(Message):
    TYPE_NAME = "blindgrasp/TactileFrame/5"
    Head = TactileFrameHead
    Item = ctypes.c_double


class ContactSet(Message):
    TYPE_NAME = "blindgrasp/ContactSet/7"
    Head = ContactSetHead
    Item = Contact


class GraspFeature(Message):
    TYPE_NAME = "blindgrasp/GraspFeature/4"
    Head = GraspFeatureHead
    Item = ctypes.c_double


class Prediction(Message):
    TYPE_NAME = "blindgrasp/Prediction/4"
    Head = PredictionHead
    Item = ctypes.c_uint8


class LiftDecision(Message):
    TYPE_NAME = "blindgrasp/LiftDecision/3"
    Head = LiftDecisionHead
    Item = ctypes.c_uint8


class GraspTruth(Message):
    TYPE_NAME = "blindgrasp/GraspTruth/2"
    Head = GraspTruthHead
    Item = ctypes.c_uint8


class LiftOutcome(Message):
    TYPE_NAME = "blindgrasp/LiftOutcome/4"
    Head = LiftOutcomeHead
    Item = ctypes.c_uint8


MESSAGES: dict[str, type[Message]] = {message.TYPE_NAME: message for message in Message.__subclasses__()}
