"""The robot's own process dies, at any moment and by any signal, and a new one goes on.

Whatever was performed is performed once: the world, which outlives the robot, has counted it.
"""

import os
import pty
import shlex
import shutil
import signal
import time
from pathlib import Path

import pytest
from tests.processes import gated_problem
from tests.processes.faults import (
    COMMAND,
    LOCAL_RECOVERY,
    PATIENT,
    References,
    Site,
    Story,
    assert_identical,
    document_of,
    sensing_steps,
    unfinished_steps,
    wait_for_end,
)
from tests.processes.test_faults import GATED, PEG, PEG_AND_SLOWLY_ALL, SERVES_GATED

from holdfast.cli.exit_codes import EXIT_CAN_GO_ON
from holdfast.journal.journal import Journal


class TestKilled:
    @pytest.mark.parametrize("problem", PEG_AND_SLOWLY_ALL)
    def test_and_resumed_again_and_again(
        self, problem: str, site: Site, references: References
    ) -> None:
        document = document_of(problem)
        steps = sensing_steps(document)
        cloud = site.service().start()
        story = Story(site, references, document)
        # With an action in the journal that was not performed, with one that was, and with an
        # observation that nobody has seen.
        story.at("perform", steps[1] + 2, site.kill_robot)
        story.at("perform", steps[3] - 1, site.kill_robot, afterwards=True)
        story.at("sense", steps[4], site.kill_robot, afterwards=True)
        assert story.run_and_resume(cloud) == 3
        # Each robot came with a higher epoch, so the cloud has taken the session over.
        cloud.process.wait_for("session_taken_over")

    def test_its_local_service_ends_with_it(self, site: Site, references: References) -> None:
        document = document_of(PEG)
        cloud = site.service()
        story = Story(
            site, references, document, offload={"startup_timeout_ms": 100.0}, recovery={}
        )
        ended: list[int] = []

        def kill_and_wait() -> None:
            ended.append(story.running.recovery_pid())
            site.kill_robot()
            wait_for_end(ended[-1])

        story.at("perform", 20, kill_and_wait)
        assert story.run_and_resume(cloud) == 1
        assert ended
        site.wait_for_nobody()
        # What the first of the two processes did counts in the tables too.
        with Journal.read(story.running.out / "journal.bin") as journal:
            (result,) = journal.results()
        assert result.recoveries == 2
        assert len(result.sensing_ms) == result.sensing_decisions == len(sensing_steps(document))
        assert all(result.sensing_ms)


class TestProblem:
    @pytest.mark.slow
    def test_a_transition_that_raises_in_the_robot_alone(
        self, site: Site, references: References
    ) -> None:
        cloud = site.service(*SERVES_GATED).start()
        story = Story(site, references, GATED)
        mark = site.directory / "stuck"
        story.at("perform", 12, mark.touch, afterwards=True)
        variables = {"HOLDFAST_TEST_STUCK": str(mark)}
        robot = site.run(story.file, services=[cloud], variables=variables)
        assert robot.wait() == EXIT_CAN_GO_ON
        (told,) = robot.matching("error")
        assert told["reason"] == (
            "trial 0 (seed 3), step 12: gated_problem:GatedPeg raised RuntimeError: the wheels are "
            "stuck"
        )
        lines = Path(gated_problem.__file__).read_text().splitlines()
        (line,) = (number for number, text in enumerate(lines, 1) if "raise RuntimeError" in text)
        assert told["details"] == (
            f'  File "{gated_problem.__file__}", line {line}, in move\n'
            '    raise RuntimeError("the wheels are stuck")'
        )
        assert "Traceback" not in robot.output
        # The motion was performed, and it is known that it was.
        assert story.world.step == 13
        assert unfinished_steps(robot.out) == list(range(13))
        # It is still stuck: then the journal cannot be read, which says the same.
        again = site.run(story.file, services=[cloud], variables=variables, resume=True)
        assert again.wait() == EXIT_CAN_GO_ON
        (told,) = again.matching("error")
        assert told["reason"].startswith(
            "trial 0 (seed 3), as the journal has it: gated_problem:GatedPeg raised RuntimeError: "
        )
        mark.unlink()
        story.finish(site.run(story.file, services=[cloud], resume=True))


