"""Evidence that a service is dead or only slow."""

import pytest

from holdfast.protocol.failure_detector import FailureDetector


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


def test_patience_has_its_limit_and_is_never_shortened() -> None:
    detector = present_detector()
    detector.asked(0.0)
    for factor, limit_s, deadline in ((2.0, 0.4, 0.4), (2.0, 0.3, 0.4), (1.5, 1.0, 0.6)):
        detector.extend_patience(factor, limit_s)
        assert detector.deadline() == pytest.approx(deadline)


def test_silence_before_something_is_awaited_asks_for_no_patience() -> None:
    """The longest silence of an answer counts, and that of the next begins anew."""
    detector = present_detector()
    detector.extend_patience(16.0, 60.0)  # to 4 s
    detector.heard(100.0)
    detector.asked(100.0)
    detector.heard(100.1)
    detector.answered()
    assert detector.deadline() == pytest.approx(102.1)
    detector.heard(101.7)
    detector.answered()
    assert detector.deadline() == pytest.approx(103.7)  # 1.6 s were needed
    detector.heard(101.8)
    detector.answered()
    assert detector.deadline() == pytest.approx(102.8)


def test_what_is_settled_twice_is_not_owed() -> None:
    detector = present_detector()
    detector.settled()
    detector.asked(1.0)
    assert detector.deadline() == 1.25
    detector.excuse(2.0)
    assert detector.deadline() == 3.25
    assert detector.silence_s(2.0) == 0.0


def test_patience_that_was_not_needed_is_given_back() -> None:
    """A local service that was silent once was given ever more time, for ever."""
    prompt, detector = present_detector(), present_detector()
    prompt.extend_patience(2.0, 60.0)
    prompt.asked(0.0)
    prompt.heard(0.01)
    prompt.answered()
    assert prompt.deadline() == 0.26
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
