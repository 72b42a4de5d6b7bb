"""Tables for pandas, which is needed by nothing else here."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ._program import answer_of
from ._types import Label

if TYPE_CHECKING:
    import pandas


def check_pandas() -> None:
    """Raises ModuleNotFoundError if pandas is not installed."""
    try:
        importlib.import_module("pandas")
    except ModuleNotFoundError as error:
        if error.name != "pandas":
            raise
        missing = "to_frame needs pandas, which is not installed: pip install pandas"
        raise ModuleNotFoundError(missing, name="pandas") from error


def table_of(columns: dict[str, Any]) -> pandas.DataFrame:
    """The columns as a table."""
    import pandas

    return pandas.DataFrame(columns)


def label_columns(labels: Sequence[Label | None]) -> dict[str, Any]:
    """The columns of labels."""
    import pandas

    known = [label or Label(False) for label in labels]
    # A column of bool cannot say that a label is not known.
    dtype = "boolean" if None in labels else "bool"
    return {
        "stable": pandas.array([label and label.is_stable for label in labels], dtype=dtype),
        "object": [label.object_id or None for label in known],
        "object_class": [label.object_class or None for label in known],
        "epsilon": [label.epsilon for label in known],
        "volume": [label.volume for label in known],
    }


def labels_of(table: Any) -> list[Label | None]:
    """The labels in the columns of `label_columns`; None for each row of a table without them."""
    names = ["stable", "object", "object_class", "epsilon", "volume"]
    columns = table.reindex(columns=names).astype(object)
    rows = columns.where(columns.notna(), None).to_dict("records")
    return [None if row["stable"] is None else Label.from_json(row | {"stable": bool(row["stable"])}) for row in rows]


def mean_of_rows(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean of each column without its NaN; NaN where there is no number."""
    n_known = np.sum(~np.isnan(rows), axis=0)
    means = np.full(rows.shape[1], np.nan)
    np.divide(np.nansum(rows, axis=0), n_known, out=means, where=n_known > 0)
    return means


def cells_of(hand: str) -> list[dict[str, Any]]:
    """A hand's cells with their pads, numbers and places, as the program tells them.

    Raises ProgramError if there is no such hand.
    """
    cells = answer_of(["info", "--json", "--", hand])
    if not isinstance(cells, list):
        raise ValueError(f"{hand} is no hand: expected the name of a built-in hand, or the path of a pad layout (YAML)")
    return cells


def cell_names(hand: str) -> list[str]:
    """The pads and numbers of a hand's cells, like `palm_0`."""
    return [f"{cell['pad']}_{cell['cell']}" for cell in cells_of(hand)]
