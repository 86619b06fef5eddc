"""A table as programs and papers take it: pandas, CSV, Markdown, LaTeX, HTML.

Programs get all columns and unrounded numbers (:meth:`Table.to_pandas`, :meth:`Table.to_csv`), one
value in a cell. People get fewer and wider cells, with intervals in them.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from holdfast.errors import HoldfastError
from holdfast.printable import cell
from holdfast.runtime.files import write_atomically

__all__ = ["Table", "cells", "csv_rows"]

_LATEX = {
    **{each: f"\\{each}" for each in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
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
        """Return the head and the rows for people."""
        raise NotImplementedError

    def legend(self) -> str:
        """Return how the numbers for people are defined."""
        return ""

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame``; it needs pandas (extra ``tune``)."""
        try:
            import pandas as pd
        except ImportError as error:
            raise HoldfastError("to_pandas needs pandas: pip install 'holdfast[tune]'") from error
        return pd.DataFrame(list(self.rows()), columns=list(self.columns()))

    def to_csv(self, path: str | Path | None = None) -> str:
        """Return comma-separated values. Reading a number back gives the same number."""
        return _written("".join(csv_rows(self.columns(), self.rows())), path)

    def to_markdown(self, path: str | Path | None = None) -> str:
        """Return a table in Markdown."""
        head, *rows = ([each.replace("|", r"\|") for each in row] for row in _aligned(self.shown()))
        rule = ["-" * len(each) for each in head]
        return _written("".join(f"| {' | '.join(row)} |\n" for row in (head, rule, *rows)), path)

    def to_latex(self, path: str | Path | None = None) -> str:
        """Return a ``tabular`` for LaTeX, which needs no package."""
        head, *rows = (
            " & ".join("".join(_LATEX.get(each, each) for each in text) for text in row) + r" \\"
            for row in self.shown()
        )
        columns = "l" + "r" * (len(self.shown()[0]) - 1)
        lines = [rf"\begin{{tabular}}{{{columns}}}", r"\hline", head, r"\hline", *rows]
        return _written("\n".join([*lines, r"\hline", r"\end{tabular}", ""]), path)

    def __str__(self) -> str:
        """Return aligned columns and the legend."""
        lines = ["  ".join(row).rstrip() for row in _aligned(self.shown())]
        return "\n".join([*lines, *filter(None, [self.legend()])])

    def __repr__(self) -> str:
        """Return what a console shows."""
        return str(self)

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        head, *rows = self.shown()
        cells = [[f"<td>{html.escape(each)}</td>" for each in row] for row in rows]
        names = "".join(f"<th>{html.escape(each)}</th>" for each in head)
        body = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
        legend = html.escape(self.legend()).replace("\n", "<br>")
        return f"<table><thead><tr>{names}</tr></thead><tbody>{body}</tbody></table><p>{legend}</p>"


def csv_rows(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> Iterator[str]:
    """Yield the lines of comma-separated values, the head first; only texts may need quotes.

    None is an empty cell, a truth value 0 or 1.
    """
    yield ",".join(columns) + "\n"
    for row in rows:
        texts = ("" if value is None else str(value) for value in cells(row))
        yield ",".join(map(_quoted, texts)) + "\n"


def cells(row: Iterable[object]) -> list[object]:
    """Return values as a CSV table has them: a truth value as 0 or 1, no text that is a formula."""
    return [int(value) if isinstance(value, bool) else cell(value) for value in row]


def _quoted(text: str) -> str:
    """Return a cell as RFC 4180 writes it."""
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\r\n') else text


def _written(text: str, path: str | Path | None) -> str:
    if path is not None:
        write_atomically(Path(path), text.encode())
    return text


def _aligned(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return the cells, padded to the widths of their columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [[f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)] for row in rows]
