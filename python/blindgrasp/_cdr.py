"""Messages of recordings: CDR, as their definitions (ros2msg) lay it out.

A list of numbers becomes an array without a copy, so that a frame of thousands of cells costs as little as a small one.
What is not read: types that blindgrasp's frames, labels and decisions do not have, and big-endian CDR.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
NUMBERS = {"bool": "?", "uint32": "I", "uint64": "Q", "float64": "d"}


def decoder(definition: str) -> Callable[[bytes], Any]:
    """A function that reads messages of this definition; the fields become attributes.

    Raises ValueError if the definition has a type that is not read.
    """
    main, *others = definition.split("=" * 80)
    parts = dict(other.strip().removeprefix("MSG: ").split("\n", 1) for other in others)
    fields = _fields(main)
    nested = {kind: _fields(parts[kind]) for kind, _ in fields if kind in parts}
    for kind, name in [*fields, *(field for part in nested.values() for field in part)]:
        if kind not in NUMBERS and kind not in nested and kind not in ("string", "float64[]"):
            raise ValueError(f"the field {name} is of the type {kind}, which is not read here")

    def read(fields: list[tuple[str, str]], body: memoryview, at: int) -> tuple[SimpleNamespace, int]:
        message = SimpleNamespace()
        value: Any
        for kind, name in fields:
            if kind in nested:
                value, at = read(nested[kind], body, at)
            elif kind in NUMBERS:
                value, at = _number(NUMBERS[kind], body, at)
            elif kind == "string":
                n_bytes, at = _number("I", body, at)
                # The last byte is 0.
                value, at = str(body[at : at + n_bytes - 1], "utf-8"), at + n_bytes
            else:
                n_items, at = _number("I", body, at)
                # An empty list has no gap before its numbers.
                at += -at % 8 if n_items else 0
                value, at = np.frombuffer(body, "<f8", n_items, at), at + 8 * n_items
            setattr(message, name, value)
        return message, at

    def decode(data: bytes) -> Any:
        if not data.startswith(LITTLE_ENDIAN):
            raise ValueError("a message is not little-endian CDR")
        return read(fields, memoryview(data)[len(LITTLE_ENDIAN) :], 0)[0]

    return decode


def _fields(definition: str) -> list[tuple[str, str]]:
    """The types and names of a definition's fields."""
    lines = (line.partition("#")[0].split() for line in definition.splitlines())
    return [(words[0], words[1]) for words in lines if len(words) == 2]


def _number(code: str, body: memoryview, at: int) -> tuple[Any, int]:
    """The number at the next place that is a multiple of its size, and the place after it."""
    size = struct.calcsize(code)
    at += -at % size
    return struct.unpack_from(f"<{code}", body, at)[0], at + size
