"""The peg, but a process with ``HOLDFAST_TEST_LIE`` in its environment decides otherwise.

The code is the same everywhere, as with a faulty machine, or an operator who means harm: nothing
but the decisions tells such a service from an honest one.

- ``far``: task actions beyond what a peg can be moved at once;
- ``half``: task actions half as long;
- ``sensing``: other sensing actions, and the right task actions.

With ``HOLDFAST_TEST_OWN_PLANNER_HANGS`` a robot's own planner never comes to a decision.
"""

import os
import threading
import time

import numpy as np
import numpy.typing as npt

from holdfast.numerics.arrays import FloatArray
from holdfast.problems.peg_in_hole_2d import PegInHole2D

VARIABLE = "HOLDFAST_TEST_LIE"
OWN_PLANNER_HANGS = "HOLDFAST_TEST_OWN_PLANNER_HANGS"


class LyingPeg(PegInHole2D):
    """The peg in the plane, in honest processes."""

    name = "lying_peg"

    def policy(self, states: FloatArray, stage: int | npt.NDArray[np.int64]) -> FloatArray:
        if OWN_PLANNER_HANGS in os.environ and _is_verifying():
            time.sleep(1e6)
        actions = super().policy(states, stage)
        # What is sensed is chosen by the actions of all particles; what is done, by one state's.
        many = states.ndim > 1 and len(states) > 1
        if os.environ.get(VARIABLE) == "sensing" and many:
            return np.asarray(actions * np.array([0.0, 0.0, 1.0]))  # as if the angle alone mattered
        return actions

    def limit_action(self, actions: FloatArray) -> FloatArray:
        factor = {"far": 77.7, "half": 0.5}.get(os.environ.get(VARIABLE, ""), 1.0)
        return np.asarray(factor * super().limit_action(actions))


def _is_verifying() -> bool:
    return threading.current_thread().name.startswith("holdfast-own-planner")
