"""Whether two runs decided the same, and if not, where they first differ.

A run whose services were killed must have decided what an undisturbed one decides. So the decisions
of both journals are compared bit for bit, trial by trial, in order. Times, recoveries and services
may differ; a sensing action, a coordinate of a task action or the digest of a state may not. A
trial that one run has not finished is a difference as well.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import zip_longest
from pathlib import Path
from typing import Any

import msgspec

from holdfast.journal.fingerprint import read_earlier
from holdfast.journal.journal_reader import JournalReader, UnfinishedTrial
from holdfast.journal.run_directory import configuration_difference, recorded_configuration
from holdfast.planning.inputs import ActingRecord, Decision, Sensed, decisions_of
from holdfast.planning.outcome import Decisions
from holdfast.printable import one_line

_ENDING = struct.Struct("<cQ32s")


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """Where two runs first differ."""

    what: str  # such as ``sensing action``, ``task action[1]`` or ``state digest``
    # Where; None if it is about the runs or the trials as a whole.
    trial: int | None = None
    step: int | None = None
    # What it is in either run; numbers as Python writes them.
    first: str
    second: str


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """The result of comparing the decisions of two runs."""

    identical: bool
    # As they were named.
    first_run: str
    second_run: str
    # How many were found to be the same.
    trials: int
    sensing_actions: int
    task_actions: int
    difference: Difference | None  # the first one
    notes: tuple[str, ...]  # other versions, other settings, other rewards

    def describe(self) -> str:
        """Return the finding in words: one line if the runs are identical, else three."""
        found = self.difference
        if found is None:
            return (
                f"identical: {_counted(self.trials, 'trial')}, "
                f"{_counted(self.sensing_actions, 'sensing action')}, "
                f"{_counted(self.task_actions, 'task action')} and every state digest"
            )
        trial = "" if found.trial is None else f"trial {found.trial}, "
        step = "" if found.step is None else f"step {found.step}, "
        width = max(len(self.first_run), len(self.second_run)) + 1
        return (
            f"different: {trial}{step}{found.what}\n"
            f"  {f'{self.first_run}:':{width}} {found.first}\n"
            f"  {f'{self.second_run}:':{width}} {found.second}"
        )

    def to_json(self) -> str:
        """Return the finding as indented JSON."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2).decode() + "\n"


def compare_runs(first: Path, second: Path) -> Comparison:
    """Compare the decisions of two runs, by their directories or journals; neither is changed.

    A run may go on meanwhile. Raises OutputError if one is no run, or is damaged.
    """
    with ExitStack() as stack:
        one, other = (
            stack.enter_context(JournalReader.read_run(run, "compare")) for run in (first, second)
        )
        notes: list[str] = []
        difference = _difference_of_runs(one.meta(), other.meta(), notes)
        same: Counter[str] = Counter()
        if difference is None:
            difference = _compare_trials(one, other, same, notes)
    return Comparison(
        identical=difference is None,
        first_run=str(first),
        second_run=str(second),
        trials=same["trials"],
        sensing_actions=same["sensing_actions"],
        task_actions=same["task_actions"],
        difference=difference,
        notes=tuple(notes),
    )


def _difference_of_runs(
    first: Mapping[str, str], second: Mapping[str, str], notes: list[str]
) -> Difference | None:
    """Return how the runs differ as wholes; what changes no decision is only noted."""
    texts = [meta.get("configuration", "") for meta in (first, second)]
    configurations: list[Any] = [recorded_configuration(text) for text in texts]
    for what, keys in (("problem", ("problem",)), ("seed", ("simulator", "seed"))):
        one, other = (_value(configuration, keys) for configuration in configurations)
        if one != other:
            return Difference(what=what, first=one_line(str(one)), second=one_line(str(other)))
    versions = [meta.get("holdfast_version", "of an unknown version") for meta in (first, second)]
    if versions[0] != versions[1]:
        notes.append(f"made by holdfast {versions[0]} and by holdfast {versions[1]}")
    for which, meta in (("first", first), ("second", second)):
        notes.extend(
            f"of the {which} run, {earlier.decided()}"
            for earlier in read_earlier(meta.get("earlier_code"))
        )
    if first.get("problem_sources") != second.get("problem_sources"):
        notes.append("the source of the problem differs")
    setting = configuration_difference(*texts)
    if setting is not None:
        key, old, new = setting
        notes.append(f"{key} is {old} in the first run and {new} in the second")
    return None


def _value(configuration: Any, keys: tuple[str, ...]) -> Any:
    for key in keys:
        if not isinstance(configuration, Mapping) or key not in configuration:
            return "not given"
        configuration = configuration[key]
    return configuration


