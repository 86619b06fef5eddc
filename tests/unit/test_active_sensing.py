"""The typed service and its client: decisions as in process, whoever answers and whoever dies."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from holdfast.configuration import Configuration, load
from holdfast.errors import CheckpointError, InvalidValueError, TransportError
from holdfast.outcome import SensingDecision, TaskDecision
from holdfast.planning import digest
from holdfast.ros.active_sensing import (
    ActiveSensing,
    Answer,
    ErrorCode,
    Kind,
    Request,
    checked_state,
)
from holdfast.ros.client import ActiveSensingClient
from holdfast.runtime.environment import Environment, SimulatedEnvironment
from holdfast.runtime.trial import run_trial
from holdfast.session.status import Status

EXAMPLE = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"


def configuration(**changes: object) -> Configuration:
    return load(EXAMPLE, overrides={"particle_filter.num_particles": 50, **changes})


class Direct:
    """A service in this process, which can be told to fail."""

    def __init__(self, name: str, answers: ActiveSensing) -> None:
        self.name = name
        self._answers = answers
        self.fails = False
        self.asked = 0

    def ask(self, request: Request, deadline_s: float) -> Answer:
        self.asked += 1
        if self.fails:
            raise TransportError("connection refused")
        return self._answers.answer(request)

    def close(self) -> None:
        pass


def decisions(
    client: ActiveSensingClient, environment: Environment, seed: int, trial: int, max_steps: int
) -> list[int | tuple[float, ...]]:
    made: list[int | tuple[float, ...]] = []
    state = client.decide(Request(Kind.INITIALIZE, seed=seed, trial=trial)).state
    steps = 0
    while True:
        chosen = client.decide(Request(Kind.CHOOSE_SENSING_ACTION, state=state)).sensing_action
        made.append(chosen)
        observation = environment.perform_sensing(chosen)
        answer = client.decide(
            Request(
                Kind.CHOOSE_TASK_ACTIONS,
                state=state,
                sensing_action=chosen,
                observation=observation,
            )
        )
        state = answer.state
        for action in answer.task_actions:
            environment.perform(action)
            made.append(tuple(action))
            steps += 1
            if environment.is_done() or steps == max_steps:
                return made


def in_process(configuration: Configuration, trial: int) -> list[int | tuple[float, ...]]:
    result = run_trial(
        configuration.problem, configuration.planning, configuration.simulator, trial
    )
    made: list[int | tuple[float, ...]] = []
    assert result.decisions is not None
    for decision in result.decisions:
        match decision:
            case SensingDecision(_, sensing_action, _):
                made.append(sensing_action)
            case TaskDecision(_, action):
                made.append(action)
    return made


@pytest.mark.parametrize("interval", [0, 3])
def test_a_trial_decides_as_in_process_whoever_is_lost(interval: int) -> None:
    settings = configuration(**{"simulator.sensing_intervals": interval})
    simulator = settings.simulator
    cloud = Direct("cloud", ActiveSensing(settings))
    recovery = Direct("recovery", ActiveSensing(settings))
    statuses: list[object] = []

    class Failing(SimulatedEnvironment):
        def perform_sensing(self, sensing_action: int) -> np.ndarray:
            cloud.fails = self.step // 5 % 2 == 1
            return super().perform_sensing(sensing_action)

    with ActiveSensingClient(
        cloud, recovery, 5.0, lambda _, **fields: statuses.append(fields.get("status"))
    ) as client:
        world = Failing(settings.problem, simulator.seed, 2)
        made = decisions(client, world, simulator.seed, 2, simulator.max_steps)
        cloud.fails = False
        while client.status is not Status.KEEP_ALIVE:
            client.decide(Request(Kind.INITIALIZE))
    assert made == in_process(settings, 2)
    assert statuses[:2] == ["local_recovery", "keep_alive"]


def test_a_service_that_never_answers_holds_nobody_longer_than_the_deadline() -> None:
    settings = configuration()
    stopped = threading.Event()

    class Stopped(Direct):
        def ask(self, request: Request, deadline_s: float) -> Answer:
            stopped.wait(60.0)
            raise TransportError("stopped")

    cloud = Stopped("cloud", ActiveSensing(settings))
    client = ActiveSensingClient(cloud, Direct("recovery", ActiveSensing(settings)), 0.01)
    answer = client.decide(Request(Kind.INITIALIZE, seed=1, trial=0))
    assert answer.error is ErrorCode.OK
    assert client.decided_by == "recovery"
    assert client.status is Status.LOCAL_RECOVERY
    stopped.set()
    client.close()


def test_nobody_answers() -> None:
    settings = configuration()
    cloud, recovery = (Direct(name, ActiveSensing(settings)) for name in ("cloud", "recovery"))
    cloud.fails = recovery.fails = True
    told: list[str] = []
    with (
        ActiveSensingClient(cloud, recovery, 0.01, lambda name, **_: told.append(name)) as client,
        pytest.raises(TransportError, match=r"0\.2 s: cloud: connection refused; recovery: conn"),
    ):
        client.decide(Request(Kind.INITIALIZE), give_up_s=0.2)
    assert told == ["status", "holding"]


def test_what_nobody_can_answer_is_said() -> None:
    service = ActiveSensing(configuration())
    state = service.answer(Request(Kind.INITIALIZE, seed=3, trial=1)).state
    assert state is not None

    def refused(request: Request) -> str:
        answer = service.answer(request)
        assert answer.error is ErrorCode.BAD_REQUEST
        assert answer.state is None
        return answer.message

    assert "state" in refused(Request(Kind.CHOOSE_SENSING_ACTION))
    assert "kind 9" in refused(Request(9))
    assert "sensing action 77" in refused(
        Request(Kind.CHOOSE_TASK_ACTIONS, state=state, sensing_action=77, observation=np.zeros(2))
    )
    sensed = state._replace(sensed=True)
    assert "needs no sensing" in refused(Request(Kind.CHOOSE_SENSING_ACTION, state=sensed))
    assert "observation of 2" in refused(
        Request(Kind.CHOOSE_TASK_ACTIONS, state=sensed, observation=np.zeros(2))
    )
    assert "particles" in refused(
        Request(
            Kind.CHOOSE_SENSING_ACTION,
            state=state._replace(belief=type(state.belief).uniform(np.zeros((3, 3)))),
        )
    )


def test_another_configuration_is_told_by_its_digest_but_not_by_its_seed() -> None:
    ours = ActiveSensing(configuration())
    assert (
        ours.configuration == ActiveSensing(configuration(**{"simulator.seed": 77})).configuration
    )
    theirs = ActiveSensing(configuration(**{"particle_filter.num_particles": 51}))
    answer = ours.answer(Request(Kind.INITIALIZE, configuration=theirs.configuration))
    assert answer.error is ErrorCode.OTHER_CONFIGURATION
    assert theirs.configuration in answer.message
    assert ours.configuration in answer.message


def test_a_state_of_a_message_is_checked_as_a_checkpoint_is() -> None:
    state = ActiveSensing(configuration()).answer(Request(Kind.INITIALIZE, seed=5, trial=0)).state
    assert state is not None
    belief = state.belief

    def taken(states: np.ndarray, weights: np.ndarray) -> object:
        return checked_state(5, 0, 0, 0, False, belief.states.shape[1], states, weights)

    again = checked_state(
        5, 0, 0, 0, False, belief.states.shape[1], belief.states.ravel(), belief.weights
    )
    assert again is not None
    assert digest(again) == digest(state)
    assert taken(np.empty(0), np.empty(0)) is None
    with pytest.raises(CheckpointError, match="state_size"):
        taken(belief.states.ravel()[1:], belief.weights)
    with pytest.raises(CheckpointError, match="weights"):
        taken(belief.states.ravel(), belief.weights * 2)
    with pytest.raises(CheckpointError, match="finite"):
        taken(belief.states.ravel() * np.nan, belief.weights)


def test_an_error_of_the_request_is_raised_and_not_asked_again_elsewhere() -> None:
    settings = configuration()
    cloud, recovery = (Direct(name, ActiveSensing(settings)) for name in ("cloud", "recovery"))
    with (
        ActiveSensingClient(cloud, recovery) as client,
        pytest.raises(InvalidValueError, match="cloud: BAD_REQUEST: kind 9"),
    ):
        client.decide(Request(9))
    assert (cloud.asked, recovery.asked) == (1, 0)


class Slow(Direct):
    """A service that takes as long as it is told, or as it is given."""

    takes_s = 0.0

    def ask(self, request: Request, deadline_s: float) -> Answer:
        self.asked += 1
        if self.takes_s > deadline_s:
            threading.Event().wait(deadline_s)
            raise TransportError("no answer in time")
        return self._answers.answer(request)


def test_a_recovery_service_that_is_slower_than_the_deadline_gets_more_time() -> None:
    settings = configuration()
    cloud, recovery = (Slow(name, ActiveSensing(settings)) for name in ("cloud", "recovery"))
    cloud.fails, cloud.takes_s, recovery.takes_s = True, 60.0, 0.05
    with ActiveSensingClient(cloud, recovery, 0.01) as client:
        for _ in range(2):
            assert client.decide(Request(Kind.INITIALIZE)).error is ErrorCode.OK
            assert client.decided_by == "recovery"
    assert recovery.asked == 5  # 10, 20, 40, 80 ms, and once more at once


def test_who_waits_for_a_client_that_is_closed_is_told_so() -> None:
    settings = configuration()
    cloud, recovery = (Direct(name, ActiveSensing(settings)) for name in ("cloud", "recovery"))
    cloud.fails = recovery.fails = True
    holding = threading.Event()
    client = ActiveSensingClient(cloud, recovery, 0.01, lambda *_, **__: holding.set())
    told: list[str] = []

    def wait() -> None:
        with pytest.raises(TransportError, match="closed") as raised:
            client.decide(Request(Kind.INITIALIZE))
        told.append(str(raised.value))

    waiting = threading.Thread(target=wait)
    waiting.start()
    assert holding.wait(60.0)
    client.close()
    waiting.join(60.0)
    assert told
    with pytest.raises(TransportError, match="closed"):
        client.decide(Request(Kind.INITIALIZE))


@pytest.mark.parametrize("deadline_s", [0.0, -1.0, float("nan"), float("inf"), 1e12])
def test_a_deadline_out_of_bounds_is_refused(deadline_s: float) -> None:
    service = Direct("cloud", ActiveSensing(configuration()))
    with pytest.raises(InvalidValueError, match="deadline_s"):
        ActiveSensingClient(service, service, deadline_s)
