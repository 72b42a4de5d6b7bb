"""The samples of blindgrasp as they lie in shared memory: heads, items, enums' codes.

Generated from crates/messages; do not edit. What each field means is said there and in docs/messages.md.
Needs nothing but Python.
"""

import ctypes
import enum

MAX_JOINTS = 32
MAX_PADS = 32
MAX_CELLS = 16384
MAX_FEATURES = 4096
MAX_NAME_BYTES = 64


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


class Action(enum.IntEnum):
    HOLD = 0
    LIFT = 1
    SQUEEZE = 3
    TEST_LIFT = 4


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


class TactileFrameHead(ctypes.Structure):
    """The items are the joint angles, gravity, the wrench, the joints' torques, and then the cells' forces."""

    _fields_ = [
        ("header", Header),
        ("grasp_id", ctypes.c_uint64),
        ("phase", ctypes.c_uint32),
        ("n_joints", ctypes.c_uint32),
        ("n_gravity", ctypes.c_uint32),
        ("n_wrench", ctypes.c_uint32),
        ("n_torques", ctypes.c_uint32),
        ("day", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "blindgrasp/TactileFrameHead/4"


class ContactSetHead(ctypes.Structure):
    """The items are the contacts."""

    _fields_ = [
        ("header", Header),
        ("grasp_id", ctypes.c_uint64),
        ("phase", ctypes.c_uint32),
        ("n_pads_in_contact", ctypes.c_uint32),
        ("self_collision", ctypes.c_uint32),
        ("n_self_contacts", ctypes.c_uint32),
        ("fault", ctypes.c_uint32),
        ("n_joints", ctypes.c_uint32),
        ("joints_rad", ctypes.c_double * 32),
        ("n_gravity", ctypes.c_uint32),
        ("n_wrench", ctypes.c_uint32),
        ("n_torques", ctypes.c_uint32),
        ("day", ctypes.c_uint32),
        ("gravity_m_per_s2", ctypes.c_double * 3),
        ("wrist_wrench", ctypes.c_double * 6),
        ("joint_torques", ctypes.c_double * 32),
    ]

    @staticmethod
    def type_name() -> str:
        return "blindgrasp/ContactSetHead/6"


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
    TYPE_NAME = "blindgrasp/TactileFrame/4"
    Head = TactileFrameHead
    Item = ctypes.c_double


class ContactSet(Message):
    TYPE_NAME = "blindgrasp/ContactSet/6"
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
    TYPE_NAME = "blindgrasp/GraspTruth/1"
    Head = GraspTruthHead
    Item = ctypes.c_uint8


class LiftOutcome(Message):
    TYPE_NAME = "blindgrasp/LiftOutcome/4"
    Head = LiftOutcomeHead
    Item = ctypes.c_uint8


MESSAGES: dict[str, type[Message]] = {message.TYPE_NAME: message for message in Message.__subclasses__()}
