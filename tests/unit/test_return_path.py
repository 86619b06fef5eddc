"""Where a service's datagrams go, step by step."""

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from holdfast.transport import return_path
from holdfast.transport.return_path import SECRET_BYTES, Probe, ReturnPath

ROBOT, ELSEWHERE, MOVED = ("192.0.2.1", 1), ("192.0.2.2", 2), ("198.51.100.1", 3)
INTERVAL_S = return_path._PROBE_INTERVAL_S


def proved(address: Any = ROBOT, now: float = 0.0) -> ReturnPath:
    path = ReturnPath()
    (probe,) = path.heard(address, now, newest=True)
    path.echoed(probe.secret, address, now)
    assert where(path) == address
    return path


def where(path: ReturnPath) -> Any:
    return path.address


def probes(path: ReturnPath, address: Any, now: float) -> dict[Any, bytes]:
    sent = path.heard(address, now, newest=True)
    return {probe.address: probe.secret for probe in sent}


def test_the_first_address_is_probed_before_anything_is_sent_there() -> None:
    path = ReturnPath()
    (probe,) = path.heard(ROBOT, 0.0, newest=True)
    assert probe.address == ROBOT and len(probe.secret) == SECRET_BYTES
    assert where(path) is None
    path.echoed(bytes(SECRET_BYTES), ROBOT, 1.0)
    path.echoed(probe.secret, ELSEWHERE, 1.0)
    path.echoed(probe.secret[:-1], ROBOT, 1.0)
    assert where(path) is None
    path.echoed(probe.secret, ROBOT, 1.0)
    assert where(path) == ROBOT
    assert path.heard(ROBOT, 2.0, newest=True) == ()


def test_a_robot_that_has_moved_is_answered_there_after_its_echo() -> None:
    path = proved()
    sent = probes(path, MOVED, 1.0)
    assert set(sent) == {MOVED, ROBOT}  # the old address may still reach it
    assert where(path) == ROBOT
    path.echoed(sent[MOVED], MOVED, 1.1)
    assert where(path) == MOVED
    sent = probes(path, ROBOT, 2.0)  # and back
    path.echoed(sent[ROBOT], ROBOT, 2.1)
    assert where(path) == ROBOT


def test_a_lost_probe_is_sent_again_with_the_same_secret() -> None:
    path = proved()
    first = probes(path, MOVED, 1.0)
    assert path.heard(MOVED, 1.0 + 0.9 * INTERVAL_S, newest=True) == ()
    assert probes(path, MOVED, 1.0 + INTERVAL_S) == first
    assert {
        probe.address: probe.secret for probe in path.heard(MOVED, 1.1, newest=False)
    } == first  # late, but from an address that is probed already


def test_a_datagram_that_was_held_back_begins_no_change() -> None:
    path = proved()
    assert path.heard(ELSEWHERE, 1.0, newest=False) == ()
    assert ReturnPath().heard(ELSEWHERE, 1.0, newest=False) == ()


def test_who_sends_everything_on_and_carries_the_probes_does_not_get_the_answers() -> None:
    """The echo of the old address shows that it still reaches the robot, whichever comes first."""
    for first in (ELSEWHERE, ROBOT):
        path = proved()
        for k in range(1, 20):
            sent = probes(path, ELSEWHERE, float(k))
            second = ROBOT if first == ELSEWHERE else ELSEWHERE
            for echo in (first, second):
                path.echoed(sent[echo], ELSEWHERE, k + 0.1)  # he is faster than the robot
            assert where(path) == ROBOT


def test_an_echo_of_the_old_address_counts_for_a_second() -> None:
    for later_s, address in ((0.99, ROBOT), (1.0, MOVED)):
        path = proved()
        sent = probes(path, MOVED, 8.0)
        path.echoed(sent[MOVED], MOVED, 8.0)
        path.echoed(sent[ROBOT], MOVED, 8.0 + later_s)
        assert where(path) == address


def test_a_second_echo_of_the_new_address_does_not_make_the_old_one_forgotten() -> None:
    path = proved()
    sent = probes(path, ELSEWHERE, 1.0)
    path.echoed(sent[ELSEWHERE], ELSEWHERE, 1.1)
    path.echoed(sent[ELSEWHERE], ELSEWHERE, 1.2)
    assert where(path) == ELSEWHERE
    path.echoed(sent[ROBOT], ELSEWHERE, 1.3)
    assert where(path) == ROBOT


def test_an_echo_from_before_a_change_says_nothing_about_the_old_address() -> None:
    path = ReturnPath()
    (probe,) = path.heard(ROBOT, 0.0, newest=True)
    path.echoed(probe.secret, ROBOT, 0.0)
    sent = probes(path, MOVED, 1.0)
    path.echoed(probe.secret, ROBOT, 1.0)  # of a second probe to the first address
    path.echoed(sent[MOVED], MOVED, 1.1)
    assert where(path) == MOVED
    path.echoed(probe.secret, ROBOT, 1.1)
    assert where(path) == MOVED


def test_the_last_of_two_new_addresses_is_the_one_that_can_be_proved() -> None:
    path = proved()
    first = probes(path, ELSEWHERE, 1.0)
    second = probes(path, MOVED, 2.0)
    path.echoed(first[ELSEWHERE], ELSEWHERE, 2.1)
    assert where(path) == ROBOT
    path.echoed(second[MOVED], MOVED, 2.1)
    assert where(path) == MOVED


@given(
    st.lists(
        st.tuples(
            st.sampled_from([ROBOT, ELSEWHERE, MOVED]),
            st.sampled_from([0.0, 0.001, 0.01, 2.0]),
            st.booleans(),
            st.booleans(),
        ),
        max_size=60,
    )
)
def test_no_address_is_used_that_has_not_echoed(steps: list[tuple[Any, float, bool, bool]]) -> None:
    path, now, sent, known = ReturnPath(), 0.0, list[Probe](), set[Any]()
    for address, wait_s, newest, echoes in steps:
        now += wait_s
        came = path.heard(address, now, newest=newest)
        assert len(came) <= 2 and all(each.address in known | {address} for each in came)
        sent.extend(came)
        if echoes and sent:
            probe = sent.pop()
            known.add(probe.address)
            path.echoed(probe.secret, probe.address, now)
        assert path.address is None or path.address in known
