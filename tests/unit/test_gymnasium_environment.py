"""Environments of gymnasium as a robot's world."""

import shutil
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml
from gymnasium import spaces
from tests import mountain_car
from tests.answers import answers_in

import holdfast as hf
from holdfast.config.loader import load
from holdfast.errors import ConfigurationError, EnvironmentFailedError, InvalidValueError
from holdfast.planning.outcome import MoveResult
from holdfast.robot.environment import Environment, is_no_reading
from holdfast.robot.environment_maker import load_environment
from holdfast.robot.gymnasium_environment import GymnasiumEnvironment

CAR = "MountainCarContinuous-v0"
RIGHT = np.array([1.0])


class Counter(gymnasium.Env[Any, Any]):
    """Counts its steps in a dictionary, the same array each time, and ends as it is told."""

    def __init__(
        self, action_space: Any = None, ending: str = "", at: int = 3, **keys: Any
    ) -> None:
        self.action_space = action_space or spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = spaces.Dict(
            {"a": spaces.Box(-9.0, 9.0, (2,), np.float64), "b": spaces.Discrete(2)}
        )
        self.seen: dict[str, Any] = {"a": np.zeros(2), "b": 0}
        self.ending, self.at, self.keys = ending, at, keys
        self.actions: list[Any] = []
        self.closed = False

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.seed = seed
        self.seen["a"][:] = 0.0
        return self.seen, {}

    def step(self, action: Any) -> Any:
        self.actions.append(action)
        self.seen["a"] += 1.0
        over = self.seen["a"][0] >= self.at
        terminated, truncated = (over and word in self.ending for word in ("term", "trunc"))
        return self.seen, 0.5, terminated, truncated, self.keys if over else {}

    def close(self) -> None:
        self.closed = True


def car(**arguments: Any) -> GymnasiumEnvironment:
    return hf.GymnasiumEnvironment(CAR, sensing=[[0], [1]], **arguments)


def counter(environment: Counter | None = None, **arguments: Any) -> GymnasiumEnvironment:
    arguments.setdefault("sensing", [[0], [1]])
    return hf.GymnasiumEnvironment(environment or Counter(), **arguments)


class TestAnEpisode:
    def test_it_is_an_environment_that_counts_and_remembers(self) -> None:
        environment = car()
        assert isinstance(environment, Environment)
        first = environment.perform(RIGHT)
        assert environment.last_move() == first
        assert environment.steps_performed() == 1
        assert environment.is_done() is False

    def test_the_same_run_meets_the_same_episodes(self) -> None:
        def shown(seed: int, trial: int) -> tuple[float, ...]:
            environment = car(seed=seed, trial=trial)
            environment.perform(RIGHT)
            return tuple(environment.perform_sensing(each)[0] for each in range(2))

        assert shown(1, 2) == shown(1, 2)
        assert len({shown(1, 2), shown(1, 3), shown(2, 2)}) == 3

    def test_sensing_shows_what_gymnasium_has_seen(self) -> None:
        environment = car(seed=4)
        own = gymnasium.make(CAR)
        seen, _ = own.reset(seed=environment.environment.unwrapped.np_random_seed)
        for _ in range(3):
            assert environment.perform_sensing(0) == pytest.approx(seen[:1])
            assert environment.perform_sensing(1) == pytest.approx(seen[1:])
            assert environment.perform_sensing(1).dtype == np.float64
            move = environment.perform(RIGHT)
            seen, reward, *_ = own.step(RIGHT.astype(np.float32))
            assert move.reward == reward

    def test_performed_actions_are_performed_again(self) -> None:
        """After a crash a robot goes on in the same episode."""
        actions = [np.array([value]) for value in (1.0, -0.5, 0.25)]
        before = car(seed=2, sensing_noise=0.1, motion=[0], motion_noise=0.1)
        for action in actions:
            before.perform(action)
        after = car(seed=2, sensing_noise=0.1, motion=[0], motion_noise=0.1, performed=actions)
        assert after.steps_performed() == 3
        assert after.last_move() == before.last_move()
        assert after.perform_sensing(0) == before.perform_sensing(0)
        assert after.perform(RIGHT) == before.perform(RIGHT)

    def test_what_was_shown_stays_as_it_was(self) -> None:
        """An environment may write each observation into the same array."""
        environment = counter(motion=[0], observation=[0, 1])
        first, second = environment.perform(RIGHT), environment.perform(RIGHT)
        assert first.motion == [1.0]
        assert second.motion == [1.0]
        assert np.array_equal(first.observation, [1.0, 1.0])  # type: ignore[arg-type]
        assert np.array_equal(second.observation, [2.0, 2.0])  # type: ignore[arg-type]

    def test_only_what_was_made_here_is_closed(self) -> None:
        theirs = Counter()
        counter(theirs).close()
        assert not theirs.closed
        environment = car()
        environment.close()
        environment.close()


