"""The problems that a service decides for, and that they are the same code as the robots'."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from holdfast.errors import HoldfastError, OtherCodeError, UnknownProblemError
from holdfast.problems import registry
from holdfast.problems.problem import Problem
from holdfast.session.messages import Opening
from holdfast.source_digest import core_version, problem_digest

__all__ = ["KnownProblems"]


class KnownProblems:
    """Builds the problems that a service decides for.

    Those that are registered are known by name. A class in somebody's file is code that a robot
    must not be able to choose, so it is known only if whoever starts the service has named it.

    Parameters
    ----------
    names : sequence of str
        Problems to have ready; ``module:Class`` among them.
    directory : Path or None
        Where their modules are looked for first.

    Raises
    ------
    UnknownProblemError
        If one of the names does not lead to a problem.
    """

    def __init__(self, names: Sequence[str] = (), directory: Path | None = None) -> None:
        self._classes = {
            name: registry.problem_class(name, search_directory=directory) for name in names
        }
        # Now, for what is on the disk can be replaced while it runs as it was loaded.
        self._core_version = core_version()
        self._digests = {
            name: problem_digest(each, registry.problem_module(name))
            for name, each in self._classes.items()
        }
        self._names: frozenset[str] | None = None
        # msgspec (0.22) finds out about a struct's fields when the first one is made, and crashes
        # if a second thread makes one meanwhile.
        self._lock = threading.Lock()

    def __call__(self, opening: Opening) -> Problem:
        """Build the problem that an opening names.

        Raises
        ------
        UnknownProblemError
            If this service does not know it.
        OtherCodeError
            If the robot's holdfast or problem is other code than this service's.
        ConfigurationError
            If its settings do not fit.
        """
        with self._lock:
            return self._build(opening)

    def _build(self, opening: Opening) -> Problem:
        name = opening.problem
        found = self._classes.get(name) or self._registered(name)
        self._require_same_code(opening, found)
        if name in registry.BUILT_IN:
            # Their own check is enough to know that all is well; what is not, the configuration
            # can explain, but takes long to import.
            with contextlib.suppress(HoldfastError, msgspec.ValidationError):
                built: Problem = found.from_settings(opening.model, opening.state_space_planner)
                return built
        from holdfast.configuration import build_problem

        return build_problem(name, found, opening.model, opening.state_space_planner)

    def _require_same_code(self, opening: Opening, found: type[Any]) -> None:
        name = opening.problem
        if name not in self._digests:
            self._digests[name] = problem_digest(found, registry.problem_module(name))
        differences = [
            f"{what} is {here} on this service, {there or 'not told'} on the robot"
            for what, here, there in (
                ("holdfast", self._core_version, opening.core_version),
                ("the digest of the problem's code", self._digests[name], opening.problem_digest),
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
            # Once: to look through all that is installed takes longer than a decision, and a robot
            # can ask for a name that nobody knows as often as it likes.
            self._names = frozenset(registry.names())
        if name in self._names:
            with contextlib.suppress(UnknownProblemError):
                return registry.problem_class(name)
        known = ", ".join(sorted({*self._names, *self._classes}))
        hint = "; a class in a file must be named when the service is started (--problem)"
        raise UnknownProblemError(
            f"problem {name}: is not known to this service{hint if ':' in name else ''}; known are "
            f"{known}"
        )
