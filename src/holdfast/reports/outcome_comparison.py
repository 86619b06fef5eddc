"""Which of several runs is better: their outcomes, compared on the same worlds.

In a simulated run, seed and trial name every random number, so trial 7 of two runs of one problem
and seed happens in the same world. Such trials are compared in pairs: the effect of a setting shows
within a pair, and the differences between worlds cancel. An interval is the percentile bootstrap
over trials; it needs no assumption about the distribution of steps, rewards or times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import msgspec
import numpy as np

from holdfast.errors import OutputError
from holdfast.journal.journal_reader import JournalReader
from holdfast.journal.run_directory import first_difference, recorded_configuration, world_of
from holdfast.journal.tables import wilson_interval
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import TrialResult
from holdfast.reports.table_formats import TIMES, Table, aligned, decimals, outward, rounded
from holdfast.robot.environment_maker import BUILT_IN

LEVEL = 0.95
RESAMPLES = 9_999
_SEED = 0
_LEAST_TRIALS = 2
_LEAST_FOR_A_VERDICT = 10  # of 2 trials half of all intervals miss the truth, of 5 every eighth
_NUMBERS_IN_MEMORY = 10_000_000

Verdict: TypeAlias = Literal[
    "better", "worse", "no difference found", "too few trials", "not judged"
]


class OutcomeEffect(msgspec.Struct, frozen=True, kw_only=True):
    """How one measure of a run compares with the baseline's.

    Attributes
    ----------
    measure : {"success_rate", "failure_rate", "steps", "reward", "decision_ms"}
    kind : {"difference", "ratio"}
        Of the run's value to the baseline's.
    trials : int
        Of the run, in the comparison.
    baseline, run : float
        Rate of success and of failure (a truncated trial is neither), geometric mean of the steps,
        mean reward, median of the decision times.
    interval : tuple of float, or None
        For ``effect``; None if no two trials differ in it, so nothing is known of its scatter.
    verdict : {"better", "worse", "no difference found", "too few trials", "not judged"}
        Of the run, by whether the interval has the value of no difference. With fewer than ten
        trials an interval is too short to say so. Times are judged only if they were measured in
        turns: another moment, load or machine makes a difference as well.
    """

    measure: str
    kind: Literal["difference", "ratio"]
    trials: int
    baseline: float
    run: float
    effect: float
    interval: tuple[float, float] | None
    verdict: Verdict


class RunOutcomes(msgspec.Struct, frozen=True, kw_only=True):
    """A run, compared with the baseline.

    Attributes
    ----------
    trials : int
        Compared trials: of pairs, or of this run alone.
    notes : tuple of str
        What else a person should know: trials left out, other versions of the code.
    """

    run: str
    trials: int
    effects: tuple[OutcomeEffect, ...]
    notes: tuple[str, ...]


class OutcomeEstimate(NamedTuple):
    """What a measure is in one run, with its interval; None if trials do not scatter."""

    measure: str
    trials: int
    value: float
    interval: tuple[float, float] | None


class OutcomeComparison(Table, msgspec.Struct, frozen=True, kw_only=True):
    """The outcomes of runs, compared with those of the first; a row for each run and measure.

    Attributes
    ----------
    paired : bool
        Whether trials were compared in pairs of one world.
    step_limit : int
        Steps that a trial counts that did not reach the goal.
    level, method
        Of each interval by itself.
    runs : tuple of RunOutcomes
        All but the first, which is the baseline.
    """

    baseline: str
    paired: bool
    step_limit: int
    level: float
    method: str
    runs: tuple[RunOutcomes, ...]

    def columns(self) -> Sequence[str]:
        """Return the names of the columns, for programs."""
        of_effect = ("measure", "kind", "trials", "baseline", "value", "effect")
        return ("run", *of_effect, "low", "high", "verdict")

    def rows(self) -> list[tuple[object, ...]]:
        """Return a row for each run and measure; without bounds where all trials are alike."""
        rows: list[tuple[object, ...]] = []
        for run in self.runs:
            for each in run.effects:
                numbers = (each.trials, each.baseline, each.run, each.effect)
                bounds = each.interval or (None, None)
                rows.append((run.run, each.measure, each.kind, *numbers, *bounds, each.verdict))
        return rows

    def names(self) -> Sequence[str]:
        """Return the names by which columns are chosen: ``trials`` and the measures."""
        there = {effect.measure for run in self.runs for effect in run.effects}
        counts = len({run.trials for run in self.runs}) > 1
        return ("", *("trials",) * counts, *(name for name in _TEXTS if name in there))

    def shown(self) -> list[tuple[str, ...]]:
        """Return a row for each run: its value of each measure, and beneath it the effect."""
        names = self.names()
        rows = [[f"{self.baseline} (baseline)", *len(names[1:]) * [""]]]
        for run in self.runs:
            texts = {"trials": str(run.trials)}
            for each in run.effects:
                baseline, value, *effect = _texts_of(each)
                at = names.index(each.measure)
                rows[0][at] = rows[0][at] or baseline
                texts[each.measure] = value
                if each.verdict != "not judged":
                    star = "*" if each.verdict in ("better", "worse") else ""
                    texts[each.measure] += f"\n{' '.join(effect)}{star}"
            rows.append([run.run, *(texts.get(name, "-") for name in names[1:])])
        heads = (_TEXTS[name][0] if name in _TEXTS else name for name in names)
        return [tuple(heads), *map(tuple, rows)]

    def legend(self) -> str:
        """Return how the numbers are defined, and the notes."""
        counts = " or ".join(sorted({f"{run.trials:,}" for run in self.runs}))
        first = (
            f"{counts} {self._pairs()}; with each value the effect against the baseline and its "
            f"interval (points of a rate, {TIMES} for ratios of steps and times, differences of "
            "rewards). *: the interval excludes no effect."
        )
        return "\n".join([first, *self._definitions(), *self.notes()])

    def notes(self) -> list[str]:
        """Return what else a person should know, a line for each."""
        return [f"{run.run}: {note}" for run in self.runs for note in run.notes]

    def _pairs(self) -> str:
        return f"trials {'paired by number' if self.paired else 'not paired'}"

    def _definitions(self) -> list[str]:
        apart = "not judged: the runs may have been measured apart (a sweep's own table is not)."
        verdicts = {each.verdict for run in self.runs for each in run.effects}
        return [
            "steps: the geometric mean, which fits ratios (the summary has the mean of the steps "
            "that were made); a trial that did not reach the goal counts as its limit, "
            f"{self.step_limit:,} steps.",
            *[f"decision (ms): {apart}"] * ("not judged" in verdicts),
            f"intervals: {self.level:.0%}, {self.method}, each by itself.",
        ]

    def fitting(self, width: int) -> str:
        """Return the table; if it has longer lines than ``width``, one for each run instead."""
        text = str(self)
        longest = max(map(len, text.splitlines()[: len(self.runs) + 2]))
        return text if longest <= width else "\n".join([self.describe(), *self.notes()])

    def describe(self) -> str:
        """Return a table for each run, and how its numbers are defined."""
        lines = []
        for run in self.runs:
            lines.append(f"{run.run} against {self.baseline}, {run.trials:,} {self._pairs()}:")
            head = ("", "baseline", "run", "effect", f"{self.level:.0%} interval", "")
            rows = ((_TEXTS[one.measure][0], *_texts_of(one), one.verdict) for one in run.effects)
            lines += [*(f"  {'  '.join(row)}".rstrip() for row in aligned([head, *rows])), ""]
        return "\n".join([*lines, *self._definitions()])

    def to_json(self) -> str:
        """Return the comparison as indented JSON."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2).decode() + "\n"


