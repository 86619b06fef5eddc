"""The page of results says what the committed results say, and shows what is there."""

import csv
import io
import re
from pathlib import Path

import msgspec
import pandas as pd
import pytest
from benchmarks import expected_return
from matplotlib.text import Text

from studies import offload_break_even, plots, published_2017
from studies.command import studies_of, study_names
from studies.study import TRIALS, Report, TrialStudy
from studies.tables import to_csv
from studies.trial_files import read_trials

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


SECTIONS = [part for part in re.split(r"^## ", PAGE, flags=re.MULTILINE) if "](results/" in part]
NUMBER = r"-?[\d,]+(?:\.\d+)?"
INTERVAL = re.compile(rf"({NUMBER})\s\[({NUMBER}),\s({NUMBER})\]")


def intervals_of(study: str) -> list[tuple[float, float, float]]:
    """Return all intervals of a study's tables."""
    found = []
    for path in (DOCS / "results" / study).glob("*.csv"):
        rows = table_of(study, path.stem)
        for name in rows[0]:
            ends = (name, f"{name}_low", f"{name}_high")
            if set(ends) <= set(rows[0]):
                found += [
                    (float(row[ends[0]]), float(row[ends[1]]), float(row[ends[2]]))
                    for row in rows
                    if all(row[end] for end in ends)
                ]
    return found


def is_rounded_from(text: str, number: float) -> bool:
    digits = len(text.partition(".")[2])
    return abs(float(text.replace(",", "")) - number) <= 0.5001 * 10.0**-digits


def is_found(match: re.Match[str], intervals: list[tuple[float, float, float]]) -> bool:
    """Tell whether an interval of a page is in a table, as a share or in percent."""
    return any(
        all(
            is_rounded_from(text, factor * end)
            for text, end in zip(match.groups(), ends, strict=True)
        )
        for ends in intervals
        for factor in (1.0, 100.0)
    )


@pytest.mark.parametrize("section", SECTIONS, ids=lambda each: each.splitlines()[0])
def test_each_interval_of_a_section_is_in_its_tables(section: str) -> None:
    studies = dict.fromkeys(re.findall(r"\]\(results/(\w+)[/)]", section))
    intervals = [each for study in studies for each in intervals_of(study)]
    quoted = list(INTERVAL.finditer(" ".join(section.split())))
    assert quoted
    assert [match[0] for match in quoted if not is_found(match, intervals)] == []


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


def test_the_page_says_that_the_default_is_not_beaten_in_the_study() -> None:
    default = "path entropy, prior neighbours"
    rows = [
        row for row in table_of("selectors", "default_candidates") if row["candidate"] == default
    ]
    assert len(rows) == 160
    assert not any(row["beaten_in"] for row in rows)
    assert f"in 0 of {len(rows)} comparisons" in PAGE


def test_the_pages_say_by_how_much_it_is_beaten_elsewhere() -> None:
    points = [
        -100.0 * float(row["success_gain"])
        for row in table_of("myopic", "outcomes")
        if (row["way"], row["rival"]) == ("default", "random")
    ]
    said = f"{min(points):.0f} to {max(points):.0f} points"
    for text in (PAGE, README, (DOCS / "problems.md").read_text(encoding="utf-8")):
        assert said in " ".join(text.split())


def test_the_page_says_where_action_entropy_fails_more_often_than_random_looks() -> None:
    losses = [
        abs(min(0.0, 100.0 * float(row["success_gain"])))
        for row in table_of("selectors", "selectors")
        if row["problem"] == "three plates" and row["way"] == "action entropy, neighbours"
    ]
    *first, last = (f"{loss:.0f}" for loss in losses)
    said = f"fails more often than random (?:looks|sensing)[*,:]* by {', '.join(first)} and {last} "
    assert re.search(said, " ".join(PAGE.split()))


def test_the_page_says_what_more_particles_than_the_default_gain() -> None:
    (row,) = (
        row
        for row in table_of("parameters", "more_particles")
        if row["problem"].startswith("all") and row["way"] == "neighbours"
    )
    assert (row["from"], row["to"]) == ("x 3", "x 10")
    value, low, high = (float(row[f"steps_ratio{end}"]) for end in ("", "_low", "_high"))
    assert f"instead of three leave {value:.3g} [{low:.3g}, {high:.3g}]" in " ".join(PAGE.split())


