"""The demo's timeline: three bars that grow with time, and the last lines below them.

A bar is made of cells, each a fraction of a second. Each kill and each start takes a cell for
itself, if need be the next, so none is lost between two cells. Colours only repeat what the
characters say.
"""

from __future__ import annotations

import io
import itertools
import sys
from collections.abc import Mapping
from typing import Literal, TypeAlias

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from holdfast.printable import printable
from holdfast.protocol.status import MEANINGS
from holdfast_lab.demo.narrator import Activity, DemoState, Line, Row

_FRAMES_HZ = 12
_LABEL_WIDTH = 8
_MIN_WIDTH = 40
_AROUND_LINES = 12
"""Rows of a frame that are no lines."""

_INTERVALS_S = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600)
_MIN_TICK_CELLS = 8


Shown: TypeAlias = Activity | Literal["start", "kill"]

ASCII: Mapping[Shown, str] = {
    "off": " ",
    "starting": ".",
    "ready": "-",
    "deciding": "#",
    "by_cloud": "C",
    "by_local": "L",
    "held": "!",
    "start": "^",
    "kill": "X",
}
UNICODE: Mapping[Shown, str] = {**ASCII, "ready": "░", "deciding": "█", "start": "▲"}

_STYLES: Mapping[Shown, str] = {
    "off": "",
    "starting": "dim",
    "ready": "dim",
    "deciding": "",
    "by_cloud": "black on green",
    "by_local": "black on yellow",
    "held": "black on red",
    "start": "bold cyan",
    "kill": "bold white on red",
}
_LEGEND: Mapping[Shown, str] = {
    "deciding": " decides  ",
    "ready": " ready  ",
    "start": " started  ",
    "kill": " killed   ",
    "by_cloud": " cloud decides  ",
    "by_local": " local  ",
    "held": " none",
}
_ROW_STYLES: Mapping[str, str] = {"demo": "bold", "cloud": "green", "local": "yellow"}


def timeline(state: DemoState, now_s: float, width: int, characters: Mapping[Shown, str]) -> Table:
    """Return a table of the axis and the three bars."""
    num_cells = max(_MIN_WIDTH, width) - _LABEL_WIDTH - 1
    # The bars never fill the width while the demo runs.
    cell_s = max(state.expected_s, 1.02 * now_s) / num_cells
    table = Table.grid()
    table.add_column(width=_LABEL_WIDTH, style="bold")
    table.add_column()
    table.add_row("", Text(_axis(num_cells, cell_s), style="dim", no_wrap=True))
    for row in state.changes:
        table.add_row(row, _bar(state, row, now_s, num_cells, cell_s, characters))
    return table


def _axis(num_cells: int, cell_s: float) -> str:
    step_s = next((s for s in _INTERVALS_S if s / cell_s >= _MIN_TICK_CELLS), _INTERVALS_S[-1])
    text = ""
    number = 0
    while (position := round(number * step_s / cell_s)) < num_cells - len(
        label := f"{number * step_s} s"
    ):
        text = text.ljust(position) + label
        number += 1
    return text


def _bar(
    state: DemoState,
    row: Row,
    now_s: float,
    num_cells: int,
    cell_s: float,
    characters: Mapping[Shown, str],
) -> Text:
    cells: list[tuple[str, str]] = []
    changes = state.changes[row]
    following = 0
    activity: Activity = "off"
    for index in range(min(num_cells, int(now_s / cell_s) + 1)):
        # A robot that is held for less than a cell is shown as held.
        held = activity == "held"
        while following < len(changes) and int(changes[following].at_s / cell_s) <= index:
            activity = changes[following].activity
            held = held or activity == "held"
            following += 1
        shown: Activity = "held" if held else activity
        style = _ROW_STYLES.get(row, "") if shown == "deciding" else _STYLES[shown]
        cells.append((characters[shown], style))
    taken: set[int] = set()
    for mark in sorted(state.marks):
        if mark.row != row or mark.at_s > now_s:
            continue
        index = int(mark.at_s / cell_s)
        while index in taken:
            index += 1
        taken.add(index)
        cells += [(" ", "")] * (index + 1 - len(cells))
        cells[index] = (characters[mark.kind], _STYLES[mark.kind])
    return Text.assemble(*cells[:num_cells], no_wrap=True)


