"""A page of text, tables and charts in one HTML file, which opens anywhere, without a network.

Charts are Vega-Lite specifications; the library that draws them is in the file. What a page shows
may be somebody else's words: the name of a problem, an event, a configuration. So every text is
escaped, data is in a block that no browser runs, and the policy of the page
(Content-Security-Policy) allows no script but those that holdfast has put there, and loads and
sends nothing.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import html
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from string import Template
from typing import Any, TypeAlias

import msgspec

from holdfast.errors import HoldfastError, OutputError, how_to_install
from holdfast.printable import printable

MAX_BYTES = 3_000_000
"""Largest size of a page; the library takes 0.9 MB of it."""

GENERATOR = b'<meta name="generator" content="holdfast report">'
"""Stands near the beginning of each page, so that a page can be told from somebody's file."""

_MAX_ROWS = 200
"""Rows of a table that are shown."""

Chart: TypeAlias = dict[str, Any]
"""A Vega-Lite specification, or a part of one."""


def require_vega() -> None:
    """Raise HoldfastError if the library that draws charts is not installed."""
    try:
        import vl_convert  # noqa: F401
    except ImportError as error:
        advice = how_to_install("vl-convert-python", "report")
        raise HoldfastError(f"a report needs vl-convert: {advice}") from error


@functools.cache
def _library() -> str:
    """Return Vega, Vega-Lite and Vega-Embed as one script; it takes some seconds."""
    import vl_convert

    return vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;")


class HtmlPage:
    """A page that grows from the top; each text is escaped."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._parts: list[str] = []
        self.sections: list[str] = []
        self._charts: list[Chart] = []

    def section(self, title: str) -> None:
        """Begin a section."""
        self._parts.append(f'<h2 id="s{len(self.sections)}">{_escaped(title)}</h2>')
        self.sections.append(title)

    def heading(self, text: str) -> None:
        """Begin a part of a section."""
        self._parts.append(f"<h3>{_escaped(text)}</h3>")

    def paragraph(self, text: str, *, muted: bool = False) -> None:
        """Add a paragraph."""
        self._parts.append(f"<p{' class=muted' * muted}>{_escaped(text)}</p>")

    def table(
        self, head: Sequence[object], rows: Iterable[Sequence[object]], most: int = _MAX_ROWS
    ) -> None:
        """Add a table; of a long one the first rows, at ``most``, with a note."""
        lines = list(rows)
        shown = [_row("th", head)] * bool(head) + [_row("td", row) for row in lines[:most]]
        self._parts.append(f"<div class=scroll><table>{''.join(shown)}</table></div>")
        if len(lines) > most:
            self.paragraph(f"The first {most} of {len(lines):,} rows.", muted=True)

    def code(self, text: str, *, summary: str = "") -> None:
        """Add text as it is; one with a ``summary`` is folded."""
        block = f"<pre>{_escaped(text)}</pre>"
        if summary:
            block = f"<details><summary>{_escaped(summary)}</summary>{block}</details>"
        self._parts.append(block)

    def picture(self, svg: bytes, text: str) -> None:
        """Add a picture (SVG); as an image it runs no script."""
        data = base64.b64encode(svg).decode()
        self._parts.append(f'<img alt="{_escaped(text)}" src="data:image/svg+xml;base64,{data}">')

    def markdown(self, text: str) -> None:
        """Add what holdfast has written as Markdown: paragraphs and tables."""
        for block in text.strip().split("\n\n"):
            lines = block.splitlines()
            if lines and all(line.startswith("| ") for line in lines):
                rows = [_cells_of(line) for line in lines]
                self.table(rows[0], rows[2:])
            elif block.strip():
                self.paragraph(block)

    def chart(self, chart: Mapping[str, Any]) -> None:
        """Add a chart; keys of ``usermeta`` say how it fits a narrow screen (html_page.js)."""
        self._parts.append(f'<div class=chart data-chart="{len(self._charts)}"></div>')
        self._charts.append({**chart_part("look"), **chart})

    def html(self) -> bytes:
        """Return the file.

        Raises OutputError if it is larger than 3 MB.
        """
        folder = files("holdfast.reports")
        texts = [_library(), (folder / "html_page.js").read_text("utf-8")]
        hashes = (hashlib.sha256(each.encode()).digest() for each in texts)
        names = [f'<a href="#s{at}">{_escaped(name)}</a>' for at, name in enumerate(self.sections)]
        head = f"<h1>{_escaped(self._title)}</h1>\n<nav>{''.join(names)}</nav>\n"
        page = Template((folder / "html_page.html").read_text("utf-8")).substitute(
            title=_escaped(self._title),
            generator=GENERATOR.decode(),
            hashes=" ".join(f"'sha256-{base64.b64encode(each).decode()}'" for each in hashes),
            body=head + "\n".join(self._parts),
            charts=_data(self._charts),
            scripts="\n".join(f"<script>{each}</script>" for each in texts),
        )
        content = page.encode("utf-8", "backslashreplace")
        if len(content) > MAX_BYTES:
            raise OutputError(
                f"the report is {len(content):,} bytes large; the limit is {MAX_BYTES:,}: show "
                "fewer trials of a run (--worst; with 0 none)"
            )
        return content


@functools.cache
def _parts() -> dict[str, str]:
    content = (files("holdfast.reports") / "charts.json").read_bytes()
    return {name: json.dumps(part) for name, part in json.loads(content).items()}


def chart_part(part: str, **values: object) -> Chart:
    """Return a part of ``charts.json`` with its ``$names`` filled in.

    A text that is nothing but a name becomes any value, even one of a run's own words. A name
    within a text becomes a part of it: a number, or a word of ours.
    """

    def value_of(match: re.Match[str]) -> str:
        whole, name, braced = match.groups()
        return json.dumps(values[whole]) if whole else str(values[name or braced])

    filled = re.sub(r'"\$(\w+)"|\$(\w+)|\$\{(\w+)\}', value_of, _parts()[part])
    found: Chart = json.loads(filled)
    return found


def _escaped(text: object) -> str:
    return html.escape(printable(str(text)))


def _row(tag: str, cells: Iterable[object]) -> str:
    texts = ("" if each is None else _escaped(each).replace("\n", "<br>") for each in cells)
    return f"<tr>{''.join(f'<{tag}>{text}</{tag}>' for text in texts)}</tr>"


def _cells_of(line: str) -> list[str]:
    """Return the cells of a row of Markdown."""
    return [
        cell.strip().replace("\0", "|")
        for cell in line.replace(r"\|", "\0").strip().strip("|").split("|")
    ]


def _data(value: object) -> str:
    """Return JSON for a block of data in a page: nothing in it ends the block."""
    text = msgspec.json.encode(value).decode()
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