def _compare_trials(
    first: JournalReader, second: JournalReader, same: Counter[str], notes: list[str]
) -> Difference | None:
    """Return where the trials first differ; ``same`` counts what does not."""
    journals = (first, second)
    finished = [journal.finished() for journal in journals]
    begun = [journal.unfinished() for journal in journals]
    numbers = {each.trial for each in begun if each is not None}.union(*finished)
    results = [journal.results(with_decisions=True) for journal in journals]
    for number in sorted(numbers):
        if not all(number in each for each in finished):
            one, other = map(_state_of, (number, number), finished, begun)
            if one != other:
                return Difference(what="state of the trial", trial=number, first=one, second=other)
            found = _compare_unfinished(begun, number, same)
            if found is not None:
                return found
            notes.append(f"trial {number} is unfinished in both runs: compared as far as it goes")
            continue
        result, counterpart = map(next, results)
        assert result.decisions is not None
        assert counterpart.decisions is not None
        found = _difference_of_decisions(result.decisions, counterpart.decisions, number)
        if found is not None:
            return found
        same["trials"] += 1
        same["sensing_actions"] += result.sensing_decisions
        same["task_actions"] += result.steps
        # Where there is no reward, earlier versions wrote 0.
        outcomes = [
            f"outcome {each.outcome}, reward {each.reward or 0.0!r}"
            for each in (result, counterpart)
        ]
        if outcomes[0] != outcomes[1] and not any("the world" in note for note in notes):
            notes.append(
                f"the world answered otherwise: trial {number} has {outcomes[0]} in the first run "
                f"and {outcomes[1]} in the second"
            )
    if not any(same.values()):
        return Difference(
            what="number of finished trials: nothing to compare", first="0", second="0"
        )
    return None


def _state_of(number: int, finished: set[int], begun: UnfinishedTrial | None) -> str:
    if number in finished:
        return "finished"
    if begun is not None and begun.trial == number:
        looked = sum(isinstance(record, Sensed) for record in begun.records)
        acted = sum(isinstance(record, ActingRecord) for record in begun.records)
        return (
            f"unfinished, {_counted(looked, 'sensing action')} and "
            f"{_counted(acted, 'task action')} so far"
        )
    return f"not in this run, which has {_counted(len(finished), 'finished trial')}"


def _compare_unfinished(
    begun: Sequence[UnfinishedTrial | None], trial: int, same: Counter[str]
) -> Difference | None:
    """Return where the same number of decisions of an unfinished trial first differ."""
    decided = (() if each is None else decisions_of(each.records) for each in begun)
    for one, other in zip(*decided, strict=True):
        found = _difference_of_decision(one, other, trial)
        if found is not None:
            return found
        same["sensing_actions" if isinstance(one, Sensed) else "task_actions"] += 1
    return None


def _difference_of_decisions(first: Decisions, second: Decisions, trial: int) -> Difference | None:
    """Return where two sequences of decisions of a trial first differ, None if they do not."""
    if first == second:
        return None
    sizes = str(first.action_size), str(second.action_size)
    if sizes[0] != sizes[1]:
        return Difference(
            what="size of the task actions", trial=trial, first=sizes[0], second=sizes[1]
        )
    for pair in zip_longest(first, second):
        found = _difference_of_decision(*pair, trial)
        if found is not None:
            return found
    (steps, digest), (other_steps, other_digest) = _ending(first), _ending(second)
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


def _difference_of_decision(
    first: Decision | None, second: Decision | None, trial: int
) -> Difference | None:
    """Return what differs first in two decisions, None if nothing does."""
    for (what, bits, text), (_, other_bits, other_text) in zip(
        _parts(first), _parts(second), strict=False
    ):
        if bits != other_bits:
            texts = text, other_text
            if text == other_text:  # as of two NaN
                texts = f"{text} (0x{bits.hex()})", f"{text} (0x{other_bits.hex()})"
            step = min(decision.step for decision in (first, second) if decision is not None)
            return Difference(what=what, trial=trial, step=step, first=texts[0], second=texts[1])
    return None


def _parts(decision: Decision | None) -> Iterator[tuple[str, bytes, str]]:
    """Yield what a decision consists of: its name, its bits, and the words for a person.

    By their bits, because 0.0 and -0.0 are different actions, and a NaN is equal to itself.
    """
    if decision is None:
        yield "next decision", b"", "none, the trial ends"
    elif isinstance(decision, Sensed):
        step, action, digest = decision.step, decision.sensing_action, decision.digest
        where = f"sensing action {action} at step {step}"
        yield "next decision", b"S" + step.to_bytes(8, "big"), where
        yield "sensing action", action.to_bytes(8, "big"), str(action)
        yield "state digest after sensing", digest, digest.hex()
    else:
        where = f"a task action at step {decision.step}"
        yield "next decision", b"A" + decision.step.to_bytes(8, "big"), where
        for index, (value,) in enumerate(struct.iter_unpack("<d", decision.action)):
            yield f"task action[{index}]", struct.pack(">d", value), repr(value)


def _counted(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
