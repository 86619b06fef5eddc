"""Services die, hang, come back and die again: decisions stay those of a run without faults.

Each run is compared, bit for bit, with an undisturbed one; each task action was performed once, in
order, which the world itself has witnessed; and the statuses passed are the thesis's.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from tests.processes.faults import (
    COMMAND,
    HERE,
    KEEP_ALIVE,
    LOCAL_RECOVERY,
    LOST,
    LOST_AGAIN,
    PATIENT,
    PROBLEMS,
    QUICK,
    RECOVERY,
    RESTORED,
    References,
    Site,
    Story,
    document_of,
    events_of,
    sensing_steps,
    services_in_order,
    wait_for_end,
)

from holdfast.planning.settings import OffloadSettings

PEG = "peg_in_hole_2d"
OTHERS = [pytest.param(name, marks=pytest.mark.slow) for name in PROBLEMS if name != PEG]
PEG_AND_SLOWLY_ALL = [PEG, *OTHERS]

GATED = {
    **document_of(PEG, max_steps=40),
    "problem": "gated_problem:GatedPeg",
    "problem_directory": str(HERE),
}
SIMULATOR = GATED["simulator"]
SERVES_GATED = ("--problem", "gated_problem:GatedPeg", "--problem-directory", str(HERE))


class TestCloud:
    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_killed_and_started_again(
        self, problem: str, site: Site, references: References
    ) -> None:
        document = document_of(problem)
        struck, later = sensing_steps(document)[2:5:2]
        cloud = site.service().start()
        story = Story(site, references, document)
        # In mid-sensing: the robot needs the next decision as soon as it has sensed.
        story.at("sense", struck, cloud.kill)
        story.at("perform", later, cloud.start, story.status(KEEP_ALIVE))
        robot = story.run(cloud)
        assert robot.statuses() == [LOST, RESTORED]
        assert len(robot.matching("launch")) == 1
        assert robot.matching("launched")[0]["launch_ms"] > 0.0
        assert robot.matching("status")[1]["outage_ms"] > 0.0

    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_stopped_for_longer_than_the_timeout(
        self, problem: str, site: Site, references: References
    ) -> None:
        document = document_of(problem)
        struck, later = sensing_steps(document)[2:5:2]
        cloud = site.service(lease_ms=QUICK["lease_ms"]).start()
        story = Story(site, references, document, offload=QUICK)
        story.at("sense", struck, cloud.stop)
        story.at("perform", later, cloud.resume, story.status(KEEP_ALIVE))
        robot = story.run(cloud)
        assert robot.statuses() == [LOST, RESTORED]
        # It was its silence that gave it away, before its link was given up.
        assert "no sign of progress" in robot.matching("service_suspected")[0]["reason"]

    def test_given_up_after_its_own_lease(self, site: Site, references: References) -> None:
        """How long it may be silent it says itself, and the robot's own lease is of no account."""
        cloud = site.service(lease_ms=300.0).start()
        story = Story(site, references, document_of(PEG), offload={"lease_ms": 60_000.0})

        # While nothing is awaited of it, only the link can tell.
        def wait_until_it_is_given_up() -> None:
            story.running.wait_for("service_vanished", service=cloud.endpoint)

        story.at("perform", 12, cloud.stop, wait_until_it_is_given_up, cloud.resume)
        story.run(cloud)

    def test_with_the_settings_that_nobody_has_chosen(
        self, site: Site, references: References
    ) -> None:
        document = document_of(PEG)
        steps = sensing_steps(document)
        defaults = OffloadSettings()
        cloud = site.service(lease_ms=400.0).start()
        offload = {key: getattr(defaults, key) for key in PATIENT}
        story = Story(site, references, document, offload=offload)
        story.at("sense", steps[1], cloud.stop)
        story.at("perform", steps[3], cloud.resume, story.status(KEEP_ALIVE))
        story.at("sense", steps[5], cloud.kill)
        robot = story.run(cloud)
        # On a busy machine a quarter of a second may also pass without a fault.
        assert robot.statuses()[:2] == [LOST, RESTORED]

    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    @pytest.mark.slow
    def test_stopped_for_shorter_than_the_timeout(
        self, problem: str, site: Site, references: References
    ) -> None:
        document = document_of(problem)
        cloud = site.service().start()
        story = Story(site, references, document)
        timers: list[threading.Timer] = []

        def stop_for_a_while() -> None:
            cloud.stop()
            timers.append(threading.Timer(0.4, cloud.resume))
            timers[-1].start()

        for struck in sensing_steps(document)[1:4]:
            story.at("sense", struck, stop_for_a_while)
        robot = story.run(cloud)
        for timer in timers:
            timer.join()
        assert robot.statuses() == []
        assert not robot.matching("service_suspected")
        assert not robot.matching("launch")

    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_never_there(self, problem: str, site: Site, references: References) -> None:
        story = Story(site, references, document_of(problem), offload={"startup_timeout_ms": 200.0})
        robot = story.run(site.service())
        assert robot.statuses() == [LOST]

    def test_late_but_within_the_time_for_starting(
        self, site: Site, references: References
    ) -> None:
        story = Story(site, references, document_of(PEG))
        cloud = site.service()
        story.at("begin", 0, cloud.start)
        robot = story.run(cloud)
        assert robot.statuses() == []

    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_killed_before_the_first_request(
        self, problem: str, site: Site, references: References
    ) -> None:
        document = document_of(problem)
        cloud = site.service().start()
        story = Story(site, references, document)
        # The trial's world is being made: the cloud is seen already, and nothing was asked of it.
        story.at(
            "begin",
            0,
            lambda: story.running.wait_for("service_appeared"),
            cloud.kill,
            lambda: story.running.wait_for("service_vanished"),
        )
        later = sensing_steps(document)[3]
        story.at("perform", later, cloud.start, story.status(KEEP_ALIVE))
        robot = story.run(cloud)
        assert robot.statuses() == [LOST, RESTORED]

    @pytest.mark.parametrize(
        "holds_at", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (4, 21))]
    )
    def test_killed_during_a_computation(
        self, holds_at: int, site: Site, references: References
    ) -> None:
        gate = site.gate(holds_at)
        cloud = site.service(*SERVES_GATED)
        cloud.variables["HOLDFAST_TEST_GATE"] = str(gate.port)
        cloud.start()
        story = Story(site, references, GATED)
        robot = site.run(story.file, services=[cloud])
        gate.wait()
        cloud.kill()
        story.finish(robot)
        assert robot.statuses() == [LOST]
        assert not robot.matching("refused")

    @pytest.mark.slow  # at a gate, and so for certain: the test above
    @pytest.mark.parametrize("problem", PROBLEMS)
    def test_killed_during_a_long_computation(
        self, problem: str, site: Site, references: References
    ) -> None:
        """Without a gate: decisions long enough for a kill to strike the middle of one."""
        document = document_of(problem, particles=1500, max_steps=36)
        document["active_sensing"]["num_observation_samples"] = 100
        cloud = site.service().start()
        story = Story(site, references, document)
        first = sensing_steps(document)[1]
        # The first move after sensing: the task actions are known, the next sensing is computed.
        story.at("perform", first, cloud.kill)
        robot = story.run(cloud)
        assert robot.statuses() == [LOST]

    @pytest.mark.slow
    def test_hung_while_it_shows_progress(self, site: Site, references: References) -> None:
        gate = site.gate(9)
        cloud = site.service(*SERVES_GATED)
        cloud.variables["HOLDFAST_TEST_GATE"] = str(gate.port)
        cloud.start()
        offload = {"detection_timeout_ms": 1500.0, "decision_timeout_ms": 1500.0}
        story = Story(site, references, GATED, offload=offload)
        robot = story.run(cloud)
        assert robot.statuses()[0] == LOST
        reason = robot.matching("service_suspected")[0]["reason"]
        assert reason == "a decision took longer than 1500 ms"

    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_killed_again_after_it_was_used_again(
        self, problem: str, site: Site, references: References
    ) -> None:
        document = document_of(problem)
        steps = sensing_steps(document)
        cloud = site.service().start()
        story = Story(site, references, document)
        story.at("sense", steps[1], cloud.kill)
        story.at("perform", steps[2], cloud.start, story.status(KEEP_ALIVE, 1))
        # This time while it moves, and found before anything is asked.
        story.at("perform", steps[3] + 1, cloud.kill, story.status(LOCAL_RECOVERY, 2))
        story.at("perform", steps[4], cloud.start, story.status(KEEP_ALIVE, 2))
        story.at("sense", steps[5], cloud.kill)
        robot = story.run(cloud)
        assert robot.statuses() == [LOST, RESTORED, LOST_AGAIN, RESTORED, LOST_AGAIN]
        # The local service stays ready: it is launched once.
        assert len(robot.matching("launch")) == 1

    @pytest.mark.slow
    @pytest.mark.parametrize("problem", PROBLEMS)
    @pytest.mark.parametrize("seed", range(4))
    def test_killed_and_stopped_at_random(
        self, problem: str, seed: int, site: Site, references: References
    ) -> None:
        document = document_of(problem, trials=2)
        random = np.random.default_rng([seed, PROBLEMS.index(problem)])
        cloud = site.service(lease_ms=QUICK["lease_ms"]).start()
        story = Story(site, references, document, offload=QUICK)
        for trial in range(2):
            steps = np.sort(random.choice(np.arange(1, 55), 6, replace=False)).tolist()
            for struck, later in zip(steps[::2], steps[1::2], strict=True):
                if random.random() < 0.5:
                    story.at("perform", struck, cloud.kill, trial=trial)
                    story.at("perform", later, cloud.start, trial=trial)
                else:
                    story.at("perform", struck, cloud.stop, trial=trial)
                    story.at("perform", later, cloud.resume, trial=trial)
        robot = story.run(cloud)
        assert set(robot.statuses()) <= {LOST, RESTORED, LOST_AGAIN}


