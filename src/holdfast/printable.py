r"""Untrusted text, escaped for a terminal or a spreadsheet.

A terminal executes control characters: an escape sequence in a service's message, a key of a file
or an exception's text can clear the screen, set the window's title, or overwrite an error message.
So untrusted text is escaped before it is printed: ``\x1b[2J``. A newline in what a peer says would
begin a line that looks like one of ours; its words are made one line where they come in.

A spreadsheet takes a cell that begins with ``=``, ``+``, ``-`` or ``@`` for a formula, which may
run a program. An apostrophe before it says that it is a text.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence


def printable(text: str, *, keep: str = "\n\t") -> str:
    """Return the text with each unprintable character escaped."""
    if text.isprintable():
        return text
    return "".join(
        letter
        if letter.isprintable() or letter in keep
        else letter.encode("unicode_escape").decode()
        for letter in text
    )


def one_line(text: str) -> str:
    """Return the text on one line, with every other unprintable character escaped."""
    return printable(" ".join(text.split()), keep="")


def brief(value: object, most: int = 80) -> str:
    """Return a value as Python writes it, on one line; ``...`` stands where a long one is cut."""
    return cut(one_line(repr(value)), most)


def cut(text: str, most: int) -> str:
    """Return a text of at most so many characters, cut between words, with ``...`` there.

    Of a path the end says more than the beginning, so both are kept.
    """
    if len(text) <= most:
        return text
    if "/" in text and " " not in text:
        begin, end = text[: most // 4], text[most // 4 + 3 - most :]
        return f"{begin[: begin.rfind('/') + 1]}...{end[max(0, end.find('/')) :]}"
    begin = text[: most - 3]
    whole = re.match(r".*(?=[\s,])", begin)
    return f"{whole[0] if whole and len(whole[0]) > most // 2 else begin}..."


def did_you_mean(text: str, known: Iterable[str], most: int = 1, sure: Sequence[str] = ()) -> str:
    """Return a question after the ``sure`` words, else after the nearest known ones, if any."""
    import difflib  # for a mistake alone

    close = sure or difflib.get_close_matches(text, list(known), n=most)
    return f"; did you mean {' or '.join(close)}?" if close else ""


def cell(value: object) -> object:
    """Return a value for a CSV table; of a text that a spreadsheet would run, with an apostrophe.

    Texts of numbers stay as they are.
    """
    if not isinstance(value, str) or not value.startswith(("=", "+", "-", "@", "\t", "\r")):
        return value
    try:
        numbers = [float(each) for each in value.split()]
    except ValueError:
        return f"'{value}"
    return value if numbers else f"'{value}"


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
