"""``expected_return`` on the eight problems of the study ``selectors``, judged by the study's rule.

The study has its own ways. This runs a candidate that came later in the same worlds, those of the
study's judging seed, and compares it trial by trial with the study's trials of random sensing, of
the default, of state entropy and of action covariance. ::

    python -m benchmarks.expected_return --out docs/results/expected_return/trials.csv

Nothing is chosen: the setting is that of the study ``myopic``, whose problems are others. Of the
study's trials those count that the candidate has, too. Before anything is run, a trial of the
default is repeated in each setting; if one comes out otherwise, the study's are of other code.
With ``--trials 0`` only the tables are made, from the trials that are there.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks import trial_table
from holdfast.planning.settings import SelectorSettings
from studies import myopic, selectors
from studies.cases import CASES, Case
from studies.judged_study import compared, steps_and_success
from studies.study import CLAIM
from studies.tables import to_csv
from studies.trial_batches import run_trials_of, trial_tasks
from studies.trial_files import read_trials

COLUMNS = ("success", "steps", "sensing_decisions", "trial_s")
NAMES = ("problem", "sensing_interval")
CANDIDATE = "expected return, 8 looks"
RIVALS = (
    selectors.BASELINE,
    selectors.DEFAULT,
    "state entropy, neighbours",
    "action covariance",
)
FEWER = {"peg in space": 24, "light and dark": 24, "busy room": 24}
"""Most trials of the problems whose decisions take five to fifty times as long."""
KNOWN = Path(__file__).parents[1] / "docs/results/selectors/trials.parquet"
_OF_THE_WORLD = COLUMNS[:3]
"""Columns that a repeated trial has again; its time is processor time, which differs."""

_Cells = Mapping[tuple[str, int, str], pd.DataFrame]
"""Trials by problem, interval and way."""


def trial_of(
    case: Case, interval: int, selector: SelectorSettings, seed: int, trial: int
) -> dict[str, Any]:
    """Run a trial of a setting; as in the study, one that fails has the limit of steps."""
    series = case.series(selector, interval, seed=seed, num_trials=2)
    (task,) = trial_tasks(series, series.num_trials)
    began = time.process_time()
    (row,) = run_trials_of(**task.parameters | {"first_trial": trial, "num_trials": 1}).to_dict(
        "records"
    )
    seconds = round(time.process_time() - began, 3)
    return {**{name: int(row[name]) for name in _OF_THE_WORLD}, "trial_s": seconds}


def known_trials() -> tuple[int, _Cells]:
    """Return the seed and the judging trials of the study."""
    trials = read_trials(KNOWN).trials
    judging = trials[(trials["purpose"] == CLAIM) & trials["way"].isin(RIVALS)]
    (seed,) = judging["seed"].unique()
    return int(seed), {
        key: rows.sort_values("trial").reset_index(drop=True)
        for key, rows in judging.groupby([*NAMES, "way"], sort=False)
    }


def check_pairs(seed: int, known: _Cells) -> None:
    """Refuse trials that this code does not repeat."""
    for case in CASES:
        for interval in selectors.INTERVALS:
            kept = known[case.name, interval, selectors.DEFAULT].iloc[0]
            selector = selectors.WAYS[selectors.DEFAULT]
            again = trial_of(case, interval, selector, seed, int(kept["trial"]))
            if any(int(kept[name]) != again[name] for name in _OF_THE_WORLD):
                raise SystemExit(
                    f"{case.name}, interval {interval}: a trial of the default is {again} here, "
                    f"another in {KNOWN}; run the study selectors anew"
                )


def cells_of(seed: int) -> list[trial_table.Cell]:
    """Return all settings of the study, with the candidate."""
    selector = myopic.WAYS[CANDIDATE]
    return [
        trial_table.Cell(
            {"problem": case.name, "sensing_interval": str(interval)},
            partial(trial_of, case, interval, selector, seed),
            FEWER.get(case.name),
        )
        for case in CASES
        for interval in selectors.INTERVALS
    ]


def verdict(path: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the comparisons of the study's rule, and those over all problems together.

    The default and random sensing are judged by the same trials, to show what these can show.
    """
    _, known = known_trials()
    cells: dict[tuple[str, int, str], pd.DataFrame] = {}
    for (problem, number), own in trial_table.read(path, NAMES).items():
        cells[problem, int(number), CANDIDATE] = own
        for rival in RIVALS:
            kept = known[problem, int(number), rival]
            cells[problem, int(number), rival] = kept[kept["trial"].isin(own["trial"])]
    comparisons, together = [], []
    for way in (CANDIDATE, selectors.DEFAULT, selectors.BASELINE):
        rivals = [rival for rival in (CANDIDATE, *RIVALS) if rival != way]
        comparisons.append(selectors.verdict_on(way, cells, rivals))
        for rival in rivals:
            own, other = (
                steps_and_success(*(table for key, table in cells.items() if key[2] == each))
                for each in (way, rival)
            )
            names = {"candidate": way, "rival": rival, "trials": len(own[0])}
            together.append(names | compared(own, other))
    return pd.concat(comparisons, ignore_index=True), pd.DataFrame(together)


def main() -> None:
    """Run what the file lacks, and write the comparisons beside it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/expected_return/trials.csv"))
    parser.add_argument("--trials", type=int, default=40, help="0: tables alone")
    options = parser.parse_args()
    seed, known = known_trials()
    if options.trials:
        check_pairs(seed, known)
    trial_table.run(options.out, cells_of(seed), options.trials, seed, COLUMNS)
    comparisons, together = verdict(options.out)
    for name, table in (("verdict", comparisons), ("together", together)):
        options.out.with_name(f"{name}.csv").write_text(to_csv(table), encoding="utf-8")
    for way, rows in comparisons.groupby("candidate", sort=False):
        print(f"{way}: beaten in {sum(rows['beaten_in'] != '')} of {len(rows)} comparisons")
    print(together.to_string())


if __name__ == "__main__":
    main()
