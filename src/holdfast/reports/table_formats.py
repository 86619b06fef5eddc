"""A table as programs and papers take it: pandas, CSV, Markdown, LaTeX, HTML.

Programs get all columns and unrounded numbers (:meth:`Table.to_pandas`, :meth:`Table.to_csv`), one
value in a cell. People get fewer and wider cells, with intervals in them, rounded.
"""

from __future__ import annotations

import html
import itertools
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from holdfast.errors import HoldfastError, InvalidValueError, how_to_install
from holdfast.printable import brief, csv_rows
from holdfast.runtime.files import write_atomically
from holdfast.validation import as_path

TIMES = "\N{MULTIPLICATION SIGN}"

_LATEX = {
    **{each: f"\\{each}" for each in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    TIMES: r"$\times$",
}


class Table:
    """A table in several formats; a derived class says what is in it.

    ``to_csv``, ``to_markdown`` and ``to_latex`` return a text, and write it to a path if they get
    one, whole or not at all.
    """

    def columns(self) -> Sequence[str]:
        """Return the names of the columns, for programs."""
        raise NotImplementedError

    def rows(self) -> Iterable[Sequence[object]]:
        """Return the rows, for programs; None where there is no value."""
        raise NotImplementedError

    def shown(self) -> list[tuple[str, ...]]:
        """Return the head and the rows for people; a second line of a cell is beneath its value."""
        raise NotImplementedError

    def names(self) -> Sequence[str]:
        """Return the names by which the columns for people are chosen."""
        return self.shown()[0]

    def legend(self) -> str:
        """Return how the numbers for people are defined; a column's lines begin with its title."""
        return ""

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame``; it needs pandas (extra ``tune``)."""
        try:
            import pandas as pd
        except ImportError as error:
            raise HoldfastError(f"to_pandas: {how_to_install('pandas', 'tune')}") from error
        return pd.DataFrame(list(self.rows()), columns=list(self.columns()))

    def to_csv(self, path: str | Path | None = None) -> str:
        """Return comma-separated values. Reading a number back gives the same number."""
        return _written("".join(csv_rows(self.columns(), self.rows())), path)

    def to_markdown(
        self, path: str | Path | None = None, *, columns: Sequence[str] | None = None
    ) -> str:
        """Return a table in Markdown, and its legend; ``columns`` as :meth:`to_latex` has them."""
        head, *rows = (
            [each.replace("|", r"\|") for each in row] for row in aligned(self._chosen(columns))
        )
        rule = ["-" * len(each) for each in head]
        table = "".join(f"| {' | '.join(row)} |\n" for row in (head, rule, *rows))
        return _written(table + "".join(f"\n{line}\n" for line in self._notes(columns)), path)

    def to_latex(
        self, path: str | Path | None = None, *, columns: Sequence[str] | None = None
    ) -> str:
        """Return a ``tabular`` for LaTeX, small, with its legend beneath; it needs no package.

        Parameters
        ----------
        columns : sequence of str, optional
            Which of :meth:`names` to show, beside the first one, and in which order.

        Raises
        ------
        InvalidValueError
            If there is no such column; the message has the names.
        """
        head, *rows = self._chosen(columns)
        lines = [rf"{{\footnotesize\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}", r"\hline"]
        for row in (head, *rows):
            # What is beneath a value gets a row of its own.
            stacked = itertools.zip_longest(*(each.split("\n") for each in row), fillvalue="")
            lines += [" & ".join(map(_in_latex, texts)) + r" \\" for texts in stacked]
            lines += [r"\hline"] * (row is head)
        notes = r" \par ".join(map(_in_latex, self._notes(columns)))
        beneath = [rf"\par\smallskip {notes}"] if notes else []
        return _written("\n".join([*lines, r"\hline", r"\end{tabular}", *beneath, "}", ""]), path)

    def _chosen(self, columns: Sequence[str] | None) -> list[tuple[str, ...]]:
        shown, names = self.shown(), list(self.names())
        if columns is None:
            return shown
        if not isinstance(columns, list | tuple):
            columns = [columns]  # type: ignore[list-item]
        for each in columns:
            if not isinstance(each, str) or each not in names[1:]:
                allowed = ", ".join(names[1:])
                raise InvalidValueError(f"columns has {brief(each)}; allowed are {allowed}")
        kept = [0, *map(names.index, columns)]
        return [tuple(row[at] for at in kept) for row in shown]

    def _notes(self, columns: Sequence[str] | None = None) -> list[str]:
        """Return the lines of the legend, without those about columns that are not shown."""
        heads = dict(zip(self.names(), self.shown()[0], strict=True))
        out = {head for name, head in heads.items() if name not in (columns or heads)}
        return [line for line in self.legend().splitlines() if line.split(":")[0] not in out]

    def __str__(self) -> str:
        """Return aligned columns and the legend."""
        lines = ["  ".join(row).rstrip() for row in aligned(self.shown())]
        return "\n".join([*lines, *self._notes()])

    def __repr__(self) -> str:
        """Return what a console shows."""
        return str(self)

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        body = ""
        for row in self.shown():
            tag = "td" if body else "th"
            cells = "".join(f"<{tag}>{_in_html(each)}</{tag}>" for each in row)
            body += f"<tr>{cells}</tr>"
        return f"<table>{body}</table><p>{_in_html(self.legend())}</p>"


def _written(text: str, path: str | Path | None) -> str:
    if path is not None:
        write_atomically(as_path("path", path), text.encode())
    return text


def decimals(bounds: Sequence[float]) -> int:
    """Return how many decimals an interval leaves to a value: those of a quarter of its width."""
    width = 0.25 * (bounds[1] - bounds[0])
    return min(6, max(0, -math.floor(math.log10(width)))) if width > 0.0 else 3


def rounded(value: float, digits: int) -> float:
    """Return a value with so many decimals; a tie goes away from zero, as people expect."""
    scale = 10.0**digits
    size = math.floor(abs(value) * scale * (1.0 + 1e-12) + 0.5) / scale
    return math.copysign(size, value) + 0.0  # no -0


def outward(bounds: Sequence[float], digits: int) -> tuple[float, float]:
    """Return an interval with so many decimals that holds the whole of the given one."""
    scale = 10.0**digits
    slack = 1e-9 * max(1.0, *(abs(scale * end) for end in bounds))
    low, high = (scale * end for end in bounds)
    return math.floor(low + slack) / scale, math.ceil(high - slack) / scale


def _in_html(text: str) -> str:
    return html.escape(text).replace("\n", "<br>")


def _in_latex(text: str) -> str:
    escaped = "".join(_LATEX.get(each, each) for each in text)
    return re.sub(r"(?<![\w.])-(?=\d)", "$-$", escaped)


def aligned(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return the cells, padded to the widths of their columns; what is beneath, in brackets."""
    flat = [[re.sub(r"\n(.+)", r" (\1)", cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*flat, strict=True)]
    return [[f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)] for row in flat]
