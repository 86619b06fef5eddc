"""Check a problem before a day is lost with it.

A problem of fifty lines can be wrong in ways that no error shows: a likelihood in place of its
logarithm, a noise that all particles share, a goal that is never reached, a resolution that makes
all actions the same. :func:`check_problem` looks for these, and says what was seen and what to do.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import real_number, whole
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.planning.settings import PlanningSettings, SimulatorSettings, check_settings
from holdfast.problems import attributes, checked
from holdfast.tuning.calibration_check import check_likelihoods
from holdfast.tuning.contract_check import check_contract, check_streams
from holdfast.tuning.decision_time import check_decision_time
from holdfast.tuning.findings import CONTRACT, FALSE_ALARM_RATE, Finding, Inspection
from holdfast.tuning.goal_check import check_motion, check_rewards, follow_policy
from holdfast.tuning.sensor_check import check_sensors
from holdfast.tuning.trial_check import SensedBelief, check_trials

__all__ = ["CHECKS", "check_problem"]

CHECKS = (
    "declarations",
    "contract",
    "streams",
    "goals",
    "likelihoods",
    "trials",
    "sensors",
    "time",
)
"""The checks in their order, as they are reported while they run."""

_STATES = 48


@in_own_mode
def check_problem(
    problem: Any,
    settings: PlanningSettings | None = None,
    *,
    max_steps: int = SimulatorSettings().max_steps,
    seed: int = 0,
    budget_s: float = 20.0,
    on_check: Callable[[str], None] = lambda _: None,
) -> list[Finding]:
    """Look for what is wrong with a problem.

    Nothing that the problem's code raises comes through, but Ctrl-C: it is a finding. The same
    seed gives the same findings, but for the times of a decision, as long as the budget lasts.

    Parameters
    ----------
    problem : Problem
        Or any object that is to be one.
    settings : PlanningSettings, optional
        With which it is to be used.
    max_steps : int
        Steps after which a simulated trial has failed.
    seed : int
        Names all random draws.
    budget_s : float
        Seconds after which no further work is begun; a single call of the problem's code is not
        interrupted.
    on_check : callable, optional
        Is told the name of each check as it begins, one of :data:`CHECKS`.

    Returns
    -------
    list of Finding
        Errors first. The statistical tests of a right problem, all together, find an error with
        a probability of at most 0.001.

    Raises
    ------
    InvalidValueError
        If an argument other than the problem is out of bounds.
    """
    settings = PlanningSettings() if settings is None else settings
    settings = check_settings(settings, PlanningSettings)
    max_steps = whole("max_steps", max_steps, 1)
    seed = whole("seed", seed, 0, 2**63 - 1)
    budget = real_number(budget_s)
    if budget is None or not 0.0 < budget <= 86_400.0:
        raise InvalidValueError(
            f"budget_s is {budget_s!r:.80}; allowed are numbers above 0 to 86400"
        )
    inspection = Inspection(problem, settings, max_steps, seed, budget)
    on_check("declarations")
    if not _declares_itself(inspection):
        return inspection.sorted_findings()
    _understood(inspection)
    beliefs: list[SensedBelief] = []

    def trials() -> None:
        beliefs.extend(check_trials(inspection))
        check_rewards(inspection)

    parts: tuple[tuple[str, Callable[[], object]], ...] = (
        ("contract", lambda: _check_contract(inspection)),
        ("streams", lambda: check_streams(inspection)),
        ("goals", lambda: _check_goals(inspection)),
        ("likelihoods", lambda: check_likelihoods(inspection)),
        ("trials", trials),
        ("sensors", lambda: check_sensors(inspection, beliefs)),
        ("time", lambda: check_decision_time(inspection, beliefs)),
    )
    for name, check in parts:
        on_check(name)
        if name == "trials":
            # All tests are made. What follows weighs beliefs by the likelihoods.
            _judge(inspection)
        if name in ("trials", "sensors") and _has_wrong_likelihood(inspection):
            continue
        with inspection.part():
            # What a check itself does with a strange object must not end the others.
            inspection.ask(f"the check of {name}", check, name)
    return inspection.sorted_findings()


def _judge(inspection: Inspection) -> None:
    if inspection.num_tests:
        inspection.add(
            "information",
            "likelihood",
            f"{inspection.num_tests} statistical tests were made; of a right problem they find an "
            f"error, all together, with a probability of at most {FALSE_ALARM_RATE:g}",
        )
    inspection.judge_tests()
    if _has_wrong_likelihood(inspection):
        inspection.add(
            "information",
            "sensors",
            "beliefs, sensors and resolution were not looked at: the likelihood comes first",
        )


def _has_wrong_likelihood(inspection: Inspection) -> bool:
    return any(found[:2] == ("error", "likelihood") for found in inspection.findings)


def _declares_itself(inspection: Inspection) -> bool:
    """Check all that a problem says of itself; without it nothing else can be asked."""
    problem = inspection.problem

    def declared() -> list[str]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            attributes.check_problem(problem)
        return [str(each.message) for each in caught]

    with inspection.part():
        for text in inspection.ask("the problem", declared):
            advice = "What has another name is never called."
            inspection.add("warning", "contract", text, advice, CONTRACT)
        lacking = [
            name
            for name in ("execute", "next_stage", "reward", "scene", "resolution", "state_labels")
            if not hasattr(problem, name)
        ]
        if lacking:
            inspection.add(
                "error",
                "contract",
                f"{inspection.name} has no {' and no '.join(lacking)}",
                "Derive the class from hf.ProblemBase, which has defaults, or write them.",
                CONTRACT,
            )
            return False
        return True
    return False


def _understood(inspection: Inspection) -> None:
    """Say what was understood of noises, so that a deviation given as a variance is seen."""
    problem = inspection.problem
    with inspection.part():
        own = inspection.random(0)
        states = inspection.ask("initial_states", lambda: checked.initial_states(problem, own, 200))
        texts = [
            f"{inspection.coordinate(at)} {states[:, at].std():.2g}"
            for at in range(min(states.shape[1], 8))
        ]
        text = f"standard deviations: of the initial belief {', '.join(texts)}"
        noise = np.sqrt(np.asarray(problem.motion_variance, dtype=np.float64))
        text += f"; of the motion noise of a step {', '.join(f'{each:.2g}' for each in noise)}"
        if not attributes.has_general_observations(problem):
            shown = []
            for action, label in enumerate(attributes.sensing_labels(problem)[:8]):
                _, variance = inspection.ask(
                    "observation_variance",
                    lambda action=action: checked.prediction(problem, states, action),  # type: ignore[misc]
                )
                # What is not positive is a finding of its own.
                least, most = np.sqrt([max(variance.min(), 0.0), max(variance.max(), 0.0)])
                spread = f"{least:.2g}" if least == most else f"{least:.2g} to {most:.2g}"
                shown.append(f"{label} {spread}")
            text += f"; of the sensors {', '.join(shown)}"
        inspection.add(
            "information",
            "noises",
            f"{text}. Compare them with what you meant: variances are their squares",
        )


def _check_contract(inspection: Inspection) -> None:
    problem = inspection.problem
    own = inspection.random(0)
    states = inspection.ask("initial_states", lambda: checked.initial_states(problem, own, _STATES))
    check_contract(inspection, states, np.zeros(_STATES, dtype=np.int64))


def _check_goals(inspection: Inspection) -> None:
    """Follow the policy, and check the contract again in states from along the way."""
    walk = follow_policy(inspection)
    rows = walk.states.reshape(-1, walk.states.shape[-1])
    chosen = np.arange(0, len(rows), max(1, len(rows) // _STATES))[:_STATES]
    if len(chosen) >= _STATES:
        stages = walk.stages.reshape(-1)
        check_contract(inspection, rows[chosen], stages[chosen])
    check_motion(inspection)
