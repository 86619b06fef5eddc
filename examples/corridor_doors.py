"""A problem with yes-or-no observations: a robot in a corridor that can tell a door from a wall.

The robot knows the map, but its own place only within six metres. It looks to the left or to the
right, and its detector says door (1) or wall (0); one look in ten is wrong. No Gaussian has two
values, so the problem gives a likelihood of its own, ``log_likelihood``, and says how to draw an
observation, ``sample_observation``; ``observation_mean`` and ``observation_variance`` are not
needed then. Run it with::

    holdfast run examples/corridor_doors.yaml

If it may be anywhere at first, its belief has several modes: see corridor_anywhere.yaml.
"""

import numpy as np

import holdfast as hf
from holdfast import numerics


class CorridorDoors(hf.ProblemBase):
    """A robot that is to stop at a place in a corridor; its state is its place x in metres."""

    name = "corridor_doors"
    state_size = action_size = 1
    sensing_actions = ("look left", "look right")
    state_labels = ("x (m)",)
    resolution = 0.05  # the standard deviation of the motion noise
    motion_variance = np.array([0.0025])

    def __init__(
        self,
        length=20.0,
        left_doors=(2.0, 5.0, 12.5, 17.0),
        right_doors=(4.0, 8.5, 14.5),
        door_width=1.0,
        wrong=0.1,
        start=(0.0, 6.0),
        goal=14.0,
    ):
        self.length, self.goal, self.half_width = length, goal, door_width / 2.0
        self.start = start
        self.doors = [np.array(left_doors), np.array(right_doors)]
        self.wrong = wrong
        self.log_wrong, self.log_right = numerics.log(np.array([wrong, 1.0 - wrong]))

    def at_door(self, states, sensing_action):
        """Tell at which states a door is on the side that is looked at."""
        distances = np.abs(states - self.doors[sensing_action])
        return (distances < self.half_width).any(axis=-1)

    def initial_states(self, stream, count):
        first, last = self.start
        return first + (last - first) * stream.uniform((count, 1))

    def move(self, states, actions, stream):
        return np.clip(states + actions + 0.05 * stream.normal(states.shape), 0.0, self.length)

    def log_likelihood(self, states, sensing_action, observation):
        said_door = observation[0] > 0.5
        return np.where(
            self.at_door(states, sensing_action) == said_door, self.log_right, self.log_wrong
        )

    def sample_observation(self, state, sensing_action, stream):
        mistaken = stream.uniform((1,)) < self.wrong
        return (self.at_door(state, sensing_action) != mistaken).astype(np.float64)

    def policy(self, states, stage):
        return self.goal - states

    def limit_action(self, actions):
        return np.clip(actions, -0.25, 0.25)

    def is_goal(self, states):
        return np.abs(states[..., 0] - self.goal) < 0.25
