"""A turntable brings a keyed part to the press, whose ram must meet the key the right way round.

States (angle, ram): the angle of the part, which wraps, and the height of the ram over it. A vision
edge finder gives the angle sharply, but not which of two ways round. A mark on the part shows that,
while it passes the camera at angle 0. The ram's height is measured by a third sensor. Pressing
the part when it is more than 0.3 rad off is a failure.
"""

import numpy as np

import holdfast as hf
from holdfast import numerics

TARGET = 2.9


class Turntable(hf.ProblemBase):
    name = "turntable"
    state_size, action_size = 2, 2
    sensing_actions = ("edges", "mark", "ram height")
    state_labels = ("angle (rad)", "ram (m)")
    resolution = np.array([0.05, 0.02])
    motion_variance = np.array([0.0016, 0.0001])
    circular = (0,)
    circular_actions = (0,)

    def initial_states(self, stream, count):
        angle = stream.uniform(-np.pi, np.pi, (count, 1))
        return np.concatenate([angle, 0.5 + 0.05 * stream.normal((count, 1))], axis=1)

    def move(self, states, actions, stream):
        noise = stream.normal((*states.shape[:-1], 2)) * np.array([0.04, 0.01])
        moved = states + actions + noise
        moved[..., 0] = numerics.wrapped(moved[..., 0])
        return moved

    def shows(self, states):
        off = numerics.wrapped(states[..., 0]) / 0.7
        return 0.04 + 0.9 * numerics.exp(-0.5 * off * off)

    def log_likelihood(self, states, sensing_action, observation):
        if sensing_action == 0:
            dx = observation[0] - numerics.cos(2.0 * states[..., 0])
            dy = observation[1] - numerics.sin(2.0 * states[..., 0])
            return -0.5 * (dx * dx + dy * dy) / 0.08**2
        if sensing_action == 1:
            p = self.shows(states)
            return numerics.log(np.where(observation[0] > 0.5, p, 1.0 - p))
        off = (observation[0] - states[..., 1]) / 0.02
        return -0.5 * off * off

    def sample_observation(self, state, sensing_action, stream):
        if sensing_action == 0:
            way = np.stack([numerics.cos(2.0 * state[0]), numerics.sin(2.0 * state[0])])
            return way + 0.08 * stream.normal((2,))
        if sensing_action == 1:
            return np.where(stream.random((1,)) < self.shows(state), 1.0, 0.0)
        return state[1:] + 0.02 * stream.normal((1,))

    def policy(self, states, stage):
        turn = numerics.wrapped(TARGET - states[..., 0])
        down = np.where(np.abs(turn) < 0.25, -states[..., 1], 0.5 - states[..., 1])
        return np.stack([turn, down], axis=-1)

    def execute(self, actions):
        return np.clip(actions, [-0.2, -0.05], [0.2, 0.05])

    def is_goal(self, states):
        off = np.abs(numerics.wrapped(states[..., 0] - TARGET))
        return (states[..., 1] < 0.03) & (off <= 0.3)

    def is_failure(self, states):
        off = np.abs(numerics.wrapped(states[..., 0] - TARGET))
        return (states[..., 1] < 0.03) & (off > 0.3)