class TestHowItEnds:
    @pytest.mark.parametrize(
        ("ending", "success", "keys", "outcome", "reason"),
        [
            (
                "term",
                None,
                {},
                "failed",
                "Counter terminated without success; success is not defined",
            ),
            ("term", None, {"is_success": True}, "failed", "Counter terminated without success"),
            ("term", "terminated", {}, "succeeded", ""),
            ("term", "is_success", {"is_success": True}, "succeeded", ""),
            ("term", "is_success", {"is_success": False}, "failed", "terminated without success"),
            ("term", "is_success", {}, "failed", "; info has no is_success; it has nothing"),
            (
                "term",
                "is_sucess",
                {"is_success": True},
                "failed",
                "; info has no is_sucess; did you mean is_success?; it has is_success",
            ),
            ("trunc", "succes", {"is_success": True}, "truncated", "; info has no succes; did you"),
            ("", "is_success", {"is_success": 1.0}, "succeeded", ""),
            ("trunc", None, {}, "truncated", "Counter truncated after 3 steps"),
            ("trunc", "terminated", {}, "truncated", "Counter truncated after 3 steps"),
            ("trunc", "is_success", {"is_success": np.True_}, "succeeded", ""),
            ("term trunc", None, {}, "failed", "Counter terminated without success"),
        ],
    )
    def test_a_success_is_one_only_if_somebody_says_so(
        self, ending: str, success: str | None, keys: Any, outcome: str, reason: str
    ) -> None:
        environment = counter(Counter(ending=ending, **keys), success=success)
        for _ in range(3):
            assert environment.is_done() is False
            environment.perform(RIGHT)
        done = environment.is_done()
        assert isinstance(done, hf.Ending)
        assert done.outcome == outcome
        assert reason in done.reason
        assert bool(done.reason) == bool(reason)

    def test_a_function_has_the_last_word(self) -> None:
        def told(environment: Any, observation: Any, info: Any) -> Any:
            assert environment.unwrapped.at == 3
            return hf.Ending("failed", "fell over") if observation["a"][0] == 2 else False

        environment = counter(success=told)
        environment.perform(RIGHT)
        assert environment.is_done() is False
        environment.perform(RIGHT)
        assert environment.is_done() == hf.Ending("failed", "fell over")


