"""Late observations, moves that show something and sensing that is left out, each by itself."""

import msgspec
import numpy as np
import pytest

from holdfast.numerics.randomness import Stream, stream
from holdfast.planning.inputs import ActingRecord, Late, Moved, Record, Sensed
from holdfast_lab.errors import Violation
from holdfast_lab.simulation.checkers import WireChecker
from holdfast_lab.simulation.environment_model import EnvironmentModel
from holdfast_lab.simulation.peg_with_encoders import PegWithEncoders
from holdfast_lab.simulation.schedule import RunSettings, SimulationSchedule, parse_schedule
from holdfast_lab.simulation.schedule_draws import draw_schedule
from holdfast_lab.simulation.world import Setup, Simulator

MAX_STEPS = 40


SETUPS = [(False, False), (True, False), (False, True), (True, True)]


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator()


def observed(step: int, sensing_action: int, shown: bytes = b"") -> Sensed:
    return Sensed(step, sensing_action, shown, bytes(32), 0.0)


class Body:
    """A world with one late observation, and the journal of the robot that acts on it."""

    def __init__(self, *moves: int | None, **settings: bool) -> None:
        self.setup = Setup(False, False)
        settings.setdefault("shows_the_same", False)
        self.world = EnvironmentModel(
            0, MAX_STEPS, self.setup.references, lateness={0: moves}, **settings
        )
        self.journal: list[Record] = []

    def go_to(self, step: int) -> list[int]:
        """Act up to a step; return the steps whose observations have come."""
        came = []
        for at in range(self.world.performed, step):
            reference = self.world._reference.steps[at]
            if reference.sensing_action is not None and (at != 0 or not self.journal):
                late = self.world.sense(at, reference.sensing_action) is None
                self.journal.append(
                    observed(at, reference.sensing_action, b"" if late else bytes(8))
                )
            self.journal.append(ActingRecord(at, reference.action))
            self.world.act(at, np.frombuffer(reference.action))
            self.journal.append(Moved(at, None))
            came += [each.taken for each in self.world.come()]
        return came

    def resume(self, **lacks: bool) -> list[int]:
        resumed = self.world.resumed(self.journal, may_lack=lacks.get("may_lack", False))
        return [each.taken for each in resumed.late]


class TestEnvironmentModel:
    def test_once_more_it_must_not_be_used(self) -> None:
        body = Body(2, 4)
        assert body.go_to(5) == [0, 0]
        body.world.is_useless(0)
        with pytest.raises(Violation, match="step 0 has come late and is not used"):
            body.world.is_useless(0)

    def test_what_was_not_written_down_and_acted_on(self) -> None:
        body = Body(2)
        body.go_to(4)
        with pytest.raises(Violation, match="the journal lacks the late observation of step 0"):
            body.resume()
        assert body.resume(may_lack=True) == []

    def test_what_never_came(self) -> None:
        body = Body(8)
        body.go_to(4)
        body.journal.append(Late(4, 0, bytes(8), bytes(32)))
        with pytest.raises(Violation, match="step 0, which never came"):
            body.resume()


def test_encoders_show_how_the_peg_has_moved() -> None:
    problem = PegWithEncoders()
    noise: Stream = stream(1, 0, 0, 0)  # type: ignore[arg-type]
    before, after = np.array([4.0, 2.0, 0.1]), np.array([3.9, 1.9, 0.0])
    measured = np.array(
        [problem.measure_motion(before, after, noise.substream(at)) for at in range(400)]
    )
    # Of a mean of 400 with deviation 0.02: beyond 5 standard errors once in 600,000.
    np.testing.assert_allclose(measured.mean(axis=0), after - before, atol=0.005)
    states = np.repeat(before[None], 400, axis=0)
    moved = problem.move_by_measurement(states, after - before, noise)
    np.testing.assert_allclose(moved.mean(axis=0), after, atol=0.005)


