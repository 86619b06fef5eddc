"""The environment of each trial, as a configuration names it: simulated, or of a user's class."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holdfast.config.user_code import find_class
from holdfast.config.user_modules import find_in
from holdfast.errors import ConfigurationError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.settings import EnvironmentSettings
from holdfast.problems.problem import Problem
from holdfast.robot.environment import Environment, SimulatedEnvironment, require_methods
from holdfast.robot.late_sensing import SenseInBackground

if TYPE_CHECKING:
    from holdfast.config.loader import Configuration

GROUP = "holdfast.environments"
"""Entry points by which packages register their environments."""

BUILT_IN = {"gymnasium": "holdfast.robot.gymnasium_environment:GymnasiumEnvironment"}
"""holdfast's own environments by name."""

_PROVIDED = ("problem", "seed", "trial", "resumed", "performed")


class EnvironmentMaker:
    """Makes the environment of each trial: a simulated one, or one of the user's.

    An environment of the user's is made anew for each trial. Its constructor is given the
    configuration's ``environment.arguments`` and, of the following, what it has named parameters
    for:

    - ``problem``: the :class:`~holdfast.problems.problem.Problem`;
    - ``seed``, ``trial``: of the run;
    - ``resumed``: True if the robot's process has died in the middle of this trial. The robot is
      where it was left then, and must not be brought back to its start;
    - ``performed``: the task actions that were performed in this trial before that. A world that
      has died with the process performs them again.

    Raises ConfigurationError if the class does not take the arguments.
    """

    def __init__(
        self,
        name: str,  # for messages
        problem: Problem,
        seed: int,
        timeout_ms: float,  # longest time that one call of the environment may take
        # The user's class; None for a world that is simulated from the problem.
        environment_class: type[Any] | None = None,
        arguments: Mapping[str, Any] | None = None,  # keyword arguments for the class
        *,
        sense_in_background: bool = False,  # whether the robot goes on while it senses
        # How often in a row sensing may give no reading.
        max_missing_in_a_row: int = EnvironmentSettings().max_missing_in_a_row,
    ) -> None:
        self.name = name
        self.max_missing_in_a_row = max_missing_in_a_row
        self._sense_in_background = sense_in_background
        self.problem = problem
        self.timeout_ms = timeout_ms
        self.simulated = environment_class is None
        self._seed = seed
        self._class = environment_class
        self._arguments = dict(arguments or {})
        self._provided: tuple[str, ...] = ()
        if environment_class is not None:
            self._provided = _provided_parameters(name, environment_class, self._arguments)

    def __call__(
        self, trial: int, *, resumed: bool = False, performed: Sequence[FloatArray] = ()
    ) -> Environment:
        """Make the environment of a trial.

        Of the task actions that were performed before the robot's process died: a simulated world
        has died with it and performs them again; a real one stands where they led to. Raises
        EnvironmentFailedError if the object lacks one of the three methods, and whatever the user's
        constructor raises.
        """
        if self._class is None:
            return SimulatedEnvironment.after(self.problem, self._seed, trial, performed)
        values = {
            "problem": self.problem,
            "seed": self._seed,
            "trial": trial,
            "resumed": resumed,
            "performed": performed,
        }
        environment = self._class(
            # A copy: what one trial does to its arguments must not reach the next one.
            **copy.deepcopy(self._arguments),
            **{name: values[name] for name in self._provided},
        )
        require_methods(environment, self.name)
        made: Environment = environment
        return SenseInBackground(made) if self._sense_in_background else made


def load_environment(configuration: Configuration, option: str | None = None) -> EnvironmentMaker:
    """Find the environment that a configuration names.

    ``option`` is what has named it instead of the file; messages then begin with that. Raises
    ConfigurationError if the class cannot be imported or does not take the arguments.
    """
    settings = configuration.environment
    seed, timeout_ms = configuration.simulator.seed, settings.timeout_ms
    if settings.object is None:
        simulated = f"the simulated {configuration.problem_name}"
        return EnvironmentMaker(simulated, configuration.problem, seed, timeout_ms)
    # It is used by the environment's thread, while the robot's own is by the loop's.
    problem = type(configuration).from_plain(configuration.plain()).problem
    directory = None if settings.directory is None else Path(settings.directory)
    name = BUILT_IN.get(settings.object, settings.object)
    try:
        found = find_class(
            name,
            what=option or "environment.object",
            group=GROUP,
            built_in=BUILT_IN,
            # Else, for a name without a module: where to look for what may have been meant, and
            # for functions that its arguments name.
            search_directory=directory if ":" in settings.object else configuration.path.parent,
            error_type=ConfigurationError,
        )
        if settings.object in BUILT_IN:
            # The modules of functions, too.
            for value in settings.arguments.values():
                if isinstance(value, str) and ":" in value:
                    find_in(configuration.path.parent, value.partition(":")[0])
        return EnvironmentMaker(
            name,
            problem,
            seed,
            timeout_ms,
            found,
            settings.arguments,
            sense_in_background=settings.sense_in_background,
            max_missing_in_a_row=settings.max_missing_in_a_row,
        )
    except ConfigurationError as error:
        if option is not None:
            raise
        raise ConfigurationError(f"{configuration.path}: {error}") from error


def _provided_parameters(
    name: str, environment_class: type[Any], arguments: Mapping[str, Any]
) -> tuple[str, ...]:
    """Check that the class takes the arguments, and return what else of ours it takes."""
    reserved = [key for key in arguments if key in _PROVIDED]
    if reserved:
        raise ConfigurationError(
            f"environment.arguments.{reserved[0]} cannot be set: holdfast itself passes "
            f"{', '.join(_PROVIDED)} to a class that has parameters of these names"
        )
    try:
        signature = inspect.signature(environment_class)
    except (TypeError, ValueError):
        return ()  # compiled code does not always tell; then its constructor complains
    parameters = signature.parameters.values()
    named = [
        parameter.name
        for parameter in parameters
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    ]
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        allowed = [key for key in named if key not in _PROVIDED]
        for key in arguments:
            if key not in allowed:
                from holdfast.validation import close_match

                raise ConfigurationError(
                    f"environment.arguments.{key} is no argument of {name}"
                    f"{close_match(key, allowed)}\n"
                    f"allowed: {', '.join(allowed) or 'no keys'}"
                )
    provided = tuple(key for key in _PROVIDED if key in named)
    try:
        signature.bind(**arguments, **dict.fromkeys(provided))
    except TypeError as error:
        raise ConfigurationError(
            f"environment.arguments do not suit {name}{signature}: {error}"
        ) from None
    return provided
