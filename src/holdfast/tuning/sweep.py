"""A grid of settings, each combination a run of its own, on the same worlds.

Every combination (an arm) has a directory of a run, as ``holdfast run`` makes it, so each can be
continued, compared and exported by the other commands. Trials are run number by number over all
arms: whenever a sweep is interrupted, what it has is nearly all paired.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple, Self

import msgspec

from holdfast.config.loader import Configuration
from holdfast.errors import InvalidValueError, OutputError
from holdfast.journal.run_directory import RunDirectory
from holdfast.journal.tables import trial_row
from holdfast.planning.outcome import TRIAL_COLUMNS, TrialResult
from holdfast.printable import csv_rows
from holdfast.reports.outcome_comparison import ComparedRun, OutcomeComparison, compare_results
from holdfast.robot.recomputing import resume_run_if_begun
from holdfast.robot.trial_pool import Arm, TrialPool
from holdfast.runtime.files import shown_path, write_atomically
from holdfast.tuning.simulated_trials import arm_of, table_of

MAX_ARMS = 200  # largest number of combinations; each has an open journal
_MAX_NAME = 100
_UNSAFE = re.compile(r"[^\w.=,+-]+")
_TABLE, _TRIALS, _SWEEP = "table", "trials.csv", "sweep.json"


class SweptArm(NamedTuple):
    """A combination: its name, its directory's name, and the values by ``section.key``.

    ``varied`` are the keys that have several values, in their order.
    """

    label: str
    directory: str
    values: Mapping[str, Any]
    configuration: Configuration
    varied: list[str]


class _Begun(msgspec.Struct):
    """What ``sweep.json`` says: the keys, the arms, and whether all arms took turns so far."""

    keys: list[str]
    arms: list[str]
    in_turns: bool = True


def arms_of(
    axes: Mapping[str, Sequence[Any]], load: Callable[[Mapping[str, Any]], Configuration]
) -> list[SweptArm]:
    """Return all combinations; the last key varies fastest.

    Raises InvalidValueError if a key has a value twice, there are more than 200 combinations, or
    they would not have the same worlds: trials, seed or limit of steps differ.

    ``axes`` have the values of each ``section.key``; one with a single value is set in all of them,
    and is in no name. ``load`` gets values by key, and returns the configuration with them.
    """
    for key, values in axes.items():
        for index, value in enumerate(values):
            # 1 and true are equal but not the same.
            if repr(value) in map(repr, values[:index]):
                raise InvalidValueError(f"{key} has the value {_text(value)} twice")
    if (count := math.prod(map(len, axes.values()))) > MAX_ARMS:
        raise InvalidValueError(f"{count:,} combinations; a sweep has at most {MAX_ARMS}")
    varied = [key for key, values in axes.items() if len(values) > 1]
    arms: list[SweptArm] = []
    for combination in itertools.product(*axes.values()):
        chosen = dict(zip(axes, combination, strict=True))
        label = ", ".join(f"{_short(key, varied)}={_text(chosen[key])}" for key in varied)
        configuration = load(chosen)
        name = _free_name(label or "run", [arm.directory for arm in arms])
        arms.append(SweptArm(label or configuration.path.stem, name, chosen, configuration, varied))
        first, this = arms[0].configuration.simulator, configuration.simulator
        for key in ("seed", "num_trials", "max_steps"):
            if getattr(this, key) != getattr(first, key):
                raise InvalidValueError(
                    f"simulator.{key} is {getattr(first, key)} and {getattr(this, key)}: it cannot "
                    "be swept, because trials are compared in pairs of the same world and limit"
                )
    return arms


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _short(key: str, keys: Sequence[str]) -> str:
    """Return a key without its section, if no other key is called so."""
    own = key.partition(".")[2]
    return key if any(other != key and other.endswith(f".{own}") for other in keys) else own


def _free_name(label: str, taken: Sequence[str]) -> str:
    name = _UNSAFE.sub("_", label.replace(", ", ",")).strip("._")[:_MAX_NAME] or "run"
    numbered = (f"{name}-{number}" for number in itertools.count(2))
    return next(each for each in itertools.chain([name], numbered) if each not in taken)


class Sweep:
    """The open directories of all arms, to be used in a ``with`` statement.

    ``directory`` gets one for each arm; a sweep that has begun goes on, perhaps with ``new`` arms.
    ``total`` counts the trials of all arms, ``finished`` those that were finished before. Raises
    OutputError on entry, if the directory has a sweep of other keys, or cannot be used.
    """

    def __init__(self, directory: Path, arms: Sequence[SweptArm]) -> None:
        self.directory = directory.absolute()
        self.arms = arms
        self.total = sum(arm.configuration.simulator.num_trials for arm in arms)
        self.finished = 0
        self.new: list[str] = []
        self._pool_arms = [arm_of(arm.configuration, arm.label) for arm in arms]
        self._runs: list[RunDirectory] = []
        self._before: list[set[int]] = []
        self._in_turns = True
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            begun = self._go_on()
            for arm in self.arms:
                run = resume_run_if_begun(self.directory / arm.directory, arm.configuration)
                self._runs.append(stack.enter_context(run))
            content = msgspec.json.format(msgspec.json.encode(begun), indent=2)
            write_atomically(self.directory / _SWEEP, content)
            self._before = [run.journal.finished() for run in self._runs]
            self.finished = sum(map(len, self._before))
            self._stack = stack.pop_all()
        return self

    def _go_on(self) -> _Begun:
        """Return which keys and arms the directory is to have; refuse those of another sweep."""
        path, keys = self.directory / _SWEEP, self.arms[0].varied
        labels = [arm.label for arm in self.arms]
        try:
            there = msgspec.json.decode(path.read_bytes(), type=_Begun)
        except FileNotFoundError:
            there = _Begun(keys, labels)
        except (OSError, msgspec.DecodeError) as error:
            raise OutputError(f"{shown_path(path)}: cannot be read: {error}") from error
        if there.keys != keys:
            raise OutputError(
                f"{shown_path(self.directory)}: has a sweep of {', '.join(there.keys)}, and this "
                f"one is of {', '.join(keys)}; name the same keys in the same order (more values "
                "extend it), or choose another directory (--out)"
            )
        self.new = [label for label in labels if label not in there.arms]
        self._in_turns = there.in_turns and not self.new
        return _Begun(keys, [*there.arms, *self.new], self._in_turns)

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def run(self, jobs: int, on_result: Callable[[TrialResult], None]) -> None:
        """Run what is not finished; raises what :meth:`TrialPool.run` raises.

        No trial runs in this process, so one that ends its process is an error that names it.
        However it ends, each arm's tables cover its finished trials.
        """
        started = perf_counter()
        by_arm = dict(zip(self._pool_arms, self._runs, strict=True))
        finished = dict(zip(self._pool_arms, self._before, strict=True))
        spent: dict[Arm, float] = dict.fromkeys(by_arm, 0.0)

        def trials() -> Iterator[tuple[Arm, int]]:
            for trial in range(self.arms[0].configuration.simulator.num_trials):
                for arm, before in finished.items():
                    if trial not in before:
                        yield arm, trial

        try:
            left = self.total - self.finished
            with TrialPool(jobs, expected=left, overdue=lambda *_: False) as pool:
                for done in pool.run(trials()):
                    by_arm[done.arm].add(done.result)
                    spent[done.arm] += done.elapsed_s
                    on_result(done.result)
        finally:
            # The processes work on all arms at once, so each gets its share of the time.
            share = (perf_counter() - started) / (sum(spent.values()) or 1.0)
            for arm, run in by_arm.items():
                run.write_tables(spent[arm] * share)

    def comparison(self, baseline: int = 0) -> OutcomeComparison:
        """Compare all arms, which are finished, with one of them."""
        order = [baseline, *(each for each in range(len(self.arms)) if each != baseline)]
        compared = []
        for arm, run in ((self._pool_arms[number], self._runs[number]) for number in order):
            results = {result.trial: result for result in run.journal.results()}
            world = table_of(arm, ()).world
            compared.append(ComparedRun(arm.label, results, arm.seed, arm.max_steps, world))
        return compare_results(compared, in_turns=self._in_turns)

    def write_tables(self, comparison: OutcomeComparison) -> list[str]:
        """Write ``trials.csv`` and the comparison in three formats; return the files' names."""
        keys = list(self.arms[0].values)
        rows = (
            (*(_text(arm.values[key]) for key in keys), *trial_row(result))
            for arm, run in zip(self.arms, self._runs, strict=True)
            for result in run.journal.results()
        )
        write_atomically(self.directory / _TRIALS, csv_rows((*keys, *TRIAL_COLUMNS), rows))
        comparison.to_csv(self.directory / f"{_TABLE}.csv")
        comparison.to_latex(self.directory / f"{_TABLE}.tex")
        comparison.to_markdown(self.directory / f"{_TABLE}.md")
        return [f"{_TABLE}.md", f"{_TABLE}.tex", f"{_TABLE}.csv", _TRIALS]