class TestActions:
    @pytest.mark.parametrize(
        ("space", "given", "performed"),
        [
            (spaces.Box(-1.0, 1.0, (2,), np.float32), [0.25, 7.0], [0.25, 1.0]),
            (spaces.Box(-1.0, 1.0, (2, 1), np.float64), [0.25, -7.0], [[0.25], [-1.0]]),
            (spaces.Box(0, 9, (1,), np.int64), [2.6], [3]),
            (spaces.Discrete(3), [1.4], 1),
            (spaces.Discrete(3), [9.0], 2),
            (spaces.Discrete(3, start=5), [1.4], 5),
            (spaces.MultiDiscrete([2, 4]), [0.6, 2.6], [1, 3]),
            (spaces.MultiBinary(2), [0.4, 0.6], [0, 1]),
        ],
    )
    def test_numbers_become_what_gymnasium_takes(
        self, space: Any, given: list[float], performed: Any
    ) -> None:
        world = Counter(space)
        counter(world).perform(np.array(given))
        (action,) = world.actions
        assert space.contains(action)
        assert np.array_equal(action, performed)

    @pytest.mark.parametrize(
        ("kind", "given", "wanted"), [(np.float32, 0.7, 0.7), (np.float64, 9.0, 1.0), (int, 0.7, 1)]
    )
    def test_a_box_of_one_number(self, kind: Any, given: float, wanted: float) -> None:
        """Its shape is (), as that of Discrete, but its numbers are not whole."""
        inner = Counter(spaces.Box(-1, 1, (), kind))
        counter(inner).perform(np.array([given]))
        (action,) = inner.actions
        assert inner.action_space.contains(action)
        assert action == kind(wanted)

    def test_a_function_says_what_is_done(self) -> None:
        world = Counter(spaces.Discrete(3))
        environment = counter(world, action=lambda _, given: int(np.argmax(given)))
        environment.perform(np.array([0.0, 5.0, 1.0]))
        assert world.actions == [1]

    def test_what_a_function_returns_must_be_an_action(self) -> None:
        environment = counter(Counter(spaces.Discrete(3)), action=lambda *_: 4)
        with pytest.raises(EnvironmentFailedError, match=r"returned 4, which is not in Discrete"):
            environment.perform(RIGHT)

    def test_as_many_numbers_as_gymnasium_takes(self) -> None:
        with pytest.raises(EnvironmentFailedError, match=r"1 numbers, and a task action has 2"):
            counter().perform(np.zeros(2))


class TestWhatIsShown:
    def test_a_function_senses(self) -> None:
        def sense(environment: Any, observation: Any, sensing_action: int) -> Any:
            return [environment.unwrapped.at, observation["a"][sensing_action]]

        environment = counter(sensing=sense)
        environment.perform(RIGHT)
        assert environment.perform_sensing(1).tolist() == [3.0, 1.0]

    def test_a_function_may_have_no_reading(self) -> None:
        environment = counter(sensing=lambda *_: None, sensing_noise=[[0.1, 0.2], [0.1, 0.2]])
        assert is_no_reading(environment.perform_sensing(1))

    def test_dictionaries_are_flattened_as_gymnasium_does(self) -> None:
        environment = counter(sensing=[[0, 2, 3]])
        environment.perform(RIGHT)
        assert environment.perform_sensing(0).tolist() == [1.0, 1.0, 0.0]  # b is one-hot

    def test_noise_has_the_size_that_is_said(self) -> None:
        """1000 draws each; a bound of 5 standard errors is passed once in a million."""
        world = Counter(at=10**9)
        environment = counter(
            world,
            sensing_noise=[0.1, 2.0],
            motion=[0, 1],
            motion_noise=[0.0, 0.5],
            observation=[0],
            observation_noise=3.0,
        )
        drawn: dict[str, list[float]] = {key: [] for key in ("0", "1", "exact", "moved", "came")}
        for step in range(1000):
            drawn["0"].append(environment.perform_sensing(0)[0] - step)
            drawn["1"].append(environment.perform_sensing(1)[0] - step)
            move = environment.perform(RIGHT)
            motion, came = np.asarray(move.motion), np.asarray(move.observation)
            drawn["exact"].append(motion[0] - 1.0)
            drawn["moved"].append(motion[1] - 1.0)
            drawn["came"].append(came[0] - step - 1)
        assert not np.any(drawn["exact"])
        for key, deviation in (("0", 0.1), ("1", 2.0), ("moved", 0.5), ("came", 3.0)):
            assert np.std(drawn[key]) == pytest.approx(deviation, rel=5 / np.sqrt(2000))
            assert np.mean(drawn[key]) == pytest.approx(0.0, abs=5 * deviation / np.sqrt(1000))

    def test_an_array_says_what_its_list_says(self) -> None:
        noise = [[0.5, 0.25], [2.0, 1.0]]
        listed = counter(sensing=[[0, 1], [1, 0]], sensing_noise=noise)
        given = counter(sensing=np.array([[0, 1], [1, 0]]), sensing_noise=np.array(noise))
        for sensing_action in range(2):
            expected = listed.perform_sensing(sensing_action)
            assert given.perform_sensing(sensing_action).tolist() == expected.tolist()
        with pytest.raises(ConfigurationError, match="sensing_noise has 3 entries; there are 2"):
            counter(sensing_noise=np.ones(3))

    def test_sensing_again_shows_the_same(self) -> None:
        environment = car(sensing_noise=0.1)
        assert environment.perform_sensing(0) == environment.perform_sensing(0)

    def test_functions_for_what_comes_with_a_move(self) -> None:
        environment = counter(
            motion=lambda _, before, after: after["a"] - before["a"] + 10.0,
            observation=lambda _, observation, action: [observation["a"][0], *action],
        )
        move = environment.perform(RIGHT)
        assert np.array_equal(np.asarray(move.motion), [11.0, 11.0])
        assert np.array_equal(np.asarray(move.observation), [1.0, 1.0])

    def test_without_them_a_move_shows_its_reward_alone(self) -> None:
        assert counter().perform(RIGHT) == MoveResult(0.5, None, None)


