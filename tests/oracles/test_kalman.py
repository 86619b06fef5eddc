"""The particle filter against the Kalman filter, which is exact where all is linear and Gaussian.

The filter is the one that plans: `Planner.observe` and `Planner.advance` on a problem of one and
of two dimensions. Its belief of N particles errs from the exact one by O(1 / sqrt N) at random and
by O(1 / N) in the mean, at every step, because it forgets. So the errors of independent runs on the
same observations are a sample of mean zero up to 10 / N, in units of the exact deviation: a t-test
with their own spread, failed by a right filter with probability 1e-6. About 400 numbers are
compared (dependent in time), so of all seeds 1e-3 would fail at most.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning.belief import estimate
from holdfast.planning.planner import Planner
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings
from holdfast.problems.problem import ProblemBase

FALSE_ALARM = 1e-6
NUM_PARTICLES = 20_000
RUNS = 32
STEPS = 12


class Linear(ProblemBase):
    """x' = A x + u + w, z = C_j x + v, all noise Gaussian."""

    sensing_actions: Sequence[str] = ("first coordinate", "everything")

    def __init__(self, transition: FloatArray, motion_variance: FloatArray) -> None:
        self.name = "linear"
        self.state_size = self.action_size = len(transition)
        self.transition = transition
        self.motion_variance = motion_variance
        self.init_mean = np.linspace(1.0, 2.0, self.state_size)
        self.init_variance = np.linspace(0.5, 1.5, self.state_size)
        self.sensing_variances = [np.array([0.3]), np.linspace(0.2, 0.6, self.state_size)]

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        noise = stream.normal((count, self.state_size))
        return self.init_mean + np.sqrt(self.init_variance) * noise

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        noise = stream.normal(states.shape)
        # Not by BLAS, whose threads get in each other's way where tests share a machine.
        moved = np.einsum("ij,...j->...i", self.transition, states) + actions
        return np.asarray(moved + np.sqrt(self.motion_variance) * noise)

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return states[..., :1] if sensing_action == 0 else states

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return self.sensing_variances[sensing_action]

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return -0.1 * states

    def is_goal(self, states: FloatArray) -> npt.NDArray[np.bool_]:
        return np.zeros(states.shape[:-1], dtype=bool)


PROBLEMS = {
    "one dimension": Linear(np.array([[0.95]]), np.array([0.05])),
    "two dimensions": Linear(np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([0.02, 0.05])),
}


class KalmanFilter:
    def __init__(self, problem: Linear) -> None:
        self.problem = problem
        self.mean = problem.init_mean.copy()
        self.covariance = np.diag(problem.init_variance)

    def update(self, sensing_action: int, observation: FloatArray) -> None:
        rows = len(observation)
        matrix = np.eye(self.problem.state_size)[:rows]
        noise = np.diag(self.problem.sensing_variances[sensing_action])
        innovation = matrix @ self.covariance @ matrix.T + noise
        gain = np.linalg.solve(innovation, matrix @ self.covariance).T
        self.mean = self.mean + gain @ (observation - matrix @ self.mean)
        self.covariance = self.covariance - gain @ matrix @ self.covariance

    def predict(self, action: FloatArray) -> None:
        transition = self.problem.transition
        self.mean = transition @ self.mean + action
        self.covariance = transition @ self.covariance @ transition.T
        self.covariance = self.covariance + np.diag(self.problem.motion_variance)


def plan(step: int, size: int) -> tuple[int | None, FloatArray]:
    """Return what to sense at a step (or nothing) and what to do then."""
    sensing_action = None if step % 4 == 3 else (step // 2) % 2
    return sensing_action, 0.3 * np.cos(0.5 * step + np.arange(size))


def true_observations(problem: Linear) -> list[FloatArray]:
    world = stream(78, 0, 0, Purpose.WORLD_INITIAL_STATE)
    state = problem.initial_states(world, 1)[0]
    observations = []
    for step in range(STEPS):
        sensing_action, action = plan(step, problem.state_size)
        mean = problem.observation_mean(state, sensing_action or 0)
        deviation = np.sqrt(problem.sensing_variances[sensing_action or 0])
        observations.append(mean + deviation * world.substream(2 * step).normal(mean.shape))
        state = problem.move(state, action, world.substream(2 * step + 1))
    return observations


def moments(states: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    mean = np.einsum("n,ni->i", weights, states)
    centred = states - mean
    return mean, np.einsum("n,ni,nj->ij", weights, centred, centred)


@pytest.mark.parametrize(
    "resampling_threshold", [1.0, pytest.param(0.5, marks=pytest.mark.slow), 0.0]
)
@pytest.mark.parametrize("name", PROBLEMS)
def test_mean_and_covariance(name: str, resampling_threshold: float) -> None:
    """After every update and every prediction; resampled always, sometimes, and never.

    Without resampling the weights degenerate, so only the first steps are compared then.
    """
    problem = PROBLEMS[name]
    size = problem.state_size
    steps = STEPS if resampling_threshold > 0.0 else 3
    settings = PlanningSettings(
        particle_filter=ParticleFilterSettings(
            num_particles=NUM_PARTICLES, resampling_threshold=resampling_threshold
        )
    )
    observations = true_observations(problem)
    exact = KalmanFilter(problem)
    planner = Planner(problem, settings)
    states = [planner.init(5, run) for run in range(RUNS)]
    resampled = []

    def compare() -> None:
        deviation = np.sqrt(np.diag(exact.covariance))
        errors = np.empty((RUNS, size + size * size))
        for run, state in enumerate(states):
            mean, covariance = moments(*state.belief)
            np.testing.assert_allclose(mean, estimate(state.belief), atol=1e-12)
            errors[run, :size] = (mean - exact.mean) / deviation
            relative = (covariance - exact.covariance) / np.outer(deviation, deviation)
            errors[run, size:] = relative.reshape(-1)
        sigma = errors.std(axis=0, ddof=1) / np.sqrt(RUNS)
        reach = stats.t.ppf(1.0 - 0.5 * FALSE_ALARM, RUNS - 1) * sigma + 10.0 / NUM_PARTICLES
        assert reach.max() < 0.1, "the test has no power"
        assert (np.abs(errors.mean(axis=0)) <= reach).all()

    compare()
    for step in range(steps):
        sensing_action, action = plan(step, size)
        if sensing_action is not None:
            exact.update(sensing_action, observations[step])
            for run, state in enumerate(states):
                states[run], info = planner.observe(state, sensing_action, observations[step])
                assert info.explained
                resampled.append(info.resampled)
            compare()
        exact.predict(action)
        states = [planner.advance(state, action) for state in states]
        compare()
    expected = {1.0: {True}, 0.5: {True, False}, 0.0: {False}}
    assert set(resampled) == expected[resampling_threshold]