class TestRecovery:
    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_killed_together_with_the_cloud(
        self, problem: str, site: Site, references: References
    ) -> None:
        document = document_of(problem)
        steps = sensing_steps(document)
        cloud = site.service().start()
        story = Story(site, references, document)

        def kill_both() -> None:
            pid = story.running.recovery_pid()
            os.kill(pid, signal.SIGKILL)
            cloud.kill()
            wait_for_end(pid)

        story.at("sense", steps[1], cloud.kill)
        story.at("perform", steps[2], cloud.start, story.status(KEEP_ALIVE))
        story.at("sense", steps[3], kill_both)
        story.at("perform", steps[4], cloud.start, story.status(KEEP_ALIVE, 2))
        robot = story.run(cloud)
        assert robot.statuses() == [LOST, RESTORED, LOST_AGAIN, RESTORED]
        assert len(robot.matching("launched")) == 2

    @pytest.mark.slow
    def test_killed_while_the_cloud_is_away(self, site: Site, references: References) -> None:
        document = document_of(PEG)
        steps = sensing_steps(document)
        cloud = site.service().start()
        story = Story(site, references, document)

        def kill_recovery() -> None:
            pid = story.running.recovery_pid()
            os.kill(pid, signal.SIGKILL)
            wait_for_end(pid)

        story.at("sense", steps[1], cloud.kill)
        for step in steps[2:5]:
            story.at("sense", step, kill_recovery)
        robot = story.run(cloud)
        assert robot.statuses() == [LOST]
        assert len(robot.matching("launched")) == 4

    @pytest.mark.slow
    def test_stopped_while_the_cloud_is_away(self, site: Site, references: References) -> None:
        """It hangs, so another one takes its place."""
        document = document_of(PEG)
        steps = sensing_steps(document)
        cloud = site.service().start()
        story = Story(site, references, document, offload=QUICK)
        story.at("sense", steps[1], cloud.kill)
        story.at("sense", steps[3], lambda: os.kill(story.running.recovery_pid(), signal.SIGSTOP))
        robot = story.run(cloud)
        assert robot.statuses() == [LOST]
        assert len(robot.matching("launched")) == 2

    @pytest.mark.slow
    def test_at_start_it_is_ready_before_it_is_needed(
        self, site: Site, references: References
    ) -> None:
        document = document_of(PEG)
        cloud = site.service().start()
        story = Story(site, references, document, recovery={"launch": "at_start"})
        story.at("begin", 0, lambda: story.running.wait_for("launched"))
        story.at("sense", sensing_steps(document)[2], cloud.kill)
        robot = story.run(cloud)
        assert robot.statuses() == [LOST]
        names = [event["event"] for event in events_of(robot.out)]
        assert names.index("launched") < names.index("status")
        assert "holding" not in names

    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_never_holds_until_the_cloud_is_back(
        self, problem: str, site: Site, references: References
    ) -> None:
        document = document_of(problem)
        cloud = site.service().start()
        story = Story(site, references, document, recovery={"launch": "never"})
        story.at(
            "sense",
            sensing_steps(document)[2],
            cloud.kill,
            lambda: story.running.wait_for("service_vanished"),
        )
        robot = site.run(story.file, services=[cloud])
        held = robot.wait_for("holding")
        assert held["reason"] == f"{cloud.endpoint}: is not there"
        assert held["step"] == sensing_steps(document)[2]
        cloud.start()
        story.finish(robot)
        assert robot.matching("resumed")[0]["held_ms"] > 0.0
        assert robot.statuses() == []
        assert not robot.matching("launch")

    @pytest.mark.parametrize(
        ("program", "reason"),
        [
            pytest.param(
                *(None, "cannot be started: No such file or directory"), marks=pytest.mark.slow
            ),
            ("exit 3", "ended with exit code 3; see "),
            pytest.param("exec sleep 1000", "not seen after ", marks=pytest.mark.slow),
        ],
        ids=["absent", "failing", "hanging"],
    )
    def test_cannot_be_launched(
        self, program: str | None, reason: str, site: Site, references: References
    ) -> None:
        """The installation breaks while the robot runs, and is mended later."""
        document = document_of(PEG)
        steps = sensing_steps(document)
        cloud = site.service().start()
        story = Story(
            site,
            references,
            document,
            recovery={"launch_timeout_ms": 300.0, "relaunch_delay_ms": 50.0},
        )
        python = installation_in(site.directory)
        whole = python.with_name("whole")

        def break_it() -> None:
            python.rename(whole)
            if program is not None:
                python.write_text(f"#!/bin/sh\n{program}\n")
                python.chmod(0o755)

        def mend_it() -> None:
            python.unlink(missing_ok=True)
            whole.rename(python)

        story.at("sense", steps[2], break_it, cloud.kill)
        robot = site.run(story.file, services=[cloud], command=[str(python), *COMMAND[1:]])
        failed = "launch_failed" if program == "exec sleep 1000" else "recovery_exited"
        # Again and again, and the robot stands still and says so.
        assert reason in robot.wait_for(failed, 3)["reason"]
        assert RECOVERY in robot.wait_for("holding")["reason"]
        # It goes on as soon as anything answers: first the cloud, then the mended service.
        story.at("sense", steps[4], mend_it, cloud.kill)
        cloud.start()
        story.finish(robot)
        assert robot.statuses() == [LOST, RESTORED, LOST_AGAIN]
        assert len(robot.matching("launched")) == 1


