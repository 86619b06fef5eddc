"""A cart on a rail drives into its dock; docs/robots.md tells it step by step.

The wheels slip, the camera is slow, and the dock has a bumper. Each class below adds one thing to
the one before. The problem says what each thing means.
"""

import threading
import time

import numpy as np

from holdfast import Ending, MoveResult, ProblemBase, numerics

DOCK, WALL = 0.05, -0.4  # m: this close is docked, and this far is through the dock
SLIP = 0.8  # of a move, at random


class Docking(ProblemBase):
    """The state is where the cart is (m); the dock is at 0."""

    name = "docking"
    state_size = 1
    action_size = 1
    sensing_actions = ("beacon", "floor marks")
    motion_variance = np.array([0.01])
    resolution = 0.02
    state_labels = ("x (m)",)

    def initial_states(self, stream, count):
        return 4.0 + 1.5 * stream.normal((count, 1))

    def move(self, states, actions, stream):
        slipped = 1.0 - SLIP * stream.uniform(states.shape)
        return states + actions * slipped + 0.02 * stream.normal(states.shape)

    def observation_mean(self, states, sensing_action):
        if sensing_action == 0:
            return states.copy()
        return numerics.sin(6.0 * states)  # the marks repeat, so they show x up to a period

    def observation_variance(self, states, sensing_action):
        return np.array([0.36 if sensing_action == 0 else 0.02])

    def policy(self, states, stage):
        return -np.clip(states, -0.3, 0.3)

    def is_goal(self, states):
        return np.abs(states[..., 0]) < DOCK

    def move_by_measurement(self, states, motion, stream):
        return states + motion + 0.01 * stream.normal(states.shape)  # the encoder's noise

    def move_log_likelihood(self, states, action, observation):
        right = (states[..., 0] < 0.1) == (observation[0] == 1.0)
        return numerics.log(np.where(right, 0.98, 0.02))  # the bumper errs once in 50 moves


class Cart:
    """The cart's own three methods; a real one would talk to its motors and its camera."""

    def __init__(self, seed, trial):
        self.random = np.random.default_rng((seed, trial))
        self.x = 4.0 + 1.5 * self.random.normal()

    def perform_sensing(self, sensing_action):
        if sensing_action == 0:
            return [self.x + 0.6 * self.random.normal()]
        return [np.sin(6.0 * self.x) + 0.14 * self.random.normal()]

    def perform(self, task_action):
        self.drive(task_action[0])

    def is_done(self):
        return abs(self.x) < DOCK

    def drive(self, distance):
        moved = distance * (1.0 - SLIP * self.random.uniform()) + 0.02 * self.random.normal()
        self.x += moved
        return moved


class CartThatCrashes(Cart):
    """An ending may be a failure, and has a reason."""

    def is_done(self):
        if self.x < WALL:
            return Ending("failed", f"through the dock, {-self.x:.2f} m behind it")
        return super().is_done()


class CartWithEncoder(CartThatCrashes):
    """A move may show how far the wheels went."""

    def perform(self, task_action):
        moved = self.drive(task_action[0])
        return MoveResult(motion=[moved + 0.01 * self.random.normal()])


class CartWithBumper(CartThatCrashes):
    """A move may show more: whether the bumper is pressed."""

    def perform(self, task_action):
        moved = self.drive(task_action[0])
        is_right = self.random.uniform() < 0.98
        return MoveResult(
            motion=[moved + 0.01 * self.random.normal()],
            observation=[float((self.x < 0.1) == is_right)],
        )


class CartWithSlowCamera(CartWithBumper):
    """A look takes 60 ms; with ``sense_in_background`` the cart goes on meanwhile."""

    def __init__(self, seed, trial):
        super().__init__(seed, trial)
        self.lock = threading.Lock()  # its methods are called at the same time

    def perform_sensing(self, sensing_action):
        with self.lock:
            shown = super().perform_sensing(sensing_action)
        time.sleep(0.06)
        return shown

    def perform(self, task_action):
        with self.lock:
            return super().perform(task_action)
