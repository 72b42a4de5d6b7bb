"""The options of subjects."""

from pathlib import Path
from typing import NamedTuple

# The default of an option that has none: it must be given.
REQUIRED = None


class Option(NamedTuple):
    """One option. Its default says what it is: a number, a path, a text, or a tuple, which is written with commas."""

    default: object
    about: str
    quick: object = None
    least: float | None = None

    def parse(self, text):
        if isinstance(self.default, tuple):
            return tuple(type(self.default[0])(word) for word in text.split(",") if word)
        if self.default is REQUIRED:
            return Path(text).resolve()
        kind = Path if isinstance(self.default, Path) else type(self.default)
        value = kind(text)
        return value.resolve() if kind is Path else value

    def is_allowed(self, value):
        if self.least is None:
            return True
        values = value if isinstance(value, tuple) else (value,)
        return all(one >= self.least for one in values)
