"""An executive for Nav2 that looks where it tells most before it drives through a door.

AMCL keeps the belief. This program reads its particles (``nav2_msgs/ParticleCloud``), asks holdfast
which turn would tell most about the next drive, and has Nav2 turn the robot there. AMCL takes the
new scan. When nearly all particles agree on the drive, the robot goes through the door::

    python examples/nav2/navigate.py                                # with Nav2
    python examples/nav2/navigate.py --particles examples/nav2/particles.csv      # without ROS
    python examples/nav2/navigate.py --simulate 100                 # looks, and spinning instead

The second prints what the robot would do with recorded particles: x, y, yaw and weight in a row
each. ``door.py`` has the map; write one of your own. ``BasicNavigator`` is of Nav2's
``nav2_simple_commander``; only ``drive`` needs it.
"""

import argparse
import csv
import math
import sys
import time
from pathlib import Path

import numpy as np

import holdfast as hf

HERE = Path(__file__).parent
MAX_LOOKS = 12
AGREED = 0.9
"""Share of the weight that must agree on the drive."""


class Looker:
    """Chooses looks for a belief that somebody else keeps, such as AMCL."""

    def __init__(self, path=HERE / "door.yaml"):
        read = hf.load_configuration(path)
        self.problem, self._seed = read.problem, read.simulator.seed
        self._count = read.planning.particle_filter.num_particles
        self._planner = hf.Planner(read.problem, read.planning)
        self._looks = 0

    def belief(self, states, weights):
        """Return the belief with the number of particles of the settings, by equal shares."""
        ends = np.cumsum(np.asarray(weights) / np.sum(weights))
        shares = (np.arange(self._count) + 0.5) / self._count
        chosen = np.minimum(np.searchsorted(ends, shares), len(ends) - 1)
        equal = np.full(self._count, 1.0 / self._count)
        return hf.Belief(np.asarray(states, dtype=np.float64)[chosen], equal)

    def agreement(self, belief):
        """Return the share of particles whose drive is that of the estimate, and the drive."""
        state = hf.PlanningState(self._seed, 0, self._looks, 0, True, belief)
        drive, _ = self._planner.choose_task_action(state)
        drives = self.problem.limit_action(self.problem.policy(belief.states, 0))
        apart = np.hypot(*(drives - drive).T)
        return float(np.mean(apart < 0.5 * np.hypot(*drive))), drive

    def look(self, belief):
        """Return the sensing action that tells most, its turn (rad) and all expected entropies."""
        state = hf.PlanningState(self._seed, 0, self._looks, 0, False, belief)
        self._looks += 1
        chosen, info = self._planner.choose_sensing_action(state)
        turn = math.remainder(self.problem.turn_of(chosen), 2.0 * math.pi)
        return chosen, turn, info.entropies


def read_particles(path):
    """Return states and weights of a table with the columns x, y, yaw, weight."""
    with Path(path).open(encoding="utf-8") as file:
        rows = [[float(row[key]) for key in ("x", "y", "yaw", "weight")]
                for row in csv.DictReader(file)]  # fmt: skip
    table = np.array(rows)
    return table[:, :3], table[:, 3]


class AmclParticles:
    """The newest of AMCL's particles, as a node subscribes to them."""

    def __init__(self, node):
        from nav2_msgs.msg import ParticleCloud
        from rclpy.qos import qos_profile_sensor_data

        self._newest = None
        # AMCL publishes best effort.
        node.create_subscription(
            ParticleCloud, "particle_cloud", self._take, qos_profile_sensor_data
        )

    def _take(self, message):
        self._newest = message

    def newest(self, spin_once, within_s=10.0):
        """Return states and weights of a cloud that arrives from now on."""
        self._newest = None
        deadline = time.monotonic() + within_s
        while self._newest is None:
            if time.monotonic() > deadline:
                raise TimeoutError(f"no message on particle_cloud within {within_s:g} s")
            spin_once()
        poses = [(each.pose.position, each.pose.orientation) for each in self._newest.particles]
        states = [(p.x, p.y, 2.0 * math.atan2(q.z, q.w)) for p, q in poses]
        return np.array(states), np.array([each.weight for each in self._newest.particles])


