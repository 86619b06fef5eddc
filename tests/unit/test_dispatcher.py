"""Which service is asked, and when the local one takes over."""

from __future__ import annotations

import itertools

import pytest
from tests.robot_world import (
    LOCAL,
    SmallService,
    World,
    answer_third_slowly,
    nth,
)

from holdfast.errors import ServiceRefusedError
from holdfast.protocol.events import (
    Launch,
    LogEvent,
    RecoveryExited,
    RobotEffect,
    ServiceAppeared,
    ServiceVanished,
    Timing,
    WriteRecords,
)
from holdfast.protocol.messages import (
    Busy,
    Progress,
    Refused,
    Reply,
    Request,
    TaskAnswer,
    encode,
)
from holdfast.protocol.records import ObservedRecord


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
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []
    asked = [sent.request for sent in world.sent]
    # The first question of a trial is for its first sensing action; then one for each observation.
    decisions = sum(result.sensing_decisions for result in world.results)
    assert len(asked) == decisions + len(world.results)
    assert [request.session_configuration is not None for request in asked].count(True) == 1
    assert all(request.checkpoint is None for request in asked)
    assert all(len(request.inputs) <= 1 for request in asked)


def test_the_prefetched_sensing_action_is_there_before_it_is_needed() -> None:
    world = World()
    world.start()
    world.run()
    waits = [e for _, e in world.trace if isinstance(e, Timing) and e.kind == "sensing"]
    assert all(wait.waited_ms == 0.0 for wait in waits if wait.step > 0)


@pytest.mark.parametrize("step", range(13))
@pytest.mark.parametrize("launch", ["on_failure", "at_start"])
def test_killed_at_any_step_and_back_again(step: int, launch: str) -> None:
    world = World(launch=launch)
    if launch == "at_start":
        world.launch_s = 0.0

    def fault(performed: int) -> None:
        if performed == step and not world.results and world.services["cloud"].boot == 1:
            world.kill("cloud")
            world.bring_up("cloud", 0.5)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery", "keep_alive"]
    limit_s = 0.01 + (world.launch_s if launch == "on_failure" else 0.0) + 0.02
    assert world.longest_wait_ms() <= 1e3 * limit_s


def test_dead_before_the_first_request() -> None:
    world = World()
    world.start(present=False)
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery"]
    lost_at = next(at for at, e in world.trace if isinstance(e, LogEvent) and e.name == "status")
    assert lost_at == pytest.approx(1e-3 * world.offload.startup_timeout_ms)


def test_stopped_for_longer_than_the_timeout_is_found_by_its_silence() -> None:
    world = World()

    def fault(performed: int) -> None:
        world.services["cloud"].stopped = not world.results and 3 <= performed < 20

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery", "keep_alive"]
    assert any("no sign" in str(f["reason"]) for f in world.reports("service_suspected"))


def test_kill_again_after_failback() -> None:
    world = World()
    times = iter([2, 14, 25])
    following = next(times)

    def fault(performed: int) -> None:
        nonlocal following
        if performed == following and not world.results:
            following = next(times, -1)
            world.kill("cloud")
            world.bring_up("cloud", 0.012)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery", "keep_alive"] * 3
    assert sum(result.recoveries for result in world.results) == 3


def test_a_cloud_that_appears_again_is_asked_what_the_local_service_was_asked() -> None:
    """Not only with the next turn: while the robot moves, the cloud comes to hold its state."""
    world = World()

    def fault(performed: int) -> None:
        if performed == 4 and not world.results:
            world.kill("cloud")
            # The robot has been answered for the steps that follow, and is in the midst of them.
            world.bring_up("cloud", 0.392)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    appeared_at = world.report_times("service_appeared")
    assert len(appeared_at) == 2
    asked = [sent for sent in world.sent if sent.at >= appeared_at[1]]
    assert (asked[0].service, asked[0].at) == ("cloud", appeared_at[1])
    last = [sent.request for sent in world.sent if sent.at < appeared_at[1]][-1]
    assert asked[0].request.digest == last.digest
    assert world.statuses() == ["local_recovery", "keep_alive"]


