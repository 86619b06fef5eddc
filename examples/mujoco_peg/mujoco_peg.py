"""A peg in MuJoCo: a robot whose contacts, friction and servos no planner knows.

The simulator has the truth and keeps it. It shows noisy looks, the motion that biased encoders
measured, and the force at the wrist, and it alone says when the peg is in the hole, or broken.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

import holdfast as hf

SUBSTEPS = 50
"""Physics steps of 2 ms in one task action: the servos have 0.1 s to follow."""

AVERAGED = 10
"""The last steps, over which the force is averaged."""


class MujocoPeg:
    """The robot; ``model`` says which.

    Parameters
    ----------
    model : str
        ``peg_2d.xml`` (x, z and angle) or ``peg_3d.xml`` (x, y and z), beside this file. Its joints
        are the pose of the peg's middle, with the hole's mouth at zero.
    start_mean, start_deviation : sequence of float
        Where the peg starts.
    look_deviation : sequence of float
        Noise of a look at each coordinate.
    encoder_deviation : float
        An encoder of a slide reads a constant share too much; this is the share's deviation.
    encoder_noise : float
        Noise of a reading of a slide, in metres.
    encoders, force : bool
        Whether a move shows the motion that the encoders measured, and the force at the wrist.
    force_noise : float
        Its noise, in newtons.
    force_limit : float
        A larger force breaks the peg.
    depth : float
        How deep the tip has to be.
    time_limit : int
        Task actions, of 0.1 s each.
    seed, trial : int
        From holdfast.
    """

    def __init__(
        self,
        model,
        start_mean,
        start_deviation,
        look_deviation,
        encoder_deviation=0.04,
        encoder_noise=0.00005,
        encoders=True,
        force=True,
        force_noise=0.3,
        force_limit=40.0,
        depth=0.02,
        time_limit=300,
        seed=0,
        trial=0,
    ):
        path = Path(__file__).with_name(model)
        self._model = mujoco.MjModel.from_xml_path(str(path))
        self._data = mujoco.MjData(self._model)
        self._size = self._model.nq
        slides = self._model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
        self._slides = np.flatnonzero(slides)
        self._sensor = self._model.sensor("wrist").adr[0]
        self._peg = self._model.geom("peg").id
        self._look_deviation = np.array(look_deviation)
        self._shows_motion, self._shows_force = encoders, force
        self._force_noise = force_noise
        self._force_limit, self._depth, self._time_limit = force_limit, depth, time_limit
        self._random = np.random.default_rng([seed, trial])
        self._noise = np.where(slides, encoder_noise, 0.001)
        self._scale = np.where(
            slides, 1.0 + encoder_deviation * self._random.normal(size=self._size), 1.0
        )
        self._performed, self._largest_force = 0, 0.0

        start = np.array(start_mean) + start_deviation * self._random.normal(size=self._size)
        self._data.qpos[:] = self._data.ctrl[:] = start
        mujoco.mj_forward(self._model, self._data)
        self._weight = self._force()
        self._read = self._encoders()

    def perform_sensing(self, sensing_action):
        """Look along one coordinate."""
        seen = self._data.qpos[sensing_action]
        noise = self._look_deviation[sensing_action] * self._random.normal()
        return np.array([seen + noise])

    def perform(self, task_action):
        """Move the servos' targets, let 0.1 s pass, and read encoders and wrist."""
        # The servos see the encoders, so that they go as wrong as these do.
        self._data.ctrl[:] += np.asarray(task_action) / self._scale
        forces = np.empty((SUBSTEPS, 3))
        for substep in range(SUBSTEPS):
            mujoco.mj_step(self._model, self._data)
            forces[substep] = self._force() - self._weight
        self._largest_force = max(self._largest_force, np.abs(forces).max())
        self._performed += 1
        before, self._read = self._read, self._encoders()
        force = forces[-AVERAGED:].mean(axis=0) + self._force_noise * self._random.normal(size=3)
        return hf.MoveResult(
            motion=self._read - before if self._shows_motion else None,
            observation=self._felt(force) if self._shows_force else None,
        )

    def is_done(self):
        """Say how the task has ended, and why."""
        if self._largest_force > self._force_limit:
            return hf.Ending("failed", f"force {self._largest_force:.0f} N at the wrist")
        if self._tip() < -self._depth:
            return hf.Ending("succeeded", "the peg is in the hole")
        if self._performed >= self._time_limit:
            return hf.Ending("truncated", f"no time left after {self._performed} moves")
        return False

    def steps_performed(self):
        """Return the number of moves in this trial."""
        return self._performed

    def _force(self):
        """Return what the peg does to the wrist; MuJoCo measures the opposite."""
        return -self._data.sensordata[self._sensor : self._sensor + 3]

    def _felt(self, force):
        """Return the force along each slide."""
        return force[[0, 2]] if self._slides.size == 2 else force

    def _encoders(self):
        noise = self._noise * self._random.normal(size=self._size)
        return self._scale * self._data.qpos + noise

    def _tip(self):
        """Return the height of the peg's lowest corner above the mouth of the hole."""
        half, turned = self._model.geom_size[self._peg], self._data.geom_xmat[self._peg]
        return self._data.geom_xpos[self._peg, 2] - np.abs(turned[6:]) @ half
