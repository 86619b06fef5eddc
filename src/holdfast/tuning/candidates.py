"""What could be decided otherwise: configurations that differ from the user's in a few keys.

Each candidate changes what belongs together, and leaves the rest as the user has it: a method, how
far ahead the expected return looks, a resolution, an estimator. How often to sense and how many
particles to take are varied afterwards, of the method that won, so that there are not too many.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import msgspec
import numpy as np

from holdfast.config.loader import Configuration
from holdfast.errors import ConfigurationError, InvalidValueError
from holdfast.planning.settings import (
    ENTROPY_METHODS,
    NEIGHBOR_ESTIMATORS,
    UNINFORMED_METHODS,
    Estimator,
    Method,
    PlanningSettings,
    estimator_of,
)
from holdfast.printable import one_line
from holdfast.problems.attributes import resolution_of, sensing_labels
from holdfast.problems.problem import ProblemBase

Objective: TypeAlias = Literal["reward", "steps", "success"]
"""What is the best: the most reward less prices, the fewest steps (a trial that does not succeed
counts as the limit), or the most successes."""

Variation: TypeAlias = Literal[
    "methods", "looks", "resolution", "estimators", "fixed", "interval", "particles"
]
VARIATIONS: tuple[Variation, ...] = get_args(Variation)
BY_DEFAULT: tuple[Variation, ...] = ("methods", "looks", "resolution")

AS_CONFIGURED = "as configured"
RANDOM = "random"
DEFAULT = "path_entropy"  # the method by default, under its name as a candidate
_LOOKS = (1, 2, 4, 8)
_FACTORS = (3, 10)


class Candidate(NamedTuple):
    """A configuration, and the keys (``section.key``) in which it differs from the user's."""

    name: str
    configuration: Configuration
    changes: Mapping[str, Any]


def has_rewards(problem: Any) -> bool:
    """Return whether a problem rewards its steps or prices its sensing actions."""
    own = getattr(type(problem), "reward", ProblemBase.reward) is not ProblemBase.reward
    return own or getattr(problem, "sensing_costs", None) is not None


def changed(base: Configuration, changes: Mapping[str, Any]) -> Configuration:
    """Return a configuration with other values of some keys, checked as one from a file.

    None of them is the problem's: the problem is that of ``base``, which may be large.
    ConfigurationError if they do not fit.
    """
    plain = base.plain()
    sections = plain["configuration"]
    for key, value in changes.items():
        section, _, name = key.partition(".")
        sections[section] = {**sections[section], name: value}
    return dataclasses.replace(Configuration.from_plain(plain), problem=base.problem)


def first_candidates(
    base: Configuration, variations: Sequence[Variation], objective: Objective
) -> tuple[list[Candidate], dict[str, str]]:
    """Return the configuration as it is (the first), random sensing and what else is asked for.

    No two decide by the same settings. Beside them, those that cannot be, with the reason.
    """
    return _distinct(base, [], _first(base, variations, objective))


def later_candidates(
    base: Configuration, winner: Candidate, variations: Sequence[Variation]
) -> tuple[list[Candidate], dict[str, str]]:
    """Return the winner with other sensing intervals and numbers of particles."""
    return _distinct(base, [winner], _later(winner, variations))


_Changes: TypeAlias = Iterator[tuple[str, dict[str, Any]]]


def _first(base: Configuration, variations: Sequence[Variation], objective: Objective) -> _Changes:
    yield AS_CONFIGURED, {}
    yield RANDOM, {"selector.method": "random"}
    selector = base.planning.selector
    methods = (selector.method,)
    if "methods" in variations:
        methods = (DEFAULT, *(each for each in get_args(Method) if each not in (DEFAULT, "fixed")))
    for method in methods:
        if method not in UNINFORMED_METHODS:
            yield method, _of_method(base, method, objective)
    if "looks" in variations and ("methods" in variations or selector.method == "expected_return"):
        of_returns = _of_method(base, "expected_return", objective)
        for looks in _LOOKS:
            more = {"selector.rollout_sensing_steps": looks}
            yield f"expected_return, {looks} look{'s' * (looks > 1)}", of_returns | more
    for method in methods:
        if method in ENTROPY_METHODS:
            yield from _of_entropies(base, method, variations, objective)
    if "fixed" in variations:
        labels = [one_line(label) for label in sensing_labels(base.problem)]
        for number, label in enumerate(labels):
            # A candidate is known by its name, here and in the table of its trials.
            label += f" ({number})" * (labels.count(label) > 1)
            fixed = {"selector.method": "fixed", "selector.sensing_action": number}
            yield f"always {label}", fixed