def test_a_given_up_service_sees_the_next_question_also_while_another_decides() -> None:
    """Only an answer of its own brings it back, so it must be asked although nobody needs it."""
    world = World(services=("first", "second"))
    first = world.services["first"]

    def fault(performed: int) -> None:
        # It is asked one question that it never answers; then it is as before.
        first.stopped = not world.results and performed == 3

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    suspected_at = world.report_times("service_suspected")[0]
    after = [sent for sent in world.sent if sent.at >= suspected_at]
    tries = [sent.at for sent in after if sent.service == "first"]
    assert len(tries) > 2
    # One try at a time, since it may be far away; with its answer it decides alone.
    assert tries[1] >= tries[0] + 1e-3 * world.offload.detection_timeout_ms
    assert {sent.service for sent in after if sent.at < tries[1]} == {"first", "second"}
    assert {sent.service for sent in after if sent.at > tries[1]} == {"first"}
    assert world.statuses() == []


def test_a_preferred_service_that_is_back_is_asked_while_the_other_takes_its_time() -> None:
    """The robot stands still for the second, which says that it is at work; the first could do."""
    world = World(services=("first", "second"))
    second = world.services["second"]

    def takes_for_ever(request: Request) -> list[Reply]:
        return [Progress(request.number, False)] * 4000

    second.rule = takes_for_ever
    second.latency_s = 0.01

    def fault(performed: int) -> None:
        if performed == 3 and not world.results:
            world.kill("first")
            world.bring_up("first", 0.05)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert {sent.service for sent in world.sent} == {"first", "second"}
    # Two timeouts at most: until the decision is late, and the next look.
    assert world.longest_wait_ms() <= 2 * world.offload.detection_timeout_ms
    assert world.statuses() == []


def test_cloud_and_recovery_killed_together() -> None:
    world = World()

    def fault(performed: int) -> None:
        if performed == 4 and not world.results:
            world.kill("cloud")
        if performed == 10 and not world.results:
            world.kill(LOCAL)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery"]
    assert len([e for _, e in world.trace if isinstance(e, Launch)]) == 2


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
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.reports("recovery_exited") == [{"reason": "signal 9"}]
    assert len([e for _, e in world.trace if isinstance(e, Launch)]) == 2


def test_two_replicas_killed_in_turn_stay_standard_until_both_are_dead() -> None:
    world = World(services=("first", "second"))

    def fault(performed: int) -> None:
        if world.results:
            return
        if performed == 4:
            world.kill("first")
        if performed == 12:
            world.kill("second")
            world.bring_up("first", 0.3)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery", "keep_alive"]
    assert {sent.service for sent in world.sent} == {"first", "second", LOCAL}


def test_without_recovery_it_holds_says_why_and_goes_on() -> None:
    world = World(launch="never")

    def fault(performed: int) -> None:
        if performed == 4 and not world.results:
            world.kill("cloud")
            world.bring_up("cloud", 3.0)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []
    (held,) = world.reports("holding")
    assert "cloud: is not there" in str(held["reason"])
    (resumed,) = world.reports("resumed")
    assert 2500.0 < float(str(resumed["held_ms"])) < 3100.0


def test_recovery_that_cannot_be_launched_holds_the_robot_until_anything_answers() -> None:
    world = World()
    world.launchable = False

    def fault(performed: int) -> None:
        if performed == 4 and not world.results:
            world.kill("cloud")
            world.bring_up("cloud", 5.0)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery", "keep_alive"]
    launches = [e for _, e in world.trace if isinstance(e, Launch)]
    assert 3 < len(launches) < 12


def test_busy_is_waited_for_if_short_and_evaded_if_long() -> None:
    world = World()
    cloud = world.services["cloud"]
    cloud.rule = lambda r: [Busy(r.number, 20)] if nth(r) in (3, 4) else None
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []

    world = World()
    cloud = world.services["cloud"]
    cloud.rule = lambda r: [Busy(r.number, 5000)] if nth(r) == 3 else None
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses()[0] == "local_recovery"


def test_progress_keeps_a_slow_service_trusted() -> None:
    world = World()
    answer_third_slowly(world.services["cloud"], num_signs=10)
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []


def test_deadline_hedges_within_its_budget() -> None:
    world = World(launch="at_start", deadline_ms=20.0)
    cloud = world.services["cloud"]
    world.start()
    world.services["cloud"].latency_s = 0.1
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []
    hedged = len(world.reports("hedge"))
    questions = len({sent.request.digest for sent in world.sent})
    assert 1 <= hedged <= 3 + 0.1 * questions
    assert cloud.requests


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


