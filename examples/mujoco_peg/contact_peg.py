"""What the planner believes of a peg on position servos, in the plane and in space.

The robot sees one coordinate at a time, and badly. Its encoders read a constant share too much or
too little, and it feels contact at the wrist. A particle is the peg's pose relative to the hole.
It moves by what the encoders measured, not by what was commanded, and stops where its peg meets the
ground. The force then tells particles that touch something from those that do not.

Nothing here knows MuJoCo: a service that decides for this robot needs this file alone.
"""

import numpy as np

import holdfast as hf
from holdfast import numerics
from holdfast.numerics.geometry import FAR, BoxWorld, RectangleWorld
from holdfast.numerics.randomness import NOISE_FREE

COLLISION_TOLERANCE = 0.01
"""Fraction of a step to which contact is located."""


class _ContactPeg(hf.ProblemBase):
    """What does not depend on the dimension. Lengths are metres, angles radians, forces newtons.

    A state is the pose of the peg's middle; the hole's mouth is at zero. ``world`` has the ground.

    Parameters
    ----------
    peg_width, peg_length : float
        Of the peg.
    clearance : float
        Gap between peg and hole on each side.
    depth : float
        How deep the tip has to be.
    start_mean, start_deviation : array of shape (3,)
        Where the peg starts.
    look_deviation : array of shape (3,)
        Noise of a look at each coordinate.
    motion_deviation : array of shape (3,)
        What a step adds: the encoders' error and noise, and what keeps particles apart, of which
        few are left after a sharp look.
    step_size : array of shape (3,)
        Largest size of each component of a step.
    hover, press_size : float
        Height of the tip at which the peg is centred, and steps with which it is lowered from there
        until it is in.
    contact_force : float
        A larger force is contact.
    contact_reach : float
        A gap below this counts as contact.
    contact_error : float
        Probability that contact is not felt, and that it is felt where there is none.
    """

    state_size = action_size = 3
    slides = ()
    """Which coordinates are lengths: along these the force is measured."""

    def __init__(
        self,
        peg_width=0.02,
        peg_length=0.06,
        clearance=0.001,
        depth=0.02,
        start_mean=(0.0, 0.0, 0.0),
        start_deviation=(0.0, 0.0, 0.0),
        look_deviation=(0.001, 0.001, 0.001),
        motion_deviation=(0.0003, 0.0003, 0.0003),
        step_size=(0.003, 0.003, 0.003),
        hover=0.005,
        press_size=0.001,
        contact_force=3.0,
        contact_reach=0.0005,
        contact_error=0.05,
    ):
        self.half_length, self.clearance = 0.5 * peg_length, clearance
        self.half_hole = 0.5 * peg_width + clearance
        self.goal_height = self.half_length - depth
        self.start_mean, self.start_deviation = np.array(start_mean), np.array(start_deviation)
        self.resolution = np.array(look_deviation)
        self.look_variance = np.square(self.resolution)
        self.motion_deviation = np.array(motion_deviation)
        self.motion_variance = np.square(self.motion_deviation)
        self.step_size, self.hover, self.press_size = np.array(step_size), hover, press_size
        self.contact_force, self.contact_reach = contact_force, contact_reach
        self.log_wrong, self.log_right = numerics.log(
            np.array([contact_error, 1.0 - contact_error])
        )
        self.world = self.ground(peg_width, peg_length, -2.0 * depth)

    def initial_states(self, stream, count):
        states, unplaced = self.world.draw_free(
            self.padded(self.start_mean), self.padded(self.start_deviation), count, stream
        )
        if unplaced:
            raise ValueError("start_mean: the peg would start in the ground")
        return states[:, : self.state_size]

    def move(self, states, actions, stream):
        """Move as commanded, for plans: the servos bring the encoders to where they are told."""
        moved = self.world.move(
            self.padded(states),
            self.padded(actions),
            self.padded(self.motion_deviation),
            COLLISION_TOLERANCE,
            stream,
        )
        return moved[..., : self.state_size]

    def expected_move(self, states, actions):
        return self.move(states, actions, NOISE_FREE)

    def move_by_measurement(self, states, motion, stream):
        """Move the belief by what the encoders measured: a peg that was held up did not move."""
        return self.move(states, motion, stream)

    def measure_motion(self, before, after, stream):
        """Read the encoders in a simulation without MuJoCo."""
        return after - before + 0.1 * self.motion_deviation * stream.normal(after.shape)

    def touches(self, states):
        """Tell which states touch something on the lower and on the upper side of each slide.

        The shape is ``(..., slides, 2)``.
        """
        found = np.empty((*states.shape[:-1], len(self.slides), 2), dtype=np.bool_)
        for row, coordinate in enumerate(self.slides):
            for side, reach in enumerate((-self.contact_reach, self.contact_reach)):
                shift = np.zeros(self.state_size)
                shift[coordinate] = reach
                found[..., row, side] = self.world.collides(self.padded(states + shift))
        return found

    def move_log_likelihood(self, states, action, observation):
        """Weigh the force along each slide: what the peg touches pushes it away from there."""
        felt = np.stack([observation, -observation], axis=-1) > self.contact_force
        terms = np.where(self.touches(states) == felt, self.log_right, self.log_wrong)
        total = np.zeros(states.shape[:-1])
        for row in range(len(self.slides)):
            total = total + terms[..., row, 0] + terms[..., row, 1]
        return total

    def sample_move_observation(self, state, action, stream):
        touched = self.touches(state).astype(np.float64)
        force = 2.0 * self.contact_force * (touched[..., 0] - touched[..., 1])
        return force + 0.1 * self.contact_force * stream.normal(force.shape)

    def observation_mean(self, states, sensing_action):
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states, sensing_action):
        return self.look_variance[sensing_action : sensing_action + 1]

    def limit_action(self, actions):
        return np.clip(actions, -self.step_size, self.step_size)

    def policy(self, states, stage):
        """Centre the peg above the hole, then lower it: slowly where it may meet the ground."""
        height = states[..., self.slides[-1]]
        to_hover = self.half_length + self.hover - height
        to_goal = self.goal_height - self.clearance - height
        inside = height < self.half_length - self.clearance
        lower = np.where(~inside & (to_hover > 0.0), -self.press_size, to_goal)
        actions = -states
        actions[..., self.slides[-1]] = np.where(inside | self.aligned(states), lower, to_hover)
        return actions

    def is_goal(self, states):
        """Only a simulation without MuJoCo asks this."""
        deep = states[..., self.slides[-1]] < self.goal_height
        return deep & (np.abs(states[..., 0]) < self.half_hole)


