"""A robot that is lost: somebody carries it away while it works.

The robot crosses a yard to its dock, and reads one coordinate of its place at a time. Somebody
carries it to another corner on the way. Its belief does not know that, so what it sees then is far
from what any particle expects; some observations later the line ``lost`` tells it. What the robot
does next is ``lost.on_lost``: with ``reinitialise`` its belief begins anew, here anywhere in the
yard (``reinitial_states``), and it finds its dock; with ``continue`` it drives on and creeps after
what it sees. Try both::

    holdfast run examples/kidnapped_robot.yaml
    holdfast run examples/kidnapped_robot.yaml --set lost.on_lost=continue
"""

import numpy as np

import holdfast as hf


class Yard(hf.ProblemBase):
    """A robot in a yard of 10 m by 10 m; its state is its place (x, y) in metres."""

    name = "kidnapped_robot"
    state_size = action_size = 2
    sensing_actions = ("receiver x", "receiver y")
    state_labels = ("x (m)", "y (m)")
    resolution = 0.03  # the standard deviation of the motion noise
    motion_variance = np.array([0.0009, 0.0009])

    def __init__(self, start=(1.0, 1.0), dock=(9.0, 2.0), side=10.0):
        self.start, self.dock, self.side = np.array(start), np.array(dock), side

    def initial_states(self, stream, count):
        return self.start + 0.2 * stream.normal((count, 2))

    def reinitial_states(self, states, stream):
        """Spread the belief over the whole yard: nothing else is known of a lost robot."""
        return self.side * stream.uniform(states.shape)

    def move(self, states, actions, stream):
        return states + actions + 0.03 * stream.normal(states.shape)

    def observation_mean(self, states, sensing_action):
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states, sensing_action):
        return np.array([0.01])

    def policy(self, states, stage):
        return self.dock - states

    def limit_action(self, actions):
        return np.clip(actions, -0.15, 0.15)

    def is_goal(self, states):
        return (np.abs(states - self.dock) < 0.3).all(axis=-1)

    def scene(self):
        return hf.Scene((0, 1), (0.0, 0.0, self.side, self.side), goal=self.dock)


class Carried(hf.SimulatedEnvironment):
    """The simulated yard, in which somebody carries the robot to a place at some step."""

    def __init__(self, problem, seed, trial, at_step=20, to=(2.0, 8.0)):
        super().__init__(problem, seed, trial)
        self.at_step, self.place = at_step, np.array(to)

    def perform(self, task_action):
        shown = super().perform(task_action)
        if self.step == self.at_step:
            self.state = self.place.copy()
        return shown
