"""A service that lies, or errs, is found out by the robot, which does what its own planner says."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from tests.robot_world import LOCAL, PROBLEM, World

from holdfast.errors import OwnDecisionError, ServiceRefusedError
from holdfast.numerics.arrays import FloatArray
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.events import (
    Act,
    ComputeOwnAnswer,
    Effects,
    Halt,
    LogEvent,
    OwnAnswer,
    RobotEffect,
    VerificationNoted,
)
from holdfast.protocol.messages import (
    Reply,
    SensingAnswer,
    TaskAnswer,
    decode_floats,
    encode_floats,
)
from holdfast.protocol.question import AnswerPart, Provenance, Question
from holdfast.protocol.verification import MAX_OPEN_CHECKS, Verification


def lie(world: World, name: str, change: Callable[[Reply], Reply], after: int = 0) -> None:
    """Let a service change its answers from one of its requests on."""
    service = world.services[name]
    honest = service.answer
    asked = 0

    def answer(payload: bytes) -> list[Reply]:
        nonlocal asked
        asked += 1
        replies = honest(payload)
        return replies if asked <= after else [change(reply) for reply in replies]

    service.answer = answer  # type: ignore[method-assign]


def other_actions(factor: float) -> Callable[[Reply], Reply]:
    """Return a lie about task actions: each is so much of what it should be."""

    def change(reply: Reply) -> Reply:
        if not isinstance(reply, TaskAnswer):
            return reply
        numbers = factor * decode_floats(reply.actions, len(reply.actions) // 8)
        return msgspec.structs.replace(reply, actions=encode_floats(numbers))

    return change


def other_sensing(reply: Reply) -> Reply:
    if not isinstance(reply, SensingAnswer):
        return reply
    following = (reply.sensing_action + 1) % len(PROBLEM.sensing_actions)
    return msgspec.structs.replace(reply, sensing_action=following)


def verdicts(world: World) -> list[tuple[str, str, str]]:
    """Return what the parts of answers came to that were computed again."""
    return [
        (each.service, each.kind, each.verdict)
        for each in world.verified
        if each.kind != "question"
    ]


def wrong(world: World) -> list[tuple[object, object]]:
    return [(each["service"], each["kind"]) for each in world.reports("wrong_answer")]


def test_an_action_outside_the_limits_is_never_performed() -> None:
    world = World(verify_share=0.0)
    lie(world, "cloud", other_actions(77.7), after=2)
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert wrong(world) == [("cloud", "task")]
    reason = str(world.reports("disagreement")[0]["reason"])
    assert "outside the limits of the problem's execute" in reason
    assert world.statuses() == ["local_recovery"]
    assert verdicts(world) == [("cloud", "task", "different"), ("cloud", "sensing", "same")]
    assert not world.reports("limits_unknown")
    # Impossible as it is, the planner need not be asked twice.
    assert len([e for _, e in world.trace if isinstance(e, ComputeOwnAnswer)]) == 1


def test_a_wrong_answer_does_not_end_the_recovery() -> None:
    world = World(verify_share=0.0)
    lie(world, "cloud", other_actions(77.7), after=2)

    def fault(performed: int) -> None:
        if performed == 2 and not world.statuses():
            world.kill("cloud")
            world.bring_up("cloud", 0.012)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert wrong(world) == [("cloud", "task")]
    assert world.statuses() == ["local_recovery"]
    assert sum(result.recoveries for result in world.results) == 1


def test_where_two_answers_differ_the_robot_decides() -> None:
    # The first is so slow once that the second is asked as well; that one lies, and is the sooner.
    world = World(services=("first", "second"), verify_share=0.0)
    first = world.services["first"]
    lie(world, "second", other_actions(0.5))
    honest = first.answer

    def answer(payload: bytes) -> list[Reply]:
        first.latency_s = 0.2535 if len(first.requests) == 1 else 0.001
        return honest(payload)

    first.answer = answer  # type: ignore[method-assign]
    world.start()
    world.run()
    assert world.stopped is None
    assert [each["kind"] for each in world.reports("disagreement")] == ["task"]
    assert wrong(world) == [("second", "task")]
    assert ("first", "task", "same") in verdicts(world)
    assert ("second", "task", "different") in verdicts(world)
    found_at = next(at for at, e in world.trace if is_report(e, "wrong_answer"))
    assert {sent.service for sent in world.sent if sent.at > found_at} == {"first"}


@pytest.mark.parametrize(
    ("change", "kind"), [(other_actions(0.5), "task"), (other_sensing, "sensing")]
)
def test_a_share_of_the_answers_is_computed_again(
    change: Callable[[Reply], Reply], kind: str
) -> None:
    world = World(verify_share=1.0)
    lie(world, "cloud", change, after=3)
    world.start()
    world.run()
    assert world.stopped is None
    assert len(world.results) == 2
    assert wrong(world)[0] == ("cloud", kind)
    assert len(wrong(world)) <= 2  # both parts of one answer at most
    # Nobody is asked again who was wrong; the trial that began afterwards is as it should be.
    found_at = next(at for at, e in world.trace if is_report(e, "wrong_answer"))
    assert all(sent.service == LOCAL for sent in world.sent if sent.at > found_at)
    assert {verdict for _, _, verdict in verdicts(world)} == {"same", "different"}


def is_report(effect: RobotEffect, name: str) -> bool:
    return getattr(effect, "name", None) == name


def test_honest_answers_are_all_the_same_and_cost_no_time() -> None:
    plain, verified = World(verify_share=0.0), World(verify_share=1.0)
    for world in (plain, verified):
        world.start()
        world.run()
        world.assert_same_as_without_faults()
    assert {verdict for _, _, verdict in verdicts(verified)} == {"same"}
    # A question for each observation, each with both parts; the last ones of a trial may not come.
    asked = len(verified.sent)
    assert 2 * asked - 4 <= len(verdicts(verified)) <= 2 * asked
    assert plain.now == verified.now
    assert not plain.verified


def test_the_share_is_kept_and_no_service_can_tell_which() -> None:
    drawn: dict[bytes, list[bool]] = {}
    for secret in (b"one", b"other"):
        effects: Effects[RobotEffect] = Effects()
        verification = Verification(0.25, secret, None, PROBLEM, effects)
        drawn[secret] = []
        for number in range(2000):
            question = question_of(number)
            before = len(effects)
            answer(verification, question)
            drawn[secret].append(len(effects) > before)
            for effect in effects[before:]:
                if isinstance(effect, ComputeOwnAnswer):
                    own = OwnAnswer(effect.number, (), 0, question.digest)
                    verification.decided(own, None)
    # Binomial: four standard deviations of 2,000 draws at 1/4 are 78 (false alarms: 6e-5 each).
    assert all(abs(sum(each) - 500) <= 78 for each in drawn.values())
    both = sum(a and b for a, b in zip(drawn[b"one"], drawn[b"other"], strict=True))
    assert abs(both - 125) <= 44


def question_of(number: int) -> Question:
    world = World()
    state = world.planner.init(number, 0)
    return Question(world.planner, state, number.to_bytes(16, "big"), (), 0)


def answer(verification: Verification, question: Question) -> None:
    """Let a service choose the first sensing action."""
    reply = SensingAnswer(1, question.state.step, 0, question.digest, 0)
    verification.take(question, AnswerPart("cloud", None, reply), Provenance("cloud", 0.0, 0.0))


def test_what_a_robot_cannot_keep_up_with_is_left_out_and_counted() -> None:
    effects: Effects[RobotEffect] = Effects()
    verification = Verification(1.0, b"secret", None, PROBLEM, effects)
    for number in range(MAX_OPEN_CHECKS + 7):
        answer(verification, question_of(number))
    assert len(verification) == MAX_OPEN_CHECKS
    rows = [effect.verdict for effect in effects if isinstance(effect, VerificationNoted)]
    assert (rows.count("asked"), rows.count("left_out")) == (MAX_OPEN_CHECKS, 7)


def test_a_wrong_answer_that_was_obeyed_is_found_and_the_robot_goes_on_from_where_it_is() -> None:
    world = World(verify_share=1.0)
    world.own_s = 0.025  # two actions are performed meanwhile
    lie(world, "cloud", other_actions(0.5), after=1)
    world.start()
    world.run()
    assert world.stopped is None
    assert wrong(world)[0] == ("cloud", "task")
    found_at = next(at for at, e in world.trace if is_report(e, "wrong_answer"))
    first = next(index for index, (at, e) in enumerate(world.trace) if at >= found_at)
    after = [e for _, e in world.trace[first:] if isinstance(e, Act)]
    limits = PegInHole2D().execute
    assert after
    assert all(np.array_equal(e.action, limits(e.action)) for e in after)
    # Every task action since is the robot's own, in the state in which it is.
    steps = [e.step for _, e in world.trace if isinstance(e, Act)]
    assert steps == sorted(steps) or len(world.results) == 2


def test_a_problem_that_is_not_deterministic_is_blamed_itself() -> None:
    world = World(verify_share=1.0)
    calls = 0
    honest = world.own

    def own(effect: ComputeOwnAnswer) -> OwnAnswer:
        nonlocal calls
        calls += 1
        decided = honest(effect)
        return decided._replace(actions=tuple(a * (1.0 - 1e-3 * calls) for a in decided.actions))

    world.own = own
    world.start()
    world.run()
    assert world.stopped is None
    assert world.reports("not_deterministic")
    assert not wrong(world)
    assert "not_deterministic" in {verdict for _, _, verdict in verdicts(world)}


def test_limits_that_change_what_they_let_through_tell_nothing() -> None:
    # A gear, say: what is executed is half of what is commanded.
    world = World(verify_share=0.0)
    world.limited = lambda actions: 0.5 * actions
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    # It was looked at once; the service was right.
    assert [each for each in verdicts(world) if each[1] == "task"] == [("cloud", "task", "same")]
    assert len(world.reports("disagreement")) == len(world.reports("limits_unknown")) == 1
    assert not wrong(world)


def test_where_limits_tell_nothing_each_action_is_compared_before_it_is_performed() -> None:
    world = World(verify_share=0.0)
    world.limited = lambda actions: 0.5 * actions
    lie(world, "cloud", other_actions(77.7), after=3)
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert wrong(world) == [("cloud", "task")]


def test_the_robot_holds_still_if_its_own_planner_cannot_settle_it() -> None:
    world = World(verify_share=0.0)
    lie(world, "cloud", other_actions(77.7), after=1)
    world.own = lambda effect: OwnAnswer(effect.number, failure="ValueError: no such state")
    world.start()
    world.run()
    assert isinstance(world.stopped, Halt)
    assert isinstance(world.stopped.error, OwnDecisionError)
    assert "no such state" in str(world.stopped.error)
    assert all(
        np.array_equal(e.action, PROBLEM.execute(e.action))
        for _, e in world.trace
        if isinstance(e, Act)
    )


def test_a_planner_that_hangs_is_waited_for_no_longer_than_a_decision() -> None:
    world = World(verify_share=0.0)
    lie(world, "cloud", other_actions(77.7), after=1)
    world.own_s = 1e6
    world.start()
    world.run(until_s=200.0)
    assert isinstance(world.stopped, Halt)
    assert isinstance(world.stopped.error, OwnDecisionError)
    assert "offload.decision_timeout_ms" in str(world.stopped.error)
    assert 59.0 < world.now < 62.0
    (held,) = world.reports("holding")
    assert held["reason"] == "the robot's own planner decides"


def test_a_planner_that_fails_the_second_time_acquits_nobody() -> None:
    world = World(verify_share=1.0)
    lie(world, "cloud", other_actions(0.5), after=1)
    honest = world.own

    def own(effect: ComputeOwnAnswer) -> OwnAnswer:
        return OwnAnswer(effect.number, failure="gone") if effect.again else honest(effect)

    world.own = own
    world.start()
    world.run()
    assert world.stopped is None
    assert len(world.results) == 2
    assert wrong(world)[0] == ("cloud", "task")


def test_zeros_of_other_sign_are_another_answer() -> None:
    world = World(verify_share=1.0)

    def negative_zeros(reply: Reply) -> Reply:
        if not isinstance(reply, TaskAnswer):
            return reply
        numbers = decode_floats(reply.actions, len(reply.actions) // 8)
        return msgspec.structs.replace(
            reply, actions=encode_floats(np.where(numbers == 0.0, -0.0, numbers))
        )

    lie(world, "cloud", negative_zeros)
    world.start()
    world.run()
    assert any(np.any(e.action == 0.0) for _, e in world.trace if isinstance(e, Act))
    assert wrong(world)[0] == ("cloud", "task")


def test_who_was_wrong_before_the_robot_was_resumed_is_not_asked() -> None:
    world = World(services=("first", "second"), distrusted=("first",))
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert {sent.service for sent in world.sent} == {"second"}
    assert [each["service"] for each in world.reports("distrusted")] == ["first"]


def test_until_the_planner_has_decided_twice_the_suspect_is_not_followed_blindly() -> None:
    # Two answers of the liar come while the planner is asked the second time.
    world = World(verify_share=1.0)
    lie(world, "cloud", other_actions(0.5), after=1)
    honest = world.own
    seconds: list[float] = []

    def own(effect: ComputeOwnAnswer) -> OwnAnswer:
        if effect.again:
            seconds.append(world.now)
            world.own_s = 0.2
        else:
            world.own_s = 0.001
        return honest(effect)

    world.own = own
    world.start()
    world.run()
    assert world.stopped is None
    found_at = next(at for at, e in world.trace if is_report(e, "wrong_answer"))
    acts = [
        e.action for at, e in world.trace if isinstance(e, Act) and seconds[0] <= at <= found_at
    ]
    assert len(acts) > 4
    # What is performed meanwhile is as long as the robot's own planner makes it.
    assert all(np.array_equal(action, PROBLEM.execute(2.0 * action)) for action in acts[1:])


def test_a_failed_verification_is_told_and_stops_nobody() -> None:
    world = World(verify_share=1.0)
    world.own = lambda effect: OwnAnswer(effect.number, failure="MemoryError")
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.reports("verification_failed")
    assert {verdict for _, _, verdict in verdicts(world)} == {"failed"}


def test_a_service_that_was_wrong_is_not_asked_again_when_it_is_started_anew() -> None:
    world = World(verify_share=0.0)
    lie(world, "cloud", other_actions(77.7), after=1)
    world.on_act = lambda step: world.bring_up("cloud") if step == 6 else None
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    found_at = next(at for at, e in world.trace if is_report(e, "wrong_answer"))
    assert all(sent.service == LOCAL for sent in world.sent if sent.at > found_at)


def test_without_a_local_service_the_robot_stops_when_all_have_lied() -> None:
    world = World(verify_share=0.0, launch="never")
    lie(world, "cloud", other_actions(77.7), after=1)
    world.start()
    world.run()
    assert isinstance(world.stopped, Halt)
    assert isinstance(world.stopped.error, ServiceRefusedError)
    assert "the robot's own planner" in str(world.stopped.error)


def test_two_services_that_give_the_same_wrong_answer_are_both_found_out() -> None:
    """They agree, so nothing is disputed; the robot's own planner says otherwise."""
    effects: Effects[RobotEffect] = Effects()
    verification = Verification(1.0, b"secret", None, PROBLEM, effects)
    question = question_of(3)
    for service in ("first", "second", "first"):
        reply = SensingAnswer(1, question.state.step, 0, question.digest, 0)
        part = AnswerPart(service, None, reply)
        verification.take(question, part, Provenance(service, 0.0, 0.0))
    assert [part.service for part in question.parts] == ["first", "second"]
    assert not question.disputed
    while asked := [each for each in effects.take() if isinstance(each, ComputeOwnAnswer)]:
        for each in asked:
            verification.decided(OwnAnswer(each.number, (), 1, question.digest), None)
    wrong = [(each.service, each.step, each.kind) for each in verification.take_wrong()]
    assert wrong == [("first", 0, "sensing"), ("second", 0, "sensing")]
    assert verification.take_wrong() == []


