import itertools
from typing import TypeAlias

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.errors import KeysExhaustedError
from holdfast.transport import datagram_cipher
from holdfast.transport.datagram_cipher import (
    KNOWN_AFTER,
    LOSS_SAMPLE,
    OVERHEAD,
    WINDOW,
    AssociationKeys,
    DatagramCipher,
    ReplayWindow,
)

Ends: TypeAlias = tuple[DatagramCipher, DatagramCipher]


@pytest.fixture
def ends() -> Ends:
    keys = AssociationKeys.draw(7)
    return DatagramCipher(keys, service=False), DatagramCipher(keys, service=True)


class TestSealing:
    def test_what_one_end_seals_the_other_opens(self, ends: Ends) -> None:
        for sender, receiver in itertools.permutations(ends):
            for message in (b"", b"a message", bytes(1000)):
                datagram = sender.encrypt(message)
                assert len(datagram) == len(message) + OVERHEAD
                assert int.from_bytes(datagram[:4]) == 7
                assert receiver.decrypt(datagram) == message

    def test_a_message_cannot_be_read_in_it(self, ends: Ends) -> None:
        robot, _ = ends
        assert b"a secret" not in robot.encrypt(b"a secret")

    def test_in_any_order(self, ends: Ends) -> None:
        robot, service = ends
        datagrams = [robot.encrypt(b"%d" % k) for k in range(5)]
        for k in (3, 0, 4, 2, 1):
            assert service.decrypt(datagrams[k]) == b"%d" % k
        assert [service.decrypt(datagram) for datagram in datagrams] == [None] * 5

    def test_it_cannot_be_reflected(self, ends: Ends) -> None:
        robot, service = ends
        assert robot.decrypt(robot.encrypt(b"mine")) is None
        assert service.decrypt(service.encrypt(b"mine")) is None

    def test_each_changed_bit_and_each_missing_byte_is_noticed(self, ends: Ends) -> None:
        robot, service = ends
        datagram = robot.encrypt(b"a message")
        for bit in range(8 * len(datagram)):
            changed = bytearray(datagram)
            changed[bit // 8] ^= 1 << bit % 8
            assert service.decrypt(bytes(changed)) is None
        for size in range(len(datagram)):
            assert service.decrypt(datagram[:size]) is None
        assert service.decrypt(datagram + b"\0") is None
        assert service.decrypt(datagram) == b"a message"

    def test_a_forged_counter_does_not_move_the_window(self, ends: Ends) -> None:
        robot, service = ends
        datagram = robot.encrypt(b"genuine")
        forged = datagram[:4] + (100_000).to_bytes(4, "big") + datagram[8:]
        assert service.decrypt(forged) is None
        assert service.window.newest == -1
        assert service.decrypt(datagram) == b"genuine"

    def test_other_keys_and_other_associations(self, ends: Ends) -> None:
        robot, service = ends
        same_number = DatagramCipher(AssociationKeys.draw(7), service=True)
        keys = AssociationKeys.draw(8)
        renumbered = DatagramCipher(
            AssociationKeys(7, keys.to_service, keys.to_robot), service=False
        )
        assert same_number.decrypt(robot.encrypt(b"x")) is None
        assert service.decrypt(renumbered.encrypt(b"x")) is None
        other = DatagramCipher(keys, service=True)
        assert other.decrypt(robot.encrypt(b"x")) is None
        # The number alone is enough, though the nonce would be the right one.
        same_keys = AssociationKeys(9, keys.to_service, keys.to_robot)
        assert other.decrypt(DatagramCipher(same_keys, service=False).encrypt(b"x")) is None

    def test_no_counter_is_used_beyond_the_bound(
        self, ends: Ends, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        robot, _ = ends
        monkeypatch.setattr(datagram_cipher, "MAX_DATAGRAMS", 3)
        for _ in range(3):
            robot.encrypt(b"")
        with pytest.raises(KeysExhaustedError, match="association 7 has encrypted 3 datagrams"):
            robot.encrypt(b"")

    def test_none_beyond_the_bound_is_taken(
        self, ends: Ends, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """An end that goes on all the same."""
        robot, service = ends
        datagrams = [robot.encrypt(b"x") for _ in range(5)]
        monkeypatch.setattr(datagram_cipher, "MAX_DATAGRAMS", 3)
        assert [service.decrypt(each) for each in datagrams] == [b"x"] * 3 + [None] * 2

    def test_keys_are_never_the_same_and_not_shown(self) -> None:
        drawn = [AssociationKeys.draw(1) for _ in range(100)]
        assert len({key for keys in drawn for key in keys[1:]}) == 200
        assert all(len(key) == 32 for keys in drawn for key in keys[1:])
        assert repr(drawn[0]) == "AssociationKeys(association=1, to_service=..., to_robot=...)"

    @given(st.binary(max_size=100))
    def test_arbitrary_bytes_are_no_datagram(self, data: bytes) -> None:
        service = DatagramCipher(AssociationKeys.draw(0), service=True)
        assert service.decrypt(data) is None
        assert service.decrypt(bytes(4) + data) is None
        assert service.window.newest == -1


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

    @pytest.mark.parametrize("behind", [0, 1, WINDOW - 1, WINDOW, WINDOW + 1, 2 * WINDOW])
    def test_no_replay_is_fresh_wherever_the_window_is(self, behind: int) -> None:
        """Also at its edges, whether the newest is reached step by step or in one."""
        for counters in (range(behind + 1), (0, behind)):
            window = ReplayWindow()
            for counter in counters:
                window.note(counter)
            assert window.newest == behind
            assert not window.is_fresh(0)
        # What has not come is fresh as long as the window can tell.
        window = ReplayWindow()
        window.note(behind)
        assert window.is_fresh(0) == (0 < behind < WINDOW)
        assert window.is_fresh(behind + 1)

    def test_none_is_lost_when_all_come(self) -> None:
        window = ReplayWindow()
        for counter in range(1000):
            window.note(counter)
            assert window.num_lost == (counter < KNOWN_AFTER + 2)

    def test_what_does_not_come_is_lost_until_it_is_long_ago(self) -> None:
        window = ReplayWindow()
        seen = {}
        for counter in range(400):
            if counter != 100:
                window.note(counter)
                seen[counter] = window.num_lost
        assert all(seen[counter] == 0 for counter in range(KNOWN_AFTER + 2, 100))
        assert all(seen[counter] == 1 for counter in range(104, 100 + LOSS_SAMPLE))
        assert all(seen[counter] == 0 for counter in range(110 + LOSS_SAMPLE, 400))

    def test_the_share(self) -> None:
        window = ReplayWindow()
        for counter in range(1000):
            if counter % 10:
                window.note(counter)
        assert abs(window.num_lost - LOSS_SAMPLE / 10) <= 1