def installation_in(directory: Path) -> Path:
    """Return a Python of its own with all that is installed here."""
    home = directory / "installation"
    (home / "bin").mkdir(parents=True)
    shutil.copy(Path(sys.prefix) / "pyvenv.cfg", home / "pyvenv.cfg")
    (home / "lib").symlink_to(Path(sys.prefix) / "lib")
    python = home / "bin" / "python"
    python.symlink_to(Path(sys.executable).resolve())
    return python


@pytest.mark.slow
class TestDeadline:
    def test_a_late_decision_is_taken_from_the_local_service(
        self, site: Site, references: References
    ) -> None:
        gate = site.gate(12)
        cloud = site.service(*SERVES_GATED)
        cloud.variables["HOLDFAST_TEST_GATE"] = str(gate.port)
        cloud.start()
        story = Story(
            site,
            references,
            GATED,
            offload={"decision_deadline_ms": 500.0, "max_hedged_share": 1.0},
            recovery={"launch": "at_start"},
        )
        story.at("begin", 0, lambda: story.running.wait_for("launched"))
        robot = story.run(cloud)
        # The cloud computes and says so: nothing is wrong with it but its pace.
        assert robot.statuses() == []
        assert robot.matching("hedge")[0]["waited_ms"] >= 500.0
        services = {
            line.split(",")[3] for line in (robot.out / "timings.csv").read_text().splitlines()[1:]
        }
        assert services == {cloud.endpoint, RECOVERY}


