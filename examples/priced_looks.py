r"""A problem of your own with a price for looking: a robot that may also drive on without it.

The robot drives to a dock in the plane. Each step costs 1, each look along an axis as much as four
steps. ``expected_return`` knows what a look saves, so it looks where that is more than the price.
In ``PricedLooks`` not to look is a sensing action of the problem, which is free and shows nothing;
in ``OptionalLooks`` it is a choice that the settings offer (``selector.sensing_is_optional``), to
any problem. Run them with::

    holdfast run examples/priced_looks.yaml
    holdfast run examples/optional_looks.yaml

Ways that minimise an entropy ask what a look must gain at least, in nats for each unit of its
price; without, they look every time::

    holdfast run examples/optional_looks.yaml --set selector.method=path_entropy \
        --set selector.actions=executed --set selector.nats_per_cost=0.1
"""

import numpy as np

import holdfast as hf


class PricedLooks(hf.ProblemBase):
    """A point robot on its way to the origin; states are (x, y) in metres."""

    name = "priced_looks"
    state_size = action_size = 2
    sensing_actions = ("look along x", "look along y", "do not look")
    state_labels = ("x (m)", "y (m)")
    resolution = 0.03  # the standard deviation of the motion noise
    motion_variance = np.array([0.0009, 0.0009])

    def __init__(self, price=4.0, start=(2.0, 1.0), start_variance=0.5):
        self.sensing_costs = (price, price, 0.0)
        self.start, self.start_variance = np.array(start), start_variance

    def initial_states(self, stream, count):
        return self.start + np.sqrt(self.start_variance) * stream.normal((count, 2))

    def move(self, states, actions, stream):
        return states + actions + 0.03 * stream.normal(states.shape)

    def observation_mean(self, states, sensing_action):
        return states[..., sensing_action % 2, np.newaxis]

    def observation_variance(self, states, sensing_action):
        return np.array([1e12 if sensing_action == 2 else 0.0025])

    def policy(self, states, stage):
        return -states

    def limit_action(self, actions):
        return np.clip(actions, -0.1, 0.1)

    def reward(self, states, actions):
        return -np.ones(np.broadcast_shapes(states.shape[:-1], actions.shape[:-1]))

    def is_goal(self, states):
        return (np.abs(states) < 0.1).all(axis=-1)

    def scene(self):
        return hf.Scene((0, 1), (-2.0, -2.0, 4.0, 4.0), goal=(0.0, 0.0))


class OptionalLooks(PricedLooks):
    """The same with the two looks alone: not to look needs no sensing action of the problem."""

    name = "optional_looks"
    sensing_actions = ("look along x", "look along y")

    def __init__(self, price=4.0, start=(2.0, 1.0), start_variance=0.5):
        super().__init__(price, start, start_variance)
        self.sensing_costs = (price, price)