class TestWhatIsRefused:
    @pytest.mark.parametrize(("text", "says"), answers_in("gymnasium_mistakes.txt"))
    def test_arguments(self, text: str, says: str) -> None:
        arguments: Any = {"env_id": CAR, "sensing": [[0], [1]], **yaml.safe_load(f"{{{text}}}")}
        with pytest.raises(ConfigurationError, match=says):
            hf.GymnasiumEnvironment(**arguments)

    def test_sensing_actions_and_actions_are_the_problems(self) -> None:
        peg = hf.make_problem("peg_in_hole_2d")
        with pytest.raises(ConfigurationError, match="has 2 entries; peg_in_hole_2d has 3 sensing"):
            car(problem=peg)
        with pytest.raises(ConfigurationError, match="1 numbers, and a task action has 3"):
            hf.GymnasiumEnvironment(CAR, [[0], [1], [0]], problem=peg)

    def test_actions_that_have_no_numbers_need_a_function(self) -> None:
        world = Counter(spaces.Text(3))
        with pytest.raises(ConfigurationError, match=r"action: Counter takes actions in Text"):
            counter(world)

    def test_observations_without_a_fixed_size_need_a_function(self) -> None:
        world = Counter()
        world.observation_space = spaces.Sequence(spaces.Discrete(2))
        with pytest.raises(ConfigurationError, match=r"sensing\[0\]: .* no fixed number"):
            counter(world)

    def test_a_sensing_action_that_does_not_exist(self) -> None:
        with pytest.raises(InvalidValueError, match=r"sensing action 2: .* has 0 to 1"):
            car().perform_sensing(2)

    def test_noise_of_another_size(self) -> None:
        environment = car(sensing_noise=[[0.1, 0.2], 0.1])
        with pytest.raises(EnvironmentFailedError, match="sensing shows 1 numbers"):
            environment.perform_sensing(0)

    def test_gymnasium_is_not_installed(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "gymnasium", None)
        with pytest.raises(
            ConfigurationError, match=r"pip install 'holdfast-sensing\[gymnasium\]'"
        ):
            car()


@pytest.fixture
def car_file(tmp_path: Path) -> Path:
    shutil.copy(mountain_car.__file__, tmp_path)
    path = tmp_path / "car.yaml"
    path.write_text(mountain_car.CONFIGURATION)
    return path


def test_a_configuration_has_it_by_name(car_file: Path) -> None:
    """Functions are found beside the file, and the run's seed and trial reach the episode."""
    maker = load_environment(load(car_file))
    environment = maker(1, performed=[RIGHT])
    assert isinstance(environment, GymnasiumEnvironment)
    assert environment.steps_performed() == 1
    same = hf.GymnasiumEnvironment(
        CAR, [[0], [1]], seed=3, trial=1, sensing_noise=[0.05, 0.01], performed=[RIGHT]
    )
    assert environment.perform_sensing(0) == same.perform_sensing(0)


def test_a_mistake_in_a_configuration_is_named(car_file: Path) -> None:
    car_file.write_text(mountain_car.CONFIGURATION.replace("sensing_noise", "sensing_noises"))
    says = "arguments.sensing_noises is no argument of .*; did you mean sensing_noise"
    with pytest.raises(ConfigurationError, match=says):
        load_environment(load(car_file))