def test_a_problem_that_every_service_refuses_stops_the_robot() -> None:
    world = World()

    def refuse(request: Request) -> list[Reply] | None:
        return [Refused(request.number, "failed", "policy gives nan")]

    world.services["cloud"].rule = refuse
    world.services[LOCAL].rule = refuse
    world.start()
    world.run()
    assert world.stopped is not None
    assert isinstance(world.stopped.error, ServiceRefusedError)
    assert "policy gives nan" in str(world.stopped.error)


@pytest.mark.parametrize("code", ["failed", "out_of_memory"])
@pytest.mark.parametrize("launch", ["on_failure", "never"])
def test_a_sensing_part_that_fails_after_its_task_part_stops_the_robot(
    code: str, launch: str
) -> None:
    world = World(launch=launch)
    for service in world.services.values():
        fails_in_its_sensing_part(service, code)
    world.start()
    world.run()
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
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    told = world.reports("refused")
    assert [(each["service"], each["final"]) for each in told] == [
        ("broken", False),
        ("broken", False),
        ("broken", True),
    ]
    assert world.statuses() == []


def test_out_of_memory_for_a_while_is_asked_again_ever_later() -> None:
    world = World(launch="never")
    fails_in_its_sensing_part(world.services["cloud"], "out_of_memory", calls=4)
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    told = [at for at, e in world.trace if isinstance(e, LogEvent) and e.name == "refused"]
    waits = [after - before for before, after in itertools.pairwise(told)]
    assert len(waits) == 3
    assert all(later > 1.5 * wait for wait, later in itertools.pairwise(waits))
    assert waits[0] > 0.1
    reasons = {str(each["reason"]) for each in world.reports("holding")}
    assert reasons == {"cloud: out_of_memory: observation_mean raised"}


def test_an_answer_clears_earlier_refusals_of_the_same_part() -> None:
    world = World(launch="never")
    refuse = {5, 6, 8, 9, 11, 12}
    world.services["cloud"].rule = lambda r: (
        [Refused(r.number, "failed", "policy gives nan")] if nth(r) in refuse else None
    )
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert len(world.reports("refused")) == len(refuse)


def test_the_machine_sleeps_while_nothing_can_be_done() -> None:
    # The local service is up before the cloud was ever seen; World.run asserts the rest.
    world = World(launch="at_start")
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
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert told


def test_no_service_is_blamed_for_the_time_in_which_the_robot_was_deaf() -> None:
    world = World()
    carry_out = world.carry_out

    def slow_disk(effects: list[RobotEffect]) -> None:
        for effect in effects:
            if isinstance(effect, WriteRecords) and isinstance(effect.records[-1], ObservedRecord):
                world.now += 0.3
                world.robot.event_loop_stalled(0.3)
            carry_out([effect])

    world.carry_out = slow_disk  # type: ignore[method-assign]
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []


def test_a_robot_that_waits_for_a_silent_local_service_asks_the_cloud_again() -> None:
    """Found by the simulator: it waited for the local one alone, for many seconds."""
    world = World()

    def fault(performed: int) -> None:
        if performed == 4 and not world.results:
            world.services["cloud"].stopped = True
        if performed == 8 and not world.results:
            # The cloud answers again, but only what it is asked from now on.
            world.services[LOCAL].stopped = True
            world.services["cloud"].stopped = False

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    timeout_ms = world.offload.detection_timeout_ms
    assert world.longest_wait_ms() < 2 * timeout_ms + 300.0


def test_a_long_wait_is_told_although_the_service_shows_life() -> None:
    world = World()
    answer_third_slowly(world.services["cloud"], num_signs=20)
    world.start()
    world.run()
    world.assert_same_as_without_faults()
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
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery", "keep_alive"]
    assert len(world.reports("refused")) == 1
    back_at = next(
        at
        for at, e in world.trace
        if isinstance(e, LogEvent) and e.fields.get("to") == "keep_alive"
    )
    assert {sent.service for sent in world.sent if sent.at > back_at} == {"cloud"}


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
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery"]
    assert [sent.service for sent in world.sent].count("cloud") == 1
