"""A recorded run as plain tables: ``trials.csv``, ``steps.csv``, ``beliefs.csv``, ``events.csv``.

Numbers are written so that reading them gives the same bits. An empty cell means that there is
none, or that it is not known. Times are seconds on the clock of the export, with nanoseconds.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from holdfast.journal.tables import trial_row
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import Belief
from holdfast.planning.outcome import TRIAL_COLUMNS
from holdfast.planning.planner import digest
from holdfast.printable import cell, cells
from holdfast.problems.attributes import choice_labels
from holdfast.problems.attributes import state_labels as declared_labels
from holdfast.problems.problem import Problem
from holdfast.protocol.robot_events import Timing
from holdfast.reports.facts import (
    DECIDER,
    EventFact,
    LateFact,
    SensingFact,
    TaskFact,
    TrialBeginFact,
    TrialEndFact,
    shown_decider,
)

TABLES = ("trials.csv", "steps.csv", "beliefs.csv", "events.csv")
"""One row a trial; a step; a particle of a belief; an event of the services."""


class CsvSink:
    """Writes the facts of a run as tables; to be used in a ``with`` statement."""

    def __init__(self, directory: Path, problem: Problem) -> None:
        self._choices = choice_labels(problem)
        self._began_ns = 0
        self._sensing: SensingFact | None = None
        self._labels = state_labels(problem)
        with ExitStack() as stack:
            self._files = [
                stack.enter_context((directory / name).open("w", encoding="utf-8", newline=""))
                for name in TABLES
            ]
            self._trials, _, self._beliefs, self._events = map(_writer, self._files)
            self._close = stack.pop_all()
        trial, *others = TRIAL_COLUMNS
        self._trials.writerow([trial, "began", "ended", *others])
        self._steps = csv.DictWriter(
            self._files[1],
            [
                *(
                    "trial",
                    "step",
                    "stage",
                    "sensing_action",
                    "sensing_action_label",
                    "observation",
                ),
                *(f"entropy_{index}" for index in range(len(self._choices))),
                *("explained", "mahalanobis_distance", "effective_sample_size", "resampled"),
                "state_digest",
                *(f"estimate {label}" for label in self._labels),
                *(f"true {label}" for label in self._labels),
                *(f"action_{index}" for index in range(problem.action_size)),
                *("motion", "move_observation", "reward"),
                *("sensing_time", "observation_time", "action_time"),
                *(f"{kind}_{name}" for kind in ("sensing", "action") for name in DECIDER),
            ],
            lineterminator="\n",
        )
        self._steps.writeheader()
        self._beliefs.writerow(
            ["trial", "step", "when", "particle", *map(cell, self._labels), "weight"]
        )
        self._events.writerow(["time", "event", "trial", "fields"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._close.close()

    def trial_begins(self, fact: TrialBeginFact) -> None:
        """Note when the trial began."""
        self._began_ns = fact.time_ns
        self._sensing = None

    def sensed(self, fact: SensingFact) -> None:
        """Write the belief before; the rest of the row comes with the task action."""
        self._sensing = fact
        before = fact.step.before
        self._write_belief(before.trial, before.step, "sensing", before.belief)

    def acted(self, fact: TaskFact) -> None:
        """Write the row of the step, and the belief."""
        state = fact.step.state
        self._write_step(state.trial, state.step, fact)
        self._write_belief(state.trial, state.step, "acting", state.belief)

    def observed_late(self, fact: LateFact) -> None:
        """Write a late observation among the events: the row of its step is written."""
        late, after, _ = fact.step
        shown = {"trial": after.trial, "step": after.step, "taken": late.taken}
        shown["observation"] = late.numbers().tolist()
        self.happened(EventFact(fact.time_ns, "late_observation", shown))

    def trial_ends(self, fact: TrialEndFact) -> None:
        """Write the row of the trial and the last belief, and a row if it ends in mid-step."""
        if self._sensing is not None:
            self._write_step(fact.trial, fact.steps, None)
        self._write_belief(fact.trial, fact.steps, "end", fact.belief)
        if fact.result is None:
            known = {"trial": fact.trial, "outcome": "unfinished", "steps": fact.steps}
            values: Sequence[object] = [known.get(column) for column in TRIAL_COLUMNS]
        else:
            values = trial_row(fact.result)
        trial, *others = cells(values)
        times = _seconds(self._began_ns), _seconds(fact.time_ns)
        self._trials.writerow([trial, *times, *others])

    def happened(self, fact: EventFact) -> None:
        """Write an event."""
        fields = json.dumps(fact.fields, ensure_ascii=False)
        trial = fact.fields.get("trial")
        self._events.writerow(map(cell, [_seconds(fact.time_ns), fact.name, trial, fields]))

    def _write_step(self, trial: int, step: int, fact: TaskFact | None) -> None:
        sensing, self._sensing = self._sensing, None
        row: dict[str, Any] = {"trial": trial, "step": step}
        if sensing is not None:
            sensed, info = sensing.step, sensing.step.observation_info
            row |= {
                "stage": sensed.before.stage,
                "sensing_action": sensed.sensing_action,
                "sensing_action_label": self._choices[sensed.sensing_action],
                "observation": _numbers(sensed.observation),
                "explained": int(info.explained),
                "mahalanobis_distance": info.mahalanobis_distance,
                "effective_sample_size": info.effective_sample_size,
                "resampled": int(info.resampled),
                "state_digest": digest(sensed.after).hex(),
                "sensing_time": _seconds(sensing.decided_ns),
                "observation_time": _seconds(sensing.observed_ns),
                **_cells("entropy_{}", sensed.sensing_info.entropies),
                **_decider_cells("sensing", sensing.decider),
            }
        if fact is not None:
            acted, (motion, observation) = fact.step, fact.step.moved.numbers()
            row |= {
                "stage": acted.task_info.stage,
                "reward": acted.reward,
                "motion": _numbers(motion),
                "move_observation": _numbers(observation),
                "action_time": _seconds(fact.time_ns),
                **_cells("estimate {}", acted.task_info.estimate, self._labels),
                **_cells("true {}", fact.true_state, self._labels),
                **_cells("action_{}", acted.executed),
                **_decider_cells("action", fact.decider),
            }
        self._steps.writerow({name: cell(value) for name, value in row.items()})

    def _write_belief(self, trial: int, step: int, when: str, belief: Belief | None) -> None:
        if belief is None:
            return
        pairs = zip(belief.states.tolist(), belief.weights.tolist(), strict=True)
        self._beliefs.writerows(
            (trial, step, when, particle, *state, weight)
            for particle, (state, weight) in enumerate(pairs)
        )


def state_labels(problem: Problem) -> list[str]:
    """Return a name for each coordinate of a state: the problem's label, if all have one."""
    labels = list(declared_labels(problem))
    if len(set(labels)) == problem.state_size:
        return labels
    return [f"state_{index}" for index in range(problem.state_size)]


def _numbers(values: FloatArray | None) -> str | None:
    return None if values is None else " ".join(map(repr, values.tolist()))


def _writer(file: io.TextIOBase) -> Any:
    return csv.writer(file, lineterminator="\n")


def _cells(
    name: str, values: FloatArray | None, labels: Sequence[object] | None = None
) -> dict[str, float]:
    """Return a column for each value, named by its label or else its index."""
    if values is None:
        return {}
    names = range(len(values)) if labels is None else labels
    return {name.format(each): value for each, value in zip(names, values.tolist(), strict=True)}


def _decider_cells(kind: str, decider: Timing | None) -> dict[str, Any]:
    return {f"{kind}_{name}": value for name, value in shown_decider(decider).items()}


def _seconds(time_ns: int) -> str:
    return f"{time_ns // 1_000_000_000}.{time_ns % 1_000_000_000:09d}"
