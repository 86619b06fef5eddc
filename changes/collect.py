"""Print the fragments in this directory as a section of CHANGELOG.md; README.md has the kinds."""

from __future__ import annotations

import sys
from pathlib import Path

KINDS = {
    "decision": "Decisions that change",
    "removed": "Removed",
    "deprecated": "Deprecated",
    "added": "Added",
    "fixed": "Fixed",
}
HERE = Path(__file__).parent


def main(arguments: list[str]) -> None:
    """Print the section; ``--remove`` also removes the files."""
    found = [file for file in sorted(HERE.glob("*.md")) if file.name != "README.md"]
    if unknown := [file.name for file in found if file.suffixes[0].strip(".") not in KINDS]:
        sys.exit(f"{', '.join(unknown)}: must be NAME.KIND.md, with KIND one of {', '.join(KINDS)}")
    for kind, title in KINDS.items():
        of_kind = [file for file in found if file.suffixes[0] == f".{kind}"]
        if of_kind:
            print(f"### {title}\n")
        for file in of_kind:
            print("- " + "\n  ".join(file.read_text(encoding="utf-8").split("\n")).rstrip())
        if of_kind:
            print()
    if "--remove" in arguments:
        for file in found:
            file.unlink()


if __name__ == "__main__":
    main(sys.argv[1:])
