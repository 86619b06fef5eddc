"""Check a problem before a day is lost with it.

A problem of fifty lines can be wrong in ways that no error shows: a likelihood in place of its
logarithm, a noise that all particles share, a goal that is never reached, a resolution that makes
all actions the same. :func:`check_problem` looks for these, and says what was seen and what to do.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import real_number, whole
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.planning.settings import PlanningSettings, SimulatorSettings, check_settings
from holdfast.printable import brief
from holdfast.problems import attributes, checked
from holdfast.robot.lost_values import ADVICE
from holdfast.runtime.command_line import MAX_TRIALS
from holdfast.tuning.calibration_check import check_likelihoods
from holdfast.tuning.contract_check import check_contract, check_streams
from holdfast.tuning.findings import CheckEndedError, Finding, Inspection
from holdfast.tuning.sensor_check import FEW_VALUES, check_sensors
from holdfast.tuning.trial_check import check_decision_time, check_goals, check_method, check_trials
from holdfast.validation import as_function

_STATES = 48
_DRAWN = 4000  # states whose standard deviation is told, off by a hundredth
_NEEDED = ("limit_action", "next_stage", "reward", "scene", "resolution", "state_labels")


@in_own_mode
def check_problem(
    problem: Any,
    settings: PlanningSettings | None = None,
    *,
    max_steps: int = SimulatorSettings().max_steps,
    seed: int = 0,
    budget_s: float = 20.0,
    trials: int = 100,
    on_check: Callable[[str], None] = lambda _: None,
) -> list[Finding]:
    """Look for what is wrong with a problem, or with any object that is to be one.

    Nothing that the problem's code raises comes through, but Ctrl-C: it is a finding. The same
    seed gives the same findings, but for the times of a decision, as long as the budget lasts.

    Parameters
    ----------
    settings : PlanningSettings, optional
        With which it is to be used.
    max_steps : int
        Steps after which a simulated trial has failed.
    budget_s : float
        Seconds after which no further work is begun; a single call of the problem's code is not
        interrupted. What was not looked at is said.
    trials : int
        Pairs of trials, at most, that compare the method with random sensing; 0 compares nothing.
    on_check : callable
        Is told the name of each check as it begins, one of :data:`CHECKS`.

    Returns
    -------
    list of Finding
        Errors first. The statistical tests of a right problem, all together, find an error with
        a probability of at most 0.001.

    Raises
    ------
    InvalidValueError
        If the problem is a name or a path, or another argument is out of bounds.
    """
    if isinstance(problem, str | os.PathLike):
        raise InvalidValueError(
            f"problem is {brief(str(problem))}: check_problem takes an object; make_problem(NAME) "
            "and load_configuration(FILE).problem return one, holdfast check takes a file"
        )
    as_function("on_check", on_check)
    settings = PlanningSettings() if settings is None else settings
    settings = check_settings(settings, PlanningSettings)
    max_steps = whole("max_steps", max_steps, 1)
    seed = whole("seed", seed, 0, 2**63 - 1)
    budget = real_number(budget_s)
    if budget is None or not 0.0 < budget <= 86_400.0:
        raise InvalidValueError(f"budget_s is {brief(budget_s)}; it must be above 0, at most 86400")
    inspection = Inspection(problem, settings, max_steps, seed, budget)
    inspection.trials = whole("trials", trials, 0, MAX_TRIALS)
    late = inspection.deadline(1.0)
    for name, check in CHECKS.items():
        errors = {each.check for each in inspection.findings if each.severity == "error"}
        if name == "contract" and errors:
            break  # without its declarations nothing else can be asked
        on_check(name)
        if name in ("trials", "sensors") and "likelihood" in errors:
            seen = "beliefs, sensors and resolution were not looked at: the likelihood comes first"
            inspection.add("information", "sensors", seen)
            continue
        if name not in ("declarations", "contract") and late():
            inspection.add_over(name)
            continue
        with contextlib.suppress(CheckEndedError):
            # What a check itself does with a strange object must not end the others.
            inspection.ask(f"the check of {name}", check, inspection, check=name)
        if name == "likelihoods":  # what follows weighs beliefs by them
            inspection.judge_tests()
    order = ("error", "warning", "information")
    return sorted(inspection.findings, key=lambda each: order.index(each.severity))


def _declarations(inspection: Inspection) -> None:
    """Check all that a problem says of itself."""
    problem = inspection.problem

    def warned() -> list[str]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            attributes.check_problem(problem)
        return [str(each.message) for each in caught]

    for seen in inspection.ask("the problem", warned):
        inspection.add("warning", "contract", seen, "What has another name is never called.")
    lacking = [name for name in _NEEDED if not hasattr(problem, name)]
    if lacking:
        seen = f"{attributes.name_of(problem)} has no {' and no '.join(lacking)}"
        advice = "Derive the class from hf.ProblemBase, which has defaults, or write them."
        inspection.add("error", "contract", seen, advice)


def _contract(inspection: Inspection) -> None:
    """Check the contract in initial states, and say what was understood of noises."""
    problem, own, ask = inspection.problem, inspection.random(0), inspection.ask
    states = ask("initial_states", checked.initial_states, problem, own, _DRAWN)
    check_contract(inspection, states[:_STATES], np.zeros(_STATES, dtype=np.int64))
    static = attributes.static_parameters(problem)
    if kinds := [at for at in static if 1 < len(np.unique(states[:, at])) < FEW_VALUES]:
        values = ", ".join(f"{each:g}" for each in np.unique(states[:, kinds]))
        seen = f"static_parameters names {', '.join(map(inspection.coordinate, kinds))}, with the "
        seen += f"values {values} alone: resampling would draw others, between and beyond these"
        advice = f"Leave {', '.join(map(str, kinds))} out. If such values get lost, {ADVICE}."
        inspection.add("warning", "contract", seen, advice)
    names = [inspection.coordinate(at) for at in range(min(states.shape[1], 8))]
    initial = ", ".join(f"{name} {states[:, at].std():.2g}" for at, name in enumerate(names))
    seen = f"standard deviations: of the initial belief {initial}; of the motion noise of a step "
    seen += ", ".join(f"{each:.2g}" for each in np.sqrt(np.ravel(problem.motion_variance)))
    if not attributes.has_general_observations(problem):
        shown = []
        for action, label in enumerate(attributes.sensing_labels(problem)[:8]):
            variance = ask("observation_variance", checked.prediction, problem, states, action)[1]
            # What is not positive is a finding of its own.
            least, most = np.sqrt(np.maximum([variance.min(), variance.max()], 0.0))
            shown.append(f"{label} {least:.2g}" + (f" to {most:.2g}" if least < most else ""))
        seen += f"; of the sensors {', '.join(shown)}"
    seen += ". Compare them with what you meant: variances are their squares"
    inspection.add("information", "noises", seen)


CHECKS: Mapping[str, Callable[[Inspection], None]] = {
    "declarations": _declarations,
    "contract": _contract,
    "streams": check_streams,
    "goals": check_goals,
    "likelihoods": check_likelihoods,
    "trials": check_trials,
    "sensors": check_sensors,
    "time": check_decision_time,
    "method": check_method,
}
"""The checks in their order, as they are reported while they run."""
