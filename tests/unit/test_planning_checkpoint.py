"""States as bytes: their digest and their checkpoint."""

import tracemalloc

import msgspec
import numpy as np
import pytest
from tests.planning_settings import SEED, TRIAL, planning_settings

from holdfast.errors import CheckpointError, InvalidValueError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import Belief
from holdfast.planning.planner import (
    Planner,
    PlanningState,
    decode_checkpoint,
    digest,
    encode_checkpoint,
)
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.problem import Problem

GOLDEN_DIGEST = "187f6a5a76a77f1a6f9557467062aeef0de3bd61a29ae3f838adc04014ef9c6c"


@pytest.fixture(scope="module")
def peg() -> Problem:
    return PegInHole2D()


class TestDigest:
    def test_every_field_counts(self, peg: Problem) -> None:
        state = Planner(peg, planning_settings()).init(SEED, TRIAL)
        states, weights = state.belief

        def changed(array: FloatArray, *at: int) -> FloatArray:
            other = array.copy()
            other[at] = np.nextafter(other[at], np.inf)
            return other

        others = [
            state._replace(seed=SEED + 1),
            state._replace(trial=TRIAL + 1),
            state._replace(step=1),
            state._replace(stage=1),
            state._replace(sensed=True),
            *(
                state._replace(belief=Belief(changed(states, n, c), weights))
                for n in (0, 17, 39)
                for c in range(3)
            ),
            *(state._replace(belief=Belief(states, changed(weights, n))) for n in (0, 17, 39)),
            state._replace(belief=Belief(states[::-1].copy(), weights)),
            state._replace(belief=Belief(states.reshape(60, 2), np.full(60, 1.0 / 60.0))),
            state._replace(belief=Belief(states[:-1].copy(), weights[:-1].copy())),
        ]
        digests = {digest(state), *map(digest, others)}
        assert len(digests) == 1 + len(others)
        assert all(len(found) == 32 for found in digests)

    def test_it_is_about_values_and_not_about_memory(self, peg: Problem) -> None:
        state = Planner(peg, planning_settings()).init(SEED, TRIAL)
        states, weights = state.belief
        for same in (
            Belief(states.copy(), weights.copy()),
            Belief(np.asfortranarray(states), weights),
            Belief(np.repeat(states, 2, axis=0)[::2], np.repeat(weights, 2)[::2]),
            Belief(states.astype(">f8"), weights.astype(">f8")),
        ):
            assert digest(state._replace(belief=same)) == digest(state)

    def test_golden(self) -> None:
        """A change here makes every digest ever written worthless."""
        belief = Belief(np.array([[1.0, -2.5], [0.0, 1e-300]]), np.array([0.25, 0.75]))
        state = PlanningState(seed=1, trial=2, step=3, stage=4, sensed=True, belief=belief)
        assert digest(state).hex() == GOLDEN_DIGEST


class TestCheckpoint:
    def test_its_arrays_are_copied_once(self) -> None:
        """And that by NumPy, which lets other threads go on meanwhile."""
        count = 100_000
        belief = Belief(np.zeros((count, 3)), np.full(count, 1.0 / count))
        data = encode_checkpoint(PlanningState(0, 0, 0, 0, False, belief))
        tracemalloc.start()
        try:
            decode_checkpoint(data)
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak < 1.5 * len(data)

    @pytest.mark.parametrize(
        ("field", "value", "text"),
        [
            (0, 2, "checkpoint version 2: this holdfast reads 1"),
            (0, 0, "checkpoint version 0"),
            (1, -1, r"no checkpoint.*>= 0.*\[1\]"),
            (1, 2**63, r"no checkpoint"),
            (2, 2**32, rf"<= {2**32 - 1}.*\[2\]"),
            (3, -1, r">= 0.*\[3\]"),
            (4, 2**32, rf"<= {2**32 - 1}.*\[4\]"),
            (5, 1, r"bool.*\[5\]"),
            (6, 0, r">= 1.*\[6\]"),
            (6, 10_000_001, r"<= 10000000.*\[6\]"),
            (6, 9, "9 particles of 3 coordinates has 240 and 80 bytes: need 216 and 72"),
            (7, 0, r">= 1.*\[7\]"),
            (7, 2, "10 particles of 2 coordinates has 240 and 80 bytes: need 160 and 80"),
            (8, np.full(30, np.nan).tobytes(), "a state that is not finite"),
            (9, np.full(10, -0.1).tobytes(), "weights that are negative or sum to -1"),
            (9, np.full(10, 0.2).tobytes(), "weights .* sum to 2"),
            (9, np.zeros(10).tobytes(), "weights .* sum to 0"),
            (9, np.array([1e308] * 10).tobytes(), "weights .* sum to inf"),
            (9, np.array([np.inf, -np.inf] * 5).tobytes(), "weights .* sum to nan"),
        ],
    )
    def test_bounds(self, peg: Problem, field: int, value: object, text: str) -> None:
        state = Planner(peg, planning_settings(10)).init(SEED, TRIAL)
        fields = msgspec.msgpack.decode(encode_checkpoint(state))
        fields[field] = value
        with pytest.raises(CheckpointError, match=text):
            decode_checkpoint(msgspec.msgpack.encode(fields))


class TestCheckState:
    def test_what_does_not_fit_is_named(self) -> None:
        problem, settings = PegInHole2D(), PlanningSettings()
        planner = Planner(problem, settings)
        state = planner.init(1, 2)
        with pytest.raises(InvalidValueError, match=r"stage 1: peg_in_hole_2d has 0 to 0"):
            planner.check(state._replace(stage=1))
        with pytest.raises(InvalidValueError, match=r"of 3 coordinates: capsule_robot has 2"):
            Planner(CapsuleRobot(), settings).check(state)
        other = PlanningSettings(particle_filter=ParticleFilterSettings(num_particles=7))
        with pytest.raises(InvalidValueError, match=r"of 300 particles.*num_particles is 7"):
            Planner(problem, other).check(state)
