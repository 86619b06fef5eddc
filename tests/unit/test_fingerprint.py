"""What identifies the code of a run, and how a difference is reported."""

import json
from pathlib import Path

import pytest
from tests.recordings import configuration_of

from holdfast.journal.fingerprint import difference, fingerprint


def test_the_same_code_is_no_difference(tmp_path: Path) -> None:
    here = fingerprint(configuration_of(tmp_path))
    assert difference(here, fingerprint(configuration_of(tmp_path, seed=6))) is None


SOURCES = "the problem's source has changed since (module"
HERE = {"holdfast_version": "1.0", "holdfast_core": "1.0+a"}


@pytest.mark.parametrize(
    ("there", "sources", "words"),
    [
        (HERE, {"arm": "1", "tables": "2"}, None),
        (HERE | {"holdfast_core": "1.0+b"}, {"arm": "1", "tables": "2"}, "made by holdfast 1.0+b"),
        (HERE, {"arm": "1"}, f"{SOURCES} tables)"),
        (HERE, {"arm": "0", "tables": "2"}, f"{SOURCES} arm)"),
        # Journals of before the core was told name fewer modules.
        ({"holdfast_version": "1.0"}, {"arm": "1"}, None),
        ({"holdfast_version": "1.0"}, {"arm": "0"}, f"{SOURCES} arm)"),
        ({"holdfast_version": "0.1"}, {"arm": "1"}, "made by holdfast 0.1, this is 1.0+a: other c"),
    ],
)
def test_other_code_is_named(
    there: dict[str, str], sources: dict[str, str], words: str | None
) -> None:
    here = HERE | {"problem_sources": json.dumps({"arm": "1", "tables": "2"})}
    found = difference(there | {"problem_sources": json.dumps(sources)}, here)
    if words is None:
        assert found is None
        return
    assert found is not None
    assert words in found.words
    assert found.is_the_problems == (SOURCES in words)
    assert found.made_by == there.get("holdfast_core", there["holdfast_version"])
