"""A service that lies, or errs, is found out by the robot, which does what its own planner says."""

from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from tests.robot_world import LOCAL, PLANNING, PROBLEM, World

from holdfast.errors import HoldfastError, ProblemError, ServiceRefusedError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.inputs import decode_floats, encode_floats
from holdfast.planning.planner import Planner
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.effects import Effects, LogEvent
from holdfast.protocol.messages import Reply, SensingAnswer, TaskAnswer
from holdfast.protocol.question import Provenance, Question, same_actions
from holdfast.protocol.robot_events import (
    Act,
    ComputeOwnAnswer,
    Halt,
    OwnAnswer,
    RobotEffect,
    VerificationNoted,
)
from holdfast.protocol.verification import MAX_OPEN_CHECKS, Verification

PLANNER = Planner(PROBLEM, PLANNING)


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
    world.complete()
    (found,) = world.reports("wrong_answer")
    step = found["step"]
    acts = [e for _, e in world.trace if isinstance(e, Act) and e.step == step]
    own = acts[0].action.tolist()
    assert (found["service"], found["kind"]) == ("cloud", "task")
    assert found["own"] == str(tuple(own))
    assert found["answered"] == str(tuple(77.7 * each for each in own))
    assert world.statuses() == ["local_recovery"]
    assert verdicts(world) == [("cloud", "task", "different")]
    assert not world.reports("limits_unknown")
    # Nothing waits for the thread of the own planner.
    assert not [e for _, e in world.trace if isinstance(e, ComputeOwnAnswer)]


def test_a_wrong_answer_does_not_end_the_recovery() -> None:
    world = World(verify_share=0.0)
    lie(world, "cloud", other_actions(77.7), after=2)

    def fault(performed: int) -> None:
        if performed == 2 and not world.statuses():
            world.kill("cloud")
            world.bring_up("cloud", 0.012)

    world.on_act = fault
    world.complete()
    assert wrong(world) == [("cloud", "task")]
    assert world.statuses() == ["local_recovery"]
    assert sum(result.recoveries for result in world.results) == 1


@pytest.mark.parametrize(
    ("change", "kind"), [(other_actions(0.5), "task"), (other_sensing, "sensing")]
)
def test_a_share_of_the_answers_is_computed_again(
    change: Callable[[Reply], Reply], kind: str
) -> None:
    world = World(verify_share=1.0)
    lie(world, "cloud", change, after=3)
    world.start_and_run()
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
        world.complete()
    assert {verdict for _, _, verdict in verdicts(verified)} == {"same"}
    # A question for each observation, each with both parts; the last ones of a trial may not come.
    asked = len(verified.sent)
    assert 2 * asked - 4 <= len(verdicts(verified)) <= 2 * asked
    assert plain.now == verified.now
    assert not plain.verified


def test_questions_that_nobody_answers_any_more_are_forgotten() -> None:
    world = World(verify_share=1.0)
    verification = world.dispatcher._verification
    kept = []
    world.on_act = lambda _: kept.append(len(verification._own))
    world.complete()
    assert len(kept) > 20
    assert max(kept) <= 2


def test_the_share_is_kept_and_no_service_can_tell_which() -> None:
    drawn: dict[bytes, list[bool]] = {}
    for secret in (b"one", b"other"):
        effects: Effects[RobotEffect] = Effects()
        verification = Verification(0.25, secret, None, PLANNER, effects)
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
    state = PLANNER.init(number, 0)
    return Question(PLANNER, state, number.to_bytes(16, "big"), (), 0)


def answer(
    verification: Verification, question: Question, service: str = "cloud", action: int = 0
) -> None:
    """Let a service choose a sensing action."""
    reply = SensingAnswer(1, question.state.step, action, question.digest, 0)
    verification.take_sensing(question, reply, Provenance(service, 0.0, 0.0))


def test_what_a_robot_cannot_keep_up_with_is_left_out_and_counted() -> None:
    effects: Effects[RobotEffect] = Effects()
    verification = Verification(1.0, b"secret", None, PLANNER, effects)
    for number in range(MAX_OPEN_CHECKS + 7):
        answer(verification, question_of(number))
    assert len(verification) == MAX_OPEN_CHECKS
    rows = [effect.verdict for effect in effects if isinstance(effect, VerificationNoted)]
    assert (rows.count("asked"), rows.count("left_out")) == (MAX_OPEN_CHECKS, 7)


