"""Which coordinates of a state are a pose, and beliefs as poses.

ROS's tools draw poses: a position and an orientation in a frame. A problem's state is a list of
numbers that only the problem can name. So a problem says with one optional attribute, ``pose``,
what its coordinates are, one word for each::

    pose = ("x", "y", "yaw")            # all three coordinates are of the pose
    pose = ("x", "y", None, "z")        # the third is something else; there is no rotation

The words are ``x``, ``y``, ``z`` (metres), ``roll``, ``pitch`` and ``yaw`` (radians, REP 103; the
body is turned by Rz(yaw) Ry(pitch) Rx(roll)). A coordinate of the pose that the state lacks is 0.
Coordinates after the last word belong to no pose. A problem in a vertical plane whose y points up
says so with ``up = "y"``; else z points up, as ROS has it.

This is plain NumPy: no message of ROS is made here.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast.errors import ProblemError
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.circular import differences
from holdfast.planning.belief import Belief, estimate
from holdfast.printable import brief
from holdfast.problems.attributes import circular_states, sequence_of

POSE_COORDINATES = ("x", "y", "z", "roll", "pitch", "yaw")
"""In the order of the covariance of ``geometry_msgs/PoseWithCovariance``: rotations are about the
fixed axes X, Y and Z."""

_HALF_ROOT = float(np.sqrt(0.5))
_UPRIGHT = {"z": (0.0, 0.0, 0.0, 1.0), "y": (_HALF_ROOT, 0.0, 0.0, _HALF_ROOT)}
"""Rotation (x, y, z, w) from a frame whose z points up to the problem's, by the problem's axis that
points up. For y it is a quarter turn about x."""


class PoseLayout(NamedTuple):
    """Where in a state the coordinates of a pose are.

    ``indices`` has for each of :data:`POSE_COORDINATES` the state's coordinate, None if there is
    none; ``upright`` is the quaternion (x, y, z, w) by which the problem's frame is turned in a
    frame whose z points up; ``circular`` has the problem's own coordinates that are angles.
    """

    indices: tuple[int | None, ...]
    upright: tuple[float, float, float, float]
    circular: tuple[int, ...] = ()

    def poses(self, states: npt.ArrayLike) -> FloatArray:
        """Return the poses of states of shape ``(..., state_size)``, in metres and radians.

        They have shape ``(..., 7)``: position x, y, z in metres and unit quaternion x, y, z, w, in
        the order in which ``geometry_msgs/Pose`` has them.
        """
        array = np.asarray(states, dtype=np.float64)
        coordinates = np.zeros((*array.shape[:-1], len(POSE_COORDINATES)))
        for target, source in enumerate(self.indices):
            if source is not None:
                coordinates[..., target] = array[..., source]
        poses = np.empty((*array.shape[:-1], 7))
        poses[..., :3] = coordinates[..., :3]
        half = 0.5 * coordinates[..., 3:]
        (sr, sp, sy), (cr, cp, cy) = (np.moveaxis(f(half), -1, 0) for f in (np.sin, np.cos))
        poses[..., 3] = sr * cp * cy - cr * sp * sy
        poses[..., 4] = cr * sp * cy + sr * cp * sy
        poses[..., 5] = cr * cp * sy - sr * sp * cy
        poses[..., 6] = cr * cp * cy + sr * sp * sy
        return poses

    def covariance(self, belief: Belief) -> FloatArray:
        """Return the covariance of a belief's poses about its mean, shape ``(6, 6)``.

        Angles are averaged as the belief averages them: those that the problem calls ``circular``
        as directions, others as numbers. What the state lacks is known: its rows and columns are 0.
        """
        mean = estimate(belief, circular=self.circular)
        difference = differences(belief.states, mean, self.circular)
        ours = [target for target, source in enumerate(self.indices) if source is not None]
        theirs = [source for source in self.indices if source is not None]
        part = difference[:, theirs]
        covariance = np.zeros((len(POSE_COORDINATES), len(POSE_COORDINATES)))
        covariance[np.ix_(ours, ours)] = (belief.weights[:, np.newaxis] * part).T @ part
        # The product of matrices need not be symmetric in its last bit.
        return 0.5 * (covariance + covariance.T)


def pose_layout(problem: Any) -> PoseLayout | None:
    """Return where in a problem's states the pose is, by its attributes ``pose`` and ``up``.

    It is None if the problem does not say. Raises ProblemError if these attributes are invalid.
    """
    given = getattr(problem, "pose", None)
    words = sequence_of(given)
    if given is None or words == ():
        return None
    name = getattr(problem, "name", "") or type(problem).__name__
    if words is None:
        raise ProblemError(
            f"pose of {name} is {brief(given)}: must be a sequence with a word for each coordinate"
            ' of the state, such as ("x", "y", "yaw")'
        )
    if len(words) > problem.state_size:
        raise ProblemError(
            f"pose of {name} has {len(words)} words: its state has {problem.state_size} coordinates"
        )
    indices: dict[str, int] = {}
    for index, word in enumerate(words):
        if word is None:
            continue
        if word not in POSE_COORDINATES:
            raise ProblemError(
                f"pose[{index}] of {name} is {brief(word)}: allowed are "
                f"{', '.join(POSE_COORDINATES)} and None"
            )
        if word in indices:
            raise ProblemError(f"pose of {name} has {word} twice, at {indices[word]} and {index}")
        indices[word] = index
    if not indices:
        return None
    up = getattr(problem, "up", "z")
    if not isinstance(up, str) or up not in _UPRIGHT:
        raise ProblemError(f"up of {name} is {brief(up)}: allowed are y and z")
    return PoseLayout(
        tuple(indices.get(word) for word in POSE_COORDINATES),
        _UPRIGHT[up],
        tuple(circular_states(problem)),
    )
