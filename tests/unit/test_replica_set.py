"""What a robot knows of the services."""

from __future__ import annotations

import pytest

from holdfast.protocol.replica_set import FailureDetector, Replica, ReplicaSet


def present_detector() -> FailureDetector:
    detector = FailureDetector(0.25)
    assert detector.appeared("a", 0.0)
    return detector


def test_absent_until_its_token_is_seen() -> None:
    detector = FailureDetector(0.25)
    assert (detector.present, detector.trusted, detector.seen) == (False, False, False)
    detector.appeared("a", 0.0)
    assert (detector.present, detector.trusted, detector.seen) == (True, True, True)


def test_a_token_that_goes_takes_only_its_own_process() -> None:
    detector = present_detector()
    assert not detector.vanished("b")
    assert (detector.present, detector.seen) == (True, True)
    assert detector.vanished("a")
    assert (detector.present, detector.seen) == (False, True)


def test_the_same_token_again_is_no_news() -> None:
    detector = present_detector()
    detector.suspect("slow")
    assert (detector.appeared("a", 0.0), detector.suspicion) == (False, "slow")
    assert (detector.appeared("b", 0.0), detector.suspicion) == (True, None)


def test_silence_counts_only_while_something_is_awaited() -> None:
    detector = present_detector()
    assert detector.deadline() is None
    assert not detector.suspect_if_silent(1e9)
    detector.asked(10.0)
    assert detector.deadline() == 10.25
    assert not detector.suspect_if_silent(10.2)
    assert detector.suspect_if_silent(10.25)
    assert detector.suspicion == "no sign of progress for 250 ms"
    assert not detector.suspect_if_silent(11.0), "suspected only once"
    assert detector.deadline() is None


def test_any_sign_moves_the_deadline_and_clears_a_suspicion() -> None:
    detector = present_detector()
    detector.asked(0.0)
    detector.heard(0.2)
    assert not detector.suspect_if_silent(0.4)
    assert detector.suspect_if_silent(0.45)
    detector.heard(5.0)
    assert detector.trusted
    assert detector.deadline() == 5.25


def test_several_awaited_things_are_one_silence() -> None:
    detector = present_detector()
    detector.asked(0.0)
    detector.asked(0.2)
    assert detector.deadline() == 0.25
    detector.settled()
    assert detector.deadline() == 0.25
    detector.settled()
    assert detector.deadline() is None
    detector.asked(9.0)
    assert detector.deadline() == 9.25


def test_patience_that_was_not_needed_is_given_back() -> None:
    """A local service that was silent once was given ever more time, for ever."""
    detector = present_detector()
    for _ in range(5):
        detector.extend_patience(2.0, 60.0)
    detector.asked(0.0)
    assert detector.deadline() == 8.0
    deadlines = []
    for _ in range(6):
        detector.heard(0.01)
        detector.answered()
        deadlines.append(detector.deadline())
    assert deadlines == [4.01, 2.01, 1.01, 0.51, 0.26, 0.26]


def test_patience_that_is_needed_is_kept() -> None:
    detector = present_detector()
    for _ in range(4):
        detector.extend_patience(2.0, 60.0)  # to 4 s
    for turn in range(10):
        detector.asked(10.0 * turn)
        detector.heard(10.0 * turn + 0.1)
        detector.heard(10.0 * turn + 3.1)
        detector.answered()
        assert detector.deadline() == pytest.approx(10.0 * turn + 7.1)
        detector.settled()


def test_one_that_was_never_asked_is_silent_since_it_appeared() -> None:
    detector = FailureDetector(0.3)
    detector.appeared("a", 86_400.0)
    assert detector.silence_s(86_401.0) == 1.0


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


def test_refusals_of_the_two_parts_of_an_answer_are_counted_apart() -> None:
    service = Replica("cloud", 0.25)
    for _ in range(2):
        assert not service.note_refusal("failed", "no", 1.0, sensing=False)
        assert not service.note_refusal("failed", "no", 1.0, sensing=True)
    assert service.note_refusal("failed", "no", 1.0, sensing=True)
