"""A robot that nobody looks after: what starts it again repeats one command, and watches it.

The commands are real processes, the service manager is a real socket, and health is asked by HTTP.
"""

from __future__ import annotations

import signal

from tests.processes.faults import (
    References,
    Site,
    Story,
    document_of,
    sensing_steps,
    services_in_order,
)

PEG = "peg_in_hole_2d"


class TestOneCommandRepeated:
    def test_it_begins_goes_on_however_it_ended_and_is_complete(
        self, site: Site, references: References
    ) -> None:
        document = document_of(PEG, max_steps=60, trials=2)
        steps = sensing_steps(document)
        cloud = site.service().start()
        story = Story(site, references, document)
        (site.directory / "out").mkdir()  # as a volume is that was just mounted
        story.at("begin", 0, site.kill_robot)  # nothing is performed yet
        story.at("sense", steps[1], site.kill_robot)
        story.at("perform", steps[2] - 1, lambda: story.running.signal(signal.SIGTERM))
        story.at("perform", 30, site.kill_robot, trial=1, afterwards=True)
        options = ("--resume-if-begun", "--rate", "2000")

        def command() -> int:
            return site.run(story.file, *options, services=[cloud]).wait()

        killed, ended = -signal.SIGKILL, 128 + signal.SIGTERM
        codes = [command() for _ in range(6)]
        assert codes == [killed, killed, ended, killed, 0, 0], story.running.account()
        note = f"{story.running.out}: complete, with 2 trials"
        assert [event["reason"] for event in story.running.events] == [note]
        story.finish(story.running)
        assert services_in_order(story.running) == [cloud.endpoint]  # each part was told of it
        said = site.holdfast("compare", story.reference, story.running.out)
        assert said.process.returncode == 0, said.account()

    def test_another_configuration_or_another_process_is_an_error_that_ends_for_good(
        self, site: Site, references: References
    ) -> None:
        document = document_of(PEG, max_steps=30)
        story = Story(site, references, document)
        other = site.configure(document, "other", simulator={"seed": 4})
        found: list[tuple[int, str]] = []

        def again() -> None:
            running = story.running
            for file in (story.file, other):
                second = site.run(file, "--rate", "2000", "--resume-if-begun")
                found.append((second.wait(), second.output))
            site.robot = running

        story.at("perform", 10, again)
        story.at("perform", 20, site.kill_robot)
        site.run(story.file, "--resume-if-begun").wait()
        differs = site.run(other, "--rate", "2000", "--resume-if-begun")
        found.append((differs.wait(), differs.output))
        assert [code for code, _ in found] == [2, 2, 2]
        assert "another process is using this run" in found[0][1]
        assert "another process is using this run" in found[1][1]
        assert "that run has another configuration: simulator.seed is 3 there" in found[2][1]
        story.finish(site.run(story.file, "--resume-if-begun"))
