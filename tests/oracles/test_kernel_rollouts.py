"""The kernel's rollouts of the built-in problems, robot by robot and step by step in Python."""

from typing import Any

import numpy as np
import pytest

from holdfast import _kernel
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning.expected_return import rollout_returns
from holdfast.planning.settings import ActiveSensingSettings, PlanningSettings, SelectorSettings
from holdfast.problems.attributes import has_own, sensing_costs
from holdfast.problems.capsule_robot import CapsuleRobot, CapsuleRobotModel
from holdfast.problems.multitier_peg_in_hole_2d import (
    MultitierPegInHole2D,
    MultitierPegInHole2DModel,
)
from holdfast.problems.peg_in_hole_2d import PegInHole2D, PegInHole2DModel
from holdfast.problems.peg_in_hole_3d import PegInHole3D, PegInHole3DModel

INTERVAL, LOOKS, STEPS, DISCOUNT, CONTACT = 4, 3, 60, 0.95, 0.25

PROBLEMS = [
    # Near the hole, or the end of a corridor: contacts, goals and stages within few steps.
    PegInHole2D(PegInHole2DModel(init_mean=(0.5, 1.1, 0.1), init_cov=(0.05, 0.01, 0.01))),
    MultitierPegInHole2D(MultitierPegInHole2DModel(init_mean=(4.0, 6.5, 0.0))),
    PegInHole3D(PegInHole3DModel(init_mean=(0.2, 0.2, 1.1, 0.0, 0.0, 0.0))),
    CapsuleRobot(CapsuleRobotModel(init_mean=(4.2, 2.4))),
]


class Robot:
    """One robot that acts on a belief; its noise is that of particles from ``first`` on."""

    def __init__(self, problem: Any, state: FloatArray, cloud: FloatArray, first: int) -> None:
        self.problem, self.state, self.cloud, self.first = problem, state, cloud, first

    def moved(self, state: FloatArray, action: FloatArray, particle: int, noise: Stream) -> Any:
        rows = np.tile(state, (particle + 1, 1))
        deviation = self.problem._motion_deviation
        return self.problem.world.move(rows, action, deviation, CONTACT, noise.anew())[particle]

    def known_value(
        self, state: FloatArray, stage: int, since: int, price: float, motion: Stream
    ) -> float:
        value, factor = 0.0, 1.0
        for step in range(since, STEPS):
            if step > since and step % INTERVAL == 0:
                value -= factor * price
            stage = self.problem.next_stage(state, stage)
            action = self.problem.limit_action(self.problem.policy(state, stage))
            drawn = motion.substream(step).substream(0).normal((self.first + 1, len(state)))
            state = state + action + drawn[-1] * self.problem._motion_deviation
            value += factor * float(self.problem.reward(state, action))
            if self.problem.is_goal(state):
                break
            factor *= DISCOUNT
        return value

    def run(self, estimate: FloatArray, stage: int, motion: Stream, price: float) -> float:
        total, factor, share = 0.0, 1.0, 0.0 if self.problem.is_goal(self.state) else 1.0
        offset = estimate - self.mean()
        for step in range(STEPS):
            if step > 0 and step % INTERVAL == 0 and share > 0.0:
                later = step // INTERVAL
                total += factor * (-price * share)
                known = share * (1.0 if later == LOOKS else 1.0 / LOOKS)
                share -= known
                value = self.known_value(self.state, stage, step, price, motion)
                total += factor * (known * value)
            if share == 0.0:
                break
            believed = self.mean() + offset
            stage = self.problem.next_stage(believed, stage)
            action = self.problem.limit_action(self.problem.policy(believed, stage))
            noise = motion.substream(step)
            for number, member in enumerate(self.cloud):
                self.cloud[number] = self.moved(member, action, self.first + 1 + number, noise)
            self.state = self.moved(self.state, action, self.first, noise)
            total += factor * (share * float(self.problem.reward(self.state, action)))
            if self.problem.is_goal(self.state):
                share = 0.0
            factor *= DISCOUNT
        return total

    def mean(self) -> Any:
        total = self.cloud[0]
        for member in self.cloud[1:]:
            total = total + member
        return total / len(self.cloud)


@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda problem: problem.name)
@pytest.mark.parametrize("threads", [1, 2])
def test_same_bits_as_robot_by_robot(problem: Any, threads: int) -> None:
    problem.sensing_costs = [0.3] * len(problem.sensing_actions)
    settings = PlanningSettings(
        active_sensing=ActiveSensingSettings(discount=DISCOUNT, num_cores=threads),
        selector=SelectorSettings(
            method="expected_return", rollout_sensing_steps=LOOKS, rollout_steps=STEPS
        ),
        sensing_interval=INTERVAL - 1,
    )
    price = _kernel.sum(sensing_costs(problem)) / len(problem.sensing_actions)
    actions, samples, members = 3, 4, 2
    draws = stream(5, 0, 0, Purpose.INITIAL_BELIEF)
    drawn = problem.initial_states(draws, actions * samples * members + samples)
    true_states = drawn[:samples]
    clouds = drawn[samples:].reshape(actions, samples, members, -1)
    estimates = clouds.mean(axis=2) + 0.01
    # One knows its state: what two robots share is computed once.
    clouds[2], estimates[2] = clouds[1], estimates[1]
    motion = stream(5, 0, 0, Purpose.HYPOTHESES)
    before = _kernel.use_threads_from(0.0)
    try:
        found = rollout_returns(problem, settings, true_states, estimates, clouds, 0, motion)
    finally:
        _kernel.use_threads_from(before)
    expected = [
        [
            Robot(problem, true_states[i], clouds[j, i].copy(), i * (1 + members)).run(
                estimates[j, i], 0, motion, price
            )
            for i in range(samples)
        ]
        for j in range(actions)
    ]
    assert found.tobytes() == np.array(expected).tobytes()
    assert len(np.unique(found)) > 2


def test_a_subclass_with_a_policy_of_its_own_is_not_rolled_out_by_the_kernel() -> None:
    class Own(PegInHole2D):
        def policy(self, states: FloatArray, stage: Any) -> FloatArray:
            return np.zeros(states.shape)

    alike = ("policy",)
    assert has_own(PegInHole2D(), "rollout_returns", alike)
    assert not has_own(Own(), "rollout_returns", alike)
