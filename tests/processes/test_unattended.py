"""A robot or a service that nobody looks after: whatever starts it again also watches it.

The commands are real processes, the service manager is a real socket, and health is asked by HTTP.
"""

import os
import shutil
import signal
import tempfile
import time
import urllib.request
from pathlib import Path

import pytest
from tests.notify_socket import NotifySocket
from tests.ports import free_port
from tests.processes.faults import (
    COMMAND,
    KEEP_ALIVE,
    LOCAL_RECOVERY,
    PATIENCE_S,
    STANDARD,
    Process,
    References,
    Site,
    Story,
    assert_identical,
    document_of,
    page,
    sensing_steps,
    services_in_order,
    wait_until,
)

PEG = "peg_in_hole_2d"
STARTING, HOLDING, ENDING = "starting", "holding still", "ending"
HEALTH = ("--health", "0")
BOOT_ID = "/proc/sys/kernel/random/boot_id"

BEAT_S = 0.05
WATCHED = {"WATCHDOG_USEC": str(round(2e6 * BEAT_S))}

# The simulated world is on the robot's loop, and so that stands still with it.
STUCK = """
import threading
from pathlib import Path

from holdfast.problems.capsule_robot import CapsuleRobot


class Stuck(CapsuleRobot):
    name = "stuck"

    def move(self, *arguments):
        on_loop = threading.current_thread() is threading.main_thread()
        if on_loop and Path("stuck").exists():
            Path("reached").touch()
            while Path("stuck").exists():
                pass
        return super().move(*arguments)
"""


def health_of(robot: Process, path: str) -> tuple[int, str]:
    """Ask a robot how it is."""
    return page(robot.wait_for("offers")["health"], path)


def variables_of(pid: int) -> set[str]:
    """Return the names of the variables that a process was started with."""
    text = Path(f"/proc/{pid}/environ").read_bytes().decode()
    return {line.partition("=")[0] for line in text.split("\0")}


def beats_in(manager: NotifySocket, seconds: float) -> int:
    """Return how often it is told from now on, in that time, that a loop moves."""
    manager.hear_out()
    before = manager.count("WATCHDOG=1")
    time.sleep(seconds)
    return manager.count("WATCHDOG=1") - before