def test_a_wrong_answer_that_was_obeyed_is_found_and_the_robot_goes_on_from_where_it_is() -> None:
    world = World(verify_share=1.0)
    world.own_s = 0.025  # two actions are performed meanwhile
    lie(world, "cloud", other_actions(0.5), after=1)
    world.start_and_run()
    assert world.stopped is None
    assert wrong(world)[0] == ("cloud", "task")
    found_at = next(at for at, e in world.trace if is_report(e, "wrong_answer"))
    first = next(index for index, (at, e) in enumerate(world.trace) if at >= found_at)
    after = [e for _, e in world.trace[first:] if isinstance(e, Act)]
    limits = PegInHole2D().limit_action
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
    world.start_and_run()
    assert world.stopped is None
    assert world.reports("not_deterministic")
    assert not wrong(world)
    assert "not_deterministic" in {verdict for _, _, verdict in verdicts(world)}


def test_a_planner_that_fails_the_second_time_acquits_nobody() -> None:
    world = World(verify_share=1.0)
    lie(world, "cloud", other_actions(0.5), after=1)
    honest = world.own

    world.own = lambda effect: (
        OwnAnswer(effect.number, failure=HoldfastError("gone")) if effect.again else honest(effect)
    )
    world.start_and_run()
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
    world.start_and_run()
    assert any(np.any(e.action == 0.0) for _, e in world.trace if isinstance(e, Act))
    assert wrong(world)[0] == ("cloud", "task")


def test_who_was_wrong_before_the_robot_was_resumed_is_not_asked() -> None:
    world = World(services=("first", "second"), distrusted=("first",))
    world.complete()
    assert {sent.service for sent in world.sent} == {"second"}
    assert [each["service"] for each in world.reports("distrusted")] == ["first"]


def test_a_failed_verification_is_told_and_stops_nobody() -> None:
    world = World(verify_share=1.0)
    world.own = lambda effect: OwnAnswer(effect.number, failure=HoldfastError("MemoryError"))
    world.complete()
    assert world.reports("verification_failed")
    assert {verdict for _, _, verdict in verdicts(world)} == {"failed"}


def test_a_service_that_was_wrong_is_not_asked_again_when_it_is_started_anew() -> None:
    world = World(verify_share=0.0)
    lie(world, "cloud", other_actions(77.7), after=1)
    world.on_act = lambda step: world.bring_up("cloud") if step == 6 else None
    world.complete()
    found_at = next(at for at, e in world.trace if is_report(e, "wrong_answer"))
    assert all(sent.service == LOCAL for sent in world.sent if sent.at > found_at)


def test_without_a_local_service_the_robot_stops_when_all_have_lied() -> None:
    world = World(verify_share=0.0, launch="never")
    lie(world, "cloud", other_actions(77.7), after=1)
    world.start_and_run()
    assert isinstance(world.stopped, Halt)
    assert isinstance(world.stopped.error, ServiceRefusedError)
    assert "the robot's own planner" in str(world.stopped.error)


def test_two_services_that_give_the_same_wrong_answer_are_both_found_out() -> None:
    """They agree; the robot's own planner says otherwise, of each when the robot follows it."""
    world = World(services=("first", "second"), verify_share=1.0)
    for name in ("first", "second"):
        lie(world, name, other_sensing)
    world.start_and_run()
    assert world.stopped is None
    assert {service for service, _ in wrong(world)} == {"first", "second"}
    assert world.statuses()[-1] == "local_recovery"


def asked_of(effects: Effects[RobotEffect]) -> list[ComputeOwnAnswer]:
    return [each for each in effects.take() if isinstance(each, ComputeOwnAnswer)]


def test_of_two_answers_the_first_is_followed_and_computed_again() -> None:
    effects: Effects[RobotEffect] = Effects()
    verification = Verification(0.0, b"secret", None, PLANNER, effects)
    question = question_of(3)
    for service, action in (("first", 0), ("second", 0)):
        answer(verification, question, service, action)
    assert not effects
    for service, action in (("third", 1), ("fourth", 2)):
        answer(verification, question, service, action)
    assert question.sensing is not None
    assert question.sensing.sensing_action == 0
    # Of many it is said and asked once.
    (told,) = [each for each in effects if isinstance(each, LogEvent)]
    assert (told.name, told.fields["service"], told.fields["kind"]) == (
        "disagreement",
        "third",
        "sensing",
    )
    (asked,) = asked_of(effects)
    own = OwnAnswer(asked.number, (), 1, question.digest)
    assert verification.decided(own, question)
    # The robot's own stands, also before it is certain who was wrong.
    assert question.sensing.sensing_action == 1
    assert not verification.take_wrong()
    (again,) = asked_of(effects)
    assert again.again
    assert verification.decided(own._replace(number=again.number), question)
    (wrong,) = verification.take_wrong()
    state = question.digest.hex()
    assert wrong == ("first", "sensing", 0, f"0 in state {state}", f"1 in state {state}")
    assert not verification.take_wrong()


