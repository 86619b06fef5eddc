import pytest
from tests.simulation.defects import DEFECTS, seeds_needed, violation_of, without_faults
from tests.simulation.edits import Defect, Edit, applied

from holdfast.protocol import requests
from holdfast.protocol.robot import Robot
from holdfast_lab.simulation.schedule import parse_schedule
from holdfast_lab.simulation.world import Simulator

# The moments that it takes, as the simulator found them, made small.
FOUND_AT_ONCE = [
    (
        "act_before_journal",
        "run\nkill_robot boundary=33 before=journal down_s=0.05 body_goes_on=true",
        "do not belong together",
    ),
    (
        "both_answers_performed",
        "run latency_s=0.04 sensing_s=0.03\nstop node=cloud-1 at=0.1 for_s=0.3",
        "performed again",
    ),
    (
        "draws_by_position",
        "run\ncrash service=cloud-1 at=0.15 down_s=0.05",
        "the undisturbed run has",
    ),
    (
        "no_reply_cache",
        "run launch=never\nkill_robot boundary=41 before=sense down_s=0.001",
        "stuck",
    ),
    (
        "reply_checksum_ignored",
        "run\nmessage service=cloud-1 direction=from number=2 what=corrupt bit=100",
        "the undisturbed run has",
    ),
    (
        "idle_by_difference",
        "run forgets_after_s=0.03 services_clock_offset_s=205448.849812",
        "no time passes",
    ),
    (
        "session_of_anybody",
        "run certificates=true launch=never\ncrowd service=cloud-1 at=0.1 robots=3",
        "has taken this session over",
    ),
    # Every decision is right, so the checker of the failback alone sees it.
    (
        "given_up_cloud_never_tried",
        "run act_s=0.1\ncrash service=cloud-1 at=0.15 down_s=0.3",
        "local decides (local_recovery), and not cloud-1",
    ),
    (
        "late_in_order_only",
        "run trial=1\nlate step=0 moves=20\nlate step=9 moves=3",
        "the undisturbed run has",
    ),
    (
        "late_folded_in_twice",
        "run remembers=true\nlate step=0 moves=5\nkill_robot at=0.1 down_s=0.05",
        "the undisturbed run has",
    ),
    (
        "late_between_order_and_performance",
        "run senses_on=true\n"
        "late step=0 moves=20\n"
        "kill_robot boundary=10 before=act down_s=0.05\n"
        "kill_robot at=0.3 down_s=0.05",
        "comes before the action of that step is known to be performed",
    ),
    ("stale_answer_used", "run trial=1\nlate step=9 moves=3", "the undisturbed run has"),
    ("motion_not_told", "run moves_show=true", "comes to another state"),
]


@pytest.mark.parametrize(("name", "text", "says"), FOUND_AT_ONCE)
def test_a_defect_is_found(name: str, text: str, says: str) -> None:
    schedule = parse_schedule(text)
    assert without_faults(DEFECTS[name], range(2)) is None
    violation = violation_of(DEFECTS[name], schedule)
    assert violation is not None
    assert says in violation
    assert Simulator().run(schedule).violation is None, "it has been taken back"


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_is_where_it_says(name: str) -> None:
    with applied(DEFECTS[name]):
        pass


def test_a_defect_that_says_nothing_is_an_error() -> None:
    gone = Defect("gone", "", (Edit(requests.OpenRequests, "send", "no such line", "pass"),))
    with pytest.raises(ValueError, match="gone: send has 0 times"), applied(gone):
        pass


def test_a_reply_to_another_process_of_the_robot_is_not_taken() -> None:
    """No seed found this: a late reply has the number of the call that it goes astray to."""
    schedule = parse_schedule(
        "run trial=1 latency_s=0.04\n"
        "message service=cloud-1 direction=from number=2 what=misroute seconds=0.21\n"
        "pause_robot at=0.2 down_s=0.001\n"
    )
    assert Simulator().run(schedule).violation is None
    numbers = Edit(requests.OpenRequests, "__init__", "epoch % _EPOCHS * _NUMBERS_OF_EPOCH", "0")
    with applied(Defect("numbers_begin_anew", "", (numbers,))):
        violation = Simulator().run(schedule).violation
    assert violation is not None
    assert "the undisturbed run has" in violation


# Each takes an end of the robot's process at one moment of a few runs: no seed found it.
RARE = [
    (
        "written_after_the_order",
        "A resumed robot orders the pending action before it writes down what has come meanwhile: "
        "the body performs it all the same, and the observation is lost.",
        Edit(
            Robot,
            "begin_trial",
            "self._write()\nself._effects.append(Act",
            "self._effects.append(Act",
        ),
        "run senses_on=true\n"
        "late step=0 moves=20\n"
        "kill_robot boundary=10 before=act\n"
        "kill_robot boundary=11 before=journal down_s=0.05 body_goes_on=true\n",
        "the journal lacks the late observation of step 0",
    ),
    (
        "lost_forgotten_in_a_crash",
        "A robot that was killed when it was found lost goes on with its old belief.",
        Edit(Robot, "begin_trial", "if history.is_lost and history.pending is None", "if False"),
        "run trial=2 on_lost=reinitialise\nkill_robot boundary=25 before=journal down_s=0.05",
        "the undisturbed run has",
    ),
]


@pytest.mark.parametrize(("name", "story", "edit", "text", "says"), RARE)
def test_a_rare_defect_is_found(name: str, story: str, edit: Edit, text: str, says: str) -> None:
    schedule = parse_schedule(text)
    assert Simulator().run(schedule).violation is None
    with applied(Defect(name, story, (edit,))):
        violation = Simulator().run(schedule).violation
    assert violation is not None
    assert says in violation


@pytest.mark.slow
@pytest.mark.parametrize("name", DEFECTS)
def test_every_defect_is_found(name: str) -> None:
    assert len(DEFECTS) >= 15
    assert without_faults(DEFECTS[name], range(8)) is None
    assert seeds_needed(DEFECTS[name]) is not None
