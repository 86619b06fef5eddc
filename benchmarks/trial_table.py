"""Trials of robots that a study of the package cannot have, in one CSV that goes on growing.

A row is written as soon as its trial is over, so the same command goes on after Ctrl-C. What a row
depends on besides its seed (code, settings) is not noted: begin a new file after a change.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from studies import statistics
from studies.statistics import Interval

__all__ = ["Cell", "compare", "main", "ranked", "rate", "read", "run", "shown"]


class Cell(NamedTuple):
    """A setting: the columns that tell it from others, and what runs one of its trials.

    Attributes
    ----------
    run : callable
        Gets a trial's number and returns the columns of its row.
    most_trials : int or None
        A limit of its own.
    """

    names: Mapping[str, str]
    run: Callable[[int], Mapping[str, Any]]
    most_trials: int | None = None


def run(path: Path, cells: Sequence[Cell], trials: int, seed: int, columns: Sequence[str]) -> None:
    """Run what the file does not have, and tell of it on stderr.

    Trials come before cells: an unfinished file has all cells, with about as many trials.
    """
    header = [*cells[0].names, "seed", "trial", *columns]
    known = set()
    if path.exists():
        with path.open(newline="") as lines:
            for row in csv.DictReader(lines):
                if list(row) != header:
                    raise SystemExit(f"{path} has other columns: begin a new file")
                known.add((*(row[name] for name in cells[0].names), row["seed"], row["trial"]))
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(",".join(header) + "\n")
    wanted = [
        (cell, trial)
        for trial in range(trials)
        for cell in cells
        if (cell.most_trials is None or trial < cell.most_trials)
        and (*cell.names.values(), str(seed), str(trial)) not in known
    ]
    started = time.monotonic()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, header)
        for count, (cell, trial) in enumerate(wanted, start=1):
            writer.writerow({**cell.names, "seed": seed, "trial": trial, **cell.run(trial)})
            file.flush()
            left = (time.monotonic() - started) / count * (len(wanted) - count)
            sys.stderr.write(f"\r{count} of {len(wanted)} trials, {left:.0f} s left   ")
    sys.stderr.write("\n" if wanted else "")


def main(
    description: str | None,
    default_out: str,
    default_trials: int,
    cells_of: Callable[[int], Sequence[Cell]],
    columns: Sequence[str],
) -> Path:
    """Run the trials that the command line asks for, and return their file."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--out", type=Path, default=Path(default_out))
    parser.add_argument("--trials", type=int, default=default_trials)
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    run(options.out, cells_of(options.seed), options.trials, options.seed, columns)
    out: Path = options.out
    return out


def read(path: Path, names: Sequence[str]) -> dict[tuple[str, ...], pd.DataFrame]:
    """Return the trials of each cell by its names, in the order of their numbers."""
    table = pd.read_csv(path, dtype=dict.fromkeys(names, str)).sort_values("trial", kind="stable")
    return {key: rows.reset_index(drop=True) for key, rows in table.groupby(list(names))}


def rate(trials: pd.DataFrame) -> Interval:
    """Return the success rate in per cent, with Wilson's interval."""
    succeeded = trials["outcome"] == "succeeded"
    return statistics.rate_interval(int(succeeded.sum()), len(trials), 100.0)


def compare(own: pd.DataFrame, other: pd.DataFrame, column: str) -> tuple[Interval, Interval]:
    """Return how a cell compares with another one on the same trials.

    Returns
    -------
    gain : Interval
        In success, in points.
    ratio : Interval
        Of a column, as a geometric mean over the trials in which both succeeded.
    """
    pairs = own.merge(other, on=["seed", "trial"], suffixes=("", "_other"), validate="1:1")
    succeeded = (pairs["outcome"] == "succeeded").to_numpy()
    others = (pairs["outcome_other"] == "succeeded").to_numpy()
    gain, _ = statistics.paired_rates(succeeded, others)
    both = pairs[succeeded & others]
    own_steps, other_steps = (
        statistics.log_steps(both[name].to_numpy(float)) for name in (column, f"{column}_other")
    )
    ratio, _ = statistics.paired_difference(own_steps, other_steps)
    return Interval(*(100.0 * end for end in gain)), statistics.ratio_of(ratio)


def shown(interval: Interval, digits: int) -> str:
    """Return an interval as tables show it."""
    value, low, high = (f"{end:.{digits}f}" for end in interval)
    return f"{value} [{low}, {high}]"


def ranked(path: Path, column: str, others: Sequence[str], first: str = "default") -> str:
    """Write a summary of cells that have one name beside the trials, and return it in Markdown.

    It has the mean of a column and of others; and, trial by trial, the first cell less each.
    """
    cells = {name: rows for (name,), rows in read(path, ("way",)).items()}
    rows: list[dict[str, Any]] = []
    lines = [
        f"| way | trials | {column} | {' | '.join(others)} | {first} less this |",
        "|---|---|---|" + "---|" * (len(others) + 1),
    ]
    for name, own in cells.items():
        pairs = own.merge(cells[first], on=["seed", "trial"], suffixes=("", "_first"))
        values, its = (pairs[key].to_numpy(float) for key in (column, f"{column}_first"))
        gain, _ = statistics.paired_difference(its, values)
        mean = statistics.mean_interval(own[column].to_numpy(float))
        means = {other: float(own[other].mean()) for other in others}
        row = {"way": name, "trials": len(own), **statistics.cells_of(column, mean), **means}
        rows.append(row | statistics.cells_of("default_less_this", gain))
        words = [name, str(len(own)), shown(mean, 2), *(f"{each:.3g}" for each in means.values())]
        lines.append(f"| {' | '.join(words)} | {'' if name == first else shown(gain, 2)} |")
    pd.DataFrame(rows).to_csv(path.with_name(f"{path.stem}_summary.csv"), index=False)
    return "\n".join(lines)
