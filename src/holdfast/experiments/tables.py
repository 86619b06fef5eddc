"""Tables of numbers and words: what tasks come to, and what studies are read from."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence

import msgspec
import numpy as np
import numpy.typing as npt

from holdfast.errors import InvalidValueError

__all__ = ["Cell", "Table", "number_of"]

Cell = bool | int | float | str | None


class Table(msgspec.Struct):
    """Named columns of the same length.

    Attributes
    ----------
    columns : dict of str to list
        A cell is a number, a word, or None where there is nothing.
    """

    columns: dict[str, list[Cell]]

    @classmethod
    def of_rows(cls, names: Sequence[str], rows: Iterable[Sequence[Cell]]) -> Table:
        """Return the table of some rows.

        Raises
        ------
        InvalidValueError
            If a row has another number of cells than there are names.
        """
        table = cls({name: [] for name in names})
        for row in rows:
            if len(row) != len(names):
                raise InvalidValueError(f"a row of {len(row)} cells for {len(names)} columns")
            for name, cell in zip(names, row, strict=True):
                table.columns[name].append(cell)
        return table

    @classmethod
    def of_records(cls, records: Sequence[Mapping[str, Cell]]) -> Table:
        """Return the table of rows that name their cells; all have those of the first."""
        names = records[0] if records else {}
        return cls({name: [record[name] for record in records] for name in names})

    @property
    def num_rows(self) -> int:
        """Rows of the table."""
        return len(next(iter(self.columns.values()), []))

    def numbers(self, name: str) -> npt.NDArray[np.float64]:
        """Return a column as numbers; NaN where there is nothing."""
        return np.array(
            [np.nan if cell is None else cell for cell in self.columns[name]], dtype=np.float64
        )

    def rows(self) -> Iterator[dict[str, Cell]]:
        """Yield the rows."""
        for cells in zip(*self.columns.values(), strict=True):
            yield dict(zip(self.columns, cells, strict=True))

    def extend(self, other: Table, **constants: Cell) -> None:
        """Append the rows of another table, each with further cells that are the same in all.

        Raises
        ------
        InvalidValueError
            If the columns are others.
        """
        if not self.columns:
            self.columns = {name: [] for name in (*constants, *other.columns)}
        names = [*constants, *other.columns]
        if names != list(self.columns):
            raise InvalidValueError(f"columns {names} do not fit {list(self.columns)}")
        for name, cell in constants.items():
            self.columns[name].extend([cell] * other.num_rows)
        for name, cells in other.columns.items():
            self.columns[name].extend(cells)

    def to_csv(self) -> str:
        """Return the table as CSV; reading a number back gives the same number."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        for row in zip(*self.columns.values(), strict=True):
            writer.writerow([_plain(cell) for cell in row])
        return text.getvalue()


def number_of(cell: Cell) -> float:
    """Return a cell as a number; NaN where there is nothing."""
    return math.nan if cell is None else float(cell)


def _plain(cell: Cell) -> Cell:
    return int(cell) if isinstance(cell, bool) else cell
