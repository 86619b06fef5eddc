"""Three problems on which looking one step ahead fails: each has two ends, one of them right.

Which end is right depends on something that no single look tells when it is asked for, so the
default is worse here than random sensing. docs/results.md has the numbers. Run one with::

    holdfast run examples/two_ends.yaml --problem two_ends:Sorting

Coming to the wrong end is a failure. Bits are -1 or 1, each with probability 1/2, and stay.
"""

import numpy as np

import holdfast as hf
from holdfast import numerics


class TwoEnds(hf.ProblemBase):
    """What they share: the first two coordinates move, the others are bits.

    ``shows`` has for each sensing action its coordinate and, of a place, the standard deviation; of
    a bit, the probability that it is shown rightly.
    """

    action_size = 2
    resolution = 0.05
    motion_variance = np.array([0.0004, 0.0004])

    def initial_states(self, stream, count):
        drawn = stream.normal((count, self.state_size))
        bits = np.where(drawn[:, 2:] < 0.0, -1.0, 1.0)
        return np.concatenate([drawn[:, :2] * self.start, bits], axis=1)

    def move(self, states, actions, stream):
        moved = states.copy()
        moved[..., :2] += actions + 0.02 * stream.normal((*states.shape[:-1], 2))
        return moved

    def limit_action(self, actions):
        return np.clip(actions, -0.1, 0.1)

    def rightly(self, states, sensing_action):
        return self.shows[sensing_action][1] + 0.0 * states[..., 0]

    def log_likelihood(self, states, sensing_action, observation):
        return self.log_likelihoods(states, sensing_action, observation[np.newaxis])[0]

    def log_likelihoods(self, states, sensing_action, observations):
        coordinate, spread = self.shows[sensing_action]
        if coordinate < 2:
            deviations = (observations - states[:, coordinate]) / spread
            return -0.5 * deviations * deviations
        right = self.rightly(states, sensing_action)
        agrees = observations * states[:, coordinate] > 0.0
        return np.where(agrees, numerics.log(right), numerics.log(1.0 - right))

    def sample_observation(self, state, sensing_action, stream):
        coordinate, spread = self.shows[sensing_action]
        if coordinate < 2:
            return state[coordinate] + spread * stream.normal((1,))
        shown = stream.uniform((1,)) < self.rightly(state, sensing_action)
        return np.where(shown, state[coordinate], -state[coordinate])

    def is_goal(self, states):
        return self.at_an_end(states) & (states[..., 1] * self.sign(states) > 0.0)

    def is_failure(self, states):
        return self.at_an_end(states) & ~self.is_goal(states)


class Corridor(TwoEnds):
    """Along x to the length, and there up or down by one."""

    start = (0.1, 0.1)

    def policy(self, states, stage):
        x, y = states[..., 0], states[..., 1]
        aside = np.where(x < self.length - 0.1, -y, self.sign(states) - y)
        return np.stack([self.length - x, aside], axis=-1)

    def at_an_end(self, states):
        there = np.abs(states[..., 0] - self.length) < 0.3
        return there & (np.abs(np.abs(states[..., 1]) - 1.0) < 0.15)


class TwoCues(Corridor):
    """The product of two bits decides: one of them alone says nothing."""

    name = "two_cues"
    state_size = 4
    sensing_actions = ("x", "cue a", "cue b")
    state_labels = ("x (m)", "y (m)", "a", "b")
    start = (0.3, 0.03)
    length = 3.0
    shows = ((0, 0.1), (2, 0.9), (3, 0.9))

    def sign(self, states):
        return states[..., 2] * states[..., 3]


class TMaze(Corridor):
    """The cue can be seen at the start alone, and decides at the other end (Bakker, 2001)."""

    name = "t_maze"
    state_size = 3
    sensing_actions = ("x", "y", "cue")
    state_labels = ("x (m)", "y (m)", "cue")
    length = 4.0
    shows = ((0, 0.05), (1, 0.05), (2, 0.9))

    def sign(self, states):
        return states[..., 2]

    def rightly(self, states, sensing_action):
        return np.where(np.abs(states[..., 0]) < 0.5, 0.9, 0.5)


class Sorting(TwoEnds):
    """To the bin of its colour, which a weak sensor shows beside a sharp one of the angle."""

    name = "sorting"
    state_size = 3
    sensing_actions = ("angle", "colour")
    state_labels = ("angle (rad)", "position (m)", "colour")
    resolution = 0.02
    start = (0.8, 0.02)
    shows = ((0, 0.02), (2, 0.75))

    def sign(self, states):
        return states[..., 2]

    def policy(self, states, stage):
        return np.stack([-states[..., 0], 2.0 * self.sign(states) - states[..., 1]], axis=-1)

    def at_an_end(self, states):
        there = np.abs(np.abs(states[..., 1]) - 2.0) < 0.15
        return there & (np.abs(states[..., 0]) < 0.5)
