"""Which service is asked, and when the local one takes over."""

import pytest
from tests.robot_world import LOCAL, SmallService, World, answer_third_slowly, nth

from holdfast.errors import ServiceRefusedError
from holdfast.protocol.effects import LogEvent
from holdfast.protocol.messages import Busy, Progress, Refused, Reply, Request, TaskAnswer, encode
from holdfast.protocol.robot_events import (
    Act,
    Launch,
    RecoveryExited,
    Send,
    ServiceAppeared,
    ServiceVanished,
)


def fails_in_its_sensing_part(service: SmallService, code: str, calls: int = 10**9) -> None:
    """Let a service give the task part and refuse the sensing part after it, for so many calls."""
    left = [calls]

    def rule(request: Request) -> list[Reply] | None:
        service.rule = lambda _: None
        replies = service.answer(encode(request))
        service.requests.pop()
        service.rule = rule
        if left[0] > 0 and isinstance(replies[0], TaskAnswer):
            left[0] -= 1
            return [replies[0], Refused(request.number, code, "observation_mean raised")]
        return replies

    service.rule = rule


def test_without_faults_it_decides_as_in_process_with_one_request_per_sensing_step() -> None:
    world = World()
    world.complete()
    assert world.statuses() == []
    asked = [sent.request for sent in world.sent]
    # The first question of a trial is for its first sensing action; then one for each observation.
    decisions = sum(result.sensing_decisions for result in world.results)
    assert len(asked) == decisions + len(world.results)
    assert [request.session_configuration is not None for request in asked].count(True) == 1
    assert all(request.checkpoint is None for request in asked)
    assert all(len(request.inputs) <= 1 for request in asked)


def test_the_exit_of_a_local_service_is_logged_although_its_link_still_stands() -> None:
    world = World()

    def fault(performed: int) -> None:
        if performed == 4 and not world.results:
            world.kill("cloud")
        if performed == 10 and not world.results:
            (launch,) = [e for _, e in world.trace if isinstance(e, Launch)]
            world.after(
                0.0,
                lambda: world.robot.handle(RecoveryExited(launch.number, "signal 9"), world.now),
            )

    world.on_act = fault
    world.complete()
    assert world.reports("recovery_exited") == [{"reason": "signal 9"}]
    assert [e["service"] for e in world.reports("service_vanished")] == ["cloud", LOCAL]
    assert len([e for _, e in world.trace if isinstance(e, Launch)]) == 2


def test_busy_is_waited_for_if_short_and_evaded_if_long() -> None:
    world = World()
    cloud = world.services["cloud"]
    cloud.rule = lambda r: [Busy(r.number, 20)] if nth(r) in (3, 4) else None
    world.complete()
    assert world.statuses() == []

    world = World()
    cloud = world.services["cloud"]
    cloud.rule = lambda r: [Busy(r.number, 5000)] if nth(r) == 3 else None
    world.complete()
    assert world.statuses()[0] == "local_recovery"


@pytest.mark.parametrize("stalled_s", [0.0, 0.35])
def test_replies_are_late_by_the_time_in_which_the_robot_could_receive(stalled_s: float) -> None:
    world = World()
    world.services["cloud"].latency_s = 0.2  # so each reply needs 0.4 s; the timeout is shorter
    send = world.send

    def stall(effect: Send) -> None:
        send(effect)
        world.robot.event_loop_stalled(stalled_s)

    world.send = stall  # type: ignore[method-assign]
    world.complete()
    assert bool(world.reports("late_replies")) == (stalled_s == 0.0)


@pytest.mark.parametrize("comes", [True, False])
def test_at_the_start_one_that_refuses_makes_nobody_give_up_those_to_come(comes: bool) -> None:
    world = World(services=("older", "current"))
    startup_s = 1e-3 * world.offload.startup_timeout_ms
    world.services["older"].rule = lambda request: [
        Refused(request.number, "other_code", "another copy of the problem")
    ]
    world.services["current"].up = False
    world.start(present=False)
    world.bring_up("older")
    if comes:
        world.bring_up("current", 0.9 * startup_s)
    world.run()
    world.assert_same_as_without_faults()
    assert [fields["final"] for fields in world.reports("refused")] == [True]
    lost = [at for at, e in world.trace if isinstance(e, LogEvent) and e.name == "status"]
    assert lost == ([] if comes else [startup_s])
    assert {sent.service for sent in world.sent} == {"older", "current" if comes else LOCAL}


@pytest.mark.parametrize("services", [("older",), ("older", "gone")])
def test_at_the_start_nobody_is_waited_for_where_the_others_refuse_or_were_there(
    services: tuple[str, ...],
) -> None:
    world = World(services=services)
    world.services["older"].rule = lambda request: [
        Refused(request.number, "other_code", "another copy of the problem")
    ]
    world.start(present=False)
    world.bring_up("older")
    world.carry_out(world.robot.handle(ServiceAppeared("gone", "1"), world.now))
    world.carry_out(world.robot.handle(ServiceVanished("gone", "1"), world.now))
    world.run()
    world.assert_same_as_without_faults()
    (launch,) = [at for at, e in world.trace if isinstance(e, Launch)]
    assert launch < 1e-3 * world.offload.startup_timeout_ms


