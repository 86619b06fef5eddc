"""The problems that a service decides for; their code must equal the robots' code."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from holdfast.config import registry
from holdfast.config.source_digest import core_version, problem_digest
from holdfast.errors import HoldfastError, OtherCodeError, UnknownProblemError
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.problems.problem import Problem
from holdfast.protocol.messages import SessionConfiguration


class ProblemFactory:
    """Builds the problems that a service decides for.

    Registered problems are known by name. A robot must not be able to load a class from an
    arbitrary file, so such a class is known only if the service's operator has named it: ``names``
    are loaded at once, their modules looked for in ``directory`` first. Raises UnknownProblemError
    if one does not lead to a problem.
    """

    def __init__(self, names: Sequence[str] = (), directory: Path | None = None) -> None:
        self._classes = {
            name: registry.problem_class(name, search_directory=directory) for name in names
        }
        # Computed now: the files may be replaced while the loaded code runs on.
        self._core_version = core_version()
        self._digests = {
            name: problem_digest(each, registry.problem_module(name))
            for name, each in self._classes.items()
        }
        self._names: frozenset[str] | None = None
        # Users' classes need not bear two threads at once.
        self._lock = threading.Lock()

    def __call__(self, session_configuration: SessionConfiguration) -> Problem:
        """Build the problem that an opening names.

        Raises UnknownProblemError if this service does not know it; OtherCodeError if the robot's
        holdfast or problem is other code than this service's; ConfigurationError if its settings do
        not fit.
        """
        with self._lock:
            return self._build(session_configuration)

    @in_own_mode
    def _build(self, session_configuration: SessionConfiguration) -> Problem:
        name = session_configuration.problem
        found = self._classes.get(name) or self._registered(name)
        self._require_same_code(session_configuration, found)
        if name in registry.BUILT_IN:
            # The problem's own check is enough. The configuration's loader explains failures
            # better, but is slow to import.
            with contextlib.suppress(HoldfastError, msgspec.ValidationError):
                built: Problem = found.from_settings(
                    session_configuration.model, session_configuration.state_space_planner
                )
                return built
        from holdfast.config.problem_builder import build_problem

        return build_problem(
            name, found, session_configuration.model, session_configuration.state_space_planner
        )

    def _require_same_code(
        self, session_configuration: SessionConfiguration, found: type[Any]
    ) -> None:
        name = session_configuration.problem
        if name not in self._digests:
            self._digests[name] = problem_digest(found, registry.problem_module(name))
        theirs, code = session_configuration.problem_digest, "the digest of the problem's code"
        differences = [
            f"{what} is {here} on this service, {there or 'not told'} on the robot"
            for what, here, there in (
                ("holdfast", self._core_version, session_configuration.core_version),
                (code, self._digests[name], theirs),
            )
            if here != there
        ]
        if differences:
            raise OtherCodeError(
                f"problem {name}: {' and '.join(differences)}; they may decide "
                "differently, so deploy the same version on both, then start the service again"
            )

    def _registered(self, name: str) -> type[Any]:
        if name in registry.BUILT_IN:
            return registry.problem_class(name)
        if self._names is None:
            # Once: scanning all installed packages takes longer than a decision, and a robot may
            # ask for unknown names at any rate.
            self._names = frozenset(registry.names())
        if name in self._names:
            with contextlib.suppress(UnknownProblemError):
                return registry.problem_class(name)
        known = ", ".join(sorted({*self._names, *self._classes}))
        hint = f"; it must be started with --problem {name}, since this is a class in a file"
        text = f"problem {name}: is not known to this service{hint if ':' in name else ''}"
        raise UnknownProblemError(f"{text}; known are {known}")