def legend(characters: Mapping[Shown, str]) -> Text:
    """Return the line that says what the characters mean."""
    said = [
        ((characters[shown], _STYLES[shown] or "dim"), (text, "dim"))
        for shown, text in _LEGEND.items()
    ]
    return Text.assemble(*itertools.chain.from_iterable(said), no_wrap=True)


def plain_line(line: Line) -> str:
    """Return a line as text: when, who, what."""
    return f"{line.at_s:6.2f} s  {line.who:<6} {line.text}"


def make_show() -> PlainShow | LiveShow:
    """Return what suits the standard error: a live timeline, or plain lines."""
    if sys.stderr.isatty():
        console = Console(stderr=True, highlight=False)
        if console.is_terminal and not console.is_dumb_terminal:
            return LiveShow(console)
    return PlainShow()


class PlainShow:
    """A line for each thing that happens, for logs."""

    def start(self, state: DemoState) -> None:
        """Do nothing."""

    def say(self, line: Line) -> None:
        """Write a line."""
        sys.stderr.write(printable(plain_line(line)) + "\n")
        sys.stderr.flush()

    def stop(self) -> None:
        """Do nothing."""

    def conclude(self, state: DemoState) -> None:
        """Draw the bars in plain characters."""
        console = Console(file=io.StringIO(), width=80, highlight=False, color_system=None)
        with console.capture() as capture:
            console.print(timeline(state, _end_of(state), 79, ASCII))
            console.print(legend(ASCII))
        lines = capture.get().splitlines()
        sys.stderr.write("\n" + "".join(f"{line.rstrip()}\n" for line in lines))
        sys.stderr.flush()


class LiveShow(PlainShow):
    """A live timeline on a terminal."""

    def __init__(self, console: Console) -> None:
        self._console = console
        is_unicode = (console.encoding or "").lower().startswith("utf")
        self._characters = UNICODE if is_unicode else ASCII
        self._live: Live | None = None

    def start(self, state: DemoState) -> None:
        """Show the state until :meth:`stop`, drawn by a thread."""
        self._live = Live(
            console=self._console,
            refresh_per_second=_FRAMES_HZ,
            transient=True,
            get_renderable=lambda: self._frame(state),
        )
        self._live.start()

    def say(self, line: Line) -> None:
        """Do nothing: the next frame has the line."""

    def stop(self) -> None:
        """Remove the timeline, and leave the terminal as it was; may be repeated."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def conclude(self, state: DemoState) -> None:
        """Leave all lines and the final timeline."""
        for line in _in_order(state):
            self._console.print(_styled(line), soft_wrap=True)
        self._console.print()
        self._console.print(self._bars(state, _end_of(state)))

    def _bars(self, state: DemoState, now_s: float) -> Group:
        width = self._console.size.width
        return Group(timeline(state, now_s, width, self._characters), legend(self._characters))

    def _frame(self, state: DemoState) -> RenderableType:
        now_s = state.now_s
        title = Table.grid(expand=True)
        title.add_column()
        title.add_column(justify="right", width=_LABEL_WIDTH, style="dim")
        name = Text.assemble(("holdfast demo", "bold"), f"  {state.title}", no_wrap=True)
        title.add_row(name, f"{now_s:.1f} s")
        facts = Table.grid()
        facts.add_column(width=_LABEL_WIDTH, style="dim")
        facts.add_column()
        status = f"{state.status.value}: {MEANINGS[state.status]}"
        facts.add_row("status", Text(status, style="bold", no_wrap=True))
        facts.add_row("robot", Text(state.progress, no_wrap=True))
        room = max(1, self._console.size.height - _AROUND_LINES - 1)
        lines = [_styled(line) for line in _in_order(state)[-room:]]
        return Group(title, "", self._bars(state, now_s), "", facts, "", *lines)


def _styled(line: Line) -> Text:
    return Text(plain_line(line), style=_ROW_STYLES.get(line.who, ""), no_wrap=True)


def _in_order(state: DemoState) -> list[Line]:
    return sorted(state.lines, key=lambda line: line.at_s)


def _end_of(state: DemoState) -> float:
    return max((line.at_s for line in state.lines), default=0.0)
