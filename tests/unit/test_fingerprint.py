"""What identifies the code of a run, and how a difference is reported."""

import json
from pathlib import Path

import pytest
from tests.recordings import configuration_of

from holdfast.journal.fingerprint import difference, fingerprint


def test_the_same_code_is_no_difference(tmp_path: Path) -> None:
    here = fingerprint(configuration_of(tmp_path))
    assert difference(here, fingerprint(configuration_of(tmp_path, seed=6))) is None


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("holdfast_version", "0.0.1", "it was made by holdfast 0.0.1, this is "),
        ("holdfast_core", "0.0.1+abc", "it was made by holdfast 0.0.1+abc, this is "),
        ("problem_sources", json.dumps({"arm": "0"}), "the problem's source has changed since"),
    ],
)
def test_other_code_is_named(key: str, value: str, message: str, tmp_path: Path) -> None:
    here = fingerprint(configuration_of(tmp_path))
    there = here | {key: value}
    if key == "holdfast_version":
        del there["holdfast_core"]  # as of journals that say nothing of it
    found = difference(there, here)
    assert found is not None
    assert found.words.startswith(message)
    assert found.is_the_problems == (key == "problem_sources")