class TestEndedInOrder:
    @pytest.mark.parametrize(
        ("number", "said"),
        [
            # The others come from a terminal, below.
            pytest.param(signal.SIGINT, "Interrupted", marks=pytest.mark.slow),
            (signal.SIGTERM, "Ended by SIGTERM"),
            pytest.param(signal.SIGHUP, "Ended by SIGHUP", marks=pytest.mark.slow),
        ],
    )
    def test_by_a_signal(
        self, number: signal.Signals, said: str, site: Site, references: References
    ) -> None:
        document = document_of(PEG)
        cloud = site.service().start()
        # Nobody starts the cloud again, so the resumed robot need not wait for it.
        story = Story(site, references, document, offload={"startup_timeout_ms": 100.0})
        story.at("perform", 12, cloud.kill, story.status(LOCAL_RECOVERY))
        story.at("perform", 30, lambda: story.running.signal(number))
        robot = site.run(story.file, services=[cloud])
        assert robot.wait() == 128 + number
        # What was being performed was still written down, and nothing after it was begun.
        (told,) = robot.matching("interrupted")
        assert str(told["reason"]).startswith(f"{said}. 0 of 1 trials are finished")
        assert 31 <= story.world.step < 80
        assert unfinished_steps(robot.out) == list(range(story.world.step))
        # No local service is left behind, and nothing else.
        site.wait_for_nobody()
        # The command that it names goes on.
        words = shlex.split(str(told["resume_command"]))
        assert words[:2] == ["holdfast", "run"]
        resumed = site.process(*COMMAND, *words[1:])
        assert resumed.wait() == 0, resumed.account()
        assert_identical(robot.out, story.reference)
        story.world.assert_each_once(story.reference)

    @pytest.mark.parametrize(
        "number",
        # Its handler is that of SIGTERM, above; of Ctrl-C at a batch: test_run_command.py.
        [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGHUP],
        ids=["ctrl_c", "closed"],
    )
    def test_by_its_terminal(
        self, number: signal.Signals, site: Site, references: References
    ) -> None:
        document = document_of(PEG)
        story = Story(site, references, document, offload={"startup_timeout_ms": 100.0})
        cloud = site.service()
        ours, theirs = pty.openpty()
        # The first terminal that the leader of a session opens is the one that controls it.
        opens_terminal = f"import os; os.open({os.ttyname(theirs)!r}, os.O_RDWR); "

        def end() -> None:
            if number == signal.SIGINT:
                os.write(ours, b"\x03")
            else:
                os.close(ours)

        story.at("perform", 20, story.status(LOCAL_RECOVERY), end)
        robot = site.run(
            story.file, services=[cloud], command=[*COMMAND[:2], opens_terminal + COMMAND[2]]
        )
        os.close(theirs)
        assert robot.wait() == 128 + number
        assert 21 <= story.world.step < 80
        assert unfinished_steps(robot.out) == list(range(story.world.step))
        site.wait_for_nobody()
        if number == signal.SIGINT:
            os.close(ours)
        story.finish(site.run(story.file, services=[cloud], resume=True))


class TestWorld:
    def test_two_that_do_not_belong_together(self, site: Site, references: References) -> None:
        """The world has done more than the journal knows: nothing is performed."""
        document = document_of(PEG)
        story = Story(site, references, document)
        early: list[Path] = []

        def copy() -> None:
            early.append(Path(shutil.copytree(story.running.out, site.directory / "early")))

        story.at("perform", 10, copy)
        story.at("perform", 20, site.kill_robot)
        site.run(story.file).wait()
        robot = site.run(story.file, out="early", resume=True)
        assert robot.wait() == 2
        assert "20 task actions were performed in this trial, the journal has 10" in robot.output
        assert story.world.step == 20


class TestEpoch:
    def test_the_older_of_two_robots_is_refused(self, site: Site, references: References) -> None:
        document = document_of(PEG)
        reference = references(document)
        steps = sensing_steps(document)
        cloud = site.service().start()
        world, file = site.world(document, "older", offload=PATIENT)
        other, other_file = site.world(document, "newer", offload=PATIENT)

        def be_overtaken() -> None:
            older = site.robot
            assert older is not None
            # Its journal is copied as it is, and somebody goes on with the copy.
            shutil.copytree(older.out, site.directory / "newer")
            with Journal.open(site.directory / "newer" / "journal.bin") as journal:
                # For the journal it is the same world, although the test reaches it elsewhere.
                text = journal.meta()["configuration"]
                here, there = f"{{port: {world.port}}}", f"{{port: {other.port}}}"
                assert here in text
                journal.set_meta(configuration=text.replace(here, there))
            other.become(world)
            newer = site.run(other_file, services=[cloud], out="newer", resume=True)
            newer.finish()
            assert_identical(newer.out, reference)

        world.on("perform", steps[2], be_overtaken)
        older = site.run(file, services=[cloud], out="older")
        assert older.wait() == 2
        assert "another process has resumed this run, so this one stops" in older.output
        cloud.process.wait_for("session_taken_over")
        cloud.process.wait_for("refused", code="stale_epoch")
        # The service may have chosen what to sense next before it was overtaken. It refuses what is
        # asked then, while the robot moves: this one stops where it should sense again, or before.
        assert world.step <= steps[4]
        world.check()
        other.assert_each_once(reference)


class TestRate:
    def test_missed_ticks_are_counted_and_told(self, site: Site, references: References) -> None:
        story = Story(site, references, document_of(PEG, max_steps=20))
        story.at("perform", 10, lambda: time.sleep(0.5))
        robot = story.run(options=("--rate", "50"))
        missed = sum(event["missed"] for event in robot.matching("missed_ticks"))
        assert missed >= 23
        assert robot.matching("missed_ticks")[-1]["total"] == missed
        told = [str(event["reason"]) for event in robot.matching("note")]
        assert f"{missed} ticks of --rate were missed" in told
