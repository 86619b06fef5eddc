"""The worlds of others in ``benchmarks``: their models are the published ones."""

import numpy as np
import pytest
from benchmarks import light_dark, rock_sample, source_location
from benchmarks.sensor_management import BEARING, MISSED, RANGE, Beam

from holdfast.numerics.randomness import Purpose, stream


class TestRockSample:
    @pytest.mark.parametrize("rocks", [0, 1, 37, 128, 255])
    def test_the_best_tour_of_known_rocks_earns_its_value(self, rocks: int) -> None:
        problem, world = rock_sample.RockSample(), rock_sample.World(0, 0)
        world.good = np.array([bool(rocks >> rock & 1) for rock in range(len(rock_sample.ROCKS))])
        state = np.array([*rock_sample.START, *world.good], dtype=float)
        noise, reward = stream(0, 0, 0, Purpose.PREDICTION), 0.0
        while not world.over:
            action = problem.limit_action(problem.policy(state, 0))
            state = problem.move(state, action, noise)
            reward += rock_sample.DISCOUNT**world.steps * float(problem.reward(state, action))
            world.act(rock_sample.code_of(action))
        value = rock_sample.tours()[0][(rocks, *rock_sample.START)]
        assert world.reward == pytest.approx(value)
        assert reward == pytest.approx(value)

    def test_a_check_is_right_as_often_as_published(self) -> None:
        world = rock_sample.World(0, 0)
        beside = np.flatnonzero((rock_sample.ROCKS == (0, 1)).all(axis=1))[0]
        assert world.accuracy(beside) == pytest.approx(0.5 + 0.5 * 2.0 ** (-2.0 / 20.0))


class TestLightDark:
    @pytest.mark.parametrize("place", [-30, -6, 0, 7, 30])
    def test_a_known_place_earns_its_value(self, place: int) -> None:
        problem, world = light_dark.LightDarkLine(), light_dark.World(0, 0)
        world.place = place
        value = problem.known_state_return(np.array([[float(place)]]), np.zeros(1, dtype=int))
        while not world.over:
            way = problem.policy(np.array([float(world.place)]), 0)
            world.act(int(problem.limit_action(way)[0]))
        assert world.reward == pytest.approx(value[0])

    def test_a_published_policy_earns_nearly_what_was_published(self) -> None:
        rule, mean, _ = light_dark.PUBLISHED["side"]
        rewards = [light_dark.play_published(rule, 0, trial).reward for trial in range(400)]
        # Its authors' filter, which draws some particles anew, is surer a little later.
        assert 0.0 < np.mean(rewards) - mean < 4.0


class TestSourceLocation:
    def test_what_shows_nothing_gains_nothing(self) -> None:
        places, heard = np.full((30, 2), 1e9), np.full(30, np.log(source_location.BACKGROUND))
        truth, draws = np.zeros(4), np.random.default_rng(0)
        assert source_location.spce(truth, places, heard, draws, 1000) == pytest.approx(0.0)

    def test_the_bound_is_that_of_bayes_rule_over_the_draws(self) -> None:
        draws = np.random.default_rng(1)
        truth, places = draws.normal(size=4), draws.normal(size=(3, 2))
        heard = np.array([source_location.signal(truth, place) for place in places]) + 0.3
        found = source_location.spce(truth, places, heard, np.random.default_rng(2), 500)
        others = np.random.default_rng(2).normal(size=(500, 4))
        each = np.concatenate([truth[np.newaxis], others])[:, np.newaxis]
        off = source_location.signal(each, places) - heard
        likely = np.exp(-2.0 * (off * off).sum(axis=1))
        assert found == pytest.approx(np.log(likely[0] / np.mean(likely)), abs=1e-4)


def test_a_beam_shows_what_is_in_it() -> None:
    """One target ahead, one behind, one aside of a beam along x."""
    state = np.array([20.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 10.0, 0.0, 5.0, 0.0])
    shown = Beam().sample_observation(state, 0, stream(0, 0, 0, Purpose.SELECTION)).reshape(3, 3)
    assert shown[:, 2].tolist() == [1.0, 0.0, 0.0]
    assert shown[0, :2] == pytest.approx([0.0, 10.0], abs=5.0 * max(BEARING, RANGE))
    turned = Beam().log_likelihood(state[np.newaxis], 3, shown.reshape(-1))
    assert turned == pytest.approx([2.0 * MISSED])
