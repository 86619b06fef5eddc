"""What the demo does: kill the cloud twice, then the robot, and compare with a run without kills.

Nothing is staged. The demo starts the commands that anyone can type, ends them with SIGKILL, and
knows of them only what they log. The kills come at fixed fractions of the run's steps, and each
only after the robot has reacted to the one before, so the demo is the same on a slow machine.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from holdfast.cli.terminal import counted
from holdfast.reports.compare import Comparison, compare_runs
from holdfast.robot.links import RECOVERY_SERVICE
from holdfast_lab.demo.narrator import DemoState, Line, Narrator
from holdfast_lab.errors import NoProgressError
from holdfast_lab.testbed.driver import Testbed
from holdfast_lab.testbed.fault_times import ROBOT, FaultTimes, times_of_faults
from holdfast_lab.testbed.processes import free_port
from holdfast_lab.testbed.records import Decision, of_services
from holdfast_lab.testbed.reference_run import ReferenceRun, make_reference_run

CONFIGURATION_NAME = "demo.yaml"
KILLED_RUN_NAME = "killed"
REFERENCE_RUN_NAME = "undisturbed"

_COMMENT = """\
# What holdfast demo has run. The same without services, without kills and as fast as it goes:
#   holdfast run {}
"""
_MAX_STEPS = 250

_FIRST_KILL = 0.14
_FIRST_RESTART = 0.32
_SECOND_KILL = 0.47
_SECOND_RESTART = 0.59
_ROBOT_KILL = 0.73
"""As fractions of the run's steps; after the last there is room for delays."""

_USUAL_START_S = 0.4
_MAX_SLOWNESS = 4.0
"""A service that takes longer to start is on a slow machine, where the robot is slower too;
otherwise its run would end before all has happened."""

_PATIENCE_S = 30.0
"""For a reaction; on an idle machine it takes a hundredth of that."""

_AROUND_S = 3.0
"""Time shown before and after the robot's run."""


class Findings(NamedTuple):
    """What the demo comes to."""

    outages: tuple[FaultTimes, ...]  # of the two kills of the cloud service
    # From the start of each cloud service that followed until it listened.
    listening_ms: tuple[float, ...]
    robot_kill: FaultTimes  # of the kill of the robot's own process
    statuses: tuple[list[str], ...]  # of each process that the robot had
    comparison: Comparison  # of the reference run and the run with the kills


class Plan(NamedTuple):
    """How long the demo is."""

    min_steps: int = 400  # trials are added until the run has as many task actions
    duration_s: float = 16.0  # how long the robot takes for them


