"""Draw docs/images/house.svg: the rooms of the product, and which imports which.

Run it from the repository: ``python docs/images/draw_house.py``. The order of the rooms is that of
the contract in pyproject.toml, the imports are those of the sources (grimp), and what a room is for
is the first sentence of its package. The picture is 900 pixels wide.
"""

from __future__ import annotations

import ast
import html
import re
import sys
import textwrap
import tomllib
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "holdfast"
PICTURE = Path(__file__).with_name("house.svg")
PLACES = {
    "studies": "not shipped",
    "holdfast_lab": "lab/, a distribution of its own",
    "holdfast_ros": "ros/, distributions of their own",
}
"""What stands on the house: it imports the product, which imports nothing of it."""

ROW, TOP, LEFT, MATRIX, COLUMN = 36, 132, 16, 520, 27


def rooms() -> list[str]:
    """Return the rooms, the lowest first: packages, not the modules that all of them use."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    layers = next(
        each["layers"] for each in contracts["contracts"] if "room imports" in each["name"]
    )
    names = [layer.removeprefix("holdfast.") for layer in reversed(layers)]
    return [name for name in names if (PACKAGE / name / "__init__.py").is_file()]


def purpose(room: str) -> str:
    """Return the first sentence of a room's package."""
    text = ast.get_docstring(ast.parse((PACKAGE / room / "__init__.py").read_text())) or ""
    return " ".join(re.split(r"\.\s|\n\n", text)[0].rstrip(".").split())


def imports(names: list[str]) -> set[tuple[str, str]]:
    """Return which room imports which, by at least one of its files."""
    graph = grimp.build_graph("holdfast", cache_dir=None)
    found = set()
    for module in graph.modules:
        for other in graph.find_modules_directly_imported_by(module):
            one, two = (f"{each}..".split(".")[1] for each in (module, other))
            if one != two and {one, two} <= set(names):
                found.add((one, two))
    return found


def text(x: float, y: float, words: str, look: str = "") -> str:
    """Return a line of text."""
    return f'<text x="{x:g}" y="{y:g}" {look}>{html.escape(words)}</text>'


def house() -> str:
    """Return the picture."""
    names = rooms()
    known = imports(names)
    floors = names[::-1]
    height = TOP + ROW * len(floors) + 40
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="900" height="{height}" '
        f'viewBox="0 0 900 {height}" role="img" '
        'font-family="system-ui, Segoe UI, Roboto, DejaVu Sans, sans-serif" font-size="13">',
        "<title>The rooms of holdfast, and which imports which</title>",
        '<rect width="100%" height="100%" fill="#ffffff"/>',
    ]
    for at, (name, place) in enumerate(PLACES.items()):
        x = LEFT + at * 166
        parts.append(
            f'<rect x="{x}" y="14" width="158" height="46" rx="4" fill="#fdf3dc" stroke="#c9a24a"/>'
        )
        parts.append(text(x + 8, 33, name, 'font-weight="600"'))
        parts.append(text(x + 8, 51, place.split(",")[0], 'font-size="11" fill="#57606a"'))
    parts.append(
        text(LEFT, 88, "import the product, which imports none of them.", 'fill="#57606a"')
    )
    parts.append(text(LEFT, TOP - 12, "A room imports only rooms below it.", 'fill="#57606a"'))
    end = TOP + ROW * len(floors) - 4
    parts += [
        f'<line x1="{x}" y1="{TOP - 6}" x2="{x}" y2="{end}" stroke="#eef0f2"/>'
        for x in (MATRIX + COLUMN * at + 12 for at in range(len(floors)))
    ]
    for at, name in enumerate(floors):
        y, column = TOP + ROW * at, MATRIX + COLUMN * at + 12
        parts.append(
            f'<rect x="{LEFT}" y="{y}" width="490" height="{ROW - 4}" rx="3" fill="#e8eff8" '
            'stroke="#8fb0d6"/>'
        )
        parts.append(text(LEFT + 8, y + 21, name, 'font-weight="600"'))
        lines = textwrap.wrap(purpose(name), 60)
        first = y + (21 if len(lines) == 1 else 14)
        parts += [
            text(LEFT + 96, first + 13 * number, line, 'font-size="11.5" fill="#333a42"')
            for number, line in enumerate(lines[:2])
        ]
        parts.append(
            text(0, 0, name, f'transform="translate({column + 4} {TOP - 12}) rotate(-55)"')
        )
        for other, below in enumerate(floors):
            x = MATRIX + COLUMN * other + 12
            if (name, below) in known:
                parts.append(f'<circle cx="{x}" cy="{y + ROW / 2 - 2:g}" r="5.5" fill="#2f6db3"/>')
            elif name == below:
                parts.append(
                    f'<rect x="{x - 5}" y="{y + ROW / 2 - 7:g}" width="10" height="10" '
                    'fill="none" stroke="#8fb0d6"/>'
                )
    words = "dot: a file of the room at the left imports one of the room above"
    parts.append(text(MATRIX - 4, height - 20, words, 'font-size="11.5" fill="#57606a"'))
    return "\n".join([*parts, "</svg>", ""])


def main() -> int:
    """Write the picture; with ``--check`` say whether it is current."""
    if "--check" in sys.argv[1:]:
        return int(PICTURE.read_text() != house())
    PICTURE.write_text(house())
    return 0


if __name__ == "__main__":
    sys.exit(main())
