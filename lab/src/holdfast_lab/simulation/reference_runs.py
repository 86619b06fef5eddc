"""What every other run of a trial must do: the trial by the plain closed loop.

It has no service, no message and no journal. A late observation is no trick here either: it is put
where it belongs in the list of what was sensed and done, and the belief is folded anew from the
beginning of the trial, step by step. So this is also the fold that the robot's own, which begins
where the observation was taken, is compared with.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import ObservationInfo
from holdfast.planning.outcome import DecisionLog, Done, MoveResult
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.problem import Problem
from holdfast.robot.environment import SimulatedEnvironment
from holdfast_lab.simulation.checked_memo import Memo

BEFORE_SENSING, BEFORE_CHOOSING, BEFORE_MOVING = range(3)
"""Moments of a step in which a late observation may come. The first is the usual one, with the move
before. The others are those of a robot that was killed: when its next process begins."""

KIDNAPPED_AT = 5
KIDNAPPED_TO = np.array([6.0, 0.0, 0.0])
"""After so many task actions a robot that is to be lost is carried away, by so much."""

_MOST = 2_000


class Delivery(NamedTuple):
    """An observation that comes late: in which step, at which moment of it, and of which step."""

    step: int
    moment: int
    taken: int


Repeats: TypeAlias = tuple[tuple[int, int], ...]


class Circumstances(NamedTuple):
    """What makes a trial another one, without any fault of the robot's."""

    # Steps in which something had been sensed before, and how often, without anybody knowing it
    # now. What is sensed there then shows something else: the trial as it goes from there.
    repeats: Repeats = ()
    late: tuple[int, ...] = ()  # steps whose observation does not come at once
    # In the order in which they come. Those that nobody awaits change nothing.
    deliveries: tuple[Delivery, ...] = ()
    unseen: tuple[int, ...] = ()  # steps of which nobody knows what the move has shown
    # Whether the robot is carried away, and its belief is begun anew after each observation outside
    # the validation gate.
    reinitialises: bool = False


UNDISTURBED = Circumstances()


class ReferenceStep(NamedTuple):
    """One step of the undisturbed run."""

    sensing_action: int | None  # what was sensed before the task action, if anything
    observation: FloatArray | None  # what it showed, at once or later
    action: bytes  # the task action, little-endian float64
    reward: float | None
    done: Done  # how the task stands after it
    # What the move has shown.
    motion: FloatArray | None = None
    shown: FloatArray | None = None


class ReferenceRun(NamedTuple):
    """A trial as it goes when nothing disturbs it."""

    steps: tuple[ReferenceStep, ...]
    done_at_start: Done
    digest: str
    unexplained: int = 0
    lost: int = 0


class _Sensed(NamedTuple):
    step: int
    sensing_action: int
    observation: FloatArray | None


class _Moved(NamedTuple):
    action: FloatArray
    motion: FloatArray | None
    shown: FloatArray | None


_Entry: TypeAlias = _Sensed | _Moved | None
"""An entry of the list of what was sensed and done; None: the belief was begun anew."""


class ReferenceRuns:
    """The undisturbed trials, each run when it is first asked for."""

    def __init__(self, problem: Problem, planning: PlanningSettings, seed: int) -> None:
        self._planner = Planner(problem, planning)
        self._seed = seed
        self._runs: Memo[tuple[int, int, Circumstances], ReferenceRun] = Memo(_MOST)

    def get(
        self, trial: int, max_steps: int, circumstances: Circumstances = UNDISTURBED
    ) -> ReferenceRun:
        """Return a trial of at most so many steps."""
        key = trial, max_steps, circumstances
        return self._runs.get(
            key, lambda: _Run(self._planner, self._seed, trial, circumstances).go(max_steps)
        )


