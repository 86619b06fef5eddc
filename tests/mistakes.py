"""What users may write wrong, and what they are told: tables of text that tests read.

In a file of ``data/``, each mistake is followed by the lines ``> `` that its answer must have.
"""

import re
from pathlib import Path
from typing import Any

import pytest

DATA = Path(__file__).parent / "unit" / "data"


def mistakes_in(name: str) -> list[Any]:
    """Return pairs of a text and of what is in the answer to it, as parameters of a test."""
    found = re.findall(r"((?:(?!> ).*\n)+)((?:> .*\n)+)", (DATA / name).read_text("utf-8"))
    assert found
    return [
        pytest.param(text.lstrip("\n"), answer, id=answer[:60])
        for text, lines in found
        for answer in [re.sub("^> ", "", lines.rstrip("\n"), flags=re.MULTILINE)]
    ]
