"""A trial as it goes: late observations, what moves show, and beginning the belief anew."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from tests.trial_inputs import begin_anew, come_late, move, sense

from holdfast import numerics
from holdfast.errors import InvalidValueError, MessageError, ProblemError, RecordError
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Stream
from holdfast.planning import tracking as module
from holdfast.planning.outcome import Ending
from holdfast.planning.planner import Planner
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings
from holdfast.planning.tracking import Trial
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.problem import ProblemBase

SETTINGS = PlanningSettings(
    particle_filter=ParticleFilterSettings(num_particles=50), sensing_interval=2
)


class Cart(ProblemBase):
    """A cart on a line with an encoder and a bumper."""

    name = "cart"
    state_size = 1
    action_size = 1
    sensing_actions: Sequence[str] = ("look",)
    motion_variance = np.array([0.01])

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return stream.normal((count, 1))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        moved: FloatArray = states + actions + 0.5 * stream.normal(states.shape)
        return moved

    def move_by_measurement(
        self, states: FloatArray, motion: FloatArray, stream: Stream
    ) -> FloatArray:
        moved: FloatArray = states + motion + 0.001 * stream.normal(states.shape)
        return moved

    def move_log_likelihood(
        self, states: FloatArray, action: FloatArray, observation: FloatArray
    ) -> FloatArray:
        touches = (states[..., 0] > 0.0) == (observation[0] > 0.5)
        return numerics.log(np.where(touches, 0.9, 0.1))

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return states.copy()

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return np.array([0.04])

    def policy(self, states: FloatArray, stage: Any) -> FloatArray:
        return np.clip(-states, -0.2, 0.2)

    def is_goal(self, states: FloatArray) -> Any:
        return np.abs(states[..., 0]) < 0.1


def acted(trial: Trial, **shown: FloatArray) -> None:
    move(trial, trial.planner.choose_task_action(trial.state)[0], None, **shown)


def observed(trial: Trial, observation: FloatArray | None) -> None:
    action, _ = trial.planner.choose_sensing_action(trial.state)
    sense(trial, action, observation, 0.0)


def bits(trial: Trial) -> bytes:
    return trial.planner.digest(trial.state)


def test_an_observation_of_the_wrong_size_changes_nothing() -> None:
    trial = Trial(Planner(Cart(), SETTINGS), 1, 0)
    observed(trial, None)
    acted(trial)
    before = bits(trial)
    with pytest.raises(InvalidValueError, match="observation of 2 coordinates"):
        come_late(trial, 0, np.zeros(2))
    assert bits(trial) == before
    assert trial.awaited == (0,)


def test_what_is_awaited_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_AWAITED", 2)
    monkeypatch.setattr(module, "MAX_INPUTS_SINCE", 6)
    trial = Trial(Planner(Cart(), SETTINGS), 1, 0)
    for step in range(9):
        if step % 3 == 0:
            observed(trial, None)
        acted(trial)
    assert trial.awaited == (6,)
    with pytest.raises(RecordError, match="of step 0, where none is awaited"):
        come_late(trial, 0, np.array([0.2]))
    assert come_late(trial, 6, np.array([0.2])).digest == bits(trial)


def test_not_to_sense_awaits_nothing() -> None:
    planner = Planner(Cart(), SETTINGS)
    trial = Trial(planner, 1, 0)
    before = trial.state.belief
    sense(trial, planner.no_sensing, None, 0.5)
    info = trial.found
    assert info is not None
    assert info.explained
    assert not info.resampled
    assert trial.state.sensed
    assert trial.state.belief is before
    assert trial.awaited == ()
    assert (trial.num_inputs, trial.num_sensed) == (1, 0)
    with pytest.raises(InvalidValueError, match="sensing action 1: cart has 0 to 0"):
        sense(Trial(planner, 1, 0), planner.no_sensing, np.zeros(1))


@pytest.mark.parametrize(
    ("motion", "observation", "message"),
    [
        (np.zeros(3), None, "a move has the measured motion .* but peg_in_hole_2d has no "),
        (None, np.zeros(3), "a move has shown .* has no move_log_likelihood"),
        (np.array([np.nan]), None, r"\[nan\] are not all finite"),
    ],
)
def test_a_problem_that_cannot_fold_it_in_is_named(
    motion: FloatArray | None, observation: FloatArray | None, message: str
) -> None:
    trial = Trial(Planner(PegInHole2D(), SETTINGS), 1, 0)
    sense(trial, 0, np.zeros(1), 0.0)
    before = bits(trial)
    action, _ = trial.planner.choose_task_action(trial.state)
    with pytest.raises((InvalidValueError, MessageError, ProblemError), match=message):
        move(trial, action, None, motion, observation)
    assert bits(trial) == before


def test_a_new_belief_is_the_initial_one_or_the_problems_own() -> None:
    class Near(Cart):
        def reinitial_states(self, states: FloatArray, stream: Stream) -> FloatArray:
            return states + stream.normal(states.shape)

    for problem in (Cart(), Near()):
        trial = Trial(Planner(problem, SETTINGS), 1, 0)
        observed(trial, np.array([0.2]))
        acted(trial)
        before = trial.state
        assert begin_anew(trial).digest == bits(trial)
        assert trial.state._replace(belief=before.belief) == before
        assert (trial.state.belief.weights == 1 / 50).all()
        # Of 50 normal deviates: outside 0.6 and 1.4 with a probability below 1e-4.
        offset = before.belief.states if isinstance(problem, Near) else 0.0
        assert 0.6 < (trial.state.belief.states - offset).std() < 1.4


def test_what_was_taken_before_a_new_belief_is_no_evidence_against_it() -> None:
    """Else a robot whose belief has begun anew would be lost again by its old looks."""
    alarms = []
    for begins_anew in (False, True):
        trial = Trial(Planner(Cart(), PlanningSettings(sensing_interval=0)), 1, 0)
        for _ in range(8):
            observed(trial, None)
            acted(trial)
        if begins_anew:
            begin_anew(trial)
        for step in range(8):
            come_late(trial, step, np.array([1e3]))
        assert trial.num_unexplained == 8
        alarms.append(trial.lost_test.num_lost)
    assert alarms == [1, 0]


def test_the_log_has_what_was_shown() -> None:
    plain, shown = (Trial(Planner(Cart(), SETTINGS), 1, 0) for _ in range(2))
    for trial in (plain, shown):
        observed(trial, np.array([0.2]))
    acted(plain)
    acted(shown, motion=np.array([0.1]))
    assert [len(trial.log.decisions().log) for trial in (plain, shown)] == [45 + 17, 45 + 17 + 41]
    begin_anew(shown)
    assert len(shown.log.decisions().log) == 45 + 17 + 41 + 41
    assert plain.result(None).digest != shown.result(None).digest
    assert len(list(shown.log.decisions())) == 2


@pytest.mark.parametrize("outcome", ["succeeded", "failed", "truncated"])
def test_the_result_has_the_ending(outcome: Any) -> None:
    trial = Trial(Planner(Cart(), SETTINGS), 1, 0)
    result = trial.result(Ending(outcome, "hit the wall"))
    assert (result.outcome, result.reason, result.reward) == (outcome, "hit the wall", 0.0)
    assert Trial(trial.planner, 1, 0).result(None).outcome == "truncated"


def test_one_observation_at_a_time_may_come_late_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only what happened since the oldest awaited one is bounded."""
    monkeypatch.setattr(module, "MAX_INPUTS_SINCE", 6)
    trial = Trial(Planner(Cart(), SETTINGS), 1, 0)
    for step in range(0, 30, 3):
        observed(trial, None)
        acted(trial)
        acted(trial)
        come_late(trial, step, np.array([0.2]))
        acted(trial)
        assert trial._inputs == []