class ContactPeg2D(_ContactPeg):
    """In the plane: x to the right, z up, and the angle, counter-clockwise from upright."""

    name = "contact_peg_2d"
    slides = (0, 1)
    sensing_actions = ("x", "z", "θ")
    state_labels = ("x (m)", "z (m)", "θ (rad)")
    pose, up = ("x", "y", "yaw"), "y"

    def ground(self, peg_width, peg_length, floor):
        obstacles = [
            (-FAR, -FAR, -self.half_hole, 0.0),
            (self.half_hole, -FAR, FAR, 0.0),
            (-self.half_hole, -FAR, self.half_hole, floor),
        ]
        return RectangleWorld(peg_width, peg_length, obstacles)

    def padded(self, poses):
        return poses

    def aligned(self, states):
        centred = np.abs(states[..., 0]) < 0.5 * self.clearance
        return centred & (np.abs(states[..., 2]) < 0.5 * self.clearance / self.half_length)

    def scene(self):
        x, z = 0.5 * self.world.width, self.half_length
        return hf.Scene(
            axes=(0, 1),
            limits=(-0.04, -0.05, 0.1, 0.11),
            obstacles=self.world.obstacles,
            body=[(-x, -z), (x, -z), (x, z), (-x, z)],
            angle=2,
            goal=(0.0, self.goal_height),
        )


class ContactPeg3D(_ContactPeg):
    """In space: an upright square peg, x, y and z."""

    name = "contact_peg_3d"
    slides = (0, 1, 2)
    sensing_actions = ("x", "y", "z")
    state_labels = ("x (m)", "y (m)", "z (m)")
    pose = ("x", "y", "z")

    def ground(self, peg_width, peg_length, floor):
        half = self.half_hole
        obstacles = [
            (-FAR, -FAR, -FAR, -half, FAR, 0.0),
            (half, -FAR, -FAR, FAR, FAR, 0.0),
            (-half, -FAR, -FAR, half, -half, 0.0),
            (-half, half, -FAR, half, FAR, 0.0),
            (-half, -half, -FAR, half, half, floor),
        ]
        return BoxWorld((peg_width, peg_width, peg_length), obstacles)

    def padded(self, poses):
        """Return poses of a box: it does not turn."""
        return np.concatenate([poses, np.zeros(poses.shape)], axis=-1)

    def aligned(self, states):
        return (np.abs(states[..., :2]) < 0.5 * self.clearance).all(axis=-1)