@pytest.mark.slow
class TestAnotherService:
    """In the place of the service that was lost comes one that does not know the problem."""

    def test_the_local_service_decides_until_the_right_one_comes(
        self, site: Site, references: References
    ) -> None:
        cloud = site.service(*SERVES_GATED).start()
        # Something is asked at each step.
        story = Story(
            site, references, GATED | {"simulator": {**SIMULATOR, "sensing_intervals": 0}}
        )
        last = SIMULATOR["max_steps"] - 10

        def start_without_the_problem() -> None:
            cloud.options = tuple(each for each in cloud.options if each not in SERVES_GATED)
            cloud.start()
            story.running.wait_for("service_appeared", 2, service=cloud.endpoint)

        def give_time() -> None:
            # Who just started may ask for patience, and is then asked with a later question.
            if not story.running.matching("refused", service=cloud.endpoint):
                time.sleep(0.1)

        def start_the_right_one() -> None:
            cloud.kill()
            cloud.options = (*cloud.options, *SERVES_GATED)
            cloud.start()

        # The next decision is awaited as soon as the robot has sensed.
        story.at("sense", 1, cloud.kill, start_without_the_problem)
        for step in range(2, last):
            story.at("perform", step, give_time)
        story.at("perform", last, start_the_right_one, story.status(KEEP_ALIVE))
        robot = story.run(cloud)
        assert robot.statuses() == [LOST, RESTORED]
        told = robot.matching("refused", service=cloud.endpoint)
        assert told, robot.account()
        assert all("gated_problem:GatedPeg" in event["reason"] for event in told)

    def test_without_a_local_service_the_run_ends_says_why_and_can_go_on(
        self, site: Site, references: References
    ) -> None:
        cloud = site.service(*SERVES_GATED).start()
        steps = sensing_steps(GATED)
        story = Story(site, references, GATED, recovery={"launch": "never"})

        def start_without_the_problem() -> None:
            cloud.options = tuple(each for each in cloud.options if each not in SERVES_GATED)
            cloud.start()
            story.running.wait_for("service_appeared", 2, service=cloud.endpoint)

        story.at("sense", steps[1], cloud.kill, start_without_the_problem)
        robot = site.run(story.file, services=[cloud])
        assert robot.wait() == 2
        (told,) = robot.matching("error")
        assert told["reason"].startswith(f"no service will decide: {cloud.endpoint}: ")
        assert "problem gated_problem:GatedPeg: is not known to this service" in told["reason"]
        assert "(--problem)" in told["reason"]
        assert story.world.step == steps[1]
        cloud.kill()
        cloud.options = (*cloud.options, *SERVES_GATED)
        cloud.start()
        story.finish(site.run(story.file, services=[cloud], resume=True))


