import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.transport import sealing
from holdfast.transport.sealing import (
    KNOWN_AFTER,
    LOSS_SAMPLE,
    OVERHEAD,
    WINDOW,
    Keys,
    KeysExhaustedError,
    ReplayWindow,
    Sealing,
    association_of,
)


@pytest.fixture
def ends() -> tuple[Sealing, Sealing]:
    keys = Keys.draw(7)
    return Sealing(keys, service=False), Sealing(keys, service=True)


class TestSealing:
    def test_what_one_end_seals_the_other_opens(self, ends: tuple[Sealing, Sealing]) -> None:
        for sender, receiver in itertools.permutations(ends):
            for message in (b"", b"a message", bytes(1000)):
                datagram = sender.seal(message)
                assert len(datagram) == len(message) + OVERHEAD
                assert association_of(datagram) == 7
                assert receiver.open(datagram) == message

    def test_a_message_cannot_be_read_in_it(self, ends: tuple[Sealing, Sealing]) -> None:
        robot, _ = ends
        assert b"a secret" not in robot.seal(b"a secret")

    def test_each_passes_once(self, ends: tuple[Sealing, Sealing]) -> None:
        robot, service = ends
        datagram = robot.seal(b"once")
        assert service.open(datagram) == b"once"
        assert service.open(datagram) is None

    def test_in_any_order(self, ends: tuple[Sealing, Sealing]) -> None:
        robot, service = ends
        datagrams = [robot.seal(b"%d" % k) for k in range(5)]
        for k in (3, 0, 4, 2, 1):
            assert service.open(datagrams[k]) == b"%d" % k
        assert [service.open(datagram) for datagram in datagrams] == [None] * 5

    def test_the_same_message_is_another_datagram_each_time(
        self, ends: tuple[Sealing, Sealing]
    ) -> None:
        robot, service = ends
        datagrams = {robot.seal(b"the same") for _ in range(100)}
        assert len(datagrams) == 100
        assert {datagram[:8] for datagram in datagrams} == {
            (7).to_bytes(4, "big") + k.to_bytes(4, "big") for k in range(100)
        }
        assert all(service.open(datagram) == b"the same" for datagram in datagrams)

    def test_it_cannot_be_reflected(self, ends: tuple[Sealing, Sealing]) -> None:
        robot, service = ends
        assert robot.open(robot.seal(b"mine")) is None
        assert service.open(service.seal(b"mine")) is None

    def test_each_changed_bit_and_each_missing_byte_is_noticed(
        self, ends: tuple[Sealing, Sealing]
    ) -> None:
        robot, service = ends
        datagram = robot.seal(b"a message")
        for bit in range(8 * len(datagram)):
            changed = bytearray(datagram)
            changed[bit // 8] ^= 1 << bit % 8
            assert service.open(bytes(changed)) is None
        for size in range(len(datagram)):
            assert service.open(datagram[:size]) is None
        assert service.open(datagram + b"\0") is None
        assert service.open(datagram) == b"a message"

    def test_a_forged_counter_does_not_move_the_window(self, ends: tuple[Sealing, Sealing]) -> None:
        robot, service = ends
        datagram = robot.seal(b"genuine")
        forged = datagram[:4] + (100_000).to_bytes(4, "big") + datagram[8:]
        assert service.open(forged) is None
        assert service.window.newest == -1
        assert service.open(datagram) == b"genuine"

    def test_other_keys_and_other_associations(self, ends: tuple[Sealing, Sealing]) -> None:
        robot, service = ends
        same_number = Sealing(Keys.draw(7), service=True)
        keys = Keys.draw(8)
        renumbered = Sealing(Keys(7, keys.to_service, keys.to_robot), service=False)
        assert same_number.open(robot.seal(b"x")) is None
        assert service.open(renumbered.seal(b"x")) is None
        other = Sealing(keys, service=True)
        assert other.open(robot.seal(b"x")) is None

    def test_no_counter_is_used_beyond_the_bound(
        self, ends: tuple[Sealing, Sealing], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        robot, _ = ends
        monkeypatch.setattr(sealing, "MAX_DATAGRAMS", 3)
        for _ in range(3):
            robot.seal(b"")
        with pytest.raises(KeysExhaustedError, match="association 7 has sealed 3 datagrams"):
            robot.seal(b"")

    def test_keys_are_never_the_same_and_not_shown(self) -> None:
        drawn = [Keys.draw(1) for _ in range(100)]
        assert len({key for keys in drawn for key in keys[1:]}) == 200
        assert all(len(key) == 32 for keys in drawn for key in keys[1:])
        assert repr(drawn[0]) == "Keys(association=1, to_service=..., to_robot=...)"

    @given(st.binary(max_size=100))
    def test_arbitrary_bytes_are_no_datagram(self, data: bytes) -> None:
        service = Sealing(Keys.draw(0), service=True)
        assert service.open(data) is None
        assert service.open(bytes(4) + data) is None
        assert service.window.newest == -1


WINDOW_BEGINS = 2 * KNOWN_AFTER


def known() -> ReplayWindow:
    """Return a window of a way that is known to lose none."""
    window = ReplayWindow()
    for counter in range(WINDOW_BEGINS):
        window.note(counter)
    assert window.lost == 0
    return window


class TestReplayWindow:
    @given(st.lists(st.integers(0, 3 * WINDOW), max_size=300))
    def test_as_a_set_of_all_that_came(self, counters: list[int]) -> None:
        window, came = ReplayWindow(), set[int]()
        for counter in counters:
            newest = max(came, default=-1)
            fresh = counter not in came and counter > newest - WINDOW
            assert window.is_fresh(counter) == fresh
            if fresh:
                window.note(counter)
                came.add(counter)
                assert window.newest == max(came)

    def test_none_is_lost_when_all_come(self) -> None:
        window = ReplayWindow()
        for counter in range(1000):
            window.note(counter)
            assert window.lost == (counter < KNOWN_AFTER + 2)

    def test_what_is_late_is_not_lost(self) -> None:
        window = known()
        for counter in (0, 1, 2, 5, 4, 3, 8, 7, 6):
            window.note(WINDOW_BEGINS + counter)
            assert window.lost == 0

    def test_what_does_not_come_is_lost_until_it_is_long_ago(self) -> None:
        window = ReplayWindow()
        seen = {}
        for counter in range(400):
            if counter != 100:
                window.note(counter)
                seen[counter] = window.lost
        assert all(seen[counter] == 0 for counter in range(KNOWN_AFTER + 2, 100))
        assert all(seen[counter] == 1 for counter in range(104, 100 + LOSS_SAMPLE))
        assert all(seen[counter] == 0 for counter in range(110 + LOSS_SAMPLE, 400))

    def test_the_share(self) -> None:
        window = ReplayWindow()
        for counter in range(1000):
            if counter % 10:
                window.note(counter)
        assert abs(window.lost - LOSS_SAMPLE / 10) <= 1
