"""Beliefs that end sure of a wrong value: those that chance has misled, and no others."""

from typing import Any

import msgspec
import numpy as np
import pytest
from tests.line_problem import SETTINGS, Line

import holdfast as hf
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.settings import LostSettings, SelectorSettings
from holdfast.robot.lost_values import LostValues, are_many, remark_on_lost_values
from holdfast.robot.trial_pool import Arm, TrialPool

TRIALS = 30
RANDOM = msgspec.structs.replace(SETTINGS, selector=SelectorSettings(method="random"))


class Bit(Line):
    """A robot that also looks for a bit, with a dull sensor; its other one leaves few particles."""

    state_labels = ("robot (m)", "bit")
    variances: Any = (1e-8, 4.0)

    def initial_states(self, stream: Any, count: int) -> FloatArray:
        bits = stream.substream(0).integers(0, 2, size=(count, 1))
        return np.concatenate([stream.substream(1).normal((count, 1)), bits], axis=1)

    def move(self, states: FloatArray, actions: FloatArray, stream: Any) -> FloatArray:
        moved = states.copy()
        moved[..., :1] += actions + 0.1 * stream.normal(states[..., :1].shape)
        return moved

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return np.array([self.variances[sensing_action]])

    def is_goal(self, states: FloatArray) -> Any:
        return np.zeros(states.shape[:-1], dtype=bool)


class Ended(LostValues):
    """Looks by itself whether the last belief has the true bit."""

    def trial_ended(self, state: Any, result: Any) -> None:
        super().trial_ended(state, result)
        assert self.world is not None
        self.has_the_bit = self.world.state[1] in state.belief.states[:, 1].tolist()
        self.is_certain = np.ptp(state.belief.states[:, 1]) == 0.0


def ended(problem: Any) -> list[Ended]:
    trials = [Ended() for _ in range(TRIALS)]
    for trial, own in enumerate(trials):
        hf.run_trial(hf.Planner(problem, RANDOM), 3, trial, max_steps=20, observer=own)
    return trials


def test_a_bit_that_chance_has_decided() -> None:
    trials = ended(Bit())
    assert [each.coordinates for each in trials] == [
        () if each.has_the_bit else (1,) for each in trials
    ]
    assert sum(each.is_certain for each in trials) > 0.8 * TRIALS
    # Chance is right half of the time: more than 6 of 30 are wrong but for one time in 1,000.
    assert 6 < sum(not each.has_the_bit for each in trials) < 24


def test_right_certainty_and_what_has_no_few_values_do_not_count() -> None:
    class Exact(Bit):
        variances = (4.0, 1e-4)

    class Beacon(Bit):
        def initial_states(self, stream: Any, count: int) -> FloatArray:
            return stream.normal((count, 2))

    class FewAtFirst(Bit):
        def move(self, states: FloatArray, actions: FloatArray, stream: Any) -> FloatArray:
            return states + actions + 0.1 * stream.normal(states.shape)

    trials = ended(Exact())
    assert sum(each.is_certain for each in trials) > TRIALS / 2
    for each in [*trials, *ended(Beacon()), *ended(FewAtFirst())]:
        assert each.coordinates == ()


def test_some_trials_may_lose_one_by_evidence() -> None:
    assert [are_many(*each) for each in ((1, 1), (2, 8), (5, 100), (6, 100))] == [
        *(False, True, False, True)
    ]
    assert remark_on_lost_values([("bit",), (), ()]) == ""
    remark = remark_on_lost_values([("bit", "lid"), (), ("bit",)])
    assert remark == (
        "2 of 3 trials ended sure of a wrong value: no particle had the true one of bit, lid"
    )


@pytest.mark.parametrize("jobs", [1, 2])
def test_workers_tell_the_same(jobs: int) -> None:
    problem = Bit()
    arm = Arm(problem, RANDOM, 3, 20, LostSettings(), "bit")
    with TrialPool(jobs, overdue=None if jobs == 1 else lambda *_: False) as pool:
        done = {each.trial: each.lost_values for each in pool.run((arm, n) for n in range(8))}
    assert [done[trial] for trial in range(8)] == [each.coordinates for each in ended(problem)[:8]]


def test_run_trials_names_them() -> None:
    trials = hf.run_trials(hf.Planner(Bit(), RANDOM), TRIALS, seed=3, max_steps=20, jobs=1)
    lost = [each.coordinates for each in ended(Bit())]
    assert [each.lost_values for each in trials] == [("bit",) * len(each) for each in lost]
    says = f"{sum(map(bool, lost))} of 30 trials ended sure of a wrong value: no particle had"
    assert f"{says} the true one of bit. Resampling loses" in str(trials)
    assert says in trials._repr_html_()
    assert "sure of" not in str(hf.run_trials(Line(), 3, max_steps=20, jobs=1))
