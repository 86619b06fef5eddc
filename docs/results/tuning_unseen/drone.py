"""A drone lands in gusts: noisy altimeter, flow sensor that works low, a sharp beacon of the yaw.

States (z, v, gust, yaw): height, climb rate, gust acceleration, and yaw. The yaw drifts, the
policy holds it, and no goal needs it. Touching the ground faster than 0.6 m/s is a crash.
"""

import numpy as np

import holdfast as hf

DT = 0.2


class Drone(hf.ProblemBase):
    name = "drone"
    state_size, action_size = 4, 2
    sensing_actions = ("altimeter", "optical flow", "yaw beacon")
    state_labels = ("z (m)", "v (m/s)", "gust (m/s2)", "yaw (rad)")
    resolution = np.array([0.2, 0.02])
    motion_variance = np.array([0.04, 0.0009])
    circular = (3,)
    circular_observations = ((), (), (0,))

    def initial_states(self, stream, count):
        n = stream.normal((count, 4))
        z = 6.0 + 1.0 * n[:, :1]
        return np.concatenate([np.maximum(z, 2.0), n[:, 1:] * np.array([0.3, 0.3, 0.2])], axis=1)

    def move(self, states, actions, stream):
        shape = states.shape[:-1]
        noise = stream.normal((*shape, 3))
        burst = stream.random(shape) < 0.03  # now and then a gust begins anew
        fresh = stream.normal(shape)
        z, v, gust, yaw = np.moveaxis(states, -1, 0)
        gust = np.where(burst, 1.0 * fresh, 0.95 * gust + 0.08 * noise[..., 2])
        v = v + DT * (actions[..., 0] + 0.2 * noise[..., 0] + gust)
        z = np.maximum(z + DT * v, 0.0)
        yaw = yaw + actions[..., 1] + 0.03 * noise[..., 1]
        return np.stack([z, v, gust, yaw], axis=-1)

    def observation_mean(self, states, sensing_action):
        i = (0, 1, 3)[sensing_action]
        return states[..., i : i + 1]

    def observation_variance(self, states, sensing_action):
        z = states[..., :1]
        if sensing_action == 0:
            return 0.4**2 + 0.0 * z
        if sensing_action == 1:
            return 0.1**2 + 0.04 * z * z  # blurred from high above
        return 0.01**2 + 0.0 * z

    def policy(self, states, stage):
        z, v, gust, yaw = np.moveaxis(states, -1, 0)
        wanted = -np.clip(0.35 * z, 0.25, 1.2)
        return np.stack([1.5 * (wanted - v) - gust, -yaw], axis=-1)

    def execute(self, actions):
        return np.clip(actions, [-2.0, -0.1], [2.0, 0.1])

    def expected_move(self, states, actions):
        z, v, gust, yaw = np.moveaxis(states, -1, 0)
        v = v + DT * (actions[..., 0] + 0.95 * gust)
        z = np.maximum(z + DT * v, 0.0)
        return np.stack([z, v, 0.95 * gust, yaw + actions[..., 1]], axis=-1)

    def is_goal(self, states):
        return (states[..., 0] <= 0.0) & (states[..., 1] >= -0.6)

    def is_failure(self, states):
        return (states[..., 0] <= 0.0) & (states[..., 1] < -0.6)
