"""A rover looks for a lost tag in a field: a detector of short range, a poor bearing, and GPS.

States (x, y, tx, ty): the rover and the tag, which stays where it is. Detector: yes or no, right
nine times in ten within 0.8 m, and three false alarms in a hundred. Microphone: a bearing with
0.5 rad of noise that is blind beyond 5 m (then any bearing). GPS: both coordinates to 0.15 m.
"""

import numpy as np

import holdfast as hf
from holdfast import numerics


class Search(hf.ProblemBase):
    name = "search"
    state_size, action_size = 4, 2
    sensing_actions = ("detector", "microphone", "gps")
    state_labels = ("x (m)", "y (m)", "tag x (m)", "tag y (m)")
    resolution = 0.1
    motion_variance = np.array([0.0016, 0.0016])
    static_parameters = (2, 3)

    def initial_states(self, stream, count):
        robot = 0.2 * stream.normal((count, 2))
        tag = stream.uniform(-3.0, 3.0, (count, 2))
        return np.concatenate([robot, tag], axis=1)

    def move(self, states, actions, stream):
        moved = states.copy()
        moved[..., :2] += actions + 0.04 * stream.normal((*states.shape[:-1], 2))
        return moved

    def way(self, states):
        return states[..., 2:] - states[..., :2]

    def detects(self, states):
        x, y = np.moveaxis(self.way(states), -1, 0)
        return np.where(x * x + y * y < 0.8**2, 0.9, 0.03)

    def log_likelihood(self, states, sensing_action, observation):
        if sensing_action == 0:
            p = self.detects(states)
            return numerics.log(np.where(observation[0] > 0.5, p, 1.0 - p))
        if sensing_action == 1:
            x, y = np.moveaxis(self.way(states), -1, 0)
            off = numerics.wrapped(observation[0] - numerics.arctan2(y, x)) / 0.5
            heard = numerics.exp(-0.5 * off * off) / (0.5 * np.sqrt(2.0 * np.pi))
            uniform = 1.0 / (2.0 * np.pi)
            return numerics.log(
                np.where(x * x + y * y < 25.0, 0.9 * heard + 0.1 * uniform, uniform)
            )
        off = (observation - states[..., :2]) / 0.15
        return -0.5 * (off * off).sum(axis=-1)

    def sample_observation(self, state, sensing_action, stream):
        if sensing_action == 0:
            return np.where(stream.random((1,)) < self.detects(state), 1.0, 0.0)
        if sensing_action == 1:
            x, y = self.way(state)
            anywhere = stream.uniform(-np.pi, np.pi, (1,))
            heard = numerics.arctan2(y, x) + 0.5 * stream.normal((1,))
            deaf = (stream.random((1,)) < 0.1) | (x * x + y * y >= 25.0)
            return numerics.wrapped(np.where(deaf, anywhere, heard))
        return state[:2] + 0.15 * stream.normal((2,))

    def policy(self, states, stage):
        return self.way(states)

    def execute(self, actions):
        return np.clip(actions, -0.15, 0.15)

    def is_goal(self, states):
        return (self.way(states) ** 2).sum(axis=-1) < 0.25**2
