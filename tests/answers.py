"""Tables of text that tests read: what is given, and what it is answered with.

In a file of ``unit/data/``, what is given is followed by the answer, in lines that begin with
``> ``: a mistake, say, by what its message must have in it.
"""

import re
from pathlib import Path
from typing import Any

import pytest

DATA = Path(__file__).parent / "unit" / "data"


def answers_in(name: str) -> list[Any]:
    """Return what is given and its answer, in turn, as parameters of a test."""
    found = re.findall(r"((?:(?!> ).*\n)+)((?:> .*\n)+)", (DATA / name).read_text("utf-8"))
    assert found
    return [
        pytest.param(given.lstrip("\n"), answer, id=answer[:60])
        for given, lines in found
        for answer in [re.sub("^> ", "", lines.rstrip("\n"), flags=re.MULTILINE)]
    ]
