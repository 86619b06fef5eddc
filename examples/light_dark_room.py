"""A problem of your own: a room with one lamp, where a robot sees well only in the light.

The robot goes to the lamp to find out where it is, then to the door. Looking along x shows x,
looking along y shows y; both are the noisier, the further the lamp. Run it with::

    holdfast run examples/light_dark_room.yaml
"""

import numpy as np

import holdfast as hf


class LightDarkRoom(hf.ProblemBase):
    """A point robot in a room; states are (x, y) in metres."""

    name = "light_dark_room"
    state_size = action_size = 2
    sensing_actions = ("look along x", "look along y")
    state_labels = ("x (m)", "y (m)")
    num_stages = 2  # first to the lamp, then to the door
    resolution = 0.03  # the standard deviation of the motion noise
    motion_variance = np.array([0.0009, 0.0009])

    def __init__(self, lamp=(4.0, 3.0), door=(0.0, 0.0), start=(2.0, 1.0), start_variance=1.0):
        self.places = np.array([lamp, door])
        self.start, self.start_variance = np.array(start), start_variance

    def initial_states(self, stream, count):
        return self.start + np.sqrt(self.start_variance) * stream.normal((count, 2))

    def move(self, states, actions, stream):
        return states + actions + 0.03 * stream.normal(states.shape)

    def observation_mean(self, states, sensing_action):
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states, sensing_action):
        x, y = states[..., 0] - self.places[0, 0], states[..., 1] - self.places[0, 1]
        return (0.0001 + 0.02 * (x * x + y * y))[..., np.newaxis]

    def policy(self, states, stage):
        return self.places[stage] - states

    def next_stage(self, estimates, stage):
        x, y = estimates[..., 0] - self.places[0, 0], estimates[..., 1] - self.places[0, 1]
        return np.where(x * x + y * y < 0.1, 1, stage)

    def limit_action(self, actions):
        return np.clip(actions, -0.1, 0.1)

    def is_goal(self, states):
        return (np.abs(states - self.places[1]) < 0.1).all(axis=-1)

    def scene(self):
        return hf.Scene((0, 1), (-1.0, -1.0, 5.0, 4.0), goal=self.places[1], points=self.places[:1])
