"""What the robot acts on: a world that goes on when the robot's process does not.

Each trial is run once by the plain closed loop (:mod:`holdfast_lab.simulation.reference_runs`).
What was sensed and done there is what every other run of that trial must do, and, as long as it
does, what the world shows to it. To sense or do something else, again, too early or too late raises
a :class:`Violation` at once.

An observation may come later than it was taken, or never. When it comes is part of the trial: the
undisturbed run gets it at the same moment. A robot that dies may change that moment, and then there
is another undisturbed run to compare with, which is the same up to there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.inputs import ActingRecord, Late, Moved, Record, Sensed, encode_floats
from holdfast.planning.outcome import Done, TrialResult
from holdfast_lab.errors import Violation
from holdfast_lab.simulation.reference_runs import (
    BEFORE_CHOOSING,
    BEFORE_MOVING,
    BEFORE_SENSING,
    Circumstances,
    Delivery,
    ReferenceRuns,
    ReferenceStep,
)


class _Coming(NamedTuple):
    """An observation on its way: of which step, and how many task actions it takes."""

    taken: int
    due: int


class Resumed(NamedTuple):
    """What the world tells a robot's next process."""

    last: ReferenceStep | None  # its last task action, if it can still tell what that has shown
    late: tuple[Late, ...]  # what has come meanwhile


