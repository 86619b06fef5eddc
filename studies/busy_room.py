"""A peg, a hole, and things that move about the room and do not matter.

The robot does not know where these things are any more than where its peg is, and it can look at
each of them. Whoever asks how uncertain the *state* is looks at them, too; whoever asks how
uncertain the next *action* is does not. So this is the problem in which the two should differ most,
and it is here for that reason.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.problem import ProblemBase, Scene

_THINGS = 3
_PLACE_DEVIATION = 2.0
_STEP_DEVIATION = 0.1
_PEG = 3  # coordinates

# Substreams of those that the peg's own noise comes from.
_PLACES = 101
_STEPS = 102


class BusyRoom(ProblemBase):
    """The states are (x, y, θ) of the peg and a coordinate of each of three things that wander.

    A step's noise is 0.1 in every coordinate, of the peg and of the things, so one resolution is
    right for actions and for states.
    """

    name = "busy_room"
    state_size = _PEG + _THINGS
    action_size = _PEG
    sensing_actions = ("x", "y", "θ", *(f"thing {number + 1}" for number in range(_THINGS)))
    state_labels = (
        "x (m)",
        "y (m)",
        "θ (rad)",
        *(f"thing {number + 1} (m)" for number in range(_THINGS)),
    )

    def __init__(self) -> None:
        self._peg = PegInHole2D()
        self.resolution = self._peg.resolution
        self.motion_variance = self._peg.motion_variance

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        """Draw the peg as in its own problem, the things around zero."""
        places = _PLACE_DEVIATION * stream.substream(_PLACES).normal((count, _THINGS))
        return np.concatenate([self._peg.initial_states(stream, count), places], axis=1)

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        """Move the peg as in its own problem; the things wander."""
        peg = self._peg.move(np.ascontiguousarray(states[..., :_PEG]), actions, stream)
        noise = stream.substream(_STEPS).normal((*states.shape[:-1], _THINGS))
        return np.concatenate([peg, states[..., _PEG:] + _STEP_DEVIATION * noise], axis=-1)

    def expected_path(
        self, states: FloatArray, stage: int, offsets: Sequence[int], threads: int
    ) -> tuple[FloatArray, IntArray]:
        """Follow the peg; without noise the things stay where they are."""
        own = np.ascontiguousarray(states[:, :_PEG])
        peg, stages = self._peg.expected_path(own, stage, offsets, threads)
        things = np.broadcast_to(states[:, _PEG:], (*stages.shape, _THINGS))
        return np.concatenate([peg, things], axis=-1), stages

    def move_each(
        self, states: FloatArray, actions: FloatArray, streams: Sequence[Stream], threads: int
    ) -> FloatArray:
        """Move several beliefs as :meth:`move` does one after the other."""
        pegs = np.ascontiguousarray(states[..., :_PEG])
        shape = (*states.shape[1:-1], _THINGS)
        noise = np.stack([stream.substream(_STEPS).normal(shape) for stream in streams])
        return np.concatenate(
            [
                self._peg.move_each(pegs, actions, streams, threads),
                states[..., _PEG:] + _STEP_DEVIATION * noise,
            ],
            axis=-1,
        )

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the coordinate that is looked at."""
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the peg's own, for everything."""
        del sensing_action
        return self._peg.observation_variance(states, 0)

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        """Do what the peg alone asks for."""
        return self._peg.policy(states[..., :_PEG], stage)

    def limit_action(self, actions: FloatArray) -> FloatArray:
        """Limit each component on its own."""
        return self._peg.limit_action(actions)

    def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Return minus the length of the way."""
        return self._peg.reward(states[..., :_PEG], actions)

    def is_goal(self, states: FloatArray) -> BoolArray:
        """Tell where the peg is half-way in the hole."""
        return self._peg.is_goal(states[..., :_PEG])

    def scene(self) -> Scene:
        """Return the peg's."""
        return self._peg.scene()
