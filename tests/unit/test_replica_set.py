"""What a robot knows of the services."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from holdfast.protocol.question import Question
from holdfast.protocol.replica_set import Replica, ReplicaSet


class TestLateReplies:
    """Replies of a service that is further away than the timeout is long."""

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
        again = [(3.0, 3.4), (4.0, 4.3)]
        assert self.heard(*late, *in_time, *again) == [None] * 5
        told = self.heard(*late, *in_time, *again, (5.0, 5.5))
        assert told[-1] == pytest.approx(0.3)

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


def test_a_wrong_service_stays_so_whatever_it_does() -> None:
    services = ReplicaSet(["cloud", "other"], None, 0.25, distrusted=["cloud", "unknown"])
    cloud, other = services.cloud
    other.distrust("lied")
    for replica in (cloud, other):
        replica.detector.appeared("b1", 0.0)
        replica.forget()
        replica.note_lost_state()
        assert replica.refusal is not None
        assert replica.refusal == replica.distrusted
        assert replica.refusal_code == "wrong_answer"
        assert not replica.usable(9.0)
    assert services.all_refuse()
    assert services.explain_no_service().endswith("other: wrong_answer: lied")


def told(service: Replica) -> str | None:
    return service.refusal or service.complaint


def test_pauses_grow_to_a_second_and_end_with_both_parts() -> None:
    service = Replica("cloud", 0.25)
    service.detector.appeared("b1", 0.0)
    pauses = []
    for _ in range(8):
        service.delay(10.0)
        pauses.append(round(service.retry_at - 10.0, 9))
    assert pauses == [0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.0, 1.0]
    assert service.note_busy(0.1, 10.0) == 1.0  # it said that already, and was asked too soon
    assert not service.usable(10.999)
    assert service.usable(11.0)
    for sensing in (False, True):
        service.note_refusal("busy", "no", 20.0, sensing=sensing)
    assert told(service) == "busy: no"
    service.detector.suspect("it was silent")
    service.note_answer(question_at(0), 20.5, sensing=True, restored=False)
    assert service.usable(20.5)
    assert (service.backoff_s, service.num_refusals) == (1.0, [1, 0])
    assert told(service) is not None
    service.note_answer(question_at(0), 21.0, sensing=False, restored=False)
    assert (service.backoff_s, service.num_refusals) == (0.02, [0, 0])
    assert told(service) is None


def test_memory_is_waited_for_longer_and_what_no_service_can_do_not_at_all() -> None:
    service = Replica("cloud", 0.25)
    found = [service.note_refusal("out_of_memory", "full", 1.0, sensing=False) for _ in range(5)]
    assert found == [False] * 4 + [True]
    assert service.retry_at == pytest.approx(1.0 + 1.0)
    assert (told(service), service.refusal_code) == ("full", "out_of_memory")
    service.forget()
    assert told(service) is None
    assert not service.note_refusal("out_of_memory", "full", 1.0, sensing=False)
    assert service.retry_at == 1.1
    for code in ("unknown_problem", "other_code", "version", "too_large"):
        service.forget()
        assert service.note_refusal(code, "no", 1.0, sensing=True)


def question_at(
    num_inputs: int,
    kept: int | None = None,
    *,
    trial: int = 0,
    step: int = 0,
    size: int = 10,
    is_first: bool = False,
    new_inputs: int = 1,
) -> Question:
    """Return a question after so many inputs, the last of which are there."""
    belief = SimpleNamespace(states=np.zeros(size))
    kept = num_inputs if kept is None else kept
    made = SimpleNamespace(
        state=SimpleNamespace(trial=trial, step=step, belief=belief),
        num_inputs=num_inputs,
        new_inputs=new_inputs,
        inputs=tuple(range(num_inputs - kept, num_inputs)),
        is_first=is_first,
    )
    return cast(Question, made)


WHOLE = ((), b"state")


def needs(service: Replica, question: Question, *, whole_state: bool) -> Any:
    lacking = service.num_lacking(question, whole_state=whole_state)
    return WHOLE if lacking is None else (question.inputs[len(question.inputs) - lacking :], None)


class TestWhatItNeeds:
    def service(self, held: int | None, *, trial: int = 0) -> Replica:
        service = Replica("cloud", 0.25)
        if held is not None:
            service.note_answer(question_at(held, trial=trial), 0.0, sensing=True, restored=False)
        return service

    def test_what_it_holds_is_the_latest_of_all(self) -> None:
        service = self.service(5)
        service.note_answer(question_at(3), 0.0, sensing=True, restored=False)
        assert service.acknowledged == (0, 5)
        service.note_answer(question_at(1, trial=1), 0.0, sensing=True, restored=False)
        assert service.acknowledged == (1, 1)

    def test_one_input_is_sent_alone_and_more_as_the_state(self) -> None:
        assert needs(self.service(5), question_at(5), whole_state=False) == ((), None)
        assert needs(self.service(7), question_at(5), whole_state=False) == ((), None)
        assert needs(self.service(5), question_at(6), whole_state=False) == ((5,), None)
        assert needs(self.service(5), question_at(6), whole_state=True) == WHOLE
        assert needs(self.service(5), question_at(7), whole_state=False) == WHOLE
        # Of a robot that has moved by itself since the question before.
        moved = question_at(7, new_inputs=2)
        assert needs(self.service(5), moved, whole_state=False) == ((5, 6), None)

    def test_a_large_state_is_replayed_up_to_a_length(self) -> None:
        for size, large in (((1 << 20) // 8, False), ((1 << 20) // 8 + 1, True)):
            question = question_at(7, size=size, step=1024)
            wanted = ((5, 6), None) if large else WHOLE
            assert needs(self.service(5), question, whole_state=False) == wanted
        long = question_at(7, size=1 << 20, step=1025)
        assert needs(self.service(5), long, whole_state=False) == WHOLE

    def test_of_another_trial_it_holds_nothing(self) -> None:
        question = question_at(1, trial=1)
        assert needs(self.service(5), question, whole_state=False) == ((0,), None)
        assert needs(self.service(5, trial=1), question, whole_state=False) == ((), None)

    def test_one_that_knows_nothing_is_sent_the_state_unless_it_begins(self) -> None:
        assert needs(self.service(None), question_at(1), whole_state=False) == WHOLE
        first = question_at(0, is_first=True)
        assert needs(self.service(None), first, whole_state=False) == ((), None)
        lost = self.service(5)
        lost.note_lost_state()
        assert needs(lost, question_at(6), whole_state=False) == WHOLE

    def test_inputs_that_are_gone(self) -> None:
        question = question_at(7, kept=1, size=1 << 20)
        assert needs(self.service(6), question, whole_state=False) == ((6,), None)
        assert needs(self.service(5), question, whole_state=False) == WHOLE

    def test_one_that_diverged_twice(self) -> None:
        service = self.service(5)
        service.num_diverged = 1
        assert needs(service, question_at(6), whole_state=False) == ((5,), None)
        service.num_diverged = 2
        assert needs(service, question_at(6), whole_state=False) == WHOLE
        service.note_answer(question_at(6), 0.0, sensing=True, restored=True)
        assert service.num_diverged == 2  # it was sent the state
        service.note_answer(question_at(6), 0.0, sensing=True, restored=False)
        assert service.num_diverged == 0


class TestAllOfThem:
    def services(self, startup_s: float = 1.0) -> ReplicaSet:
        return ReplicaSet(["first", "second"], "local", 0.25, startup_s)

    def test_until_when_they_may_be_coming_up(self) -> None:
        services = self.services()
        assert not services.is_starting(0.0)
        services.start(5.0)
        assert services.is_starting(5.999)
        assert not services.is_starting(6.0)
        services.cloud[0].distrust("lied")
        assert services.is_starting(5.0)
        services.cloud[1].distrust("lied")
        assert not services.is_starting(5.0)  # none of them is waited for
        services = self.services()
        services.start(5.0)
        services.cloud[1].detector.appeared("b1", 5.0)
        services.cloud[1].detector.vanished("b1")
        assert not services.is_starting(5.0)

    def test_the_first_that_may_be_asked_again(self) -> None:
        services = self.services()
        assert services.busy_until(0.0) is None
        for replica, after_s in zip(services.cloud, (0.5, 0.3), strict=True):
            replica.detector.appeared("b1", 0.0)
            replica.note_busy(after_s, 1.0)
        assert services.busy_until(1.0) == 1.3
        assert services.busy_until(1.3) == 1.5
        assert services.busy_until(1.5) is None
        services.cloud[1].detector.suspect("silent")
        assert services.busy_until(1.0) == 1.5

    def test_the_cloud_is_as_silent_as_the_last_that_was_heard(self) -> None:
        services = self.services()
        assert services.silence_s(9.0) is None
        services.cloud[0].detector.appeared("b1", 3.0)
        assert services.silence_s(9.0) == 6.0
        services.cloud[1].detector.appeared("b1", 5.0)
        assert services.silence_s(9.0) == 4.0
        services.cloud[1].detector.vanished("b1")
        assert services.silence_s(9.0) == 4.0

    def test_when_nobody_will_ever_answer(self) -> None:
        for code, at_once in (("invalid", True), ("failed", True), ("out_of_memory", False)):
            services = self.services()
            assert services.local is not None
            for _ in range(5):
                services.local.note_refusal(code, "no", 0.0, sensing=False)
            assert services.all_refuse() == at_once
            for replica in services.cloud:
                assert services.all_refuse() == at_once
                replica.distrust("lied")
            assert services.all_refuse()

    def test_a_local_service_is_usable_when_it_is_there(self) -> None:
        assert not ReplicaSet(["cloud"], None, 0.25).local_usable(0.0)
        services = self.services()
        assert services.local is not None
        assert not services.local_usable(0.0)
        services.local.detector.appeared("b1", 0.0)
        assert services.local_usable(0.0)

    def test_what_is_said_of_each(self) -> None:
        services = ReplicaSet(["absent", "gone", "busy", "slow", "failing", "wrong"], "local", 0.25)
        absent, gone, busy, slow, failing, wrong = services.cloud
        for replica in (gone, busy, slow, failing, wrong):
            replica.detector.appeared("b1", 0.0)
        gone.detector.vanished("b1")
        slow.detector.suspect("no sign of progress")
        failing.note_refusal("failed", "no such state", 0.0, sensing=True)
        wrong.distrust("lied")
        assert absent.refusal is None
        assert services.why_lost().split("; ") == [
            "absent has not appeared",
            "gone is gone",
            "busy is busy",
            "slow no sign of progress",
            "failing failed: no such state",
            "wrong lied",
        ]
        assert services.explain_no_service().split("; ") == [
            "absent: has not appeared",
            "gone: is not there",
            "busy: is busy",
            "slow: no sign of progress",
            "failing: failed: no such state",
            "wrong: wrong_answer: lied",
            "local: is being launched",
        ]
