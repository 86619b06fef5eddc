"""A service that lies, or errs: real processes, in which only the decisions tell it apart."""

import sys

import pytest
from tests.processes import faults
from tests.processes.lying_problem import OWN_PLANNER_HANGS, VARIABLE

EXIT_WRONG_ANSWER = 3
WITH_FIGURES = (sys.executable, "-m", "holdfast")

DOCUMENT = {
    **faults.document_of("peg_in_hole_2d", max_steps=40),
    "problem": "lying_problem:LyingPeg",
    "problem_directory": str(faults.HERE),
}
SERVES = ("--problem", "lying_problem:LyingPeg", "--problem-directory", str(faults.HERE))


def liar(site: faults.Site, what: str) -> faults.Service:
    service = site.service(*SERVES)
    service.variables[VARIABLE] = what
    return service.start()


def verdicts_of(robot: faults.Robot) -> list[tuple[str, str, str]]:
    rows = faults.rows_of(robot.out, "verification.csv")
    return [(row["service"], row["kind"], row["verdict"]) for row in rows]


def test_an_action_beyond_the_limits_is_not_performed(
    site: faults.Site, references: faults.References
) -> None:
    cloud = liar(site, "far")
    story = faults.Story(site, references, DOCUMENT, offload={"verify_share": 0.0, "what": "all"})
    robot = site.run(story.file, services=[cloud])
    assert robot.wait() == EXIT_WRONG_ANSWER, robot.account()
    story.world.check()
    # Nothing of it was performed: it is the run of an honest planner.
    faults.assert_identical(robot.out, story.reference)
    story.world.assert_each_once(story.reference)
    found = robot.matching("wrong_answer")
    assert found[0]["kind"] == "task"
    assert {event["service"] for event in found} == {cloud.endpoint}
    assert [to for _, to in robot.statuses()] == [faults.LOCAL_RECOVERY]
    summary = faults.summary_of(robot.out)
    assert summary["wrong_answers"] == {cloud.endpoint: len(found)}
    assert set(summary["sensing_decisions_by_service"]) <= {
        cloud.endpoint,
        faults.RECOVERY,
        "in_process",
    }
    assert (cloud.endpoint, "task", "different") in verdicts_of(robot)


@pytest.mark.parametrize(
    ("what", "kind"), [("half", "task"), pytest.param("sensing", "sensing", marks=pytest.mark.slow)]
)
def test_a_lie_within_the_limits_is_found_among_the_answers_computed_again(
    what: str, kind: str, site: faults.Site
) -> None:
    cloud = liar(site, what)
    offload = {**faults.PATIENT, "verify_share": 1.0, "what": {"task": "all"}.get(kind, kind)}
    world, file = site.world(DOCUMENT, offload=offload)
    robot = site.run(file, services=[cloud])
    assert robot.wait() == EXIT_WRONG_ANSWER, robot.account()
    world.check()
    assert {event["service"] for event in robot.matching("wrong_answer")} == {cloud.endpoint}
    assert (cloud.endpoint, kind, "different") in verdicts_of(robot)
    assert faults.summary_of(robot.out)["wrong_answers"][cloud.endpoint] >= 1
    assert faults.LOCAL_RECOVERY in [to for _, to in robot.statuses()]
    told = " ".join(event["reason"] for event in robot.matching("note"))
    assert "verification.csv" in told


def test_a_liar_without_anybody_else_ends_the_run_which_can_go_on(
    site: faults.Site, references: faults.References
) -> None:
    cloud = liar(site, "far")
    story = faults.Story(site, references, DOCUMENT, recovery={"launch": "never"})
    robot = site.run(story.file, services=[cloud])
    assert robot.wait() == EXIT_WRONG_ANSWER, robot.account()
    (told,) = robot.matching("error")
    assert told["reason"].startswith(f"no service will decide: {cloud.endpoint}: wrong_answer")
    assert "--resume" in told["resume_command"]
    # The same one is not asked again, whoever runs it now.
    performed = story.world.step
    robot = site.run(story.file, services=[cloud], resume=True)
    assert robot.wait() == EXIT_WRONG_ANSWER, robot.account()
    (told,) = robot.matching("error")
    assert "in an earlier part of this run" in told["reason"]
    assert story.world.step == performed
    # With an honest service it comes to the decisions of a run without faults; that somebody has
    # lied is not forgotten.
    honest = site.service(*SERVES).start()
    robot = site.run(story.file, services=[honest], resume=True)
    assert robot.wait() == EXIT_WRONG_ANSWER, robot.account()
    story.world.check()
    faults.assert_identical(robot.out, story.reference)
    story.world.assert_each_once(story.reference)
    assert set(faults.summary_of(robot.out)["wrong_answers"]) == {cloud.endpoint}