def test_the_bounds_are_what_may_still_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_INPUTS_SINCE", 3)
    trial = Trial(Planner(Cart(), PlanningSettings(sensing_interval=20)), 1, 0)
    observed(trial, None)
    awaited = []
    for _ in range(3):
        acted(trial)
        awaited.append(trial.awaited)
    assert awaited == [(0,), (0,), ()]  # with the sensing action, three inputs
    monkeypatch.setattr(module, "MAX_INPUTS_SINCE", 100)
    monkeypatch.setattr(module, "MAX_AWAITED", 2)
    trial = Trial(Planner(Cart(), PlanningSettings(sensing_interval=0)), 1, 0)
    for step in range(4):
        assert trial.awaited == tuple(range(max(0, step - 2), step))
        observed(trial, None)
        acted(trial)
    observed(trial, np.array([0.2]))  # one that is there takes nobody's place
    assert trial.awaited == (2, 3)


def test_the_account_of_a_trial() -> None:
    """What each kind of input counts for, one after the other."""
    problem = Cart()
    trial = Trial(Planner(problem, PlanningSettings(sensing_interval=0)), 1, 0)
    counts = [(trial.num_sensed, trial.num_inputs, trial.num_unexplained)]
    far, begun_before = np.array([1e3]), trial.begun

    def note() -> None:
        counts.append((trial.num_sensed, trial.num_inputs, trial.num_unexplained))

    sense(trial, 0, far, 2.0)
    note()
    assert (begun_before, trial.begun) == (False, True)
    move(trial, np.zeros(1), reward=-1.0)
    note()
    sense(trial, 0, None, 4.0)
    note()
    move(trial, np.zeros(1), reward=-0.5, observation=np.array([1.0]))
    note()
    sense(trial, trial.planner.no_sensing, None, 0.0)
    note()
    move(trial, np.zeros(1), motion=np.zeros(1))
    note()
    come_late(trial, 1, far)
    note()
    assert (trial.num_missing, trial.awaited) == (0, ())
    begin_anew(trial)
    note()
    assert not trial.is_lost
    assert counts == [
        *((0, 0, 0), (1, 1, 1), (1, 1, 1), (2, 2, 1), (2, 3, 1), (2, 4, 1), (2, 5, 1)),
        *((2, 6, 2), (2, 7, 2)),
    ]
    result = trial.result(None)
    assert (result.sensing_decisions, result.unexplained_observations) == (2, 2)
    assert (result.sensing_ms, result.mean_sensing_ms) == ((2.0, 4.0, 0.0), 2.0)
    assert result.recoveries == 0
    digests = {result.digest}
    for shorter in (lambda: begin_anew(trial), lambda: trial.result(None)):
        shorter()
        digests.add(trial.result(None).digest)
    assert len(digests) == 3  # the log has the new belief, and each ending