class EnvironmentModel:
    """The world of one trial.

    Parameters
    ----------
    shows_the_same : bool
        Whether it dies with the robot's process, and what is sensed again shows the same again. In
        a world outside of the simulation it does not: a robot that has forgotten what it sensed
        will know something else.
    lateness : mapping of int to tuple
        By step, after how many task actions the observation comes, None for never. With several it
        comes several times.
    remembers : bool
        Whether it tells a robot's next process again what the last task action has shown and which
        observations have come late.
    senses_on : bool
        Whether what it still senses when the robot's process dies is there when the next one asks.
    reinitialises : bool
        Whether the robot is carried away, and begins its belief anew after each observation outside
        the validation gate.
    """

    def __init__(
        self,
        trial: int,
        max_steps: int,
        references: ReferenceRuns,
        *,
        shows_the_same: bool,
        lateness: Mapping[int, tuple[int | None, ...]] | None = None,
        remembers: bool = False,
        senses_on: bool = False,
        reinitialises: bool = False,
    ) -> None:
        self.trial = trial
        self._max_steps = max_steps
        self._references = references
        self._shows_the_same = shows_the_same
        self._lateness = lateness or {}
        self._remembers = remembers
        self._senses_on = senses_on
        self._reinitialises = reinitialises
        self._times: dict[int, int] = {}
        self._sensed: set[int] = set()
        self._awaited: set[int] = set()
        self._coming: list[_Coming] = []
        self._told: list[_Coming] = []
        # Those that the robot had awaited, and how many of them it must have written down.
        self._deliveries: list[Delivery] = []
        self._num_written = 0
        self._useless: list[int] = []
        self._unseen: set[int] = set()
        self.performed = 0
        self._refer()

    @property
    def done(self) -> Done:
        """How the task stands."""
        if self.performed == 0:
            return self._reference.done_at_start
        return self._reference.steps[self.performed - 1].done

    def _refer(self) -> None:
        """Look up the undisturbed run under what has happened so far."""
        repeats: tuple[tuple[int, int], ...] = ()
        if not self._shows_the_same:
            repeats = tuple((at, count - 1) for at, count in self._times.items() if count > 1)
        circumstances = Circumstances(
            repeats,
            tuple(sorted(self._lateness)),
            (*self._deliveries, *self._foreseen()),
            tuple(sorted(self._unseen)),
            self._reinitialises,
        )
        self._reference = self._references.get(self.trial, self._max_steps, circumstances)

    def _foreseen(self) -> list[Delivery]:
        """Return what will come if the robot's process lives on."""
        coming = [each for each in self._coming if each.taken in self._awaited]
        for step in sorted(self._lateness.keys() - self._sensed):
            coming += self._of(step)
        first: dict[int, int] = {}
        for taken, due in coming:
            comes = max(due, taken + 1, self.performed + 1)
            first[taken] = min(comes, first.get(taken, comes))
        foreseen = [Delivery(step, BEFORE_SENSING, taken) for taken, step in first.items()]
        return sorted(foreseen, key=lambda each: each.step)

    def _is_late(self, step: int) -> bool:
        """Return whether something was sensed in a step, and came late."""
        return step in self._lateness and self._reference.steps[step].sensing_action is not None

    def will_come(self, step: int) -> bool:
        """Return whether what was sensed in a step comes later, instead of never."""
        return bool(self._of(step))

    def _of(self, step: int) -> list[_Coming]:
        delays = self._lateness.get(step, ())
        return [_Coming(step, step + moves) for moves in delays if moves is not None]

    # -- the robot's process ---------------------------------------------------------------------

    def resumed(self, records: Sequence[Record], *, may_lack: bool) -> Resumed:
        """Tell the robot's next process what has happened meanwhile.

        Of this trial the journal holds the records; a power cut may have taken some away
        (``may_lack``).
        """
        observed = [each for each in records if isinstance(each, Sensed)]
        written = [each.taken for each in records if isinstance(each, Late)]
        known = sum(isinstance(each, Moved) for each in records)
        acting = sum(isinstance(each, ActingRecord) for each in records)
        if self._shows_the_same:
            self.performed = known
        self._check_written(written, may_lack=may_lack)
        self._sensed = {each.step for each in observed if self._is_late(each.step)}
        self._awaited = self._sensed.difference(written)
        self._coming = [] if self._shows_the_same else [*self._told, *self._coming]
        self._told = []
        if self._senses_on:
            self._coming = [_Coming(taken, min(taken, due)) for taken, due in self._coming]
        unseen = acting > known and self.performed > known
        if unseen and not self._remembers:
            self._unseen.add(known)
        self._refer()
        last = None
        if self._remembers and self.performed:
            last = self._reference.steps[self.performed - 1]
        if not (observed or acting):
            return Resumed(last, ())  # nothing is known to have begun
        moment = BEFORE_SENSING
        if acting > known:
            moment = BEFORE_SENSING if unseen else BEFORE_MOVING
        elif observed and observed[-1].step == known:
            moment = BEFORE_CHOOSING
        return Resumed(last, self.come(moment))

    def _check_written(self, written: list[int], *, may_lack: bool) -> None:
        """Forget deliveries that the robot may have forgotten."""
        had = [each.taken for each in self._deliveries]
        for taken in written:
            if taken not in had:
                raise Violation(
                    f"trial {self.trial}: the journal has a late observation of step {taken}, "
                    "which never came"
                )
        for taken in had[: self._num_written]:
            if taken not in written and not may_lack:
                raise Violation(
                    f"trial {self.trial}: the journal lacks the late observation of step {taken}, "
                    "after which the robot went on"
                )
        self._deliveries = [each for each in self._deliveries if each.taken in written]
        self._num_written = len(self._deliveries)

    def begin_again(self, actions: list[FloatArray]) -> None:
        """Perform these from the beginning: this world does not outlive the robot's process."""
        self.performed = 0
        for step, action in enumerate(actions):
            self.act(step, action)

    # -- what the robot does ---------------------------------------------------------------------

    def sense(self, step: int, sensing_action: int) -> FloatArray | None:
        """Perform a sensing action and return what it shows; None if that comes later."""
        where = f"trial {self.trial}: sensing action {sensing_action} of step {step}"
        if step != self.performed:
            raise Violation(f"{where}, where {self.performed} task actions have been performed")
        steps = self._reference.steps
        expected = steps[step].sensing_action if step < len(steps) else None
        if sensing_action != expected:
            raise Violation(f"{where}: the undisturbed run has {expected}")
        self._num_written = len(self._deliveries)
        times = self._times.get(step, 0)
        self._times[step] = times + 1
        is_late = step in self._lateness
        if is_late:
            # Whoever senses again waits for that.
            for coming in (self._coming, self._told):
                coming[:] = [each for each in coming if each.taken != step]
            self._coming += self._of(step)
            self._sensed.add(step)
            self._awaited.add(step)
        if times and not self._shows_the_same:
            self._refer()
        return None if is_late else self._shown_at(step)

    def _shown_at(self, step: int) -> FloatArray:
        shown = self._reference.steps[step].observation
        assert shown is not None
        return shown

    def act(self, step: int, action: FloatArray) -> ReferenceStep:
        """Perform a task action; return what it has shown."""
        where = f"trial {self.trial}: task action of step {step}"
        if step != self.performed:
            again = " again" if step < self.performed else ""
            raise Violation(f"{where} performed{again}, where {self.performed} have been performed")
        if step >= len(self._reference.steps):
            raise Violation(f"{where}: the undisturbed run has ended before")
        due = self._reference.steps[step]
        written = np.asarray(action, dtype="<f8").tobytes()
        if written != due.action:
            expected = np.frombuffer(due.action, dtype="<f8")
            raise Violation(f"{where}: {action}, the undisturbed run has {expected}")
        self._num_written = len(self._deliveries)
        self.performed += 1
        return due

    def come(self, moment: int = BEFORE_SENSING) -> tuple[Late, ...]:
        """Return the observations of earlier steps that have come."""
        if not self._coming:
            return ()
        came = [each for each in self._coming if each.due <= self.performed]
        self._coming = [each for each in self._coming if each.due > self.performed]
        if self._remembers:
            self._told += came
        late = []
        for taken, _ in came:
            if taken in self._awaited:
                shown = self._shown_at(taken)
                self._awaited.remove(taken)
                self._deliveries.append(Delivery(self.performed, moment, taken))
            else:
                # Once more, or of a process that has forgotten that it sensed: it must not count.
                shown = np.array([99.0])
                self._useless.append(taken)
            late.append(Late(self.performed, taken, encode_floats(shown)))
        self._refer()
        return tuple(late)

    def is_useless(self, taken: int) -> None:
        """Take note that the robot does not use an observation of an earlier step."""
        if taken not in self._useless:
            raise Violation(
                f"trial {self.trial}: the observation of step {taken} has come late and is not used"
            )
        self._useless.remove(taken)

    def check_end(self, result: TrialResult, *, rewards_are_known: bool) -> None:
        """Compare the robot's result; its reward only if it has heard of that of each action."""
        reference = self._reference
        if not result.steps == self.performed == len(reference.steps):
            raise Violation(
                f"trial {self.trial} ended after {result.steps} steps, {self.performed} of which "
                f"were performed: the undisturbed run has {len(reference.steps)}"
            )
        if result.digest != reference.digest:
            raise Violation(
                f"trial {self.trial}: digest of the decisions {result.digest[:16]}, the "
                f"undisturbed run has {reference.digest[:16]}"
            )
        reward = None if reference.steps else 0.0
        for step in reference.steps:
            if step.reward is not None:
                reward = (reward or 0.0) + step.reward
        sensed = sum(step.sensing_action is not None for step in reference.steps)
        late = sum(self._is_late(step) for step in self._lateness if step < len(reference.steps))
        missing = late - len({delivery.taken for delivery in self._deliveries})
        for name, said, true in (
            ("success", result.success, self.done is True),
            ("sensing decisions", result.sensing_decisions, sensed),
            ("unexplained observations", result.unexplained_observations, reference.unexplained),
            ("missing observations", result.missing_observations, missing),
            ("times lost", result.lost if self._reinitialises else reference.lost, reference.lost),
            ("reward", result.reward if rewards_are_known else reward, reward),
        ):
            if said != true:
                raise Violation(
                    f"trial {self.trial}: {name} {said}, the undisturbed run has {true}"
                )
