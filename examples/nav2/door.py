"""A robot that must know where it is before it goes through a door, as a problem.

Nav2's own behaviour for a robot that is not localised is to spin and to back up until AMCL's
particles happen to converge. Here each look has a purpose. The robot's camera or scanner sees only
ahead. It chooses in which direction to turn by what the ranges there would tell about *its next
drive*: a look that would change no particle's way to the door is worth nothing.

The state is the pose in the map: x (m), y (m), yaw (rad), as one of AMCL's particles. The map is a
list of walls, with a door in one of them. A look measures the ranges of a few beams ahead after a
turn. ``navigate.py`` uses the problem with Nav2; without ROS it is simulated::

    holdfast run examples/nav2/door.yaml
"""

import numpy as np

import holdfast as hf
from holdfast import numerics

EAST, NORTH = 6.0, 4.0  # m: the room's corners are (0, 0) and (EAST, NORTH)
DOOR_Y, DOOR_WIDTH = 1.2, 1.0  # m: the door is in the east wall
WALLS = (
    (0.0, 0.0, EAST, 0.0),
    (0.0, NORTH, EAST, NORTH),
    (0.0, 0.0, 0.0, NORTH),
    (EAST, 0.0, EAST, DOOR_Y - DOOR_WIDTH / 2),
    (EAST, DOOR_Y + DOOR_WIDTH / 2, EAST, NORTH),
    (1.0, 3.2, 1.8, 3.2),  # a cupboard, which tells the two ends of the room apart
    (1.8, 3.2, 1.8, NORTH),
    (EAST + 3.0, -3.0, EAST + 3.0, NORTH + 3.0),  # what is seen through the door
)
"""Segments of the map: x, y of both ends, in metres."""


MAX_RANGE = 8.0  # m
BEAMS = np.array([-0.4, -0.2, 0.0, 0.2, 0.4])  # rad, from straight ahead
RANGE_NOISE = 0.15  # m: of the sensor and of the map
STRIDE = 0.25  # m


def ranges(states, turn):
    """Return the ranges of the beams after a turn, shape ``(..., 5)``, in metres."""
    x, y, yaw = (states[..., index, None, None] for index in range(3))
    angles = yaw + turn + BEAMS[:, None]
    along_x, along_y = numerics.cos(angles), numerics.sin(angles)
    first_x, first_y, last_x, last_y = np.array(WALLS).T
    wall_x, wall_y = last_x - first_x, last_y - first_y
    # Beam and wall meet at a distance t along the beam and at a share u of the wall.
    across = along_x * wall_y - along_y * wall_x
    parallel = np.abs(across) < 1e-12
    across = np.where(parallel, 1.0, across)
    t = ((first_x - x) * wall_y - (first_y - y) * wall_x) / across
    u = ((first_x - x) * along_y - (first_y - y) * along_x) / across
    hit = ~parallel & (t > 0.0) & (u >= 0.0) & (u <= 1.0)
    return np.where(hit, np.minimum(t, MAX_RANGE), MAX_RANGE).min(axis=-1)


class Door(hf.ProblemBase):
    """Go through the door; a look is a turn, and the ranges of a few beams ahead."""

    name = "door"
    state_size, action_size = 3, 2
    sensing_actions = tuple(f"turn by {45 * number} deg" for number in range(8))
    state_labels = ("x (m)", "y (m)", "yaw (rad)")
    pose = ("x", "y", "yaw")
    circular = (2,)
    resolution = 0.05
    motion_variance = np.array([0.0009, 0.0009])

    def __init__(self, spread=(0.25, 0.25, 0.15)):
        self.spread = np.array(spread)

    @staticmethod
    def turn_of(sensing_action):
        """Return the turn before a look, in rad."""
        return sensing_action * 0.7853981633974483

    @staticmethod
    def way():
        """Return the poses (x, y, yaw) of the way through the door, for Nav2."""
        return (EAST - 0.8, DOOR_Y, 0.0), (EAST + 0.6, DOOR_Y, 0.0)

    def initial_states(self, stream, count):
        """Draw poses as AMCL leaves them in a room that looks alike from both ends."""
        there = np.array([2.0, 2.4, 0.5])
        mirrored = np.array([EAST - 2.0, NORTH - 2.4, 0.5 + np.pi])
        at_other_end = stream.substream(1).uniform((count, 1)) < 0.5
        states = np.where(at_other_end, mirrored, there) + self.spread * stream.normal((count, 3))
        states[:, :2] = np.clip(states[:, :2], 0.3, [EAST - 0.3, NORTH - 0.3])
        return states

    def move(self, states, actions, stream):
        """Drive in the robot's own frame; walls stop it."""
        cos, sin = numerics.cos(states[..., 2]), numerics.sin(states[..., 2])
        x = states[..., 0] + cos * actions[..., 0] - sin * actions[..., 1]
        y = states[..., 1] + sin * actions[..., 0] + cos * actions[..., 1]
        moved = np.stack([x, y, states[..., 2]], axis=-1)
        moved = moved + np.array([0.02, 0.02, 0.01]) * stream.normal(states.shape)
        in_door = np.abs(moved[..., 1] - DOOR_Y) < DOOR_WIDTH / 2 - 0.2
        blocked = (states[..., 0] < EAST) & ~in_door
        moved[..., 0] = np.where(blocked, np.minimum(moved[..., 0], EAST - 0.2), moved[..., 0])
        return moved

    def observation_mean(self, states, sensing_action):
        return ranges(states, self.turn_of(sensing_action))

    def observation_variance(self, states, sensing_action):
        return np.full(len(BEAMS), RANGE_NOISE**2)

    def policy(self, states, stage):
        """Go in front of the door, then through."""
        x, y = states[..., 0], states[..., 1]
        before = (x < EAST - 0.6) & (np.abs(y - DOOR_Y) > 0.1)
        east = np.where(before, EAST - 0.8, EAST + 0.6) - x
        north = DOOR_Y - y
        cos, sin = numerics.cos(states[..., 2]), numerics.sin(states[..., 2])
        return np.stack([cos * east + sin * north, cos * north - sin * east], axis=-1)

    def limit_action(self, actions):
        length = np.sqrt(actions[..., 0] ** 2 + actions[..., 1] ** 2)
        return actions * (STRIDE / np.maximum(length, STRIDE))[..., None]

    def is_goal(self, states):
        return states[..., 0] > EAST + 0.3
