"""A problem whose computing can be watched, and held, from outside the process that computes.

With the variable ``HOLDFAST_TEST_GATE`` (a port) in its environment, a process says so before each
of the problem's longer computations and goes on when it is told to. Without it, it is the peg.

With the variable ``HOLDFAST_TEST_STUCK`` (a file) it raises instead of moving while that file is
there.
"""

import os
import socket

import numpy as np
import numpy.typing as npt

from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Stream
from holdfast.problems.peg_in_hole_2d import PegInHole2D

VARIABLE = "HOLDFAST_TEST_GATE"
STUCK = "HOLDFAST_TEST_STUCK"


class GatedPeg(PegInHole2D):
    """The peg in the plane, with a gate before whatever is computed on many particles."""

    name = "gated_peg"

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        if os.path.exists(os.environ.get(STUCK, "")):  # noqa: PTH110 - called a thousand times
            raise RuntimeError("the wheels are stuck")
        return super().move(states, actions, stream)

    def policy(self, states: FloatArray, stage: int | npt.NDArray[np.int64]) -> FloatArray:
        if len(states) > 1:
            _pass("policy")
        return super().policy(states, stage)

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        _pass("observation_mean")
        return super().observation_mean(states, sensing_action)


def _pass(what: str) -> None:
    port = os.environ.get(VARIABLE)
    if port is not None:
        with socket.create_connection(("127.0.0.1", int(port))) as gate:
            gate.sendall(f"{what} {os.getpid()}\n".encode())
            gate.recv(1)