def test_a_second_liar_that_agrees_with_the_first_is_found_out_in_a_run() -> None:
    world = World(services=("first", "second"), verify_share=1.0)
    for name in ("first", "second"):
        lie(world, name, other_sensing)
    world.start()
    world.run()
    assert world.stopped is None
    assert {service for service, _ in wrong(world)} == {"first", "second"}
    assert world.statuses()[-1] == "local_recovery"


def choice(service: str, question: Question, sensing_action: int) -> AnswerPart:
    reply = SensingAnswer(1, question.state.step, sensing_action, question.digest, 0)
    return AnswerPart(service, None, reply)


def test_of_many_answers_that_differ_it_is_said_and_asked_once() -> None:
    effects: Effects[RobotEffect] = Effects()
    verification = Verification(0.0, b"secret", None, PROBLEM, effects)
    question = question_of(3)
    for number, service in enumerate(("first", "second", "third", "fourth")):
        part = choice(service, question, number % 3)
        verification.take(question, part, Provenance(service, 0.0, 0.0))
        assert question.disputed == (number > 0)
    taken = effects.take()
    assert [type(each) for each in taken if isinstance(each, LogEvent)] == [LogEvent]
    (asked,) = [each for each in taken if isinstance(each, ComputeOwnAnswer)]
    assert asked.urgent
    verification.decided(OwnAnswer(asked.number, (), 1, question.digest), question)
    assert not question.disputed
    assert question.sensing is not None
    assert question.sensing.sensing_action == 1
    # Once it has decided, what still comes is compared, and disputes nothing.
    verification.take(question, choice("fifth", question, 2), Provenance("fifth", 0.0, 0.0))
    assert not question.disputed
    assert question.sensing.sensing_action == 1


