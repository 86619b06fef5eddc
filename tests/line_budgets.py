"""The size of each part of the repository, which may shrink, but not grow past its budget.

    python -m tests.line_budgets

A feature pays with a removal. The budgets are in ``pyproject.toml``; what counts are lines of
Python. A part that has become smaller may lower its own.
"""

import sys
import tomllib
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_TESTS = {"test", "tests"}


def lines_of(root: Path, part: str) -> int:
    """Return the lines of Python below a directory; ``tests`` are those of all parts together."""
    places = [part] if part != "tests" else ["tests", "lab/tests", "studies/tests", "ros"]
    files = (file for place in places for file in (root / place).rglob("*.py"))
    return sum(
        len(file.read_bytes().splitlines())
        for file in files
        if bool(_TESTS & set(file.relative_to(root).parts)) == (part == "tests")
    )


def main(root: Path = _ROOT) -> int:
    """Print the table; return 1 if a part is larger than its budget."""
    settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    above = 0
    for part, budget in settings["tool"]["line-budgets"].items():
        lines = lines_of(root, part)
        print(f"{part:14} {lines:7,} of {budget:7,} lines")
        if lines > budget:
            print(f"{part} has grown: take something away, or say why it is worth its lines")
            above += 1
    return min(above, 1)


if __name__ == "__main__":
    sys.exit(main())
