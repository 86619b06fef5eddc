"""A trial as it goes: the state that follows from what was done and shown, and its account.

Sensing may take time. The robot goes on meanwhile, and the observation that comes later still
belongs to the step at which it was taken: the state before it is kept, the observation is folded in
there, and what followed is folded again. So the state is a function of the record alone: the one of
a trial in which each observation was there at its step and the same actions were performed.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.lost import MOVE, LostTest, Verdict
from holdfast.planning.outcome import DecisionLog, Ending, RewardAccount, TrialResult
from holdfast.planning.planner import ObservationInfo, Planner, PlanningState
from holdfast.planning.settings import LostSettings

__all__ = ["MAX_AWAITED", "MAX_INPUTS_SINCE", "LateObservation", "Trial"]

MAX_AWAITED = 16
"""Bound on the observations that are awaited at once; of more, the oldest is given up."""

MAX_INPUTS_SINCE = 2000
"""Bound on what happened since the oldest awaited observation, which is then given up: all of that
is kept in memory, and folded again when it comes."""


class LateObservation(NamedTuple):
    """An observation that comes after its step.

    Attributes
    ----------
    step : int
        Task actions that were performed when it was taken.
    observation : array of shape (observation_size,)
    """

    step: int
    observation: FloatArray


class _Sensed(NamedTuple):
    sensing_action: int
    observation: FloatArray | None


class _Moved(NamedTuple):
    action: FloatArray
    motion: FloatArray | None
    observation: FloatArray | None


class _Reinitialised(NamedTuple):
    pass


_Input: TypeAlias = _Sensed | _Moved | _Reinitialised


class Trial:
    """A trial so far.

    ``false_alarm_rate`` is the one of :class:`~holdfast.planning.lost.LostTest`.

    Attributes
    ----------
    state : PlanningState
        After everything that is known to be performed.
    log : DecisionLog
    num_sensed : int
        Sensing actions that were performed.
    num_inputs : int
        What led to the state besides task actions: observations and choices not to sense, moves
        that have shown something, late observations, reinitialisations.
    num_missing : int
        Sensing actions that were performed and have no observation (so far, if it comes late).
    num_unexplained : int
        Observations that no particle explains.
    fewest_distinct : int or None
        The least number of different particles that an observation weighed.
    lost_test : LostTest
    alarm : Verdict or None
        That of the last input or move.
    sensing_ms : list of float
        How long each choice of a sensing action took.
    recoveries : int
        Times that the cloud was lost.
    """

    def __init__(
        self,
        planner: Planner,
        seed: int,
        trial: int,
        false_alarm_rate: float = LostSettings().false_alarm_rate,
    ) -> None:
        self.planner = planner
        self.state = planner.init(seed, trial)
        self.log = DecisionLog(planner.problem.action_size)
        self.rewards = RewardAccount(planner.problem)
        self.num_sensed = 0
        self.num_inputs = 0
        self.num_missing = 0
        self.num_unexplained = 0
        self.fewest_distinct: int | None = None
        self.lost_test = LostTest(false_alarm_rate)
        self.alarm: Verdict | None = None
        self.sensing_ms: list[float] = []
        self.recoveries = 0
        # From the oldest awaited observation on: each input and, of an awaited one, the state
        # before it.
        self._inputs: list[_Input] = []
        self._before: dict[int, PlanningState] = {}

    @property
    def awaited(self) -> tuple[int, ...]:
        """Steps whose observation is still to come, oldest first."""
        return tuple(state.step for state in self._before.values())

    def observe(
        self, sensing_action: int, observation: FloatArray | None, sensing_ms: float
    ) -> tuple[ObservationInfo, bytes]:
        """Fold in a sensing action; return what was found, and the digest of the state after it.

        Without an observation it comes late, or never: there was no reading.
        """
        planner, before = self.planner, self.state
        after, info = planner.observe(before, sensing_action, observation)
        performed = sensing_action != planner.no_sensing
        awaited = performed and observation is None
        if awaited and len(self._before) == MAX_AWAITED:
            self._give_up_oldest()
        self._keep(_Sensed(sensing_action, observation), before if awaited else None)
        self.state = after
        self.num_sensed += performed
        self.num_missing += awaited
        self.num_inputs += 1
        self._judge(sensing_action, None if observation is None else info)
        self.sensing_ms.append(sensing_ms)
        reached = planner.digest(after)
        self.log.sensed(before.step, sensing_action, reached)
        self.rewards.sensed(sensing_action)
        return info, reached

    def move(
        self,
        action: FloatArray,
        reward: float | None = None,
        motion: FloatArray | None = None,
        observation: FloatArray | None = None,
    ) -> ObservationInfo | None:
        """Fold in a performed task action; return what its observation has shown, if there is one.

        Raises
        ------
        HoldfastError
            If the problem cannot fold in what the move has shown; nothing is changed then.
        """
        step = self.state.step
        moved = _Moved(action, motion, observation)
        state, info = self._moved(self.state, moved)
        self._keep(moved)
        self.log.acted(step, action)
        self.state = state
        if motion is not None or observation is not None:
            self.num_inputs += 1
            self.log.moved(step, self.planner.digest(state))
        self._judge(MOVE, info)
        self.rewards.acted(reward)
        return info

    def observe_late(self, late: LateObservation) -> tuple[ObservationInfo, bytes] | None:
        """Fold in an observation at its step, and what followed again; None if none is awaited.

        Otherwise return what was found, and the digest of the state that it led to.
        """
        position = next((at for at, state in self._before.items() if state.step == late.step), None)
        if position is None:
            return None
        sensed = self._inputs[position]
        assert isinstance(sensed, _Sensed)
        state = self._before[position]
        state, info = self.planner.observe(state, sensed.sensing_action, late.observation)
        again = {}
        for at in range(position + 1, len(self._inputs)):
            if at in self._before:
                again[at] = state
            state = self._folded(state, self._inputs[at])
        # Then it says nothing of the belief that is.
        of_old_belief = any(isinstance(each, _Reinitialised) for each in self._inputs[position:])
        self._inputs[position] = _Sensed(sensed.sensing_action, late.observation)
        del self._before[position]
        self._before |= again
        self._drop_settled()
        self.state = state
        self.num_missing -= 1
        self.num_inputs += 1
        self._judge(sensed.sensing_action, info, of_old_belief=of_old_belief)
        reached = self.planner.digest(state)
        self.log.observed_late(late.step, state.step, reached)
        return info, reached

    def reinitialise(self) -> bytes:
        """Begin the belief anew; return the digest of the state that this leads to."""
        self.state = self.planner.reinitialise(self.state)
        self._keep(_Reinitialised())
        self.num_inputs += 1
        self.lost_test.restart()
        self.alarm = None
        reached = self.planner.digest(self.state)
        self.log.reinitialised(self.state.step, reached)
        return reached

    def result(self, ending: Ending | None) -> TrialResult:
        """End the trial and return its result; it is out of steps if its task has not ended."""
        state = self.state
        self.log.ended(state.step, self.planner.digest(state))
        decisions = self.log.decisions()
        sensing_ms = tuple(self.sensing_ms)
        outcome, reason = ending or ("truncated", "")
        return TrialResult(
            trial=state.trial,
            seed=state.seed,
            success=outcome == "succeeded",
            failed=outcome == "failed",
            reason=reason,
            steps=state.step,
            reward=self.rewards.total if state.step else 0.0,
            sensing_decisions=self.num_sensed,
            mean_sensing_ms=sum(sensing_ms) / len(sensing_ms) if sensing_ms else 0.0,
            recoveries=self.recoveries,
            missing_observations=self.num_missing,
            unexplained_observations=self.num_unexplained,
            lost=self.lost_test.num_lost,
            suspect_sensors=self.lost_test.num_suspect,
            fewest_distinct_particles=self.fewest_distinct,
            digest=decisions.digest(),
            sensing_ms=sensing_ms,
            decisions=decisions,
        )

    def _judge(
        self, sensing_action: int, info: ObservationInfo | None, *, of_old_belief: bool = False
    ) -> None:
        """Count an observation; None is none."""
        self.alarm = None
        if info is None:
            return
        self.num_unexplained += not info.explained
        distinct = info.distinct_particles
        self.fewest_distinct = min(distinct, self.fewest_distinct or distinct)
        if not of_old_belief:
            self.alarm = self.lost_test.observed(sensing_action, info.within_gate)

    def _folded(self, state: PlanningState, given: _Input) -> PlanningState:
        if isinstance(given, _Sensed):
            return self.planner.observe(state, given.sensing_action, given.observation)[0]
        if isinstance(given, _Moved):
            return self._moved(state, given)[0]
        return self.planner.reinitialise(state)

    def _moved(
        self, state: PlanningState, moved: _Moved
    ) -> tuple[PlanningState, ObservationInfo | None]:
        after = self.planner.advance(state, moved.action, moved.motion)
        if moved.observation is None:
            return after, None
        return self.planner.observe_move(after, moved.action, moved.observation)

    def _keep(self, given: _Input, before: PlanningState | None = None) -> None:
        """Keep an input while an observation is awaited that belongs before it."""
        if before is not None:
            self._before[len(self._inputs)] = before
        elif not self._before:
            return
        self._inputs.append(given)
        if len(self._inputs) > MAX_INPUTS_SINCE:
            self._give_up_oldest()

    def _give_up_oldest(self) -> None:
        del self._before[next(iter(self._before))]
        self._drop_settled()

    def _drop_settled(self) -> None:
        """Forget the inputs before the oldest observation that is still awaited."""
        first = min(self._before, default=len(self._inputs))
        del self._inputs[:first]
        self._before = {at - first: state for at, state in sorted(self._before.items())}
