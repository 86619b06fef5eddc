"""The client of two services: who decides, when, and what it says."""

import asyncio
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.recordings import decided

from holdfast.config.loader import Configuration, load
from holdfast.errors import InvalidValueError, TransportError
from holdfast.planning.inputs import ActingRecord, Sensed, decode_floats
from holdfast.protocol.status import Status
from holdfast.robot.environment import Environment, SimulatedEnvironment
from holdfast_ros.active_sensing import (
    ActiveSensing,
    DecisionAnswer,
    DecisionRequest,
    ErrorCode,
    RequestKind,
)
from holdfast_ros.client import ActiveSensingClient
from holdfast_ros.loop_thread import LoopThread

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

    async def ask(self, request: DecisionRequest, deadline_s: float) -> DecisionAnswer:
        self.asked += 1
        if self.fails:
            raise TransportError("connection refused")
        return self._answers.answer(request)


def two_services(kind: type[Any] = Direct) -> list[Any]:
    """Return the cloud's and the recovery service."""
    answers = ActiveSensing(configuration())
    return [kind(name, answers) for name in ("cloud", "recovery")]


def client_of(cloud: Direct, recovery: Direct, *more: Any) -> ActiveSensingClient:
    return ActiveSensingClient(cloud, recovery, LoopThread("test"), *more)


def decisions(
    client: ActiveSensingClient, environment: Environment, seed: int, trial: int, max_steps: int
) -> list[int | tuple[float, ...]]:
    made: list[int | tuple[float, ...]] = []
    state = client.decide(DecisionRequest(RequestKind.INITIALIZE, seed=seed, trial=trial)).state
    steps = 0
    while True:
        chosen = client.decide(
            DecisionRequest(RequestKind.CHOOSE_SENSING_ACTION, state=state)
        ).sensing_action
        made.append(chosen)
        observation = environment.perform_sensing(chosen)
        assert isinstance(observation, np.ndarray)
        answer = client.decide(
            DecisionRequest(
                RequestKind.CHOOSE_TASK_ACTIONS,
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
    result = decided(configuration, trial)
    made: list[int | tuple[float, ...]] = []
    assert result.decisions is not None
    for decision in result.decisions:
        match decision:
            case Sensed(_, sensing_action, _):
                made.append(sensing_action)
            case ActingRecord(_, action):
                made.append(tuple(decode_floats(action, None).tolist()))
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

    with client_of(
        cloud, recovery, 5.0, lambda _, **fields: statuses.append(fields.get("status"))
    ) as client:
        world = Failing(settings.problem, simulator.seed, 2)
        made = decisions(client, world, simulator.seed, 2, simulator.max_steps)
        cloud.fails = False
        while client.status is not Status.KEEP_ALIVE:
            client.decide(DecisionRequest(RequestKind.INITIALIZE))
    assert made == in_process(settings, 2)
    assert statuses[:2] == ["local_recovery", "keep_alive"]


def test_a_service_that_never_answers_holds_nobody_longer_than_the_deadline() -> None:
    class Stopped(Direct):
        async def ask(self, request: DecisionRequest, deadline_s: float) -> DecisionAnswer:
            await asyncio.Event().wait()
            raise AssertionError

    _, recovery = two_services()
    client = client_of(Stopped("cloud", ActiveSensing(configuration())), recovery, 0.01)
    answer = client.decide(DecisionRequest(RequestKind.INITIALIZE, seed=1, trial=0))
    assert answer.error is ErrorCode.OK
    assert client.decided_by == "recovery"
    assert client.status is Status.LOCAL_RECOVERY
    client.close()


def test_nobody_answers() -> None:
    cloud, recovery = two_services()
    cloud.fails = recovery.fails = True
    told: list[str] = []
    with (
        client_of(cloud, recovery, 0.01, lambda name, **_: told.append(name)) as client,
        pytest.raises(TransportError, match=r"0\.2 s: cloud: connection refused; recovery: conn"),
    ):
        client.decide(DecisionRequest(RequestKind.INITIALIZE), give_up_s=0.2)
    assert told == ["status", "holding"]


def test_an_error_of_the_request_is_raised_and_not_asked_again_elsewhere() -> None:
    cloud, recovery = two_services()
    with (
        client_of(cloud, recovery) as client,
        pytest.raises(InvalidValueError, match="cloud: BAD_REQUEST: kind 9"),
    ):
        client.decide(DecisionRequest(9))
    assert (cloud.asked, recovery.asked) == (1, 0)


class Slow(Direct):
    """A service that takes as long as it is told, or as it is given."""

    takes_s = 0.0

    async def ask(self, request: DecisionRequest, deadline_s: float) -> DecisionAnswer:
        self.asked += 1
        if self.takes_s > deadline_s:
            await asyncio.sleep(deadline_s)
            raise TransportError("no answer in time")
        return self._answers.answer(request)


def test_a_recovery_service_that_is_slower_than_the_deadline_gets_more_time() -> None:
    cloud, recovery = two_services(Slow)
    cloud.fails, cloud.takes_s, recovery.takes_s = True, 60.0, 0.05
    with client_of(cloud, recovery, 0.01) as client:
        for _ in range(2):
            assert client.decide(DecisionRequest(RequestKind.INITIALIZE)).error is ErrorCode.OK
            assert client.decided_by == "recovery"
    assert recovery.asked == 5  # 10, 20, 40, 80 ms, and once more at once


def test_who_waits_for_a_client_that_is_closed_is_told_so() -> None:
    cloud, recovery = two_services()
    cloud.fails = recovery.fails = True
    holding = threading.Event()
    client = client_of(cloud, recovery, 0.01, lambda *_, **__: holding.set())
    told: list[str] = []

    def wait() -> None:
        with pytest.raises(TransportError, match="closed") as raised:
            client.decide(DecisionRequest(RequestKind.INITIALIZE))
        told.append(str(raised.value))

    waiting = threading.Thread(target=wait)
    waiting.start()
    assert holding.wait(60.0)
    client.close()
    waiting.join(60.0)
    assert told
    with pytest.raises(TransportError, match="closed"):
        client.decide(DecisionRequest(RequestKind.INITIALIZE))


@pytest.mark.parametrize("deadline_s", [0.0, -1.0, float("nan"), float("inf"), 1e12])
def test_a_deadline_out_of_bounds_is_refused(deadline_s: float) -> None:
    service = Direct("cloud", ActiveSensing(configuration()))
    thread = LoopThread("test")
    with pytest.raises(InvalidValueError, match="deadline_s"):
        ActiveSensingClient(service, service, thread, deadline_s)
    thread.close(60.0)