def test_a_sensing_action_for_another_state_is_wrong() -> None:
    effects: Effects[RobotEffect] = Effects()
    verification = Verification(1.0, b"secret", None, PLANNER, effects)
    question = question_of(3)
    answer(verification, question)
    elsewhere = b"elsewhere" * 4
    for _ in range(2):
        (asked,) = asked_of(effects)
        verification.decided(OwnAnswer(asked.number, (), 0, elsewhere), None)
    (wrong,) = verification.take_wrong()
    assert wrong.own == f"0 in state {elsewhere[:16].hex()}"


def test_a_part_that_comes_after_the_own_answer_is_compared_as_well() -> None:
    effects: Effects[RobotEffect] = Effects()
    verification = Verification(1.0, b"secret", None, PLANNER, effects)
    question = tasks_of(PLANNER)
    actions, ahead = PLANNER.plan_until_sensing(question.state, question.task_count)
    verification.take_tasks(question, actions, Provenance("cloud", 0.0, 0.0))
    (asked,) = asked_of(effects)
    own = OwnAnswer(asked.number, tuple(actions), 1, PLANNER.digest(ahead))
    assert verification.decided(own, question)
    assert not asked_of(effects)
    reply = SensingAnswer(1, 3, 0, PLANNER.digest(ahead)[:16], 0)
    verification.take_sensing(question, reply, Provenance("cloud", 0.0, 0.0))
    assert question.sensing is not None
    assert question.sensing.sensing_action == 1
    (asked,) = asked_of(effects)
    assert asked.again
    verification.decided(OwnAnswer(asked.number, failure=HoldfastError("MemoryError")), question)
    assert [each.kind for each in verification.take_wrong()] == ["sensing"]


def test_the_robots_own_service_is_not_sampled() -> None:
    verification = Verification(1.0, b"secret", "local", PLANNER, Effects[RobotEffect]())
    for service, sampled in (("local", False), ("cloud", True)):
        answer(verification, question_of(3), service)
        assert len(verification) == sampled


def test_a_rounding_error_is_no_excess() -> None:
    class Clipped(PegInHole2D):
        limit = 0.0

        def limit_action(self, actions: FloatArray) -> FloatArray:
            return np.full_like(actions, self.limit)

    problem = Clipped()
    planner = Planner(problem, PLANNING)
    verification = Verification(0.0, b"", None, planner, Effects[RobotEffect]())
    for limit, slack in ((0.0, 1e-9), (1e6, 0.95e-3)):
        problem.limit = limit
        assert verification.outside_limits(np.full((2, 3), limit + slack)) is None
        outside = np.full((2, 3), limit)
        outside[1, 2] -= 1.1 * slack
        told = verification.outside_limits(outside)
        assert told is not None
        assert told.startswith("task action (")


class Geared(PegInHole2D):
    """What is executed is half of what is commanded."""

    def limit_action(self, actions: FloatArray) -> FloatArray:
        return np.asarray(0.5 * super().limit_action(actions))


def tasks_of(planner: Planner) -> Question:
    """Return a question for task actions."""
    state = planner.init(3)._replace(sensed=True)
    return Question(planner, state, planner.digest(state), (), 1)


def test_limits_that_change_what_they_let_through_are_replaced_by_the_own_planner() -> None:
    planner = Planner(Geared(), PLANNING)
    effects: Effects[RobotEffect] = Effects()
    verification = Verification(0.0, b"", None, planner, effects)
    honest = tasks_of(planner)
    own, _ = planner.plan_until_sensing(honest.state, honest.task_count)
    for question in (honest, tasks_of(planner)):
        verification.take_tasks(question, own, Provenance("cloud", 0.0, 0.0))
        assert question.followed() == [("task", "cloud")]
    # It is said once.
    (told,) = [each for each in effects.take() if isinstance(each, LogEvent)]
    assert told.name == "limits_unknown"
    question = tasks_of(planner)
    verification.take_tasks(question, [77.7 * each for each in own], Provenance("cloud", 0.0, 0.0))
    assert question.followed() == [("task", "in_process")]
    assert question.task_actions is not None
    assert same_actions(question.task_actions, own)
    assert [(each.service, each.step) for each in verification.take_wrong()] == [("cloud", 0)]


def test_the_robot_stops_if_its_own_planner_cannot_replace_an_action(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = World(verify_share=0.0)
    lie(world, "cloud", other_actions(77.7), after=1)

    def fails(*_: object) -> None:
        raise ProblemError("no such state")

    monkeypatch.setattr(Planner, "plan_until_sensing", fails)
    world.start_and_run()
    assert isinstance(world.stopped, Halt)
    assert str(world.stopped.error) == "no such state"
    assert not [e for _, e in world.trace if isinstance(e, Act)]
