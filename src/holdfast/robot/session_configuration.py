"""A robot's description of its run for services: problem, settings, seed and digests of the code.

A service whose own code or settings differ refuses the run, so both ends must build this alike.
"""

from __future__ import annotations

from holdfast.config.loader import Configuration
from holdfast.config.registry import problem_class, problem_module
from holdfast.config.source_digest import core_version, problem_digest
from holdfast.protocol.messages import SessionConfiguration


def session_configuration_of(configuration: Configuration) -> SessionConfiguration:
    """Describe a configuration's run, and the code of this process, for a service."""
    name = configuration.problem_name
    return SessionConfiguration(
        name,
        dict(configuration.model),
        dict(configuration.state_space_planner),
        configuration.planning,
        configuration.simulator.seed,
        core_version(),
        problem_digest(problem_class(name, configuration.problem_directory), problem_module(name)),
    )