def test_honest_services_are_verified_and_decide_the_same(
    site: faults.Site, references: faults.References
) -> None:
    cloud = site.service(*SERVES).start()
    story = faults.Story(site, references, DOCUMENT, offload={"verify_share": 1.0})
    robot = story.run(cloud)
    summary = faults.summary_of(robot.out)
    assert summary["wrong_answers"] == {}
    assert summary["not_deterministic"] == 0
    # Every part of every answer but those that came after the last one was compared.
    assert summary["verified_answers"] >= summary["sensing_decisions"] - 1 > 0
    assert {verdict for _, _, verdict in verdicts_of(robot)} == {"asked", "same"}
    assert summary["unverified_answers"] == 0


@pytest.mark.slow
def test_what_is_not_computed_again_in_time_is_said(
    site: faults.Site, references: faults.References
) -> None:
    cloud = site.service(*SERVES).start()
    story = faults.Story(site, references, DOCUMENT, offload={"verify_share": 1.0})
    robot = site.run(story.file, services=[cloud], variables={OWN_PLANNER_HANGS: "1"})
    # The run does not wait for its own planner for ever.
    story.finish(robot)
    assert robot.matching("verifying")
    summary = faults.summary_of(robot.out)
    assert summary["verified_answers"] == 0
    assert summary["unverified_answers"] >= summary["sensing_decisions"] > 0
    told = " ".join(event["reason"] for event in robot.matching("note"))
    assert f"{summary['unverified_answers']} questions" in told


@pytest.mark.parametrize(
    ("what", "kind", "simulated"),
    [
        ("sensing", "sensing", False),
        pytest.param("half", "task", True, marks=pytest.mark.slow),
        pytest.param("half", "task", False, marks=pytest.mark.slow),
        pytest.param("sensing", "sensing", True, marks=pytest.mark.slow),
    ],
)
def test_a_lie_that_nobody_computed_again_is_found_when_the_figure_is_drawn(
    what: str, kind: str, simulated: bool, site: faults.Site
) -> None:
    cloud = liar(site, what)
    offload = {**faults.PATIENT, "verify_share": 0.0, "what": "all"}
    if simulated:
        file = site.configure(DOCUMENT, offload=offload)
    else:
        _, file = site.world(DOCUMENT, offload=offload)
    robot = site.run(file, services=[cloud], command=WITH_FIGURES)
    assert robot.wait() == EXIT_WRONG_ANSWER, robot.account()
    assert faults.summary_of(robot.out)["wrong_answers"] == {}
    told = [each["reason"] for each in robot.matching("note") if "was run again" in each["reason"]]
    assert len(told) == 1
    assert f"{cloud.endpoint} answered with another {kind} action at step " in told[0]


UNSTEADY = """
import itertools
import sys

from holdfast.problems.peg_in_hole_2d import PegInHole2D

# Two processes never count alike, nor do two runs in one.
_COUNT = itertools.count(300 if "serve" in sys.argv else 0)


class Unsteady(PegInHole2D):
    name = "unsteady"

    def policy(self, states, stage):
        return 0.0 * super().policy(states, stage) + 1e-5 * next(_COUNT)
"""


def test_a_problem_that_is_not_deterministic_is_named_beside_the_service(site: faults.Site) -> None:
    (site.directory / "unsteady.py").write_text(UNSTEADY)
    name = "unsteady:Unsteady"
    cloud = site.service("--problem", name, "--problem-directory", str(site.directory)).start()
    document = {**faults.document_of("peg_in_hole_2d", max_steps=20), "problem": name}
    file = site.configure(document, offload={**faults.PATIENT, "verify_share": 0.0, "what": "all"})
    robot = site.run(file, services=[cloud], command=WITH_FIGURES)
    assert robot.wait() == 3, robot.account()
    told = " ".join(event["reason"] for event in robot.matching("note"))
    assert f"or the problem {name} is not deterministic" in told
