"""Services die, hang, come back and die again: decisions stay those of a run without faults.

Each run is compared, bit for bit, with an undisturbed one; each task action was performed once, in
order, which the world itself has witnessed; and the statuses passed are the thesis's.
"""

import os
import signal

import pytest
from tests.processes import faults

from holdfast.planning.settings import OffloadSettings

PEG = "peg_in_hole_2d"
OTHERS = [pytest.param(name, marks=pytest.mark.slow) for name in faults.PROBLEMS if name != PEG]
PEG_AND_SLOWLY_ALL = [PEG, *OTHERS]

GATED = {
    **faults.document_of(PEG, max_steps=40),
    "problem": "gated_problem:GatedPeg",
    "problem_directory": str(faults.HERE),
}
SERVES_GATED = ("--problem", "gated_problem:GatedPeg", "--problem-directory", str(faults.HERE))


class TestCloud:
    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_stopped_for_longer_than_the_timeout(
        self, problem: str, site: faults.Site, references: faults.References
    ) -> None:
        document = faults.document_of(problem)
        struck, later = faults.sensing_steps(document)[2:5:2]
        cloud = site.service(lease_ms=faults.QUICK["lease_ms"]).start()
        story = faults.Story(site, references, document, offload=faults.QUICK)
        story.at("sense", struck, cloud.stop)
        story.at("perform", later, cloud.resume, story.status(faults.KEEP_ALIVE))
        robot = story.run(cloud)
        assert robot.statuses() == [faults.LOST, faults.RESTORED]
        # It was its silence that gave it away, before its link was given up.
        assert "no sign of progress" in robot.matching("service_suspected")[0]["reason"]

    def test_with_the_settings_that_nobody_has_chosen(
        self, site: faults.Site, references: faults.References
    ) -> None:
        document = faults.document_of(PEG)
        steps = faults.sensing_steps(document)
        defaults = OffloadSettings()
        cloud = site.service(lease_ms=400.0).start()
        offload = {key: getattr(defaults, key) for key in faults.PATIENT}
        story = faults.Story(site, references, document, offload=offload)
        story.at("sense", steps[1], cloud.stop)
        story.at("perform", steps[3], cloud.resume, story.status(faults.KEEP_ALIVE))
        story.at("sense", steps[5], cloud.kill)
        robot = story.run(cloud)
        # On a busy machine a quarter of a second may also pass without a fault.
        assert robot.statuses()[:2] == [faults.LOST, faults.RESTORED]

    @pytest.mark.parametrize(
        "holds_at", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (4, 21))]
    )
    def test_killed_during_a_computation(
        self, holds_at: int, site: faults.Site, references: faults.References
    ) -> None:
        gate = site.gate(holds_at)
        cloud = site.service(*SERVES_GATED)
        cloud.variables["HOLDFAST_TEST_GATE"] = str(gate.port)
        cloud.start()
        story = faults.Story(site, references, GATED)
        robot = site.run(story.file, services=[cloud])
        gate.wait()
        cloud.kill()
        story.finish(robot)
        assert robot.statuses() == [faults.LOST]
        assert not robot.matching("refused")


class TestRecovery:
    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_the_cloud_is_killed_and_then_both(
        self, problem: str, site: faults.Site, references: faults.References
    ) -> None:
        document = faults.document_of(problem)
        steps = faults.sensing_steps(document)
        cloud = site.service().start()
        story = faults.Story(site, references, document)

        def kill_both() -> None:
            pid = story.running.recovery_pid()
            os.kill(pid, signal.SIGKILL)
            cloud.kill()
            faults.wait_for_end(pid)

        story.at("sense", steps[1], cloud.kill)
        story.at("perform", steps[2], cloud.start, story.status(faults.KEEP_ALIVE))
        story.at("sense", steps[3], kill_both)
        story.at("perform", steps[4], cloud.start, story.status(faults.KEEP_ALIVE, 2))
        robot = story.run(cloud)
        assert robot.statuses() == [
            faults.LOST,
            faults.RESTORED,
            faults.LOST_AGAIN,
            faults.RESTORED,
        ]
        assert [launched["launch_ms"] > 0.0 for launched in robot.matching("launched")] == [
            True
        ] * 2
        assert len(robot.matching("launch")) == 2
        outages = [told["outage_ms"] for told in robot.matching("status", to=faults.KEEP_ALIVE)]
        assert min(outages) > 0.0

    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_never_holds_until_the_cloud_is_back(
        self, problem: str, site: faults.Site, references: faults.References
    ) -> None:
        document = faults.document_of(problem)
        cloud = site.service().start()
        story = faults.Story(site, references, document, recovery={"launch": "never"})
        story.at(
            "sense",
            faults.sensing_steps(document)[2],
            cloud.kill,
            lambda: story.running.wait_for("service_vanished"),
        )
        robot = site.run(story.file, services=[cloud])
        held = robot.wait_for("holding")
        assert held["reason"] == f"{cloud.endpoint}: is not there"
        assert held["step"] == faults.sensing_steps(document)[2]
        cloud.start()
        story.finish(robot)
        assert robot.matching("resumed")[0]["held_ms"] > 0.0
        assert robot.statuses() == []
        assert not robot.matching("launch")


class TestReplicas:
    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_killed_in_turn(
        self, problem: str, site: faults.Site, references: faults.References
    ) -> None:
        document = faults.document_of(problem)
        steps = faults.sensing_steps(document)
        first, second = site.service().start(), site.service().start()
        story = faults.Story(site, references, document)
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
        deciding = faults.services_in_order(robot)
        assert deciding == [first.endpoint, second.endpoint, first.endpoint, second.endpoint]
