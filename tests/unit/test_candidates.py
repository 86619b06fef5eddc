"""What a tuning tries of a configuration."""

from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import pytest

from holdfast.config.loader import Configuration, load
from holdfast.planning.settings import Estimator
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.tuning.candidates import (
    AS_CONFIGURED,
    RANDOM,
    VARIATIONS,
    Candidate,
    first_candidates,
    has_rewards,
    later_candidates,
)


def written(directory: Path, text: str) -> Configuration:
    path = directory / "run.yaml"
    path.write_text(f"problem: peg_in_hole_2d\n{text}")
    return load(path)


def by_name(candidates: list[Candidate]) -> dict[str, Candidate]:
    assert len({each.name for each in candidates}) == len(candidates)
    return {each.name: each for each in candidates}


def test_each_differs_in_what_it_says(tmp_path: Path) -> None:
    base = written(tmp_path, "particle_filter: {num_particles: 90}\n")
    candidates, refused = first_candidates(base, VARIATIONS, "steps")
    assert refused == {}
    found = by_name(candidates)
    assert candidates[0].name == AS_CONFIGURED
    assert candidates[0].configuration == base
    assert candidates[0].changes == {}
    assert "path_entropy" not in found  # it is the configuration
    settings = [each.configuration.planning for each in candidates]
    assert len(set(map(repr, settings))) == len(settings)
    assert found[RANDOM].changes == {"selector.method": "random"}
    assert found["path_entropy, resolution x 3"].changes == {"selector.resolution": 0.3}
    assert found["always θ"].configuration.planning.selector.sensing_action == 2
    of_returns = found["expected_return, 8 looks"].configuration.planning.selector
    # The problem has rewards, but steps are to be few.
    assert (of_returns.rollout_sensing_steps, of_returns.rollout_reward) == (8, "steps")
    of_reward, _ = first_candidates(base, ["looks", "methods"], "reward")
    assert by_name(of_reward)["expected_return, 8 looks"].changes == {
        "selector.method": "expected_return",
        "selector.rollout_sensing_steps": 8,
    }
    only, _ = first_candidates(base, ["estimators"], "steps")
    assert {each.name for each in only[2:]} == {
        f"path_entropy, {name}" for name in get_args(Estimator) if name != "prior_neighbors"
    }


def test_what_does_not_fit(tmp_path: Path) -> None:
    text = "particle_filter: {num_particles: 5000}\nactive_sensing: {horizon: 2}\n"
    text += "selector: {method: action_entropy, resolution: [0.1, 0.2, 0.3]}\n"
    candidates, refused = first_candidates(written(tmp_path, text), VARIATIONS, "steps")
    assert set(refused) >= {"action_entropy, prior_neighbors"}
    assert "4096" in refused["action_entropy, prior_neighbors"]
    found = by_name(candidates)
    assert found["action_entropy, resolution x 10"].changes == {
        "selector.resolution": [1.0, 2.0, 3.0]
    }
    assert found["path_entropy"].changes["active_sensing.horizon"] == 1
    # Three numbers for the actions say nothing of states.
    assert found["state_entropy"].changes["selector.resolution"] is None


def test_a_configuration_that_is_random_is_not_tried_twice(tmp_path: Path) -> None:
    base = written(tmp_path, "selector: {method: random, rollout_sensing_steps: 7}\n")
    candidates, _ = first_candidates(base, ["methods"], "steps")
    assert RANDOM not in by_name(candidates)
    assert by_name(candidates)["path_entropy"].changes == {"selector.method": "path_entropy"}


def test_names_tell_sensing_actions_apart(tmp_path: Path) -> None:
    (tmp_path / "alike.py").write_text(ALIKE)
    (tmp_path / "run.yaml").write_text("problem: alike:Alike\n")
    found = by_name(first_candidates(load(tmp_path / "run.yaml"), ["fixed"], "steps")[0])
    actions = {name: each.changes.get("selector.sensing_action") for name, each in found.items()}
    assert actions["always look (0)"] in (0, None)
    assert actions["always look (2)"] == 2
    # It goes into a comment of tuned.yaml, whose next line would be a key.
    assert actions["always x seed: 1"] == 1


ALIKE = """
from tests.line_problem import Line

class Alike(Line):
    sensing_actions = ("look", "x\\nseed: 1", "look")

    def observation_mean(self, states, sensing_action):
        return states[..., :1]
"""


@pytest.mark.parametrize(("interval", "others"), [(8, [0, 4, 17]), (0, [1])])
def test_intervals_and_particles_of_the_winner(
    tmp_path: Path, interval: int, others: list[int]
) -> None:
    base = written(tmp_path, f"simulator: {{sensing_intervals: {interval}}}\n")
    winner = by_name(first_candidates(base, ["methods"], "steps")[0])["state_entropy"]
    found, refused = later_candidates(base, winner, ["interval", "particles"])
    assert refused == {}
    assert found[0] is winner
    methods = {each.configuration.planning.selector.method for each in found}
    assert methods == {"state_entropy"}
    intervals = [each.configuration.planning.sensing_interval for each in found[1:-2]]
    assert intervals == others
    particles = [each.changes["particle_filter.num_particles"] for each in found[-2:]]
    assert particles == [100, 900]


def test_rewards() -> None:
    assert has_rewards(CapsuleRobot())
    assert has_rewards(SimpleNamespace(sensing_costs=(1.0,)))
    assert not has_rewards(SimpleNamespace())
