"""Many robots on a service that is too small for them, and neighbours who send it nonsense."""

from __future__ import annotations

import threading

import pytest
from tests.processes import faults

PEG = "peg_in_hole_2d"


@pytest.mark.slow
class TestTooManyForOne:
    @pytest.mark.parametrize("recovery", ["never", "on_failure"])
    def test_all_runs_stay_right(
        self, recovery: str, site: faults.Site, references: faults.References
    ) -> None:
        documents = []
        for problem in (PEG, "capsule_robot"):
            # Tens of milliseconds a decision; eight robots that are quick ask for more than that.
            document = faults.document_of(problem, particles=2000, max_steps=40)
            document["active_sensing"]["num_observation_samples"] = 400
            documents += [document] * 4
        small = site.service("--workers", "1").start()
        everybody = threading.Barrier(len(documents), timeout=faults.PATIENCE_S)
        robots, worlds = [], []
        for number, document in enumerate(documents):
            world, file = site.world(
                document,
                f"robot-{number}",
                offload=faults.PATIENT,
                recovery={"launch": recovery},
            )
            world.on("begin", 0, everybody.wait)
            worlds.append(world)
            robots.append(site.run(file, services=[small], out=f"out-{number}"))
        for robot, world, document in zip(robots, worlds, documents, strict=True):
            robot.finish()
            faults.assert_identical(robot.out, references(document))
            world.assert_each_once(references(document))
        turned_away = [event for robot in robots for event in robot.matching("busy")]
        assert turned_away
        assert all(event["retry_after_ms"] > 0 for event in turned_away)
        assert not any(robot.matching("refused") for robot in robots)
