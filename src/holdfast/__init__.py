"""holdfast: choose what to sense, and keep deciding the same whatever fails.

``import holdfast as hf`` is the public face: all names below. Each is imported when it is first
used, because the start of a process is part of a robot's recovery.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holdfast import errors, numerics
    from holdfast.config.loader import load as load_configuration
    from holdfast.config.registry import make_problem
    from holdfast.config.registry import make_problem as make
    from holdfast.errors import (
        ConfigurationError,
        EnvironmentFailedError,
        HoldfastError,
        InvalidValueError,
        OutputError,
        ProblemError,
        TrialError,
        UnknownProblemError,
    )
    from holdfast.planning.belief import Belief
    from holdfast.planning.estimators import (
        GaussianMixture,
        NearestNeighbor,
        PriorNeighbors,
        entropy,
    )
    from holdfast.planning.outcome import Ending, MoveResult, TrialResult
    from holdfast.planning.planner import Planner, PlanningState
    from holdfast.planning.settings import (
        ActiveSensingSettings,
        LostSettings,
        ParticleFilterSettings,
        PlanningSettings,
        SelectorSettings,
    )
    from holdfast.problems.problem import Problem, ProblemBase, Scene
    from holdfast.reports.reading import open_run
    from holdfast.robot.environment import LATER, Environment, SimulatedEnvironment
    from holdfast.robot.gymnasium_environment import GymnasiumEnvironment
    from holdfast.robot.late_sensing import SenseInBackground
    from holdfast.robot.trial import run_trial
    from holdfast.tuning.problem_check import check_problem
    from holdfast.tuning.simulated_trials import compare, run_trials
    from holdfast.tuning.tune import tune

__all__ = [
    "LATER",
    "ActiveSensingSettings",
    "Belief",
    "ConfigurationError",
    "Ending",
    "Environment",
    "EnvironmentFailedError",
    "GaussianMixture",
    "GymnasiumEnvironment",
    "HoldfastError",
    "InvalidValueError",
    "LostSettings",
    "MoveResult",
    "NearestNeighbor",
    "OutputError",
    "ParticleFilterSettings",
    "Planner",
    "PlanningSettings",
    "PlanningState",
    "PriorNeighbors",
    "Problem",
    "ProblemBase",
    "ProblemError",
    "Scene",
    "SelectorSettings",
    "SenseInBackground",
    "SimulatedEnvironment",
    "TrialError",
    "TrialResult",
    "UnknownProblemError",
    "check_problem",
    "compare",
    "entropy",
    "errors",
    "load_configuration",
    "make",
    "make_problem",
    "numerics",
    "open_run",
    "run_trial",
    "run_trials",
    "tune",
]

__version__ = "0.1.0"

_PLACES = {
    "ActiveSensingSettings": "planning.settings.ActiveSensingSettings",
    "LostSettings": "planning.settings.LostSettings",
    "ParticleFilterSettings": "planning.settings.ParticleFilterSettings",
    "Belief": "planning.belief.Belief",
    "Ending": "planning.outcome.Ending",
    "Environment": "robot.environment.Environment",
    "LATER": "robot.environment.LATER",
    "MoveResult": "planning.outcome.MoveResult",
    "SenseInBackground": "robot.late_sensing.SenseInBackground",
    "GaussianMixture": "planning.estimators.GaussianMixture",
    "GymnasiumEnvironment": "robot.gymnasium_environment.GymnasiumEnvironment",
    "ConfigurationError": "errors.ConfigurationError",
    "EnvironmentFailedError": "errors.EnvironmentFailedError",
    "HoldfastError": "errors.HoldfastError",
    "InvalidValueError": "errors.InvalidValueError",
    "OutputError": "errors.OutputError",
    "ProblemError": "errors.ProblemError",
    "TrialError": "errors.TrialError",
    "UnknownProblemError": "errors.UnknownProblemError",
    "NearestNeighbor": "planning.estimators.NearestNeighbor",
    "Planner": "planning.planner.Planner",
    "PlanningSettings": "planning.settings.PlanningSettings",
    "PlanningState": "planning.planner.PlanningState",
    "PriorNeighbors": "planning.estimators.PriorNeighbors",
    "Problem": "problems.problem.Problem",
    "ProblemBase": "problems.problem.ProblemBase",
    "Scene": "problems.problem.Scene",
    "SimulatedEnvironment": "robot.environment.SimulatedEnvironment",
    "TrialResult": "planning.outcome.TrialResult",
    "SelectorSettings": "planning.settings.SelectorSettings",
    "check_problem": "tuning.problem_check.check_problem",
    "compare": "tuning.simulated_trials.compare",
    "entropy": "planning.estimators.entropy",
    "load_configuration": "config.loader.load",
    "make": "config.registry.make_problem",
    "make_problem": "config.registry.make_problem",
    "open_run": "reports.reading.open_run",
    "run_trial": "robot.trial.run_trial",
    "run_trials": "tuning.simulated_trials.run_trials",
    "tune": "tuning.tune.tune",
}
"""The module of each name, and its name there; type checkers read the imports above."""

_MODULES = ("errors", "numerics")

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        """Import a name of the public face (PEP 562)."""
        if name in _MODULES:
            return importlib.import_module(f"{__name__}.{name}")
        if name not in _PLACES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module, _, own_name = _PLACES[name].rpartition(".")
        value = getattr(importlib.import_module(f"{__name__}.{module}"), own_name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """Return the public names, imported or not."""
    return [*__all__, "__version__"]
