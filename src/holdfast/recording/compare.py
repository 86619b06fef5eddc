"""Whether two runs decided the same, and if not, where they first differ.

A run whose services were killed must have decided what an undisturbed one decides. So the decisions
of both journals are compared bit for bit, trial by trial, in order. Times, recoveries and services
may differ; a sensing action, a coordinate of a task action or the digest of a state may not. A
trial that one run has not finished is a difference as well.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from holdfast.outcome import Decisions, SensingDecision, TaskDecision, TrialResult
from holdfast.protocol.records import ActingRecord
from holdfast.recording.journal_file import find_journal
from holdfast.recording.journal_reader import JournalReader
from holdfast.recording.run_directory import configuration_difference

__all__ = ["Comparison", "Difference", "compare_runs"]

_ABSENT = "not given"
_ENDING = struct.Struct("<cQ32s")


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """Where two runs first differ.

    Attributes
    ----------
    what : str
        Such as ``sensing action``, ``task action[1]`` or ``state digest``.
    trial, step : int or None
        Where; None if it is about the runs or the trials as a whole.
    first, second : str
        What it is in either run; numbers as Python writes them.
    """

    what: str
    trial: int | None = None
    step: int | None = None
    first: str
    second: str


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """The result of comparing the decisions of two runs.

    Attributes
    ----------
    identical : bool
    first_run, second_run : str
        As they were named.
    trials, sensing_actions, task_actions : int
        How many were found to be the same.
    difference : Difference or None
        The first one.
    notes : tuple of str
        Other versions, other settings, other rewards.
    """

    identical: bool
    first_run: str
    second_run: str
    trials: int
    sensing_actions: int
    task_actions: int
    difference: Difference | None
    notes: tuple[str, ...]

    def describe(self) -> str:
        """Return the finding in words: one line if the runs are identical, else three."""
        difference = self.difference
        if difference is None:
            return (
                f"identical: {_counted(self.trials, 'trial')}, "
                f"{_counted(self.sensing_actions, 'sensing action')}, "
                f"{_counted(self.task_actions, 'task action')} and every state digest"
            )
        where = ""
        if difference.trial is not None:
            where += f"trial {difference.trial}, "
        if difference.step is not None:
            where += f"step {difference.step}, "
        names = (self.first_run, self.second_run)
        width = max(map(len, names)) + 1
        lines = [f"different: {where}{difference.what}"]
        for name, value in zip(names, (difference.first, difference.second), strict=True):
            lines.append(f"  {f'{name}:':{width}} {value}")
        return "\n".join(lines)

    def to_json(self) -> str:
        """Return the finding as indented JSON."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2).decode() + "\n"


def compare_runs(first: Path, second: Path) -> Comparison:
    """Compare the decisions of two runs; neither is changed.

    Parameters
    ----------
    first, second : Path
        The directory of a run, or its journal. Nobody may be using it.

    Raises
    ------
    OutputError
        If one is no run, is damaged, or is in use.
    """
    with ExitStack() as stack:
        journals = [
            stack.enter_context(JournalReader.read(find_journal(run, "compare")))
            for run in (first, second)
        ]
        found = _Found()
        _compare(journals[0], journals[1], found)
        for journal in journals:
            journal.require_unchanged()
    return Comparison(
        identical=found.difference is None,
        first_run=str(first),
        second_run=str(second),
        trials=found.trials,
        sensing_actions=found.sensing_actions,
        task_actions=found.task_actions,
        difference=found.difference,
        notes=tuple(found.notes),
    )


class _Found:
    """What has been found so far."""

    def __init__(self) -> None:
        self.difference: Difference | None = None
        self.notes: list[str] = []
        self.trials = 0
        self.sensing_actions = 0
        self.task_actions = 0


class _Trial(NamedTuple):
    """A trial of one run; without a result it is not finished."""

    number: int
    result: TrialResult | None
    state: str


def _compare(first: JournalReader, second: JournalReader, found: _Found) -> None:
    found.difference = _difference_of_runs(first.meta(), second.meta(), found)
    if found.difference is not None:
        return
    trials = (_trials(first), _trials(second))
    counts = (len(first.finished()), len(second.finished()))
    here, there = (next(own, None) for own in trials)
    while here is not None or there is not None:
        number = min(trial.number for trial in (here, there) if trial is not None)
        one = here if here is not None and here.number == number else None
        other = there if there is not None and there.number == number else None
        if one is None or other is None or one.result is None or other.result is None:
            found.difference = Difference(
                what="state of the trial",
                trial=number,
                first=_state(one, counts[0]),
                second=_state(other, counts[1]),
            )
            return
        found.difference = _difference_of_trials(one.result, other.result)
        if found.difference is not None:
            return
        _count(one.result, other.result, found)
        here, there = (next(own, None) for own in trials)
    if not found.trials:
        found.difference = Difference(
            what="number of finished trials: nothing to compare", first="0", second="0"
        )


def _difference_of_runs(
    first: Mapping[str, str], second: Mapping[str, str], found: _Found
) -> Difference | None:
    """Return how the runs differ as wholes; what changes no decision is only noted."""
    import yaml

    texts = [meta.get("configuration", "") for meta in (first, second)]
    configurations: list[Any] = [yaml.safe_load(text) for text in texts]
    for what, keys in (("problem", ("problem",)), ("seed", ("simulator", "seed"))):
        values = [_value(configuration, keys) for configuration in configurations]
        if values[0] != values[1]:
            return Difference(what=what, first=str(values[0]), second=str(values[1]))
    versions = [meta.get("holdfast_version", "of an unknown version") for meta in (first, second)]
    if versions[0] != versions[1]:
        found.notes.append(f"made by holdfast {versions[0]} and by holdfast {versions[1]}")
    if first.get("problem_sources") != second.get("problem_sources"):
        found.notes.append("the source of the problem differs")
    setting = configuration_difference(*texts)
    if setting is not None:
        key, old, new = setting
        found.notes.append(f"{key} is {old} in the first run and {new} in the second")
    return None


