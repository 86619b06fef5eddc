"""gymnasium's LunarLander for a robot that cannot see everything at once.

The lander comes down with a speed that nobody knows. It has an altimeter, a beacon that tells the
lateral position, and a horizon that tells the tilt; each is noisy, and only one can be read every
few steps. What comes by itself is whether a leg touches the ground. The policy is a controller of
proportions and rates: lean towards the pad, sink slower the lower. A lander that has come to rest
has succeeded; one whose body hits the ground, or that leaves the picture, has crashed, and that is
a failure. Run it with gymnasium and Box2D (``pip install 'gymnasium[box2d]'``)::

    holdfast run examples/lunar_lander.yaml
"""

import numpy as np

import holdfast as hf
from holdfast import numerics

GRAVITY = 0.0265
MAIN_ENGINE = np.array([0.069, 0.046])
SIDE_ENGINE = np.array([0.010, 0.0385])
"""Changes of speed in one step at full power, in gymnasium's units: of vx and vy by the main engine
along the lander's axis; of vx across it, and of the angular speed, by those at the side."""

JITTER = (0.144, 0.289)
"""Standard deviation of the main engine's thrust, across and along, as a part of it."""

CLOCK = np.array([0.01, 0.0225, 0.05])
"""By how much x, y and the tilt change in one step, for a speed of 1."""

GROUND = 0.03
"""Height below which a leg touches."""


class LunarLander(hf.ProblemBase):
    """A lander on its way to a pad at the origin, upright.

    States are (x, y, vx, vy, tilt, angular speed), and task actions the main engine, which fires
    above 0, and those at the side, which fire below -0.5 and above 0.5; all as gymnasium's.
    """

    name = "lunar_lander"
    state_size, action_size = 6, 2
    sensing_actions = ("lateral position", "height", "tilt")
    state_labels = ("x", "y", "vx", "vy", "tilt (rad)", "angular speed")
    resolution = 0.1
    motion_variance = np.array([1e-4, 1e-4])

    def __init__(self, sensing_noise=(0.1, 0.1, 0.1)):
        self.variances = [np.array([deviation * deviation]) for deviation in sensing_noise]

    def initial_states(self, stream, count):
        # gymnasium pushes the lander by a force that is uniform; the legs make it turn.
        middle = np.array([0.0, 1.41, 0.0, -0.017, 0.0, 0.0])
        reach = np.array([0.0, 0.0, 0.85, 0.57, 0.0, 0.0])
        states = middle + reach * (2.0 * stream.uniform((count, 6)) - 1.0)
        states[:, 0] += 0.01 * states[:, 2]
        states[:, 1] += 0.0225 * states[:, 3]
        states[:, 5] = -0.226 * states[:, 2]
        return states

    def move(self, states, actions, stream):
        x, y, vx, vy, tilt, turning = np.moveaxis(states, -1, 0)
        across, along, drift = np.moveaxis(stream.normal((*states.shape[:-1], 3)), -1, 0)
        main, side = actions[..., 0], actions[..., 1]
        thrust = np.where(main > 0.0, 0.5 + 0.5 * main, 0.0)
        push = np.where(np.abs(side) > 0.5, side, 0.0)
        sine, cosine = numerics.sin(tilt), numerics.cos(tilt)
        along = thrust * (1.0 + JITTER[1] * along)
        across = thrust * JITTER[0] * across
        vx = vx - MAIN_ENGINE[0] * (along * sine + across * cosine) + SIDE_ENGINE[0] * push * cosine
        vy = vy + MAIN_ENGINE[1] * (along * cosine - across * sine) - GRAVITY
        vy = vy + 0.6 * SIDE_ENGINE[0] * push * sine
        turning = turning - SIDE_ENGINE[1] * push + 0.008 * drift
        x, y, tilt = x + CLOCK[0] * vx, y + CLOCK[1] * vy, tilt + CLOCK[2] * turning
        # On the ground it lies still.
        air = np.where(y > 0.0, 1.0, 0.0)
        return np.stack([x, y * air, vx * air, vy * air, tilt, turning * air], axis=-1)

    def observation_mean(self, states, sensing_action):
        index = (0, 1, 4)[sensing_action]
        return states[..., index : index + 1]

    def observation_variance(self, states, sensing_action):
        return self.variances[sensing_action]

    def move_log_likelihood(self, states, action, observation):
        expected = states[:, 1] < GROUND
        touches = observation.max() > 0.5
        return np.where(expected == touches, LOG_RIGHT, LOG_WRONG)

    def sample_move_observation(self, state, action, stream):
        touches = (state[1] < GROUND) != (stream.uniform() < 0.02)
        return np.full(2, float(touches))

    def policy(self, states, stage):
        x, y, vx, vy, tilt, turning = np.moveaxis(states, -1, 0)
        lean = np.clip(0.5 * x + vx, -0.4, 0.4)
        turn = 0.5 * (lean - tilt) - turning
        climb = 0.5 * (0.55 * np.abs(x) - y) - 0.5 * vy
        down = y < GROUND
        turn, climb = np.where(down, 0.0, turn), np.where(down, -0.5 * vy, climb)
        return np.stack([20.0 * climb - 1.0, -20.0 * turn], axis=-1)

    def limit_action(self, actions):
        return np.clip(actions, -1.0, 1.0)

    def is_goal(self, states):
        return (states[..., 1] < GROUND) & (np.abs(states[..., 0]) < 0.2)

    def scene(self):
        return hf.Scene((0, 1), (-1.0, -0.2, 1.0, 1.6), goal=(0.0, 0.0))


LOG_WRONG, LOG_RIGHT = numerics.log(np.array([0.02, 0.98]))
"""What a leg says of the height is right so often: the ground beside the pad is not flat."""


def landed(environment, observation, _info):
    """Tell success from a crash; gymnasium says ``terminated`` of both."""
    lander = environment.unwrapped
    if not lander.lander.awake:
        return True
    if abs(observation[0]) >= 1.0:
        return hf.Ending("failed", "left the picture")
    if lander.game_over:
        down, across = -float(observation[3]), float(observation[2])
        return hf.Ending("failed", f"crashed at vx {across:.2f}, vy {-down:.2f}")
    return False
