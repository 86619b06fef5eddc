"""The production machines under drawn schedules: whatever happens, the decisions are the same."""

import pytest

from holdfast_lab.simulation.exploration import ExplorationTally, explore
from holdfast_lab.simulation.schedule import (
    NUM_TRIALS,
    Crash,
    Crowd,
    KillRobot,
    RunSettings,
    SimulationSchedule,
    Slow,
    Stop,
    parse_schedule,
)
from holdfast_lab.simulation.schedule_draws import draw_schedule
from holdfast_lab.simulation.story import RunOutcome, story_lines
from holdfast_lab.simulation.world import Simulator


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator()


def fine(outcome: RunOutcome) -> bool:
    return outcome.violation is None and outcome.held is None


@pytest.mark.parametrize("trial", range(0, NUM_TRIALS, 14))
@pytest.mark.parametrize("num_trials", [1, 2])
def test_without_faults(trial: int, num_trials: int, simulator: Simulator) -> None:
    run = RunSettings(trial=trial, num_trials=num_trials)
    outcome = simulator.run(SimulationSchedule(run))
    assert fine(outcome)
    # One request and two parts of an answer for each turn, and one for the first sensing action.
    assert outcome.messages < 30


def test_a_schedule_goes_one_way_only(simulator: Simulator) -> None:
    for seed in range(20):
        schedule = draw_schedule(seed)
        first = simulator.run(schedule, tell=True)
        # Neither on what was computed before nor on whether it is told does anything depend.
        assert Simulator().run(schedule, tell=True) == first
        assert simulator.run(schedule) == first._replace(story=[], never_happened=())


# What is slow here `make test-compiled` runs as well.
@pytest.mark.parametrize(
    "boundary",
    [
        pytest.param(boundary, marks=[pytest.mark.slow] if boundary % 9 else [])
        for boundary in range(0, 100, 3)
    ],
)
def test_the_robot_is_killed_between_any_two_effects(boundary: int, simulator: Simulator) -> None:
    kill = KillRobot(boundary=boundary, down_s=0.01)
    for environment in ("counting", "simulated"):
        run = RunSettings(trial=boundary % NUM_TRIALS, environment=environment)
        assert fine(simulator.run(SimulationSchedule(run, (kill,))))


@pytest.mark.parametrize("lost", [0, 1, 2, 100])
def test_power_is_cut(lost: int, simulator: Simulator) -> None:
    for boundary in range(10, 90, 11):
        kill = KillRobot(boundary=boundary, power_cut=True, lost_appends=lost)
        careful = RunSettings(journal_survives="power_cut")
        assert fine(simulator.run(SimulationSchedule(careful, (kill,))))
        outcome = simulator.run(SimulationSchedule(RunSettings(), (kill,)))
        assert outcome.violation is None
        if lost > 1:
            # It can only say that it does not know.
            assert outcome.held is None or "do not belong together" in outcome.held


def test_without_a_local_service_it_waits_for_the_cloud(simulator: Simulator) -> None:
    gone = Crash(service="cloud-1", at=0.1, down_s=0.2)
    run = RunSettings(launch="never")
    assert fine(simulator.run(SimulationSchedule(run, (gone,))))


def test_faults_that_never_happened_are_told(simulator: Simulator) -> None:
    """Each but the first crash and the first message, which strike what is there."""
    late = "crash service=cloud-1 at=100.0"
    down = "crash service=cloud-1 at=0.15"
    again = "kill_robot boundary=3 down_s=0.1"
    text = f"""
        crash service=cloud-1 at=0.1
        {down}
        {late}
        kill_robot boundary=3
        {again}
        message service=cloud-1 direction=to number=0 what=delay seconds=0.01
        message service=cloud-1 direction=to number=500 what=drop
        message service=cloud-1 direction=from number=400 what=drop
        message service=cloud-1 direction=to number=300 what=drop
    """
    outcome = simulator.run(parse_schedule(text), tell=True)
    assert fine(outcome)
    assert story_lines(outcome)[-5:] == [
        f"never happened: {down}",
        f"never happened: {late}",
        f"never happened: {again}",
        "never happened: message service=cloud-1 direction=to number=300,500",
        "never happened: message service=cloud-1 direction=from number=400",
    ]
    assert outcome.faults == {"crash": 1, "kill_robot": 1, "message delay": 1}


def test_a_service_that_is_down_and_gone_for_good_is_struck(simulator: Simulator) -> None:
    text = """
        run replicas=2
        crash service=cloud-1 at=0.05
        crash service=cloud-1 at=0.1 for_good=true
    """
    outcome = simulator.run(parse_schedule(text), tell=True)
    assert fine(outcome)
    assert outcome.never_happened == ()


SIXTY = Crowd(service="cloud-1", at=0.0, robots=60)


@pytest.mark.parametrize(
    ("others", "served_s"),
    [
        ((), 1.8),
        ((SIXTY, SIXTY), 3.0),
        ((Crowd(service="cloud-1", at=0.9, robots=30),), 1.8),
        ((Stop(node="cloud-1", at=0.05, for_s=0.5),), 2.3),
        ((Slow(service="cloud-1", at=0.3, for_s=0.5, factor=2.0),), 2.05),
        ((Crowd(service="cloud-2", at=0.0, robots=30),), 1.8),
    ],
    ids=["one", "three at once", "one during the other", "stopped", "slow", "elsewhere"],
)
def test_crowds_last_until_all_of_them_are_served(
    others: tuple[Crowd | Stop | Slow, ...], served_s: float, simulator: Simulator
) -> None:
    """By one worker, a hundred at the most; who is refused may be told to come back in a second.

    Who comes later brings a known problem, for whose first decisions there is another lane.
    """
    run = RunSettings(replicas=2, launch="never", workers=1, sensing_s=0.03, act_s=1.0)
    outcome = simulator.run(SimulationSchedule(run, (SIXTY, *others)))
    assert fine(outcome)
    assert outcome.duration_s - outcome.recovery_s == pytest.approx(served_s + 1.0, abs=0.1)


@pytest.mark.parametrize("first", [0, 100])
def test_seeds(first: int, simulator: Simulator) -> None:
    for seed in range(first, first + 100):
        outcome = simulator.run(draw_schedule(seed))
        assert outcome.violation is None, f"holdfast simulate --story --seeds {seed}:{seed + 1}"


def test_several_processes_see_what_one_sees() -> None:
    tallies = []
    for jobs in (1, 2):
        tally = ExplorationTally()

        def on_batch(seeds: range, seen: ExplorationTally, tally: ExplorationTally = tally) -> bool:
            assert len(seeds) == seen.runs == 20
            tally.add(seen)
            return True

        explore(range(1000, 1060), jobs, on_batch, batch=20)
        tallies.append(tally)
    assert tallies[0] == tallies[1]
    assert tallies[0].runs == 60
    assert tallies[0].findings == []


def test_the_first_finding_is_the_first() -> None:
    """Whichever process is done sooner."""
    seen = []

    def on_batch(seeds: range, tally: ExplorationTally) -> bool:
        assert tally.runs == len(seeds)
        seen.append(seeds.start)
        return len(seen) < 4

    explore(range(2000, 2090), 2, on_batch, batch=10)
    assert seen == [2000, 2010, 2020, 2030]


@pytest.mark.slow
def test_ten_thousand_seeds() -> None:
    tally = ExplorationTally()

    def on_batch(seeds: range, seen: ExplorationTally) -> bool:
        tally.add(seen)
        return not tally.findings

    explore(range(10_000), 2, on_batch)
    assert tally.findings == []
    assert tally.runs == 10_000
    assert all(count > 100 for count in tally.faults.values())
