"""Beliefs that end sure of a wrong value: those that chance has misled, and no others."""

import csv
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.line_problem import SETTINGS, Beacon, Line

import holdfast as hf
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.settings import LostSettings, SelectorSettings
from holdfast.robot.lost_values import LostValues, remark_on_lost_values
from holdfast.robot.trial_pool import Arm, TrialPool

TRIALS = 30
RANDOM = msgspec.structs.replace(SETTINGS, selector=SelectorSettings(method="random"))


class Bit(Beacon):
    """A robot that looks for a bit, with a dull sensor; its other one leaves few particles."""

    state_labels: Any = ("robot (m)", "bit")
    variances: Any = (1e-8, 4.0)

    def initial_states(self, stream: Any, count: int) -> FloatArray:
        bits = stream.substream(0).integers(0, 2, size=(count, 1))
        return np.concatenate([stream.substream(1).normal((count, 1)), bits], axis=1)

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return np.array([self.variances[sensing_action]])


class Ended(LostValues):
    """Looks by itself whether the last belief has the true bit."""

    def trial_ended(self, state: Any, result: Any) -> None:
        super().trial_ended(state, result)
        assert self.world is not None
        self.is_wrong = self.world.state[1] not in state.belief.states[:, 1].tolist()
        self.is_certain = bool(np.ptp(state.belief.states[:, 1]) == 0.0)


def ended(problem: Any) -> list[Ended]:
    trials = [Ended() for _ in range(TRIALS)]
    for trial, own in enumerate(trials):
        hf.run_trial(hf.Planner(problem, RANDOM), 3, trial, max_steps=20, observer=own)
    return trials


def test_a_bit_that_chance_has_decided() -> None:
    trials = ended(Bit())
    assert [each.lost for each in trials] == [("bit",) * each.is_wrong for each in trials]
    assert sum(each.is_certain for each in trials) > 0.8 * TRIALS
    assert 6 < sum(each.is_wrong for each in trials) < 24


def test_right_certainty_and_what_has_no_few_values_do_not_count() -> None:
    class Exact(Bit):
        variances = (4.0, 1e-4)

    class FewAtFirst(Bit):
        move = Line.move

    trials = ended(Exact())
    assert sum(each.is_certain for each in trials) > TRIALS / 2
    assert not any(each.lost for each in [*trials, *ended(Beacon()), *ended(FewAtFirst())])


def test_some_trials_may_lose_one_by_evidence() -> None:
    for lost, trials, many in ((1, 1, False), (2, 8, True), (5, 100, False), (6, 100, True)):
        given = [("bit", "lid"), *(lost - 1) * [("bit",)], *trials * [()]][:trials]
        reached = [True, *(trials - 1) * [False]]
        missed = f"({lost - 1} of these did not reach the goal)"
        told = f"{lost} of {trials} parts ended sure of a wrong value {missed}: no particle had"
        assert (
            remark_on_lost_values(given, reached, "parts")
            == f"{told} the true one of bit, lid" * many
        )


@pytest.mark.parametrize("jobs", [1, 2])
def test_workers_and_tables_tell_the_same(jobs: int) -> None:
    problem, expected = Bit(), [each.lost for each in ended(Bit())]
    arm = Arm(problem, RANDOM, 3, 20, LostSettings(), "bit")
    with TrialPool(jobs, overdue=None if jobs == 1 else lambda *_: False) as pool:
        done = {each.trial: each.lost_values for each in pool.run((arm, n) for n in range(8))}
    assert [done[trial] for trial in range(8)] == expected[:8]
    trials = hf.run_trials(hf.Planner(problem, RANDOM), TRIALS, seed=3, max_steps=20, jobs=1)
    assert [each.lost_values for each in trials] == expected
    remark = remark_on_lost_values(expected, [each.success for each in trials])
    for shown in (str(trials), trials._repr_html_()):
        assert f"{remark}. Resampling loses" in shown
    rows = csv.DictReader(trials.to_csv().splitlines())
    assert [row["lost_values"] for row in rows] == ["; ".join(each) for each in expected]