def compare_outcomes(runs: Sequence[Path], *, paired: bool = True) -> OutcomeComparison:
    """Compare the outcomes of runs on the disk, which nobody may be using, with the first one's.

    Unless ``paired``, each is a sample of its own, so that runs with other seeds can be compared.

    Raises OutputError if one is no run or is damaged, or if the runs cannot be compared: their
    problems, limits or (if paired) seeds differ, or they have too few trials.
    """
    found = [read_outcomes(path, str(path)) for path in runs]
    return compare_results(found, paired=paired, strict=True)


def compare_results(
    runs: Sequence[ComparedRun],
    *,
    paired: bool = True,
    in_turns: bool = False,
    strict: bool = False,
) -> OutcomeComparison:
    """Compare results with those of the first run; where their tasks differ, notes say so.

    If they were measured ``in_turns``, trial by trial, decision times are judged, too. If
    ``strict``, other tasks are an error. Raises OutputError if their limits or (if paired) their
    seeds differ, or they have too few trials.
    """
    baseline, *others = runs
    over = "pairs of trials" if paired else "trials"
    return OutcomeComparison(
        baseline=baseline.name,
        paired=paired,
        step_limit=baseline.step_limit,
        level=LEVEL,
        method=f"percentile bootstrap over {over}, {RESAMPLES:,} resamples, fixed seed",
        runs=tuple(_compare(baseline, other, paired, in_turns, strict) for other in others),
    )


