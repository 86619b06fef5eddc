"""A valve of unknown gain and leak fills a vessel to a pressure; each reading has a price.

States (p, g, l): pressure, gain of the valve, leak. Gain and leak are hidden and stay. Cheap
gauge 0.4 bar for 0.3; good gauge 0.08 bar for 2; flow bench 0.1 of the gain for 4. A step costs
1, and gas that is spilled over the setpoint more; above 6.5 bar the vessel's disc bursts.
"""

import numpy as np

import holdfast as hf


class Valve(hf.ProblemBase):
    name = "valve"
    state_size, action_size = 3, 1
    sensing_actions = ("cheap gauge", "good gauge", "flow bench")
    state_labels = ("pressure (bar)", "gain (bar)", "leak (bar)")
    sensing_costs = (0.3, 2.0, 4.0)
    resolution = 0.05
    motion_variance = np.array([0.0009])
    static_parameters = (1, 2)

    def __init__(self, setpoint=5.0, burst=6.5, fine=100.0):
        self.setpoint, self.burst, self.fine = setpoint, burst, fine

    def initial_states(self, stream, count):
        p = np.maximum(1.0 + 0.3 * stream.normal((count, 1)), 0.0)
        gain = stream.uniform(0.4, 1.8, (count, 1))
        return np.concatenate([p, gain, stream.uniform(0.0, 0.12, (count, 1))], axis=1)

    def move(self, states, actions, stream):
        moved = states.copy()
        opened = actions[..., 0] + 0.03 * stream.normal(states.shape[:-1])
        pressure = states[..., 0] + states[..., 1] * opened - states[..., 2]
        moved[..., 0] = np.maximum(pressure, 0.0)
        return moved

    def expected_move(self, states, actions):
        moved = states.copy()
        pressure = states[..., 0] + states[..., 1] * actions[..., 0] - states[..., 2]
        moved[..., 0] = np.maximum(pressure, 0.0)
        return moved

    def observation_mean(self, states, sensing_action):
        i = (0, 0, 1)[sensing_action]
        return states[..., i : i + 1]

    def observation_variance(self, states, sensing_action):
        return np.array([(0.16, 0.0064, 0.01)[sensing_action]])

    def policy(self, states, stage):
        p, gain, leak = np.moveaxis(states, -1, 0)
        opening = (0.5 * (self.setpoint - p) + leak) / np.maximum(gain, 0.2)
        return opening[..., np.newaxis]

    def execute(self, actions):
        return np.clip(actions, -0.8, 0.8)

    def is_goal(self, states):
        return np.abs(states[..., 0] - self.setpoint) < 0.06

    def is_failure(self, states):
        return states[..., 0] > self.burst

    def reward(self, states, actions):
        spilled = np.maximum(states[..., 0] - self.setpoint, 0.0)
        return -1.0 - 3.0 * spilled - np.where(self.is_failure(states), self.fine, 0.0)
