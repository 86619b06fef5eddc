"""A rover with an encoder, a bumper and a slow camera, and robots of it that meet faults.

Its problem is :class:`Rover`; its world is simulated, and what it was moved and shown is in files,
which outlive the robot's process, as a real robot does.
"""

from __future__ import annotations

import contextlib
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np

from holdfast import LATER, MoveResult, ProblemBase, SimulatedEnvironment, numerics

STATES = 2  # where it is, and the bias of its encoder
LATE = 4
"""Moves from a look to its picture."""
NO_READING: dict[int, Any] = {6: None, 12: np.array([np.nan]), 21: None}
NOT_LATE_EITHER = (15,)
"""Steps at which a look has no reading: found at once, and with a later move."""


class Rover(ProblemBase):
    name = "rover"
    state_size = 2
    action_size = 1
    sensing_actions = ("beacon", "wall")
    motion_variance = np.array([0.01])
    resolution = 0.1

    def initial_states(self, stream: Any, count: int) -> Any:
        return stream.normal((count, STATES)) * np.array([2.0, 0.05])

    def move(self, states: Any, actions: Any, stream: Any) -> Any:
        moved = states.copy()
        moved[..., 0] += 0.8 * actions[..., 0] + 0.2 * stream.normal(states.shape[:-1])
        return moved

    def move_by_measurement(self, states: Any, motion: Any, stream: Any) -> Any:
        moved = states.copy()
        moved[..., 0] += motion[0] - states[..., 1] + 0.02 * stream.normal(states.shape[:-1])
        return moved

    def measure_motion(self, before: Any, after: Any, stream: Any) -> Any:
        return after[:1] - before[:1] + after[1:] + 0.02 * stream.normal(1)

    def move_log_likelihood(self, states: Any, action: Any, observation: Any) -> Any:
        touched = (np.abs(states[..., 0]) < 1.0) == (observation[0] > 0.5)
        return numerics.log(np.where(touched, 0.95, 0.05))

    def sample_move_observation(self, state: Any, action: Any, stream: Any) -> Any:
        touches = (abs(state[0]) < 1.0) == (float(stream.uniform()) < 0.95)
        return np.array([float(touches)])

    def observation_mean(self, states: Any, sensing_action: int) -> Any:
        return states[..., :1] * (1.0 if sensing_action == 0 else 0.5)

    def observation_variance(self, states: Any, sensing_action: int) -> Any:
        return np.array([0.25])

    def policy(self, states: Any, stage: Any) -> Any:
        return -np.clip(states[..., :1], -0.3, 0.3)

    def is_goal(self, states: Any) -> Any:
        return np.abs(states[..., 0]) < 0.02


class Robot:
    """The rover; each second look comes late, and some give no reading.

    ``kill_at`` names the steps at which, in the midst of the move, the process whose id is in the
    file ``victim`` is killed: the service's, or the robot's own.
    """

    def __init__(
        self, problem: Any, seed: int, trial: int, resumed: bool, kill_at: tuple[int, ...] = ()
    ) -> None:
        self._trial, self._kill_at = trial, kill_at
        self._moves, self._looks = Path(f"moves-{trial}"), Path(f"looks-{trial}")
        if not resumed:
            self._moves.write_text("")
            self._looks.write_text("")
        self._world = SimulatedEnvironment(problem, seed, trial)
        self._last: Any = None
        for line in self._moves.read_text().split():
            self._last = self._world.perform(np.array([float.fromhex(line)]))

    def perform_sensing(self, sensing_action: int) -> Any:
        step = self._world.step
        shown = self._world.perform_sensing(sensing_action)
        if step in NO_READING:
            return NO_READING[step]
        if step // 3 % 2 == 0:
            return shown
        looks = [line for line in self._looks.read_text().splitlines() if line]
        looks = [line for line in looks if not line.startswith(f"{step} ")]
        looks.append(f"{step} {float(shown[0]).hex()}")
        self._looks.write_text("\n".join(looks))
        return LATER

    def late_observations(self) -> list[tuple[int, list[float] | None]]:
        now = self._world.step
        looks = (line.split() for line in self._looks.read_text().splitlines())
        return [
            (int(step), None if int(step) in NOT_LATE_EITHER else [float.fromhex(value)])
            for step, value in looks
            if int(step) + LATE == now
        ]

    def perform(self, task_action: Any) -> Any:
        step = self._world.step
        self._last = self._world.perform(task_action)
        with self._moves.open("a") as file:
            file.write(float(task_action[0]).hex() + "\n")
        mark = Path(f"killed-{self._trial}-{step}")
        if step in self._kill_at and not mark.exists():
            mark.touch()
            victim = Path("victim").read_text()
            with contextlib.suppress(ProcessLookupError):  # a service is killed once
                os.kill(int(victim) if victim else os.getpid(), signal.SIGKILL)
        assert isinstance(self._last, MoveResult)
        return self._last

    def last_move(self) -> Any:
        return self._last

    def is_done(self) -> bool:
        return False

    def steps_performed(self) -> int:
        return self._world.step
