"""Schedules: what is drawn can be written down and read back, and what is none is refused."""

import pytest
from tests.answers import answers_in

from holdfast_lab.errors import ScheduleError
from holdfast_lab.simulation.schedule import (
    Crash,
    KillRobot,
    MessageFault,
    RunSettings,
    SimulationSchedule,
    parse_schedule,
)
from holdfast_lab.simulation.schedule_draws import draw_schedule


def test_a_drawn_schedule_is_read_back_from_its_text() -> None:
    for seed in range(200):
        schedule = draw_schedule(seed)
        assert parse_schedule(schedule.text()) == schedule
        assert draw_schedule(seed) == schedule


def test_all_kinds_of_faults_are_drawn() -> None:
    kinds = {fault.kind for seed in range(300) for fault in draw_schedule(seed).faults}
    assert kinds == {
        "crash",
        "crowd",
        "cut",
        "disk_stall",
        "kill_robot",
        "late",
        "launch",
        "message corrupt",
        "message delay",
        "message drop",
        "message duplicate",
        "message misroute",
        "pause_robot",
        "slow",
        "stop",
    }


def test_text_is_as_short_as_it_can_be() -> None:
    schedule = SimulationSchedule(
        RunSettings(replicas=2, deadline_ms=15.0),
        (
            Crash(service="cloud-2", at=0.5),
            KillRobot(boundary=7, power_cut=True),
            MessageFault(service="local", direction="from", number=3, what="drop"),
        ),
    )
    assert schedule.text() == (
        "run replicas=2 deadline_ms=15.0\n"
        "crash service=cloud-2 at=0.5\n"
        "kill_robot boundary=7 power_cut=true\n"
        "message service=local direction=from number=3 what=drop\n"
    )
    assert parse_schedule(f"\n# a comment\n{schedule.text()}") == schedule
    assert parse_schedule("") == SimulationSchedule(RunSettings())


@pytest.mark.parametrize(("line", "says"), answers_in("schedule_mistakes.txt"))
def test_what_is_no_schedule_is_refused(line: str, says: str) -> None:
    with pytest.raises(ScheduleError) as raised:
        parse_schedule(line)
    assert says in str(raised.value)