def _value(configuration: Any, keys: tuple[str, ...]) -> Any:
    for key in keys:
        if not isinstance(configuration, Mapping) or key not in configuration:
            return _ABSENT
        configuration = configuration[key]
    return configuration


def _trials(journal: JournalReader) -> Iterator[_Trial]:
    """Yield the trials of a run in order, the unfinished one in its place."""
    unfinished = journal.unfinished()
    begun = None
    if unfinished is not None:
        acted = sum(isinstance(record, ActingRecord) for record in unfinished.records)
        begun = _Trial(
            unfinished.trial, None, f"unfinished, {_counted(acted, 'task action')} so far"
        )
    for result in journal.results(with_decisions=True):
        if begun is not None and begun.number < result.trial:
            yield begun
            begun = None
        yield _Trial(result.trial, result, "finished")
    if begun is not None:
        yield begun


def _state(trial: _Trial | None, count: int) -> str:
    if trial is None:
        return f"not in this run, which has {_counted(count, 'finished trial')}"
    return trial.state


def _count(first: TrialResult, second: TrialResult, found: _Found) -> None:
    found.trials += 1
    found.sensing_actions += first.sensing_decisions
    found.task_actions += first.steps
    # Where there is no reward, earlier versions wrote 0.
    outcomes = [
        f"outcome {result.outcome}, reward {result.reward or 0.0!r}" for result in (first, second)
    ]
    if outcomes[0] != outcomes[1] and not any("the world" in note for note in found.notes):
        found.notes.append(
            f"the world answered otherwise: trial {first.trial} has {outcomes[0]} in the first run "
            f"and {outcomes[1]} in the second"
        )


# ---------------------------------------------------------------------------------------------
# One trial
# ---------------------------------------------------------------------------------------------


def _difference_of_trials(first: TrialResult, second: TrialResult) -> Difference | None:
    one, other = first.decisions, second.decisions
    assert one is not None
    assert other is not None
    if one == other:
        return None
    trial = first.trial
    if one.action_size != other.action_size:
        return Difference(
            what="size of the task actions",
            trial=trial,
            first=str(one.action_size),
            second=str(other.action_size),
        )
    for decision, counterpart in zip_longest(one, other):
        found = _difference_of_decisions(decision, counterpart)
        if found is not None:
            step, what, values = found
            return Difference(what=what, trial=trial, step=step, first=values[0], second=values[1])
    (steps, digest), (other_steps, other_digest) = _ending(one), _ending(other)
    if steps != other_steps:
        return Difference(
            what="number of steps", trial=trial, first=str(steps), second=str(other_steps)
        )
    return Difference(
        what="digest of the last state",
        trial=trial,
        step=steps,
        first=digest.hex(),
        second=other_digest.hex(),
    )


def _ending(decisions: Decisions) -> tuple[int, bytes]:
    """Return the number of steps and the digest of the last state; iterating leaves them out."""
    kind, steps, digest = _ENDING.unpack(decisions.log[-_ENDING.size :].rjust(_ENDING.size, b"\0"))
    return (steps, digest) if kind == b"E" else (0, b"")


def _difference_of_decisions(
    first: SensingDecision | TaskDecision | None, second: SensingDecision | TaskDecision | None
) -> tuple[int, str, tuple[str, str]] | None:
    """Return step, what differs and both values, None if nothing does."""
    if isinstance(first, SensingDecision) and isinstance(second, SensingDecision):
        if first == second:
            return None
        if first.step == second.step:
            if first.sensing_action != second.sensing_action:
                values = (str(first.sensing_action), str(second.sensing_action))
                return first.step, "sensing action", values
            return (
                first.step,
                "state digest after sensing",
                (first.state_digest.hex(), second.state_digest.hex()),
            )
    if (
        isinstance(first, TaskDecision)
        and isinstance(second, TaskDecision)
        and first.step == second.step
    ):
        # By their bits: 0.0 and -0.0 are different actions, and a NaN is equal to itself.
        for index, pair in enumerate(zip(first.action, second.action, strict=True)):
            if _bits(pair[0]) != _bits(pair[1]):
                return first.step, f"task action[{index}]", _written(*pair)
        return None
    step = min(decision.step for decision in (first, second) if decision is not None)
    return step, "next decision", (_named(first), _named(second))


def _bits(number: float) -> bytes:
    return struct.pack(">d", number)


def _written(first: float, second: float) -> tuple[str, str]:
    """Write numbers so that they look different: if their repr does not, as their bits too."""
    if repr(first) != repr(second):
        return repr(first), repr(second)
    return f"{first!r} (0x{_bits(first).hex()})", f"{second!r} (0x{_bits(second).hex()})"


def _named(decision: SensingDecision | TaskDecision | None) -> str:
    if decision is None:
        return "none, the trial ends"
    if isinstance(decision, SensingDecision):
        return f"sensing action {decision.sensing_action} at step {decision.step}"
    return f"a task action at step {decision.step}"


def _counted(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