@pytest.mark.parametrize("code", ["failed", "out_of_memory"])
@pytest.mark.parametrize("launch", ["on_failure", "never"])
def test_a_sensing_part_that_fails_after_its_task_part_stops_the_robot(
    code: str, launch: str
) -> None:
    world = World(launch=launch)
    for service in world.services.values():
        fails_in_its_sensing_part(service, code)
    world.start_and_run()
    assert world.stopped is not None
    assert isinstance(world.stopped.error, ServiceRefusedError)
    asked = ["cloud"] if launch == "never" else ["cloud", LOCAL]
    for name in asked:
        assert f"{name}: {code}: observation_mean raised" in str(world.stopped.error)
        told = [each for each in world.reports("refused") if each["service"] == name]
        assert [each["final"] for each in told] == [False] * (len(told) - 1) + [True]
        assert len(told) <= 5
    # What was not refused was performed, and nobody guessed the rest.
    assert [step for step, _ in world.acted] == list(range(4))


def test_who_fails_in_its_sensing_part_leaves_the_rest_to_another_service() -> None:
    world = World(services=("broken", "sound"))
    fails_in_its_sensing_part(world.services["broken"], "failed")
    world.complete()
    told = world.reports("refused")
    assert [(each["service"], each["final"]) for each in told] == [
        ("broken", False),
        ("broken", False),
        ("broken", True),
    ]
    assert world.statuses() == []


def test_the_machine_sleeps_while_nothing_can_be_done() -> None:
    # The local service is up before the cloud was ever seen; World.run asserts the rest.
    world = World(launch="at_start")
    assert any(isinstance(e, Launch) for e in World(launch="at_start").robot.start(0.0))
    world.launch_s = 0.1
    world.start(present=False)
    world.run()
    world.assert_same_as_without_faults()

    world = World(services=("busy", "dying"))
    told: list[int] = []

    def busy_once(request: Request) -> list[Reply] | None:
        if request.step >= 4 and not told:
            told.append(request.number)
            return [Busy(request.number, 200)]
        return None

    world.services["busy"].rule = busy_once
    world.services["dying"].rule = lambda _: []
    world.complete()
    assert told


def test_a_call_that_ends_once_another_service_has_answered_is_no_loss() -> None:
    world = World(services=("prompt", "slow"))
    timeout_s, slow = 1e-3 * world.offload.detection_timeout_ms, world.services["slow"]
    slow.latency_s = (timeout_s + 0.01) / 8
    slow.rule = lambda r: [Progress(r.number, False)] * 7 if nth(r) == 2 else None
    world.services["prompt"].up = False
    world.start(present=False)
    world.bring_up("slow")
    world.bring_up("prompt", timeout_s)
    world.run()
    world.assert_same_as_without_faults()
    assert [sent.service for sent in world.sent[:3]] == ["slow", "slow", "prompt"]
    assert not world.reports("service_suspected")


def test_a_robot_that_nobody_answers_holds_once() -> None:
    """Not before it waits: the actions that it had been given are performed."""
    world = World(launch="never")
    world.services["cloud"].latency_s = 0.03
    world.lose_the_cloud_for_a_while()
    world.complete()
    held = [at for at, e in world.trace if isinstance(e, LogEvent) and e.name == "holding"]
    acted = [at for at, e in world.trace if isinstance(e, Act) and e.step == 11]
    assert len(held) == 1
    assert held[0] > acted[0]


def test_a_long_wait_is_told_although_the_service_shows_life() -> None:
    world = World()
    answer_third_slowly(world.services["cloud"], num_signs=20)
    world.complete()
    (told,) = world.reports("waiting")
    assert told["service"] == "cloud"
    assert float(str(told["waited_ms"])) >= 1000.0


def test_another_process_of_a_service_that_refused_for_good_is_asked() -> None:
    """It may have been updated; what is known of one process says nothing of the next."""
    world = World()
    cloud = world.services["cloud"]
    cloud.rule = lambda r: [Refused(r.number, "other_code", "is another release")]

    def update(performed: int) -> None:
        if performed == 4 and cloud.boot == 1:
            world.kill("cloud")
            cloud.rule = lambda _: None
            world.bring_up("cloud", 0.02)

    world.on_act = update
    world.complete()
    assert world.statuses() == ["local_recovery", "keep_alive"]
    assert len(world.reports("refused")) == 1
    back_at = next(
        at
        for at, e in world.trace
        if isinstance(e, LogEvent) and e.fields.get("to") == "keep_alive"
    )
    assert {sent.service for sent in world.sent if sent.at > back_at} == {"cloud"}
    appeared_at = [
        at for at, e in world.trace if isinstance(e, LogEvent) and e.name == "service_appeared"
    ][-1]
    assert appeared_at in {sent.at for sent in world.sent}  # it need not wait for the next turn


def test_the_same_process_behind_another_link_still_refuses() -> None:
    world = World()
    cloud = world.services["cloud"]
    cloud.rule = lambda r: [Refused(r.number, "other_code", "is another release")]

    def reconnect(performed: int) -> None:
        if performed == 4 and not world.results:
            boot = str(cloud.boot)
            world.after(0.01, lambda: world.robot.handle(ServiceVanished("cloud", boot), world.now))
            world.after(0.02, lambda: world.robot.handle(ServiceAppeared("cloud", boot), world.now))

    world.on_act = reconnect
    world.complete()
    assert world.statuses() == ["local_recovery"]
    assert [sent.service for sent in world.sent].count("cloud") == 1
