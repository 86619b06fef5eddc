"""Plans for beliefs in Van der Pol tag, and rules for when to look."""

from functools import partial

import numpy as np
import pytest

from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning.belief import Belief
from holdfast.planning.settings import ActiveSensingSettings, PlanningSettings, SelectorSettings
from studies.vdp_pursuit import Pursuit, PursuitSettings, always, by_chance, by_selector, never
from studies.vdp_tag import (
    VdpTag,
    chance_of_tag,
    interception,
    missing_length,
    stop_at_barriers,
    target_flow,
    toward,
    value_of_plan,
    way_length,
)
from studies.vdp_trials import intercept, run_vdp_tag_trials, to_next

SEED = 8101
fresh = partial(stream, SEED, 0, 0, Purpose.SELECTION)  # anew at each call
SMALL = PursuitSettings(
    num_particles=48,
    num_places=16,
    num_directions=12,
    num_candidates=2,
    num_second_directions=8,
    num_observations=8,
)


@pytest.mark.parametrize(
    ("start", "end", "length"),
    [
        ((1.0, 1.0), (2.0, 1.0), 1.0),  # nothing in the way
        ((0.1, 0.1), (-0.1, -0.1), np.sqrt(0.08)),  # through the gap
        ((1.0, 0.5), (1.0, -0.5), 2.0 * np.sqrt(0.64 + 0.25)),  # past the inner end
        ((0.5, 3.5), (-0.5, 3.5), 1.0),  # beyond the outer end
    ],
)
def test_lengths_of_ways(
    start: tuple[float, float], end: tuple[float, float], length: float
) -> None:
    there = way_length(np.array(start), np.array(end))
    back = way_length(np.array(end), np.array(start))
    np.testing.assert_allclose([there, back], length)


def test_no_way_is_shorter_than_a_straight_one() -> None:
    ends = fresh().normal((2, 500, 2))
    straight = np.sqrt(((ends[0] - ends[1]) ** 2).sum(axis=-1))
    assert (way_length(ends[0], ends[1]) >= straight * (1.0 - 1e-12)).all()


def test_one_step_ends_on_a_circle_and_more_anywhere() -> None:
    lengths = np.array([0.2, 0.5, 0.9, 1.2])
    np.testing.assert_allclose(missing_length(lengths, 1), [0.3, 0.0, 0.4, 0.7])
    np.testing.assert_allclose(missing_length(lengths, 2), [0.0, 0.0, 0.0, 0.2])


def test_the_value_of_a_plan() -> None:
    assert value_of_plan(1, 1.0) == 100.0
    assert value_of_plan(1, 0.0, 20.0) == pytest.approx(-1.0 + 0.95 * 20.0)
    expected = -1.0 - 0.95 + 0.95**2 * (0.25 * 100.0 + 0.75 * (-1.0 + 0.95 * 8.0))
    assert value_of_plan(3, 0.25, 8.0) == pytest.approx(expected)


def test_the_chance_of_a_tag_is_that_of_a_gaussian_in_a_disc() -> None:
    points = 0.05 * fresh().normal((100_000, 2))
    share = (np.sqrt((points**2).sum(axis=1)) < 0.1).mean()
    # Five standard errors: one false alarm in a million seeds.
    assert abs(chance_of_tag(1) - share) < 5.0 * np.sqrt(0.12 / 100_000)


def test_a_known_target_is_met_when_it_is_said_to_be() -> None:
    """Without noise and barriers' detours: steps that are taken again and again lead there."""
    states = VdpTag().initial_states(stream(SEED, 1, 0, Purpose.INITIAL_BELIEF), 300)
    agents, targets = states[:, :2], states[:, 2:]
    _, numbers = interception(agents, targets)
    tagged = np.zeros(300, dtype=np.int64)
    for step in range(1, 31):
        steps, _ = interception(agents, targets)
        agents, targets = stop_at_barriers(agents, steps), target_flow(targets)
        near = np.sqrt(((agents - targets) ** 2).sum(axis=1)) < 0.1
        tagged = np.where((tagged == 0) & near, step, tagged)
    assert (tagged > 0).mean() > 0.95
    assert (tagged == numbers).mean() > 0.8


def test_known_states_are_worth_more() -> None:
    certain = run_vdp_tag_trials(intercept, SEED, range(20), 1, known_state=True)
    blind = run_vdp_tag_trials(intercept, SEED, range(8), 50)
    assert all(result.tagged for result in certain)
    rewards = [np.mean([each.discounted_reward for each in of]) for of in (certain, blind)]
    assert rewards[0] > 60.0 > 20.0 > rewards[1]