class _Run:
    """One trial."""

    def __init__(
        self, planner: Planner, seed: int, trial: int, circumstances: Circumstances
    ) -> None:
        self._planner = planner
        self._seed = seed
        self._trial = trial
        self._repeats = dict(circumstances.repeats)
        self._late = circumstances.late
        self._unseen = circumstances.unseen
        self._due: dict[tuple[int, int], list[int]] = {}
        for step, moment, taken in circumstances.deliveries:
            self._due.setdefault((step, moment), []).append(taken)
        self._world = SimulatedEnvironment(planner.problem, seed, trial)
        self._log = DecisionLog(planner.problem.action_size)
        self._state = planner.init(seed, trial)
        self._reinitialises = circumstances.reinitialises
        self._entries: list[_Entry] = []
        self._awaited: dict[int, _Sensed] = {}
        self._unexplained = self._lost = 0

    def go(self, max_steps: int) -> ReferenceRun:
        planner, world, log = self._planner, self._world, self._log
        done_at_start = done = world.is_done()
        steps: list[ReferenceStep] = []
        while not done and len(steps) < max_steps:
            step = len(steps)
            sensing_action = observation = None
            if planner.needs_sensing(self._state):
                sensing_action, observation = self._sense(step)
            self._deliver(BEFORE_CHOOSING)
            action, _ = planner.choose_task_action(self._state)
            self._deliver(BEFORE_MOVING)
            shown = world.perform(action)
            if self._reinitialises and world.step == KIDNAPPED_AT:
                world.state = world.state + KIDNAPPED_TO
            reward, motion, observed = self._shown(step, shown)
            done = world.is_done()
            written = np.asarray(action, dtype="<f8").tobytes()
            steps.append(
                ReferenceStep(sensing_action, observation, written, reward, done, motion, observed)
            )
            seen = (None, None) if step in self._unseen else (motion, observed)
            self._entries.append(_Moved(action, *seen))
            self._state, info = self._after(self._state, self._entries[-1])
            log.acted(step, action)
            if any(each is not None for each in seen):
                log.moved(step, planner.digest(self._state))
            self._judge(info)
            self._deliver(BEFORE_SENSING)
        log.ended(len(steps), planner.digest(self._state))
        digest = log.decisions().digest()
        return ReferenceRun(tuple(steps), done_at_start, digest, self._unexplained, self._lost)

    def _sense(self, step: int) -> tuple[int | None, FloatArray | None]:
        planner = self._planner
        chosen, _ = planner.choose_sensing_action(self._state)
        sensed: tuple[int | None, FloatArray | None] = (None, None)
        known = None
        if chosen != planner.no_sensing:
            times = self._repeats.get(step, 0)
            world = self._again(times) if times else self._world
            shown = np.array(world.perform_sensing(chosen), dtype=np.float64)
            shown.setflags(write=False)
            sensed = chosen, shown
            if step in self._late:
                self._awaited[step] = _Sensed(step, chosen, shown)
            else:
                known = shown
        self._entries.append(_Sensed(step, chosen, known))
        self._state, info = self._after(self._state, self._entries[-1])
        self._log.sensed(step, chosen, planner.digest(self._state))
        self._judge(info)
        return sensed

    def _again(self, times: int) -> SimulatedEnvironment:
        """Return the same world with noise of its own for what is sensed again."""
        world = self._world
        again = SimulatedEnvironment(self._planner.problem, self._seed + times, self._trial)
        again.state, again.step = world.state, world.step
        return again

    def _deliver(self, moment: int) -> None:
        """Let come what is due."""
        step = self._state.step
        for taken in self._due.get((step, moment), ()):
            if taken not in self._awaited:
                continue
            came = self._awaited.pop(taken)
            at = next(
                at
                for at, entry in enumerate(self._entries)
                if isinstance(entry, _Sensed) and entry.step == taken
            )
            _, info = self._after(self._folded(self._entries[:at]), came)
            of_old_belief = any(entry is None for entry in self._entries[at:])
            self._entries[at] = came
            self._state = self._folded(self._entries)
            self._log.observed_late(taken, step, self._planner.digest(self._state))
            self._judge(info, of_old_belief=of_old_belief)

    def _judge(self, info: ObservationInfo | None, *, of_old_belief: bool = False) -> None:
        """Count what an observation has shown, and begin the belief anew if that is to be done."""
        if info is None:
            return
        self._unexplained += not info.explained
        if self._reinitialises and not info.within_gate and not of_old_belief:
            self._lost += 1
            self._entries.append(None)
            self._state, _ = self._after(self._state, None)
            self._log.reinitialised(self._state.step, self._planner.digest(self._state))

    def _folded(self, entries: list[_Entry]) -> PlanningState:
        state = self._planner.init(self._seed, self._trial)
        for entry in entries:
            state, _ = self._after(state, entry)
        return state

    def _after(
        self, state: PlanningState, entry: _Entry
    ) -> tuple[PlanningState, ObservationInfo | None]:
        planner = self._planner
        if entry is None:
            return planner.reinitialise(state), None
        if isinstance(entry, _Sensed):
            after, info = planner.observe(state, entry.sensing_action, entry.observation)
            return after, None if entry.observation is None else info
        state = planner.advance(state, entry.action, entry.motion)
        if entry.shown is None:
            return state, None
        return planner.observe_move(state, entry.action, entry.shown)

    @staticmethod
    def _shown(
        step: int, result: float | MoveResult | None
    ) -> tuple[float | None, FloatArray | None, FloatArray | None]:
        """Return the reward and what the move has shown: not always everything."""
        if not isinstance(result, MoveResult):
            return result, None, None
        reward, motion, observation = (
            result.reward,
            None if result.motion is None else np.array(result.motion, dtype=np.float64),
            None if result.observation is None else np.array(result.observation, dtype=np.float64),
        )
        return (
            None if reward is None else float(reward),
            None if step % 3 == 1 else motion,
            None if step % 4 == 2 else observation,
        )