class ComparedRun(NamedTuple):
    """What is compared of a run."""

    name: str
    results: Mapping[int, TrialResult]
    seed: Any
    step_limit: int
    world: Mapping[str, Any]  # the settings that say which task it is, as far as known
    is_finished: bool = True
    arguments: Mapping[str, Any] = {}  # of a world not simulated: perhaps only how it is reached
    simulated: bool = True
    problem_sources: str | None = None


def read_outcomes(path: Path, name: str) -> ComparedRun:
    """Read what is compared of a recorded run; OutputError if it is none or is damaged."""
    with JournalReader.read_run(path, "compare") as journal:
        return outcomes_of(journal, name)


def outcomes_of(journal: JournalReader, name: str) -> ComparedRun:
    """Return what is compared of a run whose journal is open; OutputError if it is damaged."""
    meta = journal.meta()
    results = {result.trial: result for result in journal.results()}
    configuration = recorded_configuration(meta.get("configuration", ""), journal.path)
    simulator = configuration["simulator"]
    environment = world_of(configuration.get("environment") or {})
    # An episode of gymnasium follows from seed and trial, too.
    simulated = environment["object"] is None or environment["object"] in BUILT_IN
    arguments = environment["arguments"] if simulated else environment.pop("arguments")
    return ComparedRun(
        name=name,
        problem_sources=meta.get("problem_sources"),
        results=results,
        is_finished=len(results) >= int(simulator["num_trials"]),
        seed=simulator["seed"],
        step_limit=int(simulator["max_steps"]),
        world={
            "problem": configuration["problem"],
            "model": configuration.get("model"),
            "environment": environment,
        },
        arguments=arguments,
        simulated=simulated,
    )


def _compare(
    baseline: ComparedRun, other: ComparedRun, paired: bool, in_turns: bool, strict: bool
) -> RunOutcomes:
    refused = f"{other.name}: cannot be {{}} with {baseline.name}: "
    known = baseline.world.keys() & other.world  # a table of Python knows less than a run
    there, here = ({key: run.world[key] for key in known} for run in (baseline, other))
    notes = []
    for found, so in (
        (first_difference(there, here), "so the trials are of different tasks"),
        (
            first_difference(baseline.arguments, other.arguments, "environment.arguments"),
            "so these may be two worlds",
        ),
    ):
        if found is not None:
            notes.append(f"{found[0]} is {found[2]} here and {found[1]} there, {so}")
            if strict and "tasks" in so:
                raise OutputError(refused.format("compared") + notes[-1])
    if baseline.step_limit != other.step_limit:
        raise OutputError(
            f"{refused.format('compared')}the limit is {other.step_limit:,} steps here and "
            f"{baseline.step_limit:,} there"
        )
    if paired and baseline.seed != other.seed:
        raise OutputError(
            f"{refused.format('paired')}the seed is {other.seed} here and {baseline.seed} there, "
            "so the worlds differ; compare them as independent samples (--unpaired), which takes "
            "more trials to find a difference"
        )
    pairs = [list(run.results.values()) for run in (baseline, other)]
    if paired:
        trials = sorted(baseline.results.keys() & other.results.keys())
        pairs = [[run.results[trial] for trial in trials] for run in (baseline, other)]
        left_out = len(baseline.results.keys() ^ other.results.keys())
        if left_out:
            notes.append(f"trials that only one of the runs has finished, left out: {left_out:,}")
        if not other.simulated:
            notes.append(
                "the world is not simulated: trials of one number need not be in the same world"
            )
    notes += [f"{run.name}: is not finished" for run in (baseline, other) if not run.is_finished]
    if min(map(len, pairs)) < _LEAST_TRIALS:
        raise OutputError(
            f"{other.name}: too few trials to compare with {baseline.name}: "
            f"{min(map(len, pairs))}; intervals need at least {_LEAST_TRIALS}"
        )
    if other.problem_sources != baseline.problem_sources:
        notes.append("the source of the problem differs")
    effects = effects_of(*pairs, step_limit=baseline.step_limit, paired=paired, in_turns=in_turns)
    return RunOutcomes(run=other.name, trials=len(pairs[1]), effects=effects, notes=tuple(notes))


