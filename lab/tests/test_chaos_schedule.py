"""What is drawn for a chaos trial: the same from the same numbers, and only what can be done."""

from collections import Counter

import msgspec
import pytest

from holdfast_lab.chaos.schedule import WIRES, Schedule, draw_schedule, kinds_over
from holdfast_lab.chaos.series import SeriesPlan
from holdfast_lab.testbed.faults import DESCRIPTIONS, NEEDS_NAMESPACE, NEEDS_PROXY, FaultKind

ALL = tuple(FaultKind)
WITHOUT_NFTABLES = tuple(kind for kind in FaultKind if kind not in NEEDS_NAMESPACE)


def drawn(kind: FaultKind, number: int = 40) -> list[Schedule]:
    return [draw_schedule(7, trial, kind, "tcp", ALL) for trial in range(number)]


@pytest.mark.parametrize("kind", ALL)
def test_it_is_a_function_of_seed_trial_and_kind(kind: FaultKind) -> None:
    first = draw_schedule(3, 5, kind, "tcp", ALL)
    assert first == draw_schedule(3, 5, kind, "tcp", ALL)
    assert first != draw_schedule(3, 6, kind, "tcp", ALL)
    assert first != draw_schedule(4, 5, kind, "tcp", ALL)
    assert msgspec.json.decode(msgspec.json.encode(first), type=Schedule) == first


def test_it_is_the_same_on_every_machine() -> None:
    schedule = draw_schedule(0, 0, FaultKind.CLOUD_KILLED, "tls", ALL)
    assert [(fault.at, fault.duration_s) for fault in schedule.faults] == [
        (0.0796, 0.525),
        (0.4941, 0.337),
    ]
    assert schedule.world_seed == 1977823661


@pytest.mark.parametrize("kind", [kind for kind in ALL if kind is not FaultKind.COMBINATION])
def test_a_trial_has_the_faults_of_its_kind(kind: FaultKind) -> None:
    for schedule in drawn(kind):
        assert {fault.kind for fault in schedule.faults} == {kind}
        assert schedule.needs_namespace == (kind in NEEDS_NAMESPACE)
        assert schedule.needs_proxy == (kind in NEEDS_PROXY)


def test_faults_come_in_order_and_within_the_run() -> None:
    for kind in ALL:
        for schedule in drawn(kind):
            times = [fault.at for fault in schedule.faults]
            assert times == sorted(times)
            assert all(0.0 < at < 1.0 for at in times)
            assert all(0.0 <= fault.duration_s <= 2.0 for fault in schedule.faults)
            assert all(0 <= fault.cloud < schedule.num_clouds for fault in schedule.faults)


def test_replicas_are_killed_alternately() -> None:
    for schedule in drawn(FaultKind.REPLICAS_KILLED):
        assert schedule.num_clouds == 2
        assert [fault.cloud for fault in schedule.faults] == [0, 1, 0]


def test_a_local_service_that_is_killed_is_launched_before() -> None:
    for kind in (FaultKind.LOCAL_KILLED, FaultKind.COMBINATION):
        for schedule in drawn(kind, 200):
            if any(fault.kind is FaultKind.LOCAL_KILLED for fault in schedule.faults):
                assert schedule.launch != "never"


def test_nobody_else_is_asked_where_there_is_nobody() -> None:
    schedules = [schedule for kind in ALL for schedule in drawn(kind)]
    assert any(schedule.decision_deadline_ms is not None for schedule in schedules)
    for schedule in schedules:
        assert schedule.launch != "never" or schedule.decision_deadline_ms is None


class TestCombination:
    def test_it_has_several(self) -> None:
        schedules = drawn(FaultKind.COMBINATION, 200)
        assert {len(schedule.faults) for schedule in schedules} == {2, 3, 4, 5}
        # Everything is combined with something, in one trial or another.
        assert {fault.kind for schedule in schedules for fault in schedule.faults} == {*ALL} - {
            FaultKind.COMBINATION,
            FaultKind.REPLICAS_KILLED,
        }

    def test_a_proxy_and_a_network_of_its_own_exclude_each_other(self) -> None:
        for schedule in drawn(FaultKind.COMBINATION, 200):
            assert not (schedule.needs_namespace and schedule.needs_proxy)

    def test_of_what_can_be_done_here(self) -> None:
        for trial in range(100):
            schedule = draw_schedule(7, trial, FaultKind.COMBINATION, "udp", WITHOUT_NFTABLES)
            assert not schedule.needs_namespace

    def test_a_local_socket_has_no_packets(self) -> None:
        schedules = [
            draw_schedule(7, trial, FaultKind.COMBINATION, "unix", ALL) for trial in range(200)
        ]
        assert not any(schedule.needs_namespace for schedule in schedules)
        assert any(schedule.needs_proxy for schedule in schedules)


def test_all_wires_have_as_many_trials_and_all_their_kinds() -> None:
    plan = SeriesPlan(seed=0, wires=WIRES, kinds=ALL, possible=ALL)
    drawn = [plan.of(trial) for trial in range(len(WIRES) * len(ALL))]
    assert Counter(wire for wire, _ in drawn) == dict.fromkeys(WIRES, len(ALL))
    for wire in WIRES:
        assert {kind for each, kind in drawn if each == wire} == set(kinds_over(wire, ALL))
    assert NEEDS_NAMESPACE.isdisjoint(kinds_over("unix", ALL))
    # The default of twenty trials has most of the kinds.
    assert len({kind for _, kind in drawn[:20]}) > 10


def test_every_kind_is_described() -> None:
    assert set(DESCRIPTIONS) == set(FaultKind)