class TestReplicas:
    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_killed_in_turn(self, problem: str, site: Site, references: References) -> None:
        document = document_of(problem)
        steps = sensing_steps(document)
        first, second = site.service().start(), site.service().start()
        story = Story(site, references, document)
        story.at("begin", 0, story.seen(first), story.seen(second))
        story.at("sense", steps[1], first.kill)
        story.at("perform", steps[2], first.start, story.seen(first, 2))
        story.at("sense", steps[3], second.kill)
        story.at("perform", steps[4], second.start, story.seen(second, 2))
        story.at("sense", steps[5], first.kill)
        robot = story.run(first, second)
        # One of them could always be asked, so nothing else was needed.
        assert robot.statuses() == []
        assert not robot.matching("launch")
        deciding = services_in_order(robot)
        assert deciding == [first.endpoint, second.endpoint, first.endpoint, second.endpoint]

    @pytest.mark.slow  # one after the other: the test above; together: the simulator
    def test_both_at_once(self, site: Site, references: References) -> None:
        document = document_of(PEG)
        steps = sensing_steps(document)
        first, second = site.service().start(), site.service().start()
        story = Story(site, references, document)
        story.at("begin", 0, story.seen(first), story.seen(second))
        story.at("sense", steps[1], first.kill, second.kill)
        story.at("perform", steps[3], second.start, story.status(KEEP_ALIVE))
        robot = story.run(first, second)
        assert robot.statuses() == [LOST, RESTORED]
        assert services_in_order(robot)[-1] == second.endpoint

    def test_the_preferred_one_is_only_stopped(self, site: Site, references: References) -> None:
        document = document_of(PEG)
        steps = sensing_steps(document)
        first, second = site.service().start(), site.service().start()
        story = Story(site, references, document, offload=QUICK)
        # Nobody takes the place of one that is not there yet but the local service.
        story.at("begin", 0, story.seen(first), story.seen(second))
        story.at("sense", steps[1], first.stop)
        story.at("perform", steps[3], first.resume)
        robot = story.run(first, second)
        assert robot.statuses() == []
        assert second.endpoint in services_in_order(robot)
