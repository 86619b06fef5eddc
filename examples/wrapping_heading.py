"""A problem with angles: a robot that drives west, where its heading is pi as much as -pi.

The robot turns towards its goal and drives; its tracks slip, so each step leaves some doubt about
where it looks. It has a compass and a receiver for its position, of which it can read one
coordinate at a time. Its states keep headings between -pi and pi, so half of the particles of a
robot that looks west say 3.1 and half of them -3.1: they mean the same, but their mean as numbers
is 0, which is east. So the class says which coordinates are angles: ``circular`` of a state,
``circular_observations`` of what each sensing action shows. Run it with::

    holdfast run examples/wrapping_heading.yaml
"""

import numpy as np

import holdfast as hf
from holdfast import numerics


class WrappingHeading(hf.ProblemBase):
    """A robot that turns and drives; states are (x, y, heading) in metres and radians."""

    name = "wrapping_heading"
    state_size = 3
    action_size = 2  # a turn in radians, then a way ahead in metres
    sensing_actions = ("heading", "x", "y")
    state_labels = ("x (m)", "y (m)", "heading (rad)")
    resolution = state_resolution = 0.1
    motion_variance = np.array([0.01, 0.0004])
    pose = ("x", "y", "yaw")
    circular = (2,)
    circular_observations = ((0,), (), ())  # the compass alone shows an angle

    def __init__(self, start=(6.0, 0.0, 3.1), goal=(0.0, 0.0)):
        self.start, self.goal = np.array(start), np.array(goal)

    def initial_states(self, stream, count):
        states = self.start + np.array([0.5, 0.5, 0.4]) * stream.normal((count, 3))
        states[:, 2] = numerics.wrapped(states[:, 2])
        return states

    def move(self, states, actions, stream):
        noise = np.array([0.1, 0.02]) * stream.normal((*states.shape[:-1], 2))
        turn, ahead = np.moveaxis(actions + noise, -1, 0)
        heading = states[..., 2] + turn
        x = states[..., 0] + ahead * numerics.cos(heading)
        y = states[..., 1] + ahead * numerics.sin(heading)
        return np.stack([x, y, numerics.wrapped(heading)], axis=-1)

    def observation_mean(self, states, sensing_action):
        coordinate = (2, 0, 1)[sensing_action]
        return states[..., coordinate : coordinate + 1]

    def observation_variance(self, states, sensing_action):
        return np.array([0.01])

    def policy(self, states, stage):
        x, y = np.moveaxis(self.goal - states[..., :2], -1, 0)
        turn = numerics.wrapped(numerics.arctan2(y, x) - states[..., 2])
        ahead = np.where(np.abs(turn) < 0.5, np.sqrt(x * x + y * y), 0.0)
        return np.stack([turn, ahead], axis=-1)

    def limit_action(self, actions):
        return np.clip(actions, [-0.3, 0.0], [0.3, 0.2])

    def is_goal(self, states):
        x, y = np.moveaxis(states[..., :2] - self.goal, -1, 0)
        return x * x + y * y < 0.25 * 0.25

    def scene(self):
        body = [(0.2, 0.0), (-0.1, 0.1), (-0.1, -0.1)]
        return hf.Scene((0, 1), (-2.0, -3.0, 8.0, 3.0), body=body, angle=2, goal=self.goal)
