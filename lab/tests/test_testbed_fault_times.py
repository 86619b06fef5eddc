"""How long reactions took: from made-up events and tables, with known times."""

import pytest

from holdfast.robot.links import RECOVERY_SERVICE as LOCAL
from holdfast_lab.testbed.fault_times import (
    ROBOT,
    FaultTimes,
    InjectedFault,
    spread_of,
    times_of_faults,
)
from holdfast_lab.testbed.records import Decision, LogEvent, log_event_of

CLOUD, OTHER = "tcp/127.0.0.1:1", "tcp/127.0.0.1:2"


def decision(at: float, service: str = CLOUD, waited_ms: float = 1.0) -> Decision:
    return Decision(at, 0, 0, "task", service, "standard", waited_ms)


def status(at: float, to: str) -> LogEvent:
    return LogEvent(at, "status", {"to": to})


def of_one(fault: InjectedFault, logged: list[LogEvent], decisions: list[Decision]) -> FaultTimes:
    (times,) = times_of_faults([fault], logged, decisions)
    return times


def test_a_cloud_that_is_killed_and_started_again() -> None:
    times = of_one(
        InjectedFault(kind="cloud_killed", target=CLOUD, injected_at=10.0, usable_at=11.0),
        [
            LogEvent(9.0, "service_appeared", {"service": CLOUD}),
            LogEvent(10.005, "service_vanished", {"service": CLOUD}),
            status(10.006, "local_recovery"),
            LogEvent(10.2, "launched", {"launch_ms": 190.0}),
            status(11.08, "keep_alive"),
        ],
        [
            decision(9.9),
            decision(10.3, LOCAL, 250.0),
            decision(10.9, LOCAL),
            decision(11.09, CLOUD, 2.0),
            decision(11.5, CLOUD, 900.0),
        ],
    )
    assert times == FaultTimes(
        kind="cloud_killed",
        target=CLOUD,
        away_ms=1000.0,
        in_use=True,
        detection_ms=5.0,
        recovery_ms=300.0,
        launch_ms=190.0,
        failback_ms=90.0,
        longest_wait_ms=250.0,
    )


def test_what_is_not_noticed_has_no_times() -> None:
    times = of_one(
        InjectedFault(kind="cloud_stopped", target=CLOUD, injected_at=10.0, usable_at=10.1),
        [],
        [decision(9.9), decision(10.15, CLOUD, 70.0)],
    )
    assert times.detection_ms is None
    assert times.recovery_ms is None
    assert times.failback_ms is None
    assert times.longest_wait_ms == 70.0


def test_a_service_that_was_not_in_use_is_not_used_again() -> None:
    times = of_one(
        InjectedFault(kind="replicas_killed", target=OTHER, injected_at=10.0, usable_at=11.0),
        [LogEvent(10.01, "service_vanished", {"service": OTHER}), status(10.5, "local_recovery")],
        [decision(9.9), decision(10.2), decision(11.2, OTHER)],
    )
    assert not times.in_use
    assert times.detection_ms == pytest.approx(10.0)
    assert times.recovery_ms is None
    assert times.failback_ms is None


def test_another_replica_decides() -> None:
    times = of_one(
        InjectedFault(kind="replicas_killed", target=CLOUD, injected_at=10.0),
        [LogEvent(10.01, "service_vanished", {"service": CLOUD})],
        [decision(9.9), decision(10.02, OTHER)],
    )
    assert times.recovery_ms == pytest.approx(20.0)
    assert times.away_ms is None
    assert times.failback_ms is None


def test_the_local_service_is_launched_again() -> None:
    times = of_one(
        InjectedFault(kind="local_killed", target=LOCAL, injected_at=10.0),
        [
            LogEvent(10.01, "recovery_exited", {"reason": "was ended by SIGKILL"}),
            LogEvent(10.3, "launched", {"launch_ms": 280.0}),
        ],
        # The answer that it had given before was carried out after its end.
        [decision(9.9, LOCAL), decision(10.001, LOCAL), decision(10.31, LOCAL, 290.0)],
    )
    assert times.detection_ms == pytest.approx(10.0)
    assert times.recovery_ms == pytest.approx(310.0)
    assert times.launch_ms == 280.0
    assert times.failback_ms is None


def test_a_robot_that_is_killed_and_one_that_stood_still() -> None:
    killed = InjectedFault(kind="robot_killed", target=ROBOT, injected_at=10.0, usable_at=10.1)
    stopped = InjectedFault(kind="robot_stopped", target=ROBOT, injected_at=20.0, usable_at=20.5)
    first, second = times_of_faults(
        [killed, stopped], [], [decision(9.9), decision(10.8), decision(20.53)]
    )
    assert first.in_use
    assert first.recovery_ms == pytest.approx(800.0)
    assert second.recovery_ms == pytest.approx(30.0)


def test_what_comes_after_the_next_strike_is_due_to_that() -> None:
    strikes = [
        InjectedFault(kind="cloud_stopped", target=CLOUD, injected_at=10.0, usable_at=10.1),
        InjectedFault(kind="link_cut", target=OTHER, injected_at=10.2, usable_at=10.3),
        InjectedFault(kind="cloud_killed", target=CLOUD, injected_at=11.0),
    ]
    logged = [
        LogEvent(10.25, "service_vanished", {"service": OTHER}),
        LogEvent(11.01, "service_vanished", {"service": CLOUD}),
    ]
    first, second, third = times_of_faults(strikes, logged, [decision(9.9), decision(10.9)])
    assert first.detection_ms is None
    assert second.detection_ms == pytest.approx(50.0)
    assert third.detection_ms == pytest.approx(10.0)
    # A robot's end is the end of whatever struck before.
    killed = InjectedFault(kind="robot_killed", target=ROBOT, injected_at=10.05)
    first, _ = times_of_faults([strikes[0], killed], logged, [decision(9.9), decision(12.0)])
    assert first.detection_ms is None


def test_spread() -> None:
    assert spread_of([]) is None
    one = spread_of([3.0])
    assert one is not None
    assert (one.count, one.median_ms, one.p95_ms, one.max_ms) == (1, 3.0, 3.0, 3.0)
    many = spread_of([float(number) for number in range(100, -1, -1)])
    assert many is not None
    assert (many.count, many.median_ms, many.p95_ms, many.max_ms) == (101, 50.0, 95.0, 100.0)


def test_lines_that_are_events() -> None:
    line = '{"time":"1970-01-01T00:00:01.500000Z","component":"robot","event":"launch","n":3}'
    logged = log_event_of(line)
    assert logged is not None
    assert (logged.at, logged.name, logged.fields["n"]) == (1.5, "launch", 3)
    for other in ("", "ready", "{", '{"event": "ready"}', '{"time": 3, "event": "x"}', "[]"):
        assert log_event_of(other) is None
