"""The page of results says what the committed results say, and shows what is there."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest

from holdfast.experiments.registry import study_names

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "results.md").read_text(encoding="utf-8")
ORIGINS = {
    path.parent.name: msgspec.json.decode(path.read_bytes())
    for path in sorted((DOCS / "results").glob("*/origin.json"))
}


def test_results_are_of_full_runs_with_seed_version_and_machine() -> None:
    assert ORIGINS
    for name, origin in ORIGINS.items():
        assert name in study_names()
        assert origin["quick"] is False
        assert origin["seed"] == 2017
        assert origin["holdfast_version"]
        assert {"processor", "cores", "system", "holdfast"} <= set(origin["machine"])
        assert re.fullmatch(r"0\.\d+\.\d+, commit [0-9a-f]{7,}", origin["machine"]["holdfast"])


def test_what_is_quoted_was_found() -> None:
    """Lines that begin with ``> `` are sentences of the studies, word by word."""
    found = {finding for origin in ORIGINS.values() for finding in origin["findings"]}
    quoted = [
        " ".join(line.removeprefix("> ") for line in block.splitlines())
        for block in re.findall(r"(?:^> .*\n)+", PAGE, re.MULTILINE)
    ]
    assert len(quoted) >= 5
    assert [line for line in quoted if line not in found] == []


@pytest.mark.parametrize("name", ORIGINS)
def test_figures_are_shown(name: str) -> None:
    figures = sorted(path.name for path in (DOCS / "results" / name).glob("*.png"))
    assert figures
    for figure in figures:
        assert f"](results/{name}/{figure})" in PAGE
        assert (DOCS / "results" / name / figure).with_suffix(".svg").exists()


def test_links_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", PAGE):
        if "://" not in target:
            assert (DOCS / target).exists(), target


def test_no_trial_is_committed() -> None:
    assert list((DOCS / "results").rglob("*_trials.csv")) == []
