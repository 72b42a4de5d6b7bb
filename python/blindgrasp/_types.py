"""The label of a grasp and the decision about it."""

from __future__ import annotations

import dataclasses
import math
import time
from typing import Any

# Actions that are told while the arm lifts.
WHILE_LIFTING = {"tighten", "set_down", "go_on"}


@dataclasses.dataclass(frozen=True)
class Label:
    """What is known to be true of a grasp. `docs/messages.md` describes the fields."""

    is_stable: bool
    epsilon: float = math.nan
    """The epsilon quality of the grasp wrench space; NaN if it was not computed."""
    volume: float = math.nan
    """The volume of the grasp wrench space; NaN if it was not computed."""
    object_id: str = ""
    """The object's name, like `mug-02`; empty if it is not known."""
    object_class: str = ""
    """The object's class, like `mug`; empty if it is not known."""

    @classmethod
    def from_json(cls, fields: dict[str, Any] | None) -> Label | None:
        """The label as `run --json` and `predict --json` print it (`truth`); None for null."""
        if fields is None:
            return None
        epsilon, volume = (fields.get(name) for name in ("epsilon", "volume"))
        return cls(
            is_stable=fields["stable"],
            epsilon=math.nan if epsilon is None else epsilon,
            volume=math.nan if volume is None else volume,
            object_id=fields.get("object") or "",
            object_class=fields.get("object_class") or "",
        )


@dataclasses.dataclass(frozen=True)
class Decision:
    """A decision of the arbiter about a grasp, recorded or live."""

    grasp_id: int
    action: str
    """`lift`, `hold`, `squeeze` or `test_lift`; while the arm lifts, `tighten`, `set_down` or `go_on`. Only `lift` allows
    a lift."""
    reason: str
    """Why, like `stable` or `out_of_order`: the reasons of `docs/messages.md`."""
    probability_stable: float
    """The lowest probability among the predictions that decided, from 0 to 1; 0 if none did."""
    seq: int
    """The decision's number, from 0."""
    stamp_nanos: int
    """Nanoseconds of the source's clock."""
    epoch: int | None = None
    """The generation of the source. Only recorded decisions have it."""
    latency_nanos: int | None = None
    """From the source to the decision, nanoseconds. Only live decisions have it."""
    valid_until_nanos: int | None = None
    """When the decision expires, nanoseconds of CLOCK_BOOTTIME. Only live decisions have it."""
    label: Label | None = None
    """The grasp's label, if the graph has one."""

    @classmethod
    def from_json(cls, fields: dict[str, Any]) -> Decision:
        """A decision as `blindgrasp run --json` prints it."""
        known = {field.name for field in dataclasses.fields(cls)}
        label = Label.from_json(fields.get("truth"))
        return cls(**{name: value for name, value in fields.items() if name in known}, label=label)

    def may_lift(self) -> bool:
        """Whether the arm may lift now: the action is `lift`, and the decision is live and has not expired."""
        if self.action != "lift" or self.valid_until_nanos is None:
            return False
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME) < self.valid_until_nanos