@pytest.mark.parametrize("kind", ["observed", "moved", "late"])
def test_an_alarm_is_that_of_the_last_input(kind: str) -> None:
    """With a rate of 1, two observations outside the gate raise one; the next input ends it."""
    trial = Trial(Planner(Cart(), PlanningSettings(sensing_interval=0)), 1, 0, 1.0)
    far = np.array([1e3])
    observed(trial, None)
    acted(trial)
    if kind == "late":
        come_late(trial, 0, far)
    else:
        sense(trial, 0, far, 0.0)
    assert alarm_of(trial) == "lost"
    assert trial.is_lost
    if kind == "observed":
        acted(trial)
        observed(trial, None)
    elif kind == "moved":
        acted(trial)
    else:
        begin_anew(trial)
    assert alarm_of(trial) is None


def alarm_of(trial: Trial) -> str | None:
    return None if trial.alarm is None else trial.alarm.kind


def test_a_new_belief_has_no_evidence_against_it() -> None:
    trial = Trial(Planner(Cart(), PlanningSettings(sensing_interval=0)), 1, 0, 0.1)
    far = np.array([1e3])
    for alarmed in (False, True):
        sense(trial, 0, far, 0.0)
        assert (trial.alarm is not None) == alarmed
        acted(trial)
    sense(trial, 0, far, 0.0)
    begin_anew(trial)
    acted(trial)
    sense(trial, 0, far, 0.0)
    assert trial.alarm is None


def test_what_moves_show_can_be_suspect() -> None:
    class Bumpless(Cart):
        def move_log_likelihood(
            self, states: FloatArray, action: FloatArray, observation: FloatArray
        ) -> FloatArray:
            return np.full(states.shape[:-1], -np.inf)

    trial = Trial(Planner(Bumpless(), PlanningSettings(sensing_interval=0)), 1, 0, 1.0)
    observed(trial, np.array([0.0]))
    acted(trial, observation=np.array([1.0]))
    assert trial.alarm is not None
    assert trial.alarm.kind == "sensor_suspect"
    assert trial.num_unexplained == 1