def child_of(process: Process) -> int:
    """Return the id of the process that another one has started."""
    pid = process.pid
    (child,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return int(child)


class TestRestart:
    """``--restart``, as the first process of a container.

    What is not started again: unit/test_cli_restart.py, and after a reboot deploy/test_compose.py.
    """

    OPTIONS = ("--resume-if-begun", "--restart", "--rate", "2000")

    def test_a_robot_that_is_killed_goes_on_with_nobody_there(
        self, site: Site, references: References
    ) -> None:
        document = document_of(PEG, max_steps=60, trials=2)
        cloud = site.service().start()
        story = Story(site, references, document)

        def kill() -> None:
            os.kill(child_of(story.running), signal.SIGKILL)

        story.at("begin", 0, kill)
        story.at("perform", 30, kill, trial=1, afterwards=True)
        robot = site.run(story.file, *self.OPTIONS, services=[cloud])
        assert robot.wait() == 0, robot.account()
        told = robot.matching("process_ended")
        assert [event["reason"] for event in told] == ["was ended by SIGKILL"] * 2
        story.finish(robot)


class TestHealth:
    def test_of_a_robot_whose_only_service_is_killed_and_started_again(
        self, site: Site, references: References
    ) -> None:
        document = document_of(PEG)
        steps = sensing_steps(document)
        cloud = site.service()
        story = Story(site, references, document, recovery={"launch": "never"})
        seen = []

        def look() -> None:
            assert health_of(story.running, "/livez") == (200, "ok\n")
            seen.append(health_of(story.running, "/readyz"))

        story.at("perform", steps[1], look, cloud.kill)
        story.at("perform", steps[3], look, lambda: story.running.signal(signal.SIGTERM))
        robot = site.run(story.file, *HEALTH, services=[cloud])
        look()
        cloud.start()
        robot.wait_for("holding")
        look()
        cloud.start()
        assert robot.wait() == 128 + signal.SIGTERM
        ready = (200, f"{STANDARD}\n")
        assert seen == [(503, f"{STARTING}\n"), ready, (503, f"{HOLDING}\n"), ready]
        story.finish(site.run(story.file, services=[cloud], resume=True))

    def test_of_one_with_a_local_service_that_is_asked_to_end(
        self, site: Site, references: References
    ) -> None:
        document = document_of(PEG)
        steps = sensing_steps(document)
        cloud = site.service().start()
        story = Story(site, references, document)

        def is_said(status: int, word: str) -> None:
            expected = (status, f"{word}\n")
            wait_until(lambda: health_of(story.running, "/readyz") == expected, word)

        story.at("perform", steps[1], lambda: is_said(200, STANDARD), cloud.kill)
        story.at("perform", steps[3], lambda: is_said(200, LOCAL_RECOVERY), cloud.start)
        story.at("perform", steps[5], story.status(KEEP_ALIVE), lambda: is_said(200, KEEP_ALIVE))
        story.at(
            *("perform", steps[6]),
            lambda: story.running.signal(signal.SIGTERM),
            lambda: is_said(503, ENDING),
        )
        robot = site.run(story.file, *HEALTH, services=[cloud])
        assert robot.wait() == 128 + signal.SIGTERM
        (interrupted,) = robot.matching("interrupted")
        assert "--health 127.0.0.1:0 " in interrupted["resume_command"]
        story.finish(site.run(story.file, *HEALTH, services=[cloud], resume=True))

    def test_metrics_of_a_robot(self, site: Site, references: References) -> None:
        """One address has health and metrics, and the counts are those of the run."""
        document = document_of(PEG, max_steps=40, trials=2)
        cloud = site.service().start()
        address = f"127.0.0.1:{free_port()}"
        story = Story(site, references, document)
        seen: list[str] = []

        def look() -> None:
            assert health_of(story.running, "/readyz") == (200, f"{STANDARD}\n")
            with urllib.request.urlopen(f"http://{address}/metrics", timeout=PATIENCE_S) as answer:
                assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
                seen.append(answer.read().decode())

        story.at("perform", 20, look, trial=1)
        robot = site.run(story.file, "--health", address, "--metrics", address, services=[cloud])
        assert robot.wait() == 0, robot.account()
        story.finish(robot)
        (text,) = seen
        sensing = sum(step <= 20 for step in sensing_steps(document)) + len(sensing_steps(document))
        name = cloud.endpoint
        told = dict(line.rsplit(" ", 1) for line in text.splitlines() if line[:1] != "#")
        decided = told[f'holdfast_robot_decisions_total{{kind="sensing",service="{name}"}}']
        assert float(decided) == sensing
        assert float(told["holdfast_robot_trial"]) == 1.0
        assert float(told['holdfast_robot_trials_total{outcome="truncated"}']) == 1.0
        assert float(told["holdfast_robot_step"]) in (20.0, 21.0)

    def test_a_port_that_is_taken_leaves_no_run(self, site: Site) -> None:
        document = document_of(PEG)
        service = site.service("--health", "0").start()
        (taken,) = (event["health"] for event in service.process.matching("ready"))
        file = site.configure(document)
        robot = site.run(file, "--rate", "100", "--health", taken)
        assert robot.wait() == 2
        assert f"health or metrics at {taken}: another program listens there" in robot.output
        site.run(file, "--rate", "10000").finish()


class TestServiceManager:
    def test_of_a_robot(self, site: Site, references: References) -> None:
        document = document_of(PEG)
        steps = sensing_steps(document)
        cloud = site.service().start()
        story = Story(site, references, document)
        begun = []
        with NotifySocket(abstract=True) as manager:

            def starts() -> None:
                manager.wait_for("WATCHDOG=1", 3)
                assert manager.count("READY=1") == 0
                assert manager.count(f"STATUS={STARTING}") == 1

            def decides() -> None:
                manager.wait_for("READY=1")
                manager.wait_for(f"STATUS={STANDARD}, trial 0")

            def recovers() -> None:
                begun.append(variables_of(story.running.recovery_pid()))
                manager.wait_for(f"STATUS={LOCAL_RECOVERY}, trial 0")

            def ends() -> None:
                assert manager.count("STOPPING=1") == 0
                story.running.signal(signal.SIGTERM)
                manager.wait_for("STOPPING=1")

            story.at("begin", 0, starts)
            story.at("perform", steps[1], decides, cloud.kill)
            story.at("perform", steps[2], recovers, ends)
            variables = manager.variables | WATCHED
            robot = site.run(story.file, services=[cloud], variables=variables)
            assert robot.wait() == 128 + signal.SIGTERM
            manager.wait_for("WATCHDOG_USEC=0")
            assert manager.count("READY=1") == 1
            assert manager.messages[-1] == ["WATCHDOG_USEC=0"]
        (names,) = begun
        assert "PATH" in names
        assert names.isdisjoint(("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"))
        cloud.start()
        # Nobody listens any more: that is no reason not to run.
        story.finish(site.run(story.file, services=[cloud], variables=variables, resume=True))

    def test_a_robot_whose_loop_stands_still_is_found(self, site: Site) -> None:
        (site.directory / "stuck_problem.py").write_text(STUCK)
        document = document_of("capsule_robot") | {"problem": "stuck_problem:Stuck"}
        file = site.configure(document)
        stuck, reached = site.directory / "stuck", site.directory / "reached"
        with NotifySocket() as manager:
            robot = site.run(file, "--rate", "20", variables=manager.variables | WATCHED)
            manager.wait_for("READY=1")
            stuck.touch()
            wait_until(reached.exists, "the loop to stand still")
            assert beats_in(manager, 20 * BEAT_S) == 0
            stuck.unlink()
            manager.wait_for("WATCHDOG=1", manager.count("WATCHDOG=1") + 3)
            robot.signal(signal.SIGTERM)
            robot.wait()

    def test_of_a_run_that_is_complete_or_a_batch(self, site: Site) -> None:
        file = site.configure(document_of(PEG, trials=2))
        for options in (("--jobs", "1"), ()):
            with NotifySocket() as manager:
                robot = site.process(
                    *(*COMMAND, "run", str(file), "--out", "out", "--resume-if-begun", *options),
                    variables=manager.variables | WATCHED,
                )
                assert robot.wait() == 0, robot.account()
                manager.wait_for("WATCHDOG_USEC=0")
                assert manager.lines == ["READY=1", "WATCHDOG_USEC=0"]

    def test_of_a_service(self, site: Site, keys: Path, references: References) -> None:
        with NotifySocket() as manager:
            cloud = site.service(
                *("--tls", str(keys / "ours" / "service")), endpoint="tls/127.0.0.1:0"
            )
            cloud.variables = manager.variables | WATCHED
            cloud.start()
            manager.wait_for("READY=1")
            manager.wait_for("STATUS=serving, 0 sessions")
            manager.wait_for("WATCHDOG=1", 3)
            cloud.stop()
            # What was sent before has been read when this is.
            assert beats_in(manager, 20 * BEAT_S) <= 1
            assert beats_in(manager, 20 * BEAT_S) == 0
            cloud.resume()
            manager.wait_for("WATCHDOG=1", manager.count("WATCHDOG=1") + 1)
            cloud.process.signal(signal.SIGHUP)
            manager.wait_for("READY=1", 2)
            (reloading,) = (each for each in manager.messages if each[0] == "RELOADING=1")
            at_us = int(reloading[1].removeprefix("MONOTONIC_USEC="))
            assert 0 < at_us <= time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000

            (where,) = cloud.process.matching("ready")[0]["listen"]
            document = document_of(PEG, max_steps=20)
            story = Story(site, references, document)
            story.at("perform", 10, lambda: manager.wait_for("STATUS=serving, 1 session"))
            story.run(where, options=("--tls", str(keys / "ours" / "robot")))

            cloud.process.signal(signal.SIGTERM)
            assert cloud.process.wait() == 0
            manager.wait_for("STOPPING=1")
            (stopping,) = (each for each in manager.messages if each[0] == "STOPPING=1")
            assert int(stopping[1].removeprefix("EXTEND_TIMEOUT_USEC=")) > 5_000_000

    def test_of_several_processes(self, site: Site) -> None:
        with NotifySocket() as manager:
            cloud = site.service("--processes", "2")
            cloud.variables = manager.variables | WATCHED
            cloud.start()
            manager.wait_for("READY=1")
            manager.wait_for("STATUS=serving, 0 sessions at 2 of 2 processes")
            manager.wait_for("WATCHDOG=1", 3)
            pid = cloud.process.pid
            for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
                assert variables_of(int(child)).isdisjoint(manager.variables | WATCHED)
                os.kill(int(child), signal.SIGKILL)
            cloud.process.wait_for("process_started", 2)
            cloud.process.signal(signal.SIGTERM)
            assert cloud.process.wait() == 0
            manager.wait_for("STOPPING=1")
            assert manager.count("READY=1") == 1  # none of them speaks for all


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can hand files to another user")
def test_credentials_of_which_another_user_is_the_owner(keys: Path, references: References) -> None:
    """As systemd (LoadCredential=) and a cluster hand them over: root's, and read-only."""
    nobody = 65534
    as_nobody = ("setpriv", f"--reuid={nobody}", f"--regid={nobody}", "--clear-groups")
    # Not below pytest's own directories, which no other user may enter.
    with tempfile.TemporaryDirectory() as name, Site(Path(name)) as site:
        os.chown(site.directory, nobody, nobody)
        for role in ("robot", "service"):
            theirs = Path(shutil.copytree(keys / "ours" / role, site.directory / role))
            for path in (*theirs.iterdir(), theirs):
                os.chown(path, 0, nobody)
                path.chmod(0o550 if path == theirs else 0o440)
        cloud = site.service("--tls", "service", endpoint=f"tls/localhost:{free_port()}")
        cloud.command = (*as_nobody, *cloud.command)
        cloud.start()
        cloud.process.signal(signal.SIGHUP)
        cloud.process.wait_for("credentials_reloaded")
        document = document_of(PEG, max_steps=20)
        file = site.configure(document, recovery={"launch": "never"})
        options = ("--tls", site.directory / "robot", "--rate", "10000")
        robot = site.run(file, *options, services=[cloud], command=(*as_nobody, *COMMAND))
        robot.finish()
        for process in (robot, cloud.process):
            assert process.matching("credentials") == []
        assert services_in_order(robot) == [cloud.endpoint]
        assert_identical(robot.out, references(document))
