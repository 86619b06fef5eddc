"""What a robot knows of the services."""

from __future__ import annotations

import pytest

from holdfast.protocol.replica_set import Replica, ReplicaSet


class TestLateReplies:
    """Of a service that is further away than the timeout is long."""

    @staticmethod
    def heard(*calls: tuple[float, float]) -> list[float | None]:
        service = Replica("cloud", 0.25, late_after_s=0.25)
        return [service.note_first_reply(sent_at, now) for sent_at, now in calls]

    def test_the_third_in_a_row_is_told_once(self) -> None:
        calls = [(float(turn), turn + 0.4 - 0.01 * turn) for turn in range(9)]
        told = self.heard(*calls)
        assert told[2] == pytest.approx(0.38)
        assert [each for each in told if each is not None] == [told[2]]

    def test_one_in_time_begins_anew(self) -> None:
        late, in_time = [(0.0, 0.4), (1.0, 1.4)], [(2.0, 2.25)]
        assert self.heard(*late, *in_time, *late) == [None] * 5

    def test_what_waited_for_the_same_thing_counts_once(self) -> None:
        """A service stood still for a second, and then replies to all that it was asked."""
        assert self.heard(*((0.25 * call, 1.1) for call in range(4))) == [None] * 4

    def test_the_local_service_is_near(self) -> None:
        services = ReplicaSet(["cloud"], "local", 0.25)
        assert services.cloud[0].late_after_s == 0.25
        assert services.local is not None
        assert [services.local.note_first_reply(0.0, 9.0) for _ in range(9)] == [None] * 9


def test_a_busy_service_is_asked_again_soon_whatever_it_says() -> None:
    service = Replica("cloud", 0.25)
    assert service.note_busy(2.0, 10.0) == 2.0
    assert service.note_busy(4_294_967.295, 10.0) == 5.0
    assert not service.usable(14.9)
    service.detector.appeared("b1", 0.0)
    assert service.usable(15.0)