@pytest.mark.parametrize(("height", "closed"), [(2.0, False), (1.1, True)])
def test_the_switch_is_mostly_right(height: float, closed: bool) -> None:
    problem = PegWithEncoders()
    noise: Stream = stream(1, 0, 0, 0)  # type: ignore[arg-type]
    state = np.array([0.0, height, 0.0])
    says = [
        problem.sample_move_observation(state, np.zeros(3), noise.substream(at))[0] > 0.5
        for at in range(400)
    ]
    # 360 of 400 are right, give or take 6: fewer than 330 once in a million.
    assert sum(each == closed for each in says) > 330
    likelihoods = np.exp(
        problem.move_log_likelihood(state[None], np.zeros(3), np.array([float(closed)]))
    )
    assert likelihoods == pytest.approx([0.9])


def test_a_service_that_diverges_is_found() -> None:
    payload = bytes(msgspec.msgpack.encode([4, 1, True, True])) + b"sum!"
    with pytest.raises(Violation, match="comes to another state in call 1 than the robot"):
        WireChecker().replied("cloud-1", 1, 1, payload)
    WireChecker(services_forget=True).replied("cloud-1", 1, 1, payload)
    checker = WireChecker()
    checker.robot_forgets()
    checker.replied("cloud-1", 1, 1, payload)


def test_what_a_move_shows_is_folded_in_once() -> None:
    planner = Setup(True, False).planner
    state = planner.init(1, 0)
    one, other = (planner.observe_move(state, np.zeros(3), np.array([1.0])) for _ in range(2))
    assert one[0] is other[0]
    assert planner.observe_move(state, np.zeros(3), np.array([0.0]))[0] is not one[0]
    assert planner.reinitialise(state) is planner.reinitialise(state)


@pytest.mark.parametrize("remembers", [False, True])
@pytest.mark.parametrize("senses_on", [False, True])
def test_the_robot_is_killed_between_any_two_effects(
    remembers: bool, senses_on: bool, simulator: Simulator
) -> None:
    for boundary in range(8, 110, 3):
        schedule = parse_schedule(
            f"run trial={boundary % 4} remembers={remembers} senses_on={senses_on} "
            f"moves_show={boundary % 2 == 0}\n"
            "late step=0 moves=14\nlate step=9 moves=2\n"
            "late step=18 moves=9\nlate step=27 moves=0\n"
            f"kill_robot boundary={boundary} down_s=0.01 body_goes_on={boundary % 5 == 0}\n".lower()
        )
        outcome = simulator.run(schedule)
        assert (outcome.violation, outcome.held) == (None, None), schedule.text()


@pytest.mark.parametrize("first", [20_000, 20_250])
def test_seeds_in_which_something_is_shown_late(first: int, simulator: Simulator) -> None:
    found = 0
    for seed in range(first, first + 250):
        schedule = draw_schedule(seed)
        if not (schedule.run.moves_show or any(each.kind == "late" for each in schedule.faults)):
            continue
        found += 1
        outcome = simulator.run(schedule)
        assert outcome.violation is None, f"holdfast simulate --story --seeds {seed}:{seed + 1}"
    assert found > 20


def test_both_are_drawn_and_most_runs_are_as_they_were() -> None:
    schedules = [draw_schedule(seed) for seed in range(500)]
    shows = sum(each.run.moves_show for each in schedules)
    optional = sum(each.run.sensing_is_optional for each in schedules)
    late = sum(any(fault.kind == "late" for fault in each.faults) for each in schedules)
    assert shows > 10
    assert optional > 5
    assert 40 < late < 150


def test_settings_without_faults(simulator: Simulator) -> None:
    for trial in range(3):
        for moves_show, sensing_is_optional in SETUPS:
            run = RunSettings(
                trial=trial, moves_show=moves_show, sensing_is_optional=sensing_is_optional
            )
            outcome = simulator.run(SimulationSchedule(run))
            assert (outcome.violation, outcome.held) == (None, None)
