"""The demo's picture: three bars that grow with time, and what happened last, in words.

A bar is made of cells, each a fraction of a second. A kill or a start is never lost between two
cells: it takes one for itself, if need be the next. Colours only repeat what the characters say, so
the picture is the same without them.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

from holdfast.printable import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    from holdfast.cli.chronicle import Chronicle, Line, Row, State

__all__ = [
    "ASCII",
    "UNICODE",
    "Characters",
    "LiveShow",
    "Piece",
    "PlainShow",
    "Show",
    "bars",
    "make_show",
    "plain_line",
]

_FRAMES_INTERVAL_S = 0.08
_LABEL_WIDTH = 8
_MIN_WIDTH = 40
_AROUND_LINES = 12
"""Rows of a frame that are not lines of the story."""

_INTERVALS_S = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600)
_MIN_TICK_CELLS = 8


class Piece(NamedTuple):
    """Characters in one style, as rich names it."""

    text: str
    style: str


class Characters(NamedTuple):
    """What a picture is drawn with."""

    start: str
    kill: str
    cells: Mapping[State, Piece]


_COLOURS: Mapping[State, str] = {
    "off": "",
    "starting": "dim",
    "ready": "dim",
    "deciding": "",
    "by_cloud": "black on green",
    "by_local": "black on yellow",
    "held": "black on red",
}


def _characters(start: str, deciding: str, ready: str) -> Characters:
    texts: Mapping[State, str] = {
        "off": " ",
        "starting": ".",
        "ready": ready,
        "deciding": deciding,
        "by_cloud": "C",
        "by_local": "L",
        "held": "!",
    }
    cells = {state: Piece(text, _COLOURS[state]) for state, text in texts.items()}
    return Characters(start, "X", cells)


UNICODE = _characters("▲", "█", "░")
ASCII = _characters("^", "#", "-")

_MEANINGS = {
    "standard": "the cloud decides, the local service was never needed",
    "local_recovery": "the local service decides, the cloud is tried again",
    "keep_alive": "the cloud decides, the local service stays ready",
}

_ROW_COLOURS: Mapping[Row, str] = {"cloud": "green", "local": "yellow", "robot": ""}


def bars(
    chronicle: Chronicle, now_s: float, width: int, characters: Characters
) -> list[list[Piece]]:
    """Draw the axis and the three bars.

    Parameters
    ----------
    chronicle : Chronicle
    now_s : float
        How far the bars reach.
    width : int
        Of the whole, in characters.
    characters : Characters

    Returns
    -------
    list of list of Piece
        Four lines, none of them longer than the width.
    """
    num_cells = max(_MIN_WIDTH, width) - _LABEL_WIDTH - 1
    # Never full while the story goes on, so that one sees that it does.
    cell_s = max(chronicle.expected_s, 1.02 * now_s) / num_cells
    lines = [_axis(num_cells, cell_s)]
    for row in chronicle.changes:
        cells = _cells_of(chronicle, row, now_s, num_cells, cell_s, characters)
        label = Piece(row.ljust(_LABEL_WIDTH), "bold")
        lines.append([label, *_joined(cells)])
    return lines


def _axis(num_cells: int, cell_s: float) -> list[Piece]:
    step_s = next((s for s in _INTERVALS_S if s / cell_s >= _MIN_TICK_CELLS), _INTERVALS_S[-1])
    text = ""
    number = 0
    while (position := round(number * step_s / cell_s)) < num_cells - len(
        label := f"{number * step_s} s"
    ):
        text = text.ljust(position) + label
        number += 1
    return [Piece(" " * _LABEL_WIDTH + text, "dim")]


def _cells_of(
    chronicle: Chronicle,
    row: Row,
    now_s: float,
    num_cells: int,
    cell_s: float,
    characters: Characters,
) -> list[Piece]:
    reached = min(num_cells, int(now_s / cell_s) + 1)
    cells = []
    changes = chronicle.changes[row]
    following = 0
    state: State = "off"
    for index in range(reached):
        held = state == "held"
        while following < len(changes) and int(changes[following].at_s / cell_s) <= index:
            state = changes[following].state
            held = held or state == "held"
            following += 1
        # A robot that stood still for less than a cell did so nevertheless.
        piece = characters.cells["held" if held else state]
        colour = _ROW_COLOURS[row] if state == "deciding" else ""
        cells.append(Piece(piece.text, piece.style or colour))
    taken: set[int] = set()
    for mark in sorted(chronicle.marks):
        if mark.row != row or mark.at_s > now_s:
            continue
        index = int(mark.at_s / cell_s)
        while index in taken:
            index += 1
        taken.add(index)
        cells += [characters.cells["off"]] * (index + 1 - len(cells))
        if mark.kind == "kill":
            cells[index] = Piece(characters.kill, "bold white on red")
        else:
            cells[index] = Piece(characters.start, "bold cyan")
    return cells[:num_cells]


def _joined(cells: Sequence[Piece]) -> list[Piece]:
    """Join neighbours of the same style."""
    pieces: list[Piece] = []
    for cell in cells:
        if pieces and pieces[-1].style == cell.style:
            pieces[-1] = Piece(pieces[-1].text + cell.text, cell.style)
        else:
            pieces.append(cell)
    return pieces


def legend(characters: Characters) -> list[Piece]:
    """Return the line that says what the characters mean."""
    deciding, ready = characters.cells["deciding"].text, characters.cells["ready"].text
    return [
        Piece(f"{deciding} decides  {ready} ready  ", "dim"),
        Piece(characters.start, "bold cyan"),
        Piece(" started  ", "dim"),
        Piece(characters.kill, "bold white on red"),
        Piece(" killed   ", "dim"),
        Piece("C", _COLOURS["by_cloud"]),
        Piece(" cloud decides  ", "dim"),
        Piece("L", _COLOURS["by_local"]),
        Piece(" local  ", "dim"),
        Piece("!", _COLOURS["held"]),
        Piece(" nobody", "dim"),
    ]


def plain_line(line: Line) -> str:
    """Return a line of the story: when, who, what."""
    return f"{line.at_s:6.2f} s  {line.who:<6} {line.text}"


class Show(Protocol):
    """Shows a story on the standard error, as it happens."""

    def say(self, line: Line) -> None:
        """Show a line."""
        ...

    def look(self, chronicle: Chronicle, now_s: float) -> None:
        """Show how things stand."""
        ...

    def stop(self) -> None:
        """End, and leave the terminal as it was; may be repeated."""
        ...

    def conclude(self, chronicle: Chronicle) -> None:
        """Leave behind what a person may want to look at afterwards."""
        ...


def make_show() -> Show:
    """Return what suits the standard error: a picture that moves, or lines."""
    if sys.stderr.isatty():
        from rich.console import Console

        console = Console(stderr=True, highlight=False)
        if console.is_terminal and not console.is_dumb_terminal:
            return LiveShow(console)
    return PlainShow()


class PlainShow:
    """A line for each thing that happens, for logs."""

    def say(self, line: Line) -> None:
        """Write a line."""
        sys.stderr.write(printable(plain_line(line)) + "\n")
        sys.stderr.flush()

    def look(self, chronicle: Chronicle, now_s: float) -> None:
        """Do nothing."""

    def stop(self) -> None:
        """Do nothing."""

    def conclude(self, chronicle: Chronicle) -> None:
        """Draw the bars, in plain characters."""
        lines = [
            "".join(piece.text for piece in line)
            for line in bars(chronicle, _end_of(chronicle), 79, ASCII)
        ]
        lines.append("".join(piece.text for piece in legend(ASCII)))
        sys.stderr.write("\n" + "".join(f"{line.rstrip()}\n" for line in lines))
        sys.stderr.flush()


class LiveShow:
    """A picture that moves, for people.

    Parameters
    ----------
    console : Console
        Of rich, on a terminal.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._unicode = (console.encoding or "").lower().startswith("utf")
        self._characters = UNICODE if self._unicode else ASCII
        self._live: Live | None = None
        self._drawn_at = 0.0
        self._fresh = True

    def say(self, line: Line) -> None:
        """Have it drawn soon."""
        del line
        self._fresh = True

    def look(self, chronicle: Chronicle, now_s: float) -> None:
        """Draw, if it is time to."""
        from rich.live import Live

        moment = time.monotonic()
        if not self._fresh and moment - self._drawn_at < _FRAMES_INTERVAL_S:
            return
        self._fresh = False
        self._drawn_at = moment
        if self._live is None:
            self._live = Live(console=self._console, auto_refresh=False, transient=True)
            self._live.start()
        self._live.update(self._frame(chronicle, now_s), refresh=True)

    def stop(self) -> None:
        """Take the picture away."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def conclude(self, chronicle: Chronicle) -> None:
        """Leave all lines, and the picture as it was in the end."""
        for line in sorted(chronicle.lines, key=_moment_of):
            self._console.print(self._text([_styled(line)]), soft_wrap=True)
        self._console.print()
        for pieces in self._picture(chronicle, _end_of(chronicle)):
            self._console.print(self._text(pieces))

    def _frame(self, chronicle: Chronicle, now_s: float) -> Text:
        from rich.text import Text

        width, height = self._console.size
        title = [Piece("holdfast demo", "bold"), Piece(f"  {chronicle.title}", "")]
        passed = f"{now_s:.1f} s"
        used = sum(len(piece.text) for piece in title)
        title.append(Piece(passed.rjust(max(len(passed) + 1, width - 1 - used)), "dim"))
        lines = [title, [], *self._picture(chronicle, now_s), []]
        for label, value, style in (
            ("status", f"{chronicle.status}: {_MEANINGS.get(chronicle.status, '')}", "bold"),
            ("robot", chronicle.progress, ""),
        ):
            lines.append([Piece(label.ljust(_LABEL_WIDTH), "dim"), Piece(value, style)])
        lines.append([])
        room = max(1, height - _AROUND_LINES - 1)
        lines += [[_styled(line)] for line in sorted(chronicle.lines, key=_moment_of)[-room:]]
        texts = [self._text(pieces) for pieces in lines]
        for text in texts:
            text.truncate(width - 1, overflow="ellipsis" if self._unicode else "crop")
        return Text("\n").join(texts)

    def _picture(self, chronicle: Chronicle, now_s: float) -> list[list[Piece]]:
        width = self._console.size.width
        drawn = bars(chronicle, now_s, width, self._characters)
        return [*drawn, legend(self._characters)]

    @staticmethod
    def _text(pieces: Sequence[Piece]) -> Text:
        from rich.text import Text

        return Text.assemble(*((piece.text, piece.style) for piece in pieces), no_wrap=True)


def _styled(line: Line) -> Piece:
    style = {"demo": "bold", "cloud": "green", "local": "yellow"}.get(line.who, "")
    return Piece(plain_line(line), style)


def _end_of(chronicle: Chronicle) -> float:
    return max((line.at_s for line in chronicle.lines), default=0.0)


def _moment_of(line: Line) -> float:
    """Return by what lines are ordered; those of the same moment stay as they were told."""
    return line.at_s
