"""A gripper must tell two screw types, fetch the right driver from the rack, and drive the screw.

States (x, y, type, tool): position of the gripper, type of the head (-1 hex, 1 torx), tool held
(0 none, -1, 1). It starts over the screw. A camera tells the head's type, well only close by;
two encoders give the position. A wrong driver in the screw strips the head: failure, a fine.
It may see at the rack that it was wrong, and change the driver there.
"""

import numpy as np

import holdfast as hf
from holdfast import numerics

SLOTS = {-1.0: np.array([1.6, -0.7]), 1.0: np.array([1.6, 0.7])}


class Screws(hf.ProblemBase):
    name = "screws"
    state_size, action_size = 4, 2
    sensing_actions = ("camera on the head", "encoder x", "encoder y")
    state_labels = ("x (m)", "y (m)", "type", "tool")
    resolution = 0.03
    motion_variance = np.array([0.0009, 0.0009])

    def __init__(self, fine=80.0):
        self.fine = fine

    def initial_states(self, stream, count):
        place = np.array([0.25, 0.0]) + 0.08 * stream.normal((count, 2))
        kind = np.where(stream.random((count, 1)) < 0.5, -1.0, 1.0)
        return np.concatenate([place, kind, np.zeros((count, 1))], axis=1)

    def move(self, states, actions, stream):
        moved = states.copy()
        moved[..., :2] += actions + 0.03 * stream.normal((*states.shape[:-1], 2))
        for tool, slot in SLOTS.items():
            near = ((moved[..., :2] - slot) ** 2).sum(axis=-1) < 0.2**2
            moved[..., 3] = np.where(near, tool, moved[..., 3])
        return moved

    def right(self, states):
        d2 = states[..., 0] ** 2 + states[..., 1] ** 2
        return 0.5 + 0.32 * numerics.exp(-d2 / 0.5)

    def log_likelihood(self, states, sensing_action, observation):
        if sensing_action:
            deviation = (observation[0] - states[..., sensing_action - 1]) / 0.03
            return -0.5 * deviation * deviation
        right = self.right(states)
        agrees = observation[0] * states[..., 2] > 0.0
        return np.where(agrees, numerics.log(right), numerics.log(1.0 - right))

    def sample_observation(self, state, sensing_action, stream):
        if sensing_action:
            return state[sensing_action - 1] + 0.03 * stream.normal((1,))
        return np.where(stream.random((1,)) < self.right(state), state[2], -state[2])

    def policy(self, states, stage):
        kind = np.where(states[..., 2] < 0.0, -1.0, 1.0)
        has = kind * states[..., 3] > 0.5
        x = np.where(has, 0.0, SLOTS[1.0][0])
        y = np.where(has, 0.0, kind * SLOTS[1.0][1])
        return np.stack([x, y], axis=-1) - states[..., :2]

    def execute(self, actions):
        return np.clip(actions, -0.1, 0.1)

    def in_head(self, states):
        near = states[..., 0] ** 2 + states[..., 1] ** 2 < 0.1**2
        return near & (np.abs(states[..., 3]) > 0.5)

    def is_goal(self, states):
        return self.in_head(states) & (states[..., 2] * states[..., 3] > 0.0)

    def is_failure(self, states):
        return self.in_head(states) & (states[..., 2] * states[..., 3] < 0.0)

    def reward(self, states, actions):
        return np.where(self.is_failure(states), -self.fine, -1.0) + 0.0 * actions[..., 0]