def _of_method(base: Configuration, method: Method, objective: Objective) -> dict[str, Any]:
    changes: dict[str, Any] = {"selector.method": method}
    selector = base.planning.selector
    if method == "expected_return" and objective != "reward" and has_rewards(base.problem):
        changes["selector.rollout_reward"] = "steps"
    if method == "path_entropy" and base.planning.active_sensing.horizon > 1:
        changes["active_sensing.horizon"] = 1
    if isinstance(selector.resolution, tuple) and (
        (method == "state_entropy") != (selector.method == "state_entropy")
    ):
        changes["selector.resolution"] = None  # of actions is none of states
    return changes


def _of_entropies(
    base: Configuration, method: Method, variations: Sequence[Variation], objective: Objective
) -> _Changes:
    changes = _of_method(base, method, objective)
    selector = msgspec.structs.replace(base.planning.selector, method=method)
    particles = base.planning.particle_filter.num_particles
    now = estimator_of(selector, particles)
    if "resolution" in variations and now in NEIGHBOR_ESTIMATORS:
        given = changes.get("selector.resolution", selector.resolution)
        try:
            own = resolution_of(base.problem, given, of_states=method == "state_entropy")
        except InvalidValueError:
            return  # the method itself is refused, with the reason
        for factor in _FACTORS:
            coarser = [float(f"{factor * each:.6g}") for each in np.atleast_1d(own)]
            yield (
                f"{method}, resolution x {factor}",
                changes | {"selector.resolution": coarser if np.ndim(own) else coarser[0]},
            )
    if "estimators" in variations:
        for estimator in get_args(Estimator):
            if estimator != now:
                yield f"{method}, {estimator}", changes | {"selector.estimator": estimator}


def _later(winner: Candidate, variations: Sequence[Variation]) -> _Changes:
    planning = winner.configuration.planning
    now: dict[str, Any] = dict(winner.changes)
    if "interval" in variations:
        interval = planning.sensing_interval
        for other in sorted({0, interval // 2, 2 * interval + 1} - {interval}):
            steps = "step" if other == 0 else f"{other + 1} steps"
            yield f"{winner.name}, every {steps}", now | {"simulator.sensing_intervals": other}
    if "particles" in variations:
        particles = planning.particle_filter.num_particles
        for other in sorted({max(1, particles // 3), 3 * particles} - {particles}):
            more = {"particle_filter.num_particles": other}
            yield f"{winner.name}, {other} particles", now | more


def _distinct(
    base: Configuration, found: list[Candidate], proposals: _Changes
) -> tuple[list[Candidate], dict[str, str]]:
    refused = {}
    for name, changes in proposals:
        try:
            configuration = changed(base, changes)
        except ConfigurationError as error:
            refused[name] = str(error).removeprefix(f"{base.path}: ")
            continue
        settings = _what_counts(configuration.planning)
        if all(_what_counts(each.configuration.planning) != settings for each in found):
            own, its = (each.plain()["configuration"] for each in (base, configuration))
            differing = {}
            for key, value in changes.items():
                section, _, option = key.partition(".")
                if its[section][option] != own[section][option]:
                    differing[key] = value
            found.append(Candidate(name, configuration, differing))
    return found, refused


def _what_counts(planning: PlanningSettings) -> PlanningSettings:
    """Return the settings with the estimator that is taken, and without what random ignores."""
    selector = planning.selector
    if selector.method == "random":
        selector = type(selector)(method="random", sensing_is_optional=selector.sensing_is_optional)
    estimator = estimator_of(selector, planning.particle_filter.num_particles)
    return msgspec.structs.replace(
        planning, selector=msgspec.structs.replace(selector, estimator=estimator)
    )
