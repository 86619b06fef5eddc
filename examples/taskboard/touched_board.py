"""What the planner believes of a task board that it finds by touch.

The board stands still, but where is not known: within 2 cm and 15 degrees. A touch is a peg's side
against one of the board's edges, and shows where along its axis they met. One touch says little of
three unknowns, and which one it says most of depends on what is known. A task action is a try: the
peg is pressed down where its hole seems to be. One that fails tells where the hole is not.

The particles of a thing that does not move have no noise that keeps them apart, and a sharp touch
leaves few of them. So each step draws them anew around themselves, as far as they are spread, with
their mean and covariance kept (J. Liu and M. West, "Combined parameter and state estimation in
simulation-based filtering", 2001).
"""

import numpy as np

import holdfast as hf
from holdfast import numerics
from holdfast.numerics.randomness import NoiseFreeStream


class TouchedBoard(hf.ProblemBase):
    """A board by touch: a state is the centre (x, y) and the yaw, each less its nominal value.

    Parameters
    ----------
    half_side : float
        Of the square board, in metres.
    centre : array of shape (2,)
        Its nominal place.
    hole : array of shape (2,)
        Of the peg, in the board's frame.
    peg_radius : float
        Of the peg that touches.
    rays : sequence of (int, float)
        The touches: along x (0) or y (1), and at which value of the other coordinate. The peg comes
        from the side of the robot along x, and against y.
    reach, turn : float
        The board is within ``reach`` of its nominal place along x and y, and turned by at most
        ``turn`` (rad).
    touch_deviation : float
        Noise of a touch, in metres.
    press_reach : float
        How far beside its hole a peg that is pressed down still goes in.
    press_error : float
        Probability that one within that reach does not, and that one beyond it does.
    kernel : float
        Of Liu and West: the share of the spread with which particles are drawn anew, up to 1.
    """

    name = "touched_board"
    state_size, action_size = 3, 2
    state_labels = ("x (m)", "y (m)", "yaw (rad)")
    pose = ("x", "y", "yaw")
    resolution = 0.0002
    state_resolution = np.array([0.0002, 0.0002, 0.002])
    motion_variance = np.array([4e-8, 4e-8])

    def __init__(
        self,
        half_side=0.192,
        centre=(0.5, -0.2),
        hole=(0.07448, -0.06985),
        peg_radius=0.008,
        rays=((0, -0.18), (0, -0.3), (1, 0.42), (1, 0.58)),
        reach=0.02,
        turn=0.2617993877991494,
        touch_deviation=0.0004,
        press_reach=0.00035,
        press_error=0.15,
        kernel=0.5,
    ):
        self.edge = half_side + peg_radius
        self.centre, self.hole = np.array(centre), np.array(hole)
        self.rays = [(int(axis), float(at)) for axis, at in rays]
        self.sensing_actions = tuple(f"{'xy'[axis]} at {at:g}" for axis, at in self.rays)
        self.half_extent = np.array([reach, reach, turn])
        self.touch_variance = np.array([touch_deviation * touch_deviation])
        self.press_reach, self.kernel = press_reach, kernel
        self.log_missed, self.log_found = numerics.log(np.array([press_error, 1.0 - press_error]))

    def initial_states(self, stream, count):
        return self.half_extent * (2.0 * stream.uniform((count, 3)) - 1.0)

    def move(self, states, actions, stream):
        """Draw particles anew around themselves: the board has not moved."""
        if isinstance(stream, NoiseFreeStream) or states.ndim == 1:
            return self.expected_move(states, actions)
        keep = np.sqrt(1.0 - self.kernel * self.kernel)
        moved = np.empty(states.shape)
        for index in np.ndindex(states.shape[:-2]):
            belief = states[index]
            mean, root = _mean_and_root(belief)
            noise = stream.normal(belief.shape)
            drawn = mean + keep * (belief - mean)
            for column in range(3):
                for row in range(column + 1):
                    drawn[:, column] += self.kernel * root[column, row] * noise[:, row]
            moved[index] = drawn
        return moved

    def expected_move(self, states, actions):
        shape = np.broadcast_shapes(states.shape[:-1], actions.shape[:-1])
        return np.broadcast_to(states, (*shape, 3))

    def observation_mean(self, states, sensing_action):
        """Return where the peg's axis is on its ray when its side meets the edge."""
        axis, at = self.rays[sensing_action]
        other = 1 - axis
        sine, cosine = numerics.sin(states[..., 2]), numerics.cos(states[..., 2])
        along = at - self.centre[other] - states[..., other]
        met = (self.edge + along * sine) / cosine
        return (self.centre[axis] + states[..., axis] + (met if axis else -met))[..., np.newaxis]

    def observation_variance(self, states, sensing_action):
        return self.touch_variance

    def hole_of(self, states):
        """Return where the hole is, less the nominal place of the board."""
        sine, cosine = numerics.sin(states[..., 2]), numerics.cos(states[..., 2])
        x, y = self.hole
        return np.stack(
            [states[..., 0] + cosine * x - sine * y, states[..., 1] + sine * x + cosine * y],
            axis=-1,
        )

    def policy(self, states, stage):
        """Press the peg down where the hole is."""
        return self.centre + self.hole_of(states)

    def move_log_likelihood(self, states, action, observation):
        """Weigh a try: 1 if the peg went in, 0 if not."""
        off = self.centre + self.hole_of(states) - action
        near = off[..., 0] * off[..., 0] + off[..., 1] * off[..., 1]
        within = near < self.press_reach * self.press_reach
        found = observation[0] > 0.5
        return np.where(within == found, self.log_found, self.log_missed)

    def sample_move_observation(self, state, action, stream):
        off = self.centre + self.hole_of(state) - action
        within = off[0] * off[0] + off[1] * off[1] < self.press_reach * self.press_reach
        return np.array([float(within)])

    def is_goal(self, states):
        """Only a simulation without the arm asks this, and it never tries."""
        return np.zeros(states.shape[:-1], dtype=np.bool_)


def _mean_and_root(belief):
    """Return the mean of particles, and the Cholesky factor of their covariance, bit for bit."""
    count = belief.shape[0]
    mean = np.array([numerics.sum(belief[:, column]) for column in range(3)]) / count
    off = belief - mean
    root = np.zeros((3, 3))
    for column in range(3):
        for row in range(column + 1):
            value = numerics.sum(off[:, column] * off[:, row]) / count
            for before in range(row):
                value -= root[column, before] * root[row, before]
            if row == column:
                root[column, column] = np.sqrt(max(value, 0.0))
            elif root[row, row] > 0.0:
                root[column, row] = value / root[row, row]
    return mean, root
