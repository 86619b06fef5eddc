"""The page of results says what the committed results say, and shows what is there."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import msgspec
import pytest

from holdfast.experiments import published_2017
from holdfast.experiments.registry import studies_of, study_names
from holdfast.experiments.study import TrialStudy
from holdfast.experiments.tables import Cell, Table
from holdfast.experiments.trial_files import read_trials

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "results.md").read_text(encoding="utf-8")
README = (DOCS.parent / "README.md").read_text(encoding="utf-8")
ORIGINS = {
    path.parent.name: msgspec.json.decode(path.read_bytes())
    for path in sorted((DOCS / "results").glob("*/origin.json"))
}


def test_results_are_of_full_runs_with_seed_version_and_machine() -> None:
    assert ORIGINS
    for name, origin in ORIGINS.items():
        assert name in study_names()
        assert origin["quick"] is False
        # What was chosen for published_worlds was chosen on another seed than it is claimed on.
        assert origin["seed"] == (8101 if name == "published_worlds" else 2017)
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


def table_of(study: str, name: str) -> list[dict[str, str]]:
    with (DOCS / "results" / study / f"{name}.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_both_pages_say_that_the_default_is_beaten_nowhere() -> None:
    default = "path entropy, prior neighbours"
    rows = [
        row for row in table_of("selectors", "default_candidates") if row["candidate"] == default
    ]
    assert len(rows) == 80
    assert not any(row["beaten_in"] for row in rows)
    said = f"beaten beyond noise in 0 of {len(rows)} comparisons"
    assert f"{default} as the default (not chosen on the other seed): {said}" in PAGE
    assert f"in none of {len(rows)} comparisons" in " ".join(README.split())


def test_both_pages_say_where_action_entropy_fails_more_often_than_random_looks() -> None:
    losses = [
        abs(min(0.0, 100.0 * float(row["success_gain"])))
        for row in table_of("selectors", "selectors")
        if row["problem"] == "three plates" and row["way"] == "action entropy, neighbours"
    ]
    *first, last = (f"{loss:.0f}" for loss in losses)
    said = f"fails more often than random (?:looks|sensing)[*,:]* by {', '.join(first)} and {last} "
    for page in (PAGE, README):
        assert re.search(said, " ".join(page.split()))


def test_both_pages_say_what_more_particles_than_the_default_gain() -> None:
    (row,) = (
        row
        for row in table_of("parameters", "more_particles")
        if row["problem"].startswith("all") and row["way"] == "neighbours"
    )
    assert (row["from"], row["to"]) == ("x 3", "x 10")
    value, low, high = (float(row[f"steps_ratio{end}"]) for end in ("", "_low", "_high"))
    assert f"{value:.2f} [{low:.2f}, {high:.2f}] times the steps of three times" in README
    assert f"particles x 10 instead of x 3: {value:.3g} [{low:.3g}, {high:.3g}]" in PAGE


def typed_table(study: str, name: str) -> Table:
    """Return a committed table with the types that the study gave it."""
    rows = table_of(study, name)
    texts = {"problem", "estimator", "parameter", "value", "reference", "logged", "selector"}
    texts |= {"from", "to"}

    def cell_of(column: str, text: str) -> Cell:
        if column in texts:
            return text
        if not text:
            return None
        return int(text) if re.fullmatch(r"-?\d+", text) else float(text)

    return Table.of_records(
        [{name: cell_of(name, text) for name, text in row.items()} for row in rows]
    )


def test_findings_follow_from_the_committed_tables() -> None:
    found = published_2017._findings(typed_table("published_2017", "published_2017"))
    assert found == ORIGINS["published_2017"]["findings"]


FILES = sorted((DOCS / "results").glob("*/trials.parquet"))


@pytest.mark.skipif(not FILES, reason="no trials are committed")
@pytest.mark.parametrize("path", FILES, ids=[path.parent.name for path in FILES])
def test_tables_and_findings_follow_from_the_committed_trials(path: Path) -> None:
    """Each number: but for the last digits, in which machines may differ."""
    kept = read_trials(path)
    assert kept.study == path.parent.name
    if kept.scale.quick:
        pytest.skip("the trials are of a quick run")
    (study,) = studies_of([kept.study])
    assert isinstance(study, TrialStudy)
    report = study.report_of(kept.trials)
    assert report.findings == ORIGINS[kept.study]["findings"]
    committed = {table.stem for table in path.parent.glob("*.csv")}
    assert committed == set(report.summary)
    for name, table in report.summary.items():
        rows = table_of(kept.study, name)
        again = list(csv.DictReader(io.StringIO(table.to_csv())))
        assert len(rows) == len(again)
        for row, other in zip(rows, again, strict=True):
            assert list(row) == list(other)
            assert all(is_the_same(row[column], other[column]) for column in row), (name, row)
    assert path.stat().st_size < 2_000_000


def is_the_same(cell: str, other: str) -> bool:
    try:
        return float(cell) == pytest.approx(float(other), rel=1e-9, abs=1e-12)
    except ValueError:
        return cell == other


def test_a_number_that_differs_is_seen() -> None:
    assert is_the_same("0.25", "0.2500000000001")
    assert is_the_same("", "")
    assert not is_the_same("0.25", "0.2501")
    assert not is_the_same("0.25", "")
    assert not is_the_same("random", "fixed")


def test_both_pages_say_how_far_from_the_logged_successes_the_emulated_ones_may_be() -> None:
    said = [
        re.search(r"largest difference is \+(\S+) points \[\+(\S+), \+(\S+)\]", finding)
        for finding in ORIGINS["published_2017"]["findings"]
        if "emulated less logged successes" in finding
    ]
    value, low, high = max(
        (each.groups() for each in said if each), key=lambda ends: float(ends[0])
    )
    assert f"largest difference is of {value} points [{low}, {high}]" in " ".join(PAGE.split())
    assert f"(the largest is {value} points [{low}, {high}])" in " ".join(README.split())


def test_no_trial_is_committed() -> None:
    assert list((DOCS / "results").rglob("*_trials.csv")) == []
