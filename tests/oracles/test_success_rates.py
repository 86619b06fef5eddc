"""How often trials succeed: what a user gets, and what no comparison of parts can show.

Seeds are fixed, so a test gives the same result until a decision changes. Then it is a new draw:
what is said below of false alarms is the probability that such a draw fails although the true rate
of success is 99.5 %, a little less than what was seen when the bounds were chosen.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from scipy import stats

from holdfast.config.loader import Configuration, load
from holdfast.planning.planner import Planner
from holdfast.robot.trial import run_trial

EXAMPLES = Path(__file__).parents[2] / "examples"
TRUE_RATE = 0.995


def successes(configuration: Configuration, num_particles: int, max_steps: int, seed: int) -> int:
    planning = msgspec.structs.replace(
        configuration.planning,
        particle_filter=msgspec.structs.replace(
            configuration.planning.particle_filter, num_particles=num_particles
        ),
    )
    simulator = msgspec.structs.replace(configuration.simulator, max_steps=max_steps, seed=seed)
    assert planning.selector.method == "path_entropy"
    assert planning.sensing_interval == 8
    return sum(
        run_trial(
            Planner(configuration.problem, planning),
            simulator.seed,
            trial,
            max_steps=simulator.max_steps,
        ).success
        for trial in range(simulator.num_trials)
    )


def false_alarm(num_trials: int, least: int) -> float:
    return float(stats.binom.cdf(least - 1, num_trials, TRUE_RATE))


@pytest.mark.parametrize(
    ("num_trials", "least"),
    [
        # False alarms: 2.6e-4 and 8e-8. With a rate of 85 % the first fails all but surely (98 %),
        # with 95 % the second.
        (60, 57),
        pytest.param(1000, 980, marks=pytest.mark.slow),
    ],
)
def test_peg_in_hole(num_trials: int, least: int) -> None:
    """At most 500 steps, 100 particles, a measurement at every ninth step."""
    assert false_alarm(num_trials, least) < 1e-3
    configuration = load(EXAMPLES / "peg_in_hole_2d.yaml", num_trials=num_trials)
    assert successes(configuration, 100, 500, 0) >= least


@pytest.mark.slow
@pytest.mark.parametrize("num_particles", [100, 200, 300, 400, 500])
def test_the_thesis(num_particles: int) -> None:
    """The configuration of the thesis, at each of its numbers of particles: 9 of 10 trials.

    False alarms: 1.1e-3 for each number.
    """
    configuration = load(EXAMPLES / "thesis.yaml")
    assert configuration.simulator.num_trials == 10
    assert configuration.simulator.max_steps == 700
    assert successes(configuration, num_particles, 700, 0) >= 9
