"""An actuator with backlash: after each reversal the drive turns, and the carriage stands still.

A carriage goes to a lamp, by which it sees where it is, and back into the dark to its mark. At the
reversal its drive takes up 0.4 m of play, so commands are performed that move nothing, and a belief
that is moved by commands is off by that. An encoder on the carriage shows it: ``perform`` returns
the measured motion, and ``move_by_measurement`` moves the belief by it. In ``steps.csv`` of
``holdfast export RUN --csv DIR --problem-directory examples`` the lines after the reversal
(``stage`` 1) have an ``action_0`` of -0.1 and a ``motion`` of about 0::

    holdfast run examples/backlash.yaml
    holdfast run examples/backlash.yaml --set environment.arguments.encoder=false
"""

import numpy as np

import holdfast as hf


class Carriage(hf.ProblemBase):
    """A carriage on a rail; its state is its place in metres."""

    name = "backlash"
    state_size = action_size = 1
    sensing_actions = ("camera",)
    state_labels = ("x (m)",)
    num_stages = 2  # first to the lamp, then to the mark
    resolution = 0.01  # the standard deviation of the motion noise
    motion_variance = np.array([0.0001])

    def __init__(self, lamp=4.0, mark=0.0, start=1.5):
        self.places, self.start = np.array([lamp, mark]), start

    def initial_states(self, stream, count):
        return self.start + 0.3 * stream.normal((count, 1))

    def move(self, states, actions, stream):
        return states + actions + 0.01 * stream.normal(states.shape)

    def move_by_measurement(self, states, motion, stream):
        """Move by what the encoder has counted, with its own noise."""
        return states + motion + 0.005 * stream.normal(states.shape)

    def measure_motion(self, before, after, stream):
        return after - before + 0.005 * stream.normal(before.shape)

    def observation_mean(self, states, sensing_action):
        return states

    def observation_variance(self, states, sensing_action):
        far = states - self.places[0]
        return 0.0004 + 0.5 * far * far

    def policy(self, states, stage):
        return self.places[stage, np.newaxis] - states

    def next_stage(self, estimates, stage):
        return np.where(np.abs(estimates[..., 0] - self.places[0]) < 0.05, 1, stage)

    def limit_action(self, actions):
        return np.clip(actions, -0.1, 0.1)

    def is_goal(self, states):
        return np.abs(states[..., 0] - self.places[1]) < 0.1


class Play(hf.SimulatedEnvironment):
    """A simulated carriage whose drive has play, with or without an encoder on the carriage."""

    def __init__(self, problem, seed, trial, play=0.4, encoder=True):
        super().__init__(problem, seed, trial)
        self.play, self.encoder = play, encoder
        self.slack = 0.0  # of the play, what lies before the drive as it turns forwards

    def perform(self, task_action):
        turned = float(task_action[0])
        drives = min(turned + self.slack, 0.0) + max(turned + self.slack - self.play, 0.0)
        self.slack += turned - drives
        shown = super().perform(np.array([drives]))
        return shown if self.encoder else None
