"""Tables and bars: what a measurement leaves, and how it reads on the terminal and in a file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rich.console import Console
from rich.table import Table as RichTable

__all__ = [
    "Bar",
    "Result",
    "Table",
    "markdown_of",
    "milliseconds",
    "paragraph",
    "show",
]


class Bar(NamedTuple):
    """A figure that was asked for.

    Attributes
    ----------
    at_least : bool
        Whether the value must reach the limit; else it must not be above it.
    percentile_99 : float or None
        Where the value is a median and was taken often. The verdict is the median's; it says so if
        the 99th percentile would have another.
    """

    what: str
    value: float
    limit: float
    unit: str
    at_least: bool = False
    percentile_99: float | None = None

    @property
    def met(self) -> bool:
        """Whether the value is on the right side of the limit."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit

    def _verdict(self) -> str:
        if not self.met:
            return "**miss**"
        rare = self.percentile_99
        return "pass" if rare is None or rare <= self.limit else "median passes"

    def cells(self, command: str) -> list[str]:
        """Return the bar as a row of a table, with the name of what measures it."""
        bound = "at least" if self.at_least else "at most"
        return [
            self.what,
            f"{self.value:.3g} {self.unit}".rstrip(),
            "" if self.percentile_99 is None else f"{self.percentile_99:.3g} {self.unit}".rstrip(),
            f"{bound} {self.limit:g} {self.unit}".rstrip(),
            self._verdict(),
            command,
        ]


class Table(NamedTuple):
    """Rows of text under a header; the first column is text, the others are numbers."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]


class Result(NamedTuple):
    """What one measurement found: paragraphs and tables in order, and its bars."""

    content: Sequence[str | Table]
    bars: Sequence[Bar] = ()


BARS_HEADER = ("what", "measured", "99 %", "bar", "verdict", "case")


def milliseconds(seconds: float) -> str:
    """Return a time in milliseconds with three significant digits."""
    value = seconds * 1e3
    return f"{value:.0f}" if value >= 1000.0 else f"{value:.3g}"


def paragraph(text: str) -> str:
    """Return a text with every run of white space made one space."""
    return " ".join(text.split())


def markdown_of(table: Table) -> str:
    """Return a table in Markdown, its columns aligned for those who read the source."""
    rows = [list(table.header), *[list(row) for row in table.rows]]
    widths = [max(3, *(len(row[column]) for row in rows)) for column in range(len(table.header))]

    def line(cells: Sequence[str]) -> str:
        padded = [cells[0].ljust(widths[0])]
        padded += [cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True)]
        return "| " + " | ".join(padded) + " |"

    rule = "|" + "|".join(
        "-" * (width + 2) if column == 0 else "-" * (width + 1) + ":"
        for column, width in enumerate(widths)
    )
    return "\n".join([line(rows[0]), rule + "|", *[line(row) for row in rows[1:]]])


def show(console: Console, content: Sequence[str | Table]) -> None:
    """Print paragraphs and tables on the terminal."""
    for part in content:
        if isinstance(part, str):
            console.print(part, markup=False, highlight=False)
            continue
        table = RichTable(show_edge=False, pad_edge=False)
        for column, name in enumerate(part.header):
            table.add_column(name, justify="left" if column == 0 else "right")
        for row in part.rows:
            table.add_row(*[cell.replace("**", "") for cell in row])
        console.print(table)