class Demo:
    """The demo in a testbed's directory."""

    def __init__(
        self,
        testbed: Testbed,
        seed: int,
        plan: Plan,
        state: DemoState,
        show: Callable[[Line], object],
    ) -> None:
        self._testbed = testbed
        self._seed = seed
        self._plan = plan
        self._state = state
        self._cloud = testbed.add_service(f"tcp/127.0.0.1:{free_port()}")
        self._narrator = Narrator(testbed, self._cloud, state, show)
        testbed.on_turn = self._narrator.update

    def run(self) -> Findings:
        """Run it.

        Raises NoProgressError if something does not happen in time; ProcessEndedError if a process
        ends that should not.
        """
        testbed = self._testbed
        directory = testbed.directory
        reference = self._make_reference_run()
        slowness = min(_MAX_SLOWNESS, max(1.0, self._start_cloud() / _USUAL_START_S))
        steps = sum(reference.steps_of_trials)
        rate_hz = float(max(1, round(steps / (self._plan.duration_s * slowness))))
        self._state.expected_s = self._state.now_s + _AROUND_S + steps / rate_hz
        self._state.title += f" at {rate_hz:g} Hz"
        robot = testbed.start_robot(
            directory / CONFIGURATION_NAME,
            directory / KILLED_RUN_NAME,
            reference.steps_of_trials,
            rate_hz,
            *("--service", self._cloud.endpoint),
        )
        self._narrator.started_robot()
        self._wait(lambda: bool(robot.decisions), "the robot's first decision")
        listening_ms = (
            self._kill_cloud(_FIRST_KILL, _FIRST_RESTART),
            self._kill_cloud(_SECOND_KILL, _SECOND_RESTART),
        )
        self._kill_robot()
        self._wait(lambda: robot.is_done, "the end of the robot's run", steps / rate_hz)
        robot.table.read()
        *outages, robot_kill = times_of_faults(testbed.faults, robot.events, robot.decisions)
        return Findings(
            outages=tuple(outages),
            listening_ms=listening_ms,
            robot_kill=robot_kill,
            statuses=tuple(self._narrator.statuses),
            comparison=compare_runs(directory / REFERENCE_RUN_NAME, robot.out),
        )

    def _make_reference_run(self) -> ReferenceRun:
        directory = self._testbed.directory
        path = directory / CONFIGURATION_NAME
        document = {
            "problem": "peg_in_hole_2d",
            "simulator": {"max_steps": _MAX_STEPS, "seed": self._seed},
        }
        reference = make_reference_run(
            directory / REFERENCE_RUN_NAME,
            path,
            document,
            self._plan.min_steps,
            comment=_COMMENT.format(path),
        )
        self._state.title = (
            f"{reference.configuration.problem_name}, seed {self._seed}: "
            f"{counted(len(reference.steps_of_trials), 'trial')}, "
            f"{sum(reference.steps_of_trials)} steps"
        )
        text = f"the run without kills, in this process, took {reference.took_s:.2f} s"
        self._narrator.say("demo", text)
        return reference

    def _kill_cloud(self, kill_at: float, restart_at: float) -> float:
        """Kill the cloud, let the robot do without it for a while, and start it again.

        Returns how long the new service took until it listened, in ms.
        """
        testbed, cloud, narrator = self._testbed, self._cloud, self._narrator
        decisions = testbed.robot.decisions
        self._wait_for_progress(kill_at)
        self._wait(
            lambda: narrator.cloud_decides and of_services(decisions)[-1].service == cloud.endpoint,
            "the use of the cloud service",
        )
        fault = testbed.note_fault("cloud_killed", cloud.endpoint, cloud.process.kill())
        narrator.killed("cloud", cloud.process, "the cloud service")
        self._wait(lambda: not narrator.cloud_decides, "the loss being noticed")
        local = self._wait_for_decision(
            lambda row: row.service == RECOVERY_SERVICE and row.at >= fault.injected_at,
            "a decision of the local service",
        )
        narrator.say("local", f"decides, from step {local.step} on", local.at)
        self._wait_for_progress(restart_at)
        start_s = self._start_cloud()
        fault.usable_at = ready_at = cloud.process.spawned_at + start_s
        self._wait_for_decision(
            lambda row: row.service == cloud.endpoint and row.at >= ready_at,
            "the cloud being used again",
        )
        return 1e3 * start_s

    def _kill_robot(self) -> None:
        """Kill the robot's own process in mid-step, resume its run and wait until it acts."""
        self._wait_for_progress(_ROBOT_KILL)
        robot = self._testbed.robot
        fault = self._testbed.note_fault("robot_killed", ROBOT, robot.process.kill())
        self._narrator.killed("robot", robot.process, "the robot's own process")
        robot.resume()
        self._narrator.started_robot("--resume")
        fault.usable_at = resumed_at = robot.process.spawned_at
        self._wait_for_decision(lambda row: row.at >= resumed_at, "the robot acting again")

    def _start_cloud(self) -> float:
        """Start the cloud service and wait until it listens; return how long it took in s."""
        self._cloud.start()
        self._narrator.started_cloud()
        self._wait(lambda: self._cloud.ready_at is not None, "the cloud service listening")
        return self._cloud.start_s

    # -- waiting -------------------------------------------------------------------------------

    def _wait_for_progress(self, fraction: float) -> None:
        robot = self._testbed.robot
        step = int(fraction * robot.steps)
        expected_s = robot.steps / robot.rate_hz
        self._wait(lambda: robot.steps_done >= step, f"step {step} of the run", expected_s)

    def _wait_for_decision(self, wanted: Callable[[Decision], bool], what: str) -> Decision:
        """Wait for a row in the robot's table, and return it."""
        decisions = self._testbed.robot.decisions
        self._wait(lambda: any(map(wanted, decisions)), what)
        return next(filter(wanted, decisions))

    def _wait(self, done: Callable[[], bool], what: str, expected_s: float = 0.0) -> None:
        robot = self._testbed.robot_or_none

        def is_over() -> bool:
            return done() or (robot is not None and robot.is_done)

        self._testbed.wait_until(is_over, what, expected_s + _PATIENCE_S)
        if not done():
            raise NoProgressError(
                f"the robot's run was over before {what}; the logs are in {self._testbed.directory}"
            )