def test_the_known_state_return_is_the_value_of_meeting_the_target() -> None:
    near = np.array([[1.0, 1.0, 0.0, 0.0]])
    near[:, 2:] = [1.2, 1.1]
    following = target_flow(near[:, 2:])
    near[:, :2] = following - toward(following - near[:, :2])
    known = VdpTag().known_state_return(near, np.zeros(1, dtype=np.int64))
    assert known[0] == value_of_plan(1, chance_of_tag(1))


def belief_of(targets: FloatArray) -> FloatArray:
    return np.concatenate([np.zeros((1, *targets.shape)), targets[np.newaxis]], axis=-1)


def test_rules_are_asked_about_the_belief_after_the_step() -> None:
    seen: list[Belief] = []

    def rule(problem: VdpTag, belief: Belief, draw: Stream) -> bool:
        seen.append(belief)
        return True

    targets = np.array([1.5, 0.5]) + 0.01 * fresh().normal((100, 2))
    steps, looks = Pursuit(rule, SMALL).decide(belief_of(targets), [fresh()])
    (belief,) = seen
    np.testing.assert_array_equal(looks, [1])
    np.testing.assert_allclose(belief.states[:, :2], np.tile(steps, (48, 1)), atol=1e-12)
    mean = target_flow(np.array([1.5, 0.5]))
    np.testing.assert_allclose(belief.states[:, 2:].mean(axis=0), mean, atol=0.05)


def test_rules_that_look_at_nothing() -> None:
    problem = VdpTag()
    belief = Belief.uniform(problem.initial_states(fresh(), 10))
    assert not never(problem, belief, fresh())
    assert always(problem, belief, fresh())
    drawn = [by_chance(0.3)(problem, belief, fresh().substream(i)) for i in range(1000)]
    # Five standard errors.
    assert abs(np.mean(drawn) - 0.3) < 5.0 * np.sqrt(0.21 / 1000)


def test_a_selector_looks_for_enough_nats() -> None:
    problem = VdpTag()
    belief = Belief.uniform(problem.initial_states(fresh(), 60))
    sensing = ActiveSensingSettings(num_observation_samples=8, num_cores=1)
    planning = PlanningSettings(
        selector=SelectorSettings(method="state_entropy"), active_sensing=sensing
    )
    assert by_selector(planning, -50.0)(problem, belief, fresh())
    assert not by_selector(planning, 50.0)(problem, belief, fresh())


def test_a_selector_that_knows_the_price_is_asked_what_is_best() -> None:
    problem = VdpTag()
    sensing = ActiveSensingSettings(num_observation_samples=4, num_cores=1, discount=0.95)
    planning = PlanningSettings(
        selector=SelectorSettings(
            method="expected_return", rollout_steps=5, max_observation_samples=4
        ),
        active_sensing=sensing,
    )
    # Where the target is known, a look is not worth five.
    known = np.tile([1.0, 1.0, -1.5, -0.5], (40, 1))
    assert not by_selector(planning)(problem, Belief.uniform(known), fresh())


def test_a_look_is_not_worth_its_price_where_all_is_known() -> None:
    targets = np.tile([1.5, 0.5], (100, 1))
    _, looks = Pursuit(None, SMALL).decide(belief_of(targets), [fresh()])
    np.testing.assert_array_equal(looks, [0])


def test_a_target_within_one_step_is_tagged() -> None:
    targets = np.tile([1.9, 0.1], (100, 1))
    following = target_flow(targets)
    beliefs = belief_of(targets)
    beliefs[0, :, :2] = following[0] + toward(np.array([-1.0, 1.0]))
    steps, _ = Pursuit(None, SMALL).decide(beliefs, [fresh()])
    reached = stop_at_barriers(beliefs[0, 0, :2], steps[0])
    assert np.sqrt(((reached - following[0]) ** 2).sum()) < 0.1


def test_decisions_do_not_depend_on_the_company() -> None:
    beliefs = np.stack([VdpTag().initial_states(fresh().substream(i), 100) for i in range(3)])
    draws = [fresh().substream(10 + i) for i in range(3)]
    steps, looks = Pursuit(None, SMALL).decide(beliefs, draws)
    for i in range(3):
        own_step, own_look = Pursuit(None, SMALL).decide(beliefs[i : i + 1], draws[i : i + 1])
        np.testing.assert_array_equal(own_step[0], steps[i])
        assert own_look[0] == looks[i]


def test_plans_earn_more_than_heading_for_the_next_place() -> None:
    """Eight trials, and a difference of some seven standard errors."""
    plans = run_vdp_tag_trials(Pursuit(None, SMALL).decide, SEED, range(8), 200)
    rival = run_vdp_tag_trials(to_next, SEED, range(8), 100)
    means = [np.mean([each.discounted_reward for each in of]) for of in (plans, rival)]
    assert means[0] > means[1] + 20.0
