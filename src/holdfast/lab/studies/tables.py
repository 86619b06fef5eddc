"""Tables as plain data: how a data frame travels between processes and into files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.errors import InvalidValueError

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Cell", "Columns", "columns_of", "frame_of", "to_csv"]

Cell = bool | int | float | str | None


class Columns(msgspec.Struct):
    """A data frame as plain data: named columns of the same length."""

    columns: dict[str, list[Cell]]


def columns_of(table: pd.DataFrame) -> Columns:
    """Return a data frame as plain data."""
    return Columns({str(name): table[name].tolist() for name in table.columns})


def frame_of(plain: Columns | Mapping[str, Any]) -> pd.DataFrame:
    """Return plain data as a data frame; InvalidValueError if the columns differ in length."""
    import pandas as pd

    try:
        return pd.DataFrame(plain.columns if isinstance(plain, Columns) else plain)
    except ValueError as error:
        raise InvalidValueError(f"columns that make no table: {error}") from error


def to_csv(table: pd.DataFrame) -> str:
    """Return a table as CSV; reading a number back gives the same number, and truth is 0 or 1."""
    truths = table.select_dtypes(bool).columns
    return str(table.astype(dict.fromkeys(truths, int)).to_csv(index=False, lineterminator="\n"))
