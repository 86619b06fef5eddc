"""Tables as plain data, as which they travel and are kept, and as CSV."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd


Cell = bool | int | float | str | None

Columns = dict[str, list[Cell]]


def columns_of(table: pd.DataFrame) -> Columns:
    """Return the cells of each column, as Python's own numbers."""
    return {str(name): table[name].tolist() for name in table.columns}


def to_csv(table: pd.DataFrame) -> str:
    """Return a table as CSV; reading a number back gives the same number, and truth is 0 or 1."""
    truths = table.select_dtypes(bool).columns
    return str(table.astype(dict.fromkeys(truths, int)).to_csv(index=False, lineterminator="\n"))
