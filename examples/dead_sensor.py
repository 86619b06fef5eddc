"""A sensor that dies: its reading sticks, and the robot is told which one it is.

The robot drives along a warehouse to its bay. It reads a receiver for x, one for y, or a coarse
camera for both. After some steps the receiver for x shows one number for ever. That is far from
what any particle expects, while the other sensors are explained, so the line ``sensor_suspect``
names it; a robot that only counted surprises would call itself lost. Leave the sensor out then, and
the camera takes over::

    holdfast run examples/dead_sensor.yaml
    holdfast run examples/dead_sensor.yaml --set model.left_out=0
"""

import numpy as np

import holdfast as hf


class Warehouse(hf.ProblemBase):
    """A robot in a warehouse; its state is its place (x, y) in metres."""

    name = "dead_sensor"
    state_size = action_size = 2
    sensing_actions = ("receiver x", "receiver y", "camera")
    state_labels = ("x (m)", "y (m)")
    resolution = 0.05  # the standard deviation of the motion noise
    motion_variance = np.array([0.0025, 0.0025])

    def __init__(self, start=(0.0, 0.0), bay=(5.0, 8.0), left_out=None):
        self.start, self.bay, self.left_out = np.array(start), np.array(bay), left_out

    def initial_states(self, stream, count):
        return self.start + 0.3 * stream.normal((count, 2))

    def move(self, states, actions, stream):
        return states + actions + 0.05 * stream.normal(states.shape)

    def observation_mean(self, states, sensing_action):
        return states if sensing_action == 2 else states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states, sensing_action):
        if sensing_action == self.left_out:
            return np.array([1e12])  # what it shows says nothing
        return np.array([0.09, 0.09]) if sensing_action == 2 else np.array([0.0025])

    def policy(self, states, stage):
        return self.bay - states

    def limit_action(self, actions):
        return np.clip(actions, -0.1, 0.1)

    def is_goal(self, states):
        return (np.abs(states - self.bay) < 0.3).all(axis=-1)

    def scene(self):
        return hf.Scene((0, 1), (-1.0, -1.0, 7.0, 9.0), goal=self.bay)


class Stuck(hf.SimulatedEnvironment):
    """The simulated warehouse, in which a sensor sticks at what it showed at some step."""

    def __init__(self, problem, seed, trial, sensing_action=0, from_step=30):
        super().__init__(problem, seed, trial)
        self.sensing_action, self.from_step, self.shown = sensing_action, from_step, None

    def perform_sensing(self, sensing_action):
        observation = super().perform_sensing(sensing_action)
        if sensing_action != self.sensing_action:
            return observation
        if self.shown is None or self.step < self.from_step:
            self.shown = observation
        return self.shown