def test_the_numbers_of_2017_follow_from_the_committed_table() -> None:
    table = pd.read_csv(DOCS / "results" / "published_2017" / "published_2017.csv")
    report = Report(numbers=published_2017.numbers_of(table))
    compare("published_2017", "numbers", report.tables["numbers"])


def test_the_break_even_follows_from_the_committed_times() -> None:
    times = pd.read_csv(DOCS / "results" / "offload_break_even" / "sensing_times.csv")
    scalings = offload_break_even.scalings_of(times)
    lines = offload_break_even.break_even_table(scalings)
    compare("offload_break_even", "break_even", lines)
    compare("offload_break_even", "break_even_ahead", offload_break_even.ahead_table(scalings))
    report = Report(numbers=offload_break_even.numbers_of(lines))
    compare("offload_break_even", "numbers", report.tables["numbers"])
    rows = {row["name"]: row["value"] for row in table_of("thesis_chapter_6", "numbers")}
    measured = rows["round trip without computation, cloud, same machine"]
    assert float(measured) == offload_break_even.EXCHANGE_MS


def compare(study: str, name: str, table: pd.DataFrame) -> None:
    """Compare a table with the committed one: but for the last digits, where machines differ."""
    rows = table_of(study, name)
    again = list(csv.DictReader(io.StringIO(to_csv(table))))
    assert len(rows) == len(again)
    for row, other in zip(rows, again, strict=True):
        assert list(row) == list(other)
        assert all(is_the_same(row[column], other[column]) for column in row), (name, row)


FILES = sorted((DOCS / "results").glob("*/trials.parquet"))


@pytest.mark.skipif(not FILES, reason="no trials are committed")
@pytest.mark.parametrize("path", FILES, ids=[path.parent.name for path in FILES])
def test_tables_follow_from_the_committed_trials(path: Path) -> None:
    kept = read_trials(path)
    assert kept.study == path.parent.name
    if kept.scale.quick:
        pytest.skip("the trials are of a quick run")
    (study,) = studies_of([kept.study])
    assert isinstance(study, TrialStudy)
    report = study.report_of({TRIALS: kept.trials})
    committed = {table.stem for table in path.parent.glob("*.csv")}
    assert committed == set(report.tables)
    for name, table in report.tables.items():
        compare(kept.study, name, table)
    assert path.stat().st_size < 2_000_000


def test_the_verdict_on_expected_return_follows_from_its_trials() -> None:
    tables = expected_return.verdict(DOCS / "results" / "expected_return" / "trials.csv")
    for name, table in zip(("verdict", "together"), tables, strict=True):
        compare("expected_return", name, table)
    rows = tables[0][tables[0]["candidate"] == expected_return.CANDIDATE]
    beaten = sum(rows["beaten_in"] != "")
    assert f"is beaten in {beaten} of {len(rows)} comparisons" in " ".join(PAGE.split())


def is_the_same(cell: str, other: str) -> bool:
    try:
        return float(cell) == pytest.approx(float(other), rel=1e-9, abs=1e-12)
    except ValueError:
        return cell == other


@pytest.mark.slow
@pytest.mark.parametrize("path", FILES, ids=[path.parent.name for path in FILES])
def test_figures_are_legible_on_the_page(path: Path) -> None:
    """Where a figure is 900 pixels wide, its texts are at least 9 pixels high."""
    (study,) = studies_of([path.parent.name])
    assert isinstance(study, TrialStudy)
    for draw in study.report_of({TRIALS: read_trials(path).trials}).figures.values():
        figure = draw()
        plots.make_legible(figure)
        figure.canvas.draw()
        pixels = 900.0 / (72.0 * figure.get_figwidth())
        texts = [text for text in figure.findobj(Text) if isinstance(text, Text)]
        assert min(plots.font_size_of(text) * pixels for text in texts if text.get_text()) >= 8.99


def test_no_trial_is_committed() -> None:
    assert list((DOCS / "results").rglob("*_trials.csv")) == []