def effects_of(
    first: Sequence[TrialResult],
    second: Sequence[TrialResult],
    *,
    step_limit: int,
    paired: bool,
    in_turns: bool = False,
) -> tuple[OutcomeEffect, ...]:
    """Compare the results of two runs, the first the baseline.

    If ``paired``, they are of the same trials in the same order. A measure that fewer than two
    trials of a run have is left out.
    """
    pairs = (first, second)
    effects = [_effect_of(measure, pairs, step_limit, paired=paired) for measure in _MEASURES]
    if not in_turns and effects[-1] is not None:
        effects[-1] = msgspec.structs.replace(effects[-1], verdict="not judged")
    return tuple(filter(None, effects))


def estimates_of(results: Sequence[TrialResult], *, step_limit: int) -> tuple[OutcomeEstimate, ...]:
    """Return each measure of a run with its interval; rates have Wilson's, others the bootstrap's.

    A measure that no trial has is left out.
    """
    found = []
    for measure in _MEASURES:
        numbers = _numbers_of(measure, [results], step_limit)
        if numbers is None or not (known := [each for each in numbers[0] if each is not None]):
            continue
        values = np.array(known, dtype=np.float64)
        interval: tuple[float, float] | None = None
        if measure.name.endswith("_rate"):
            interval = wilson_interval(int(values.sum()), values.size)
        elif values.size >= _LEAST_TRIALS and np.ptp(values) > 0.0:
            interval = bootstrap_interval([values], measure.summarise, paired=False)
        value = float(measure.summarise(values, 0))
        found.append(OutcomeEstimate(measure.name, values.size, value, interval))
    return tuple(found)


class _Measure(NamedTuple):
    """A number of each trial, None if that says nothing, and how those of a run are summarised."""

    name: str
    kind: Literal["difference", "ratio"]
    more_is_better: bool
    of_trial: Callable[[TrialResult, int], float | None]  # of a result and the limit of steps
    summarise: Callable[[FloatArray, int], Any]  # of numbers and an axis


def _steps_to_goal(result: TrialResult, limit: int) -> float | None:
    # A trial that begins in the goal does so in each run of its world, and has no ratio.
    return float(result.steps if result.success else limit) or None


def _decision_ms(result: TrialResult, limit: int) -> float | None:
    del limit
    return float(np.median(result.sensing_ms)) if result.sensing_ms else None


def _geometric_mean(values: FloatArray, axis: int) -> Any:
    return np.exp(np.mean(np.log(values), axis=axis))


_MEASURES = (
    _Measure("success_rate", "difference", True, lambda result, _: float(result.success), np.mean),
    _Measure("failure_rate", "difference", False, lambda result, _: float(result.failed), np.mean),
    _Measure("steps", "ratio", False, _steps_to_goal, _geometric_mean),
    _Measure("reward", "difference", True, lambda result, _: result.reward, np.mean),
    _Measure("decision_ms", "ratio", False, _decision_ms, np.median),
)


def _numbers_of(
    measure: _Measure, runs: Sequence[Sequence[TrialResult]], limit: int
) -> list[list[float | None]] | None:
    """Return a measure of each trial of each run; None if it says nothing about them."""
    numbers = [[measure.of_trial(result, limit) for result in results] for results in runs]
    if measure.name == "reward" and any(None in values for values in numbers):
        return None  # a mean over the trials that have one would not be of the same trials
    if measure.name == "failure_rate" and not any(map(any, numbers)):
        return None  # in most worlds nothing can fail
    return numbers