def test_one_service_that_answers_in_two_ways_is_wrong_in_one() -> None:
    effects: Effects[RobotEffect] = Effects()
    verification = Verification(0.0, b"secret", None, PROBLEM, effects)
    question = question_of(3)
    for action in (1, 0, 1):
        verification.take(question, choice("cloud", question, action), Provenance("cloud", 0, 0))
    assert question.disputed
    while asked := [each for each in effects.take() if isinstance(each, ComputeOwnAnswer)]:
        for each in asked:
            verification.decided(OwnAnswer(each.number, (), 1, question.digest), None)
    assert [each.service for each in verification.take_wrong()] == ["cloud"]


def test_the_robots_own_service_is_not_sampled_but_a_suspect_is_disputed() -> None:
    effects: Effects[RobotEffect] = Effects()
    verification = Verification(1.0, b"secret", "local", PROBLEM, effects)
    for service, sampled in (("local", False), ("cloud", True)):
        question = question_of(3)
        verification.take(question, choice(service, question, 0), Provenance(service, 0.0, 0.0))
        assert question.check_decided == sampled
    (asked,) = [each for each in effects.take() if isinstance(each, ComputeOwnAnswer)]
    verification.decided(OwnAnswer(asked.number, (), 1, question.digest), None)
    suspected = question_of(4)
    verification.take(suspected, choice("cloud", suspected, 0), Provenance("cloud", 0.0, 0.0))
    assert suspected.disputed
    trusted = question_of(5)
    verification.take(trusted, choice("local", trusted, 0), Provenance("local", 0.0, 0.0))
    assert not trusted.disputed


