"""Stone Soup's sensor management: where a radar points next, by its managers and by holdfast's.

The scene of its tutorial "Single sensor management": three targets that move at nearly constant
velocity, and a radar with a beam of 30 degrees that can turn anywhere within a second. Tracking is
Stone Soup's own in all cases (an extended Kalman filter, each detection given to its target);
only the direction is chosen otherwise. Holdfast's selectors are asked about 300 particles drawn
from the predicted tracks. The policy is to tell where the targets are. ::

    pip install stonesoup==1.9.1
    python -m benchmarks.sensor_management --out docs/results/other_worlds/sensor_management.csv

A row has the mean distance of the tracks from their targets over all targets and steps. Trials of
seed 2026 judge; nothing was chosen.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from functools import partial
from typing import Any

import numpy as np

from benchmarks import trial_table
from holdfast import numerics
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning.belief import Belief
from holdfast.planning.sensing import choose_sensing_action
from holdfast.planning.settings import ActiveSensingSettings, PlanningSettings, SelectorSettings
from holdfast.problems.problem import ProblemBase

COLUMNS = ("error_m", "decision_s")
STEPS, TARGETS, PARTICLES, DIRECTIONS = 50, 3, 300, 12
PLACE, BEAM = np.array([10.0, 0.0]), np.radians(30.0)
BEARING, RANGE, VELOCITY_NOISE = np.radians(0.5), 1.0, 0.005
MISSED = -50.0
"""Logarithm of the likelihood of a target that is seen though it is not in the beam, or not seen
though it is: next to none, but no decision ends with no particle."""

WAYS: Mapping[str, SelectorSettings] = {
    "default": SelectorSettings(),
    "state entropy": SelectorSettings(method="state_entropy"),
    "action covariance": SelectorSettings(method="action_covariance"),
    "random": SelectorSettings(method="random"),
}
MANAGERS = ("Stone Soup: uncertainty", "Stone Soup: KL divergence")


class Beam(ProblemBase):
    """States are (x, vx, y, vy) of each target, and a sensing action the direction of the beam."""

    name = "radar"
    state_size = 4 * TARGETS
    action_size = 2 * TARGETS
    sensing_actions: Sequence[str] = tuple(
        f"{360 * each // DIRECTIONS} degrees" for each in range(DIRECTIONS)
    )
    resolution = 0.3
    state_resolution = 0.3
    motion_variance = np.full(2 * TARGETS, 0.3**2)

    def _seen(self, states: FloatArray, sensing_action: int) -> tuple[FloatArray, BoolArray]:
        """Return bearing and range of each target, shape (..., 3, 2), and which are in the beam."""
        places = states.reshape(*states.shape[:-1], TARGETS, 4)
        x, y = places[..., 0] - PLACE[0], places[..., 2] - PLACE[1]
        bearing = numerics.arctan2(np.ascontiguousarray(y), np.ascontiguousarray(x))
        off = numerics.wrapped(bearing - 2.0 * np.pi * sensing_action / DIRECTIONS)
        return np.stack([bearing, np.sqrt(x * x + y * y)], axis=-1), np.abs(off) <= BEAM / 2.0

    def log_likelihood(
        self, states: FloatArray, sensing_action: int, observation: FloatArray
    ) -> FloatArray:
        return np.asarray(self.log_likelihoods(states, sensing_action, observation[np.newaxis])[0])

    def log_likelihoods(
        self, states: FloatArray, sensing_action: int, observations: FloatArray
    ) -> FloatArray:
        expected, inside = self._seen(states, sensing_action)
        shown = observations.reshape(-1, 1, TARGETS, 3)
        bearing = numerics.wrapped(shown[..., 0] - expected[..., 0]) / BEARING
        away = (shown[..., 1] - expected[..., 1]) / RANGE
        seen = shown[..., 2] > 0.5
        fits = np.where(seen, -0.5 * (bearing * bearing + away * away), 0.0)
        each = np.maximum(np.where(seen == inside, fits, MISSED), MISSED)
        return np.asarray(each[..., 0] + each[..., 1] + each[..., 2])

    def sample_observation(
        self, state: FloatArray, sensing_action: int, stream: Stream
    ) -> FloatArray:
        shown, inside = self._seen(state, sensing_action)
        noisy = shown + stream.normal((TARGETS, 2)) * np.array([BEARING, RANGE])
        seen = inside[:, np.newaxis]
        return np.concatenate([np.where(seen, noisy, 0.0), seen.astype(float)], axis=1).reshape(-1)

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        del actions, stream
        moved = states.copy()
        moved[..., ::2] += states[..., 1::2]
        return moved

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        del stage
        return states[..., ::2].copy()

    def is_goal(self, states: FloatArray) -> BoolArray:
        return np.zeros(states.shape[:-1], dtype=bool)


def run(way: str, seed: int, trial: int) -> Mapping[str, Any]:
    """Track for 50 s, and return the mean error and the time of a decision."""
    try:
        from stonesoup.models.transition.linear import (
            CombinedLinearGaussianTransitionModel,
            ConstantVelocity,
        )
        from stonesoup.predictor.kalman import KalmanPredictor
        from stonesoup.sensor.radar.radar import RadarRotatingBearingRange
        from stonesoup.sensormanager import BruteForceSensorManager
        from stonesoup.sensormanager.reward import ExpectedKLDivergence, UncertaintyRewardFunction
        from stonesoup.types.angle import Angle
        from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
        from stonesoup.types.hypothesis import SingleHypothesis
        from stonesoup.types.state import GaussianState, StateVector
        from stonesoup.types.track import Track
        from stonesoup.updater.kalman import ExtendedKalmanUpdater
    except ImportError as error:
        raise SystemExit(f"this needs: pip install stonesoup==1.9.1 ({error})") from error
    begin = datetime(2026, 1, 1)
    model = CombinedLinearGaussianTransitionModel([ConstantVelocity(VELOCITY_NOISE)] * 2)
    np.random.seed(1000 * seed + trial)  # noqa: NPY002 - Stone Soup draws from it
    starts = [[0, 1, 0, 1], [0, -1, 10, -1], [0, 1, 20, -1]]
    truths = []
    for start in starts:
        truth = GroundTruthPath([GroundTruthState(start, timestamp=begin)])
        for step in range(1, STEPS + 1):
            moved = model.function(truth[-1], noise=True, time_interval=timedelta(seconds=1))
            truth.append(GroundTruthState(moved, timestamp=begin + timedelta(seconds=step)))
        truths.append(truth)
    noises = np.random.default_rng([seed, trial]).normal(size=(STEPS, TARGETS, 2))
    radar = RadarRotatingBearingRange(
        position_mapping=(0, 2),
        noise_covar=np.diag([BEARING**2, RANGE**2]),
        ndim_state=4,
        position=PLACE[:, np.newaxis],
        rpm=60,
        fov_angle=BEAM,
        dwell_centre=StateVector([0.0]),
        max_range=np.inf,
        resolution=Angle(BEAM),
    )
    radar.timestamp = begin
    predictor, updater = KalmanPredictor(model), ExtendedKalmanUpdater(measurement_model=None)
    tracks = [
        Track([GaussianState([*start[:2], start[2] + 0.1, start[3]], np.diag([0.5] * 4), begin)])
        for start in starts
    ]
    reward = {MANAGERS[0]: UncertaintyRewardFunction, MANAGERS[1]: ExpectedKLDivergence}.get(way)
    manager = None
    if reward is not None:
        manager = BruteForceSensorManager({radar}, reward_function=reward(predictor, updater))
    problem: Any = Beam()  # its observations have a likelihood of their own
    draws = np.random.default_rng([seed, trial, 1])
    errors, seconds = [], 0.0
    for step in range(1, STEPS + 1):
        now = begin + timedelta(seconds=step)
        predicted = [predictor.predict(track[-1], timestamp=now) for track in tracks]
        began = time.process_time()
        if manager is not None:
            (actions,) = [chosen[radar] for chosen in manager.choose_actions(set(tracks), now)]
        else:
            particles = np.concatenate(
                [
                    draws.multivariate_normal(np.ravel(each.state_vector), each.covar, PARTICLES)
                    for each in predicted
                ],
                axis=1,
            )
            index, _ = choose_sensing_action(
                problem,
                PlanningSettings(
                    selector=WAYS[way],
                    active_sensing=ActiveSensingSettings(num_cores=1),
                    sensing_interval=0,
                ),
                Belief(particles.astype(float), np.full(PARTICLES, 1.0 / PARTICLES)),
                0,
                stream(seed, trial, step, Purpose.HYPOTHESES),
                stream(seed, trial, step, Purpose.SELECTION),
            )
            (generator,) = radar.actions(now)
            # Its action_from_value rounds down, at times to the direction before.
            target = 2.0 * np.pi * index / DIRECTIONS
            offers = list(generator)
            turns = np.array([float(each.target_value) for each in offers])
            actions = [offers[int(np.argmin(np.abs(numerics.wrapped(turns - target))))]]
        seconds += time.process_time() - began
        radar.add_actions(actions)
        radar.act(now)
        for number, (truth, track) in enumerate(zip(truths, tracks, strict=True)):
            state = predicted[number]
            for detection in radar.measure({truth[step]}, noise=False):
                detection = copy.copy(detection)
                noise = noises[step - 1, number] * np.array([BEARING, RANGE])
                detection.state_vector = detection.state_vector + noise[:, np.newaxis]
                state = updater.update(SingleHypothesis(state, detection))
            track.append(state)
            off = np.ravel(truth[step].state_vector - track[-1].state_vector).astype(float)
            errors.append(float(np.hypot(off[0], off[2])))
    return {"error_m": float(np.mean(errors)), "decision_s": seconds / STEPS}


def cells_of(seed: int) -> list[trial_table.Cell]:
    return [trial_table.Cell({"way": way}, partial(run, way, seed)) for way in (*WAYS, *MANAGERS)]


if __name__ == "__main__":
    out = trial_table.main(__doc__, "runs/sensor_management/trials.csv", 30, cells_of, COLUMNS)
    print(trial_table.ranked(out, COLUMNS[0], COLUMNS[1:]))