def _effect_of(
    measure: _Measure, pairs: Sequence[Sequence[TrialResult]], limit: int, *, paired: bool
) -> OutcomeEffect | None:
    """Return how the second run compares with the first, None if that is not known."""
    numbers = _numbers_of(measure, pairs, limit)
    if numbers is None:
        return None
    if paired:
        known = [pair for pair in zip(*numbers, strict=True) if None not in pair]
        numbers = [[pair[which] for pair in known] for which in (0, 1)]
    one, other = (
        np.array([number for number in each if number is not None], dtype=np.float64)
        for each in numbers
    )
    trials = min(len(one), len(other))
    if trials < _LEAST_TRIALS:
        return None

    def compared(first: Any, second: Any) -> Any:
        return second - first if measure.kind == "difference" else second / first

    def effect_of(first: FloatArray, second: FloatArray, axis: int) -> Any:
        return compared(measure.summarise(first, axis), measure.summarise(second, axis))

    interval = None
    with np.errstate(divide="ignore", invalid="ignore"):
        effect = float(effect_of(one, other, 0))
        if not np.isfinite(effect):
            return None  # a ratio to no time at all
        scatter = [compared(one, other)] if paired else [one, other]
        if max(map(np.ptp, scatter)) > 0.0:
            interval = bootstrap_interval((one, other), effect_of, paired=paired)
    no_effect = 0.0 if measure.kind == "difference" else 1.0
    verdict: Verdict = "no difference found"
    if trials < _LEAST_FOR_A_VERDICT:
        verdict = "too few trials"
    elif interval is not None and not interval[0] <= no_effect <= interval[1]:
        verdict = "better" if (effect > no_effect) == measure.more_is_better else "worse"
    return OutcomeEffect(
        measure=measure.name,
        kind=measure.kind,
        trials=len(other),
        baseline=float(measure.summarise(one, 0)),
        run=float(measure.summarise(other, 0)),
        effect=effect,
        interval=interval,
        verdict=verdict,
    )


def bootstrap_interval(
    values: Sequence[FloatArray],
    statistic: Callable[..., Any],
    *,
    paired: bool,
    level: float = LEVEL,
) -> tuple[float, float]:
    """Return the interval in which the statistic of resamples lies; pairs are drawn as pairs."""
    generator = np.random.default_rng(_SEED)
    lengths = [len(each) for each in (values[:1] if paired else values)]
    batch = max(1, _NUMBERS_IN_MEMORY // max(lengths))
    found = []
    for first in range(0, RESAMPLES, batch):
        rows = min(batch, RESAMPLES - first)
        drawn = [generator.integers(0, length, (rows, length)) for length in lengths]
        if paired:
            drawn *= len(values)
        resampled = (each[indices] for each, indices in zip(values, drawn, strict=True))
        found.append(statistic(*resampled, axis=-1))
    low, high = np.quantile(np.concatenate(found), [0.5 - 0.5 * level, 0.5 + 0.5 * level])
    return float(low), float(high)


_TEXTS = {
    "success_rate": ("success (%)", 100.0),
    "failure_rate": ("failed (%)", 100.0),
    "steps": ("steps", 1.0),
    "reward": ("reward", 1.0),
    "decision_ms": ("decision (ms)", 1.0),
}
"""For people: a measure's title, and its scale."""


def _texts_of(effect: OutcomeEffect) -> tuple[str, str, str, str]:
    """Return the baseline's value and the run's, the effect and its interval, rounded to it."""
    scale = _TEXTS[effect.measure][1]
    values = scale * effect.baseline, scale * effect.run
    ratio = effect.kind == "ratio"
    if effect.interval is None:
        change = f"{TIMES}{effect.effect:.3g}" if ratio else f"{scale * effect.effect:+.4g}"
        return f"{values[0]:.4g}", f"{values[1]:.4g}", change, "all alike"
    own, sign, none = (1.0, "", 1.0) if ratio else (scale, "+", 0.0)
    bounds = [own * end for end in effect.interval]
    digits = decimals(bounds)
    # What does not have the value of no effect must not be rounded to it.
    while none in outward(bounds, digits) and none not in bounds:
        digits += 1
    ends = own * effect.effect, *outward(bounds, digits)
    change, low, high = (f"{rounded(each, digits):{sign}.{digits}f}" for each in ends)
    # Of a ratio the values are as sure as their share of it.
    shares = [each / effect.effect if ratio and effect.effect else 1.0 for each in values]
    places = [decimals([share * end for end in bounds]) for share in shares]
    baseline, value = (
        f"{rounded(each, at):.{at}f}" for each, at in zip(values, places, strict=True)
    )
    return baseline, value, f"{TIMES}{change}" if ratio else change, f"[{low}, {high}]"


def shown_estimate(estimate: OutcomeEstimate) -> tuple[str, str, str]:
    """Return a measure's title, its value and its interval, for people."""
    title, scale = _TEXTS[estimate.measure]
    value = scale * estimate.value
    if estimate.interval is None:
        return title, f"{value:.4g}", "all alike"
    bounds = [scale * end for end in estimate.interval]
    digits = decimals(bounds)
    ends = rounded(value, digits), *outward(bounds, digits)
    value_text, low, high = (f"{each:.{digits}f}" for each in ends)
    return title, value_text, f"[{low}, {high}]"