def pose_of(navigator, x, y, yaw):
    """Return a goal of Nav2's."""
    from geometry_msgs.msg import PoseStamped

    pose = PoseStamped()
    pose.header.frame_id = "map"
    pose.header.stamp = navigator.get_clock().now().to_msg()
    pose.pose.position.x, pose.pose.position.y = float(x), float(y)
    pose.pose.orientation.z, pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return pose


def finish(navigator, what, accepted):
    """Wait for Nav2's task; raise if it did not succeed."""
    from nav2_simple_commander.robot_navigator import TaskResult

    while accepted and not navigator.isTaskComplete():
        pass  # it waits itself, a tenth of a second
    if not accepted or navigator.getResult() != TaskResult.SUCCEEDED:
        raise RuntimeError(f"Nav2 did not {what}")


def drive(looker, say=print):
    """Look until the particles agree on the drive, then go through the door."""
    try:
        import rclpy
        from nav2_simple_commander.robot_navigator import BasicNavigator
    except ModuleNotFoundError as error:
        sys.exit(f"{error}: source a ROS 2 with Nav2; or use --particles or --simulate")
    rclpy.init()
    navigator = BasicNavigator()
    try:
        particles = AmclParticles(navigator)
        navigator.waitUntilNav2Active()
        for _ in range(MAX_LOOKS):
            states, weights = particles.newest(lambda: rclpy.spin_once(navigator, timeout_sec=0.1))
            belief = looker.belief(states, weights)
            agreed, _ = looker.agreement(belief)
            if agreed >= AGREED:
                break
            chosen, turn, _ = looker.look(belief)
            say(f"{agreed:.0%} agree on the drive; {looker.problem.sensing_actions[chosen]}")
            finish(navigator, "turn", navigator.spin(spin_dist=turn, time_allowance=15))
        else:
            raise RuntimeError(f"not localised after {MAX_LOOKS} looks")
        say(f"{agreed:.0%} agree on the drive: through the door")
        for x, y, yaw in looker.problem.way():
            finish(navigator, "drive", navigator.goToPose(pose_of(navigator, x, y, yaw)))
    finally:
        rclpy.shutdown()


def simulate(trials):
    """Print how many looks it takes until the particles agree, and with how many of them rightly.

    The particle filter of the simulation stands for AMCL. A robot that spins looks in all
    directions in turn, as Nav2's own behaviour does.
    """
    read = hf.load_configuration(HERE / "door.yaml")
    planner = hf.Planner(read.problem, read.planning)
    for way in ("chosen looks", "spinning"):
        looks, right = [], 0
        for trial in range(trials):
            looker = Looker()
            world = hf.SimulatedEnvironment(read.problem, read.simulator.seed, trial)
            state = planner.init(read.simulator.seed, trial)
            for number in range(MAX_LOOKS + 1):
                agreed, drive = looker.agreement(state.belief)
                if agreed >= AGREED or number == MAX_LOOKS:
                    break
                chosen = looker.look(state.belief)[0] if way == "chosen looks" else number % 8
                seen = world.perform_sensing(chosen)
                state, _ = planner.observe(state._replace(step=number), chosen, seen)
                state = state._replace(sensed=False)
            looks.append(number)
            truth = read.problem.limit_action(read.problem.policy(world.state, 0))
            right += bool(agreed >= AGREED and np.hypot(*(truth - drive)) < 0.5 * np.hypot(*drive))
        print(f"{way}: {np.mean(looks):.2f} looks, and {right} of {trials} know the way")


def main(arguments=None):
    """Run with Nav2, or say what would be done with recorded particles."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--particles", metavar="CSV", help="recorded particles instead of Nav2")
    parser.add_argument("--simulate", metavar="N", type=int, help="trials in simulation instead")
    options = parser.parse_args(arguments)
    if options.simulate is not None:
        simulate(options.simulate)
        return 0
    looker = Looker()
    if options.particles is None:
        drive(looker)
        return 0
    belief = looker.belief(*read_particles(options.particles))
    agreed, way = looker.agreement(belief)
    print(f"{agreed:.0%} of the particles agree on the drive ({way[0]:+.2f}, {way[1]:+.2f}) m")
    if agreed >= AGREED:
        print("drive through the door")
        return 0
    chosen, _, entropies = looker.look(belief)
    for name, entropy in zip(looker.problem.sensing_actions, entropies, strict=True):
        mark = " <- tells most" if name == looker.problem.sensing_actions[chosen] else ""
        print(f"{name:12} {entropy:+.2f} nats expected{mark}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