def test_a_rounding_error_is_no_excess() -> None:
    class Clipped(PegInHole2D):
        limit = 0.0

        def execute(self, actions: FloatArray) -> FloatArray:
            return np.full_like(actions, self.limit)

    problem = Clipped()
    verification = Verification(0.0, b"", None, problem, Effects[RobotEffect]())
    for limit, slack in ((0.0, 1e-9), (1e6, 0.95e-3)):
        problem.limit = limit
        assert verification.outside_limits(np.full((2, 3), limit + slack)) is None
        outside = np.full((2, 3), limit)
        outside[1, 2] -= 1.1 * slack
        told = verification.outside_limits(outside)
        assert told is not None
        assert told.startswith("task action (")


def test_the_robot_follows_the_first_of_each_part_and_keeps_a_bounded_number() -> None:
    verification = Verification(0.0, b"secret", None, PROBLEM, Effects[RobotEffect]())
    question = question_of(3)
    step = PROBLEM.execute(np.full(3, 1e-3))
    for number in range(70):
        service = f"service {number}"
        provenance = Provenance(service, 0.0, 0.0)
        verification.take(question, choice(service, question, number % 2), provenance)
        actions = [step * (0.5 if number else 1.0)]
        verification.take(question, AnswerPart(service, actions, None), provenance)
    assert question.sensing is not None
    assert question.sensing.sensing_action == 0
    assert question.task_actions is not None
    assert np.array_equal(question.task_actions[0], step)
    assert question.sensing_provenance == question.task_provenance
    assert question.task_provenance == Provenance("service 0", 0.0, 0.0)
    assert len(question.parts) == 64
