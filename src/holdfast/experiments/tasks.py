"""Tasks: the pieces of work that studies are made of.

A task is plain data: the name of a function and its parameters. What comes of it depends on nothing
else, whichever process or machine computes it; so it can be repeated when its process is killed,
and what came of it can be kept under the digest of everything that it depends on: the parameters,
and the code.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import msgspec

import holdfast
from holdfast import _kernel
from holdfast.errors import HoldfastError
from holdfast.experiments.tables import Table

__all__ = ["Task", "TaskError", "code_digest", "run_task", "task_key"]

_FUNCTIONS: Mapping[str, str] = {
    "trials": "holdfast.experiments.trial_batches:run_trials_of",
    "cloud_trials": "holdfast.experiments.cloud_trials:run_cloud_trials",
    "emulation_2017": "holdfast.experiments.emulation_2017:run_emulation",
}
"""Where the function of each kind of task is; imported when it is needed."""

_WITHOUT_EFFECT = ("cli", "chaos", "recording", "simulation", "experiments")
"""Packages on which no task depends, but for the module of its own function."""

_KEY_SIZE = 16


class TaskError(HoldfastError):
    """A task cannot be computed."""


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """A piece of work.

    Attributes
    ----------
    kind : str
        Names the function.
    parameters : dict
        Its arguments: plain data, as JSON has it.
    units : int
        How much work it is, in trials: for progress and for the time left.
    exclusive : bool
        Whether it measures times, so that nothing else may run meanwhile; it is computed on this
        machine, after all others.
    """

    kind: str
    parameters: dict[str, Any]
    units: int = 1
    exclusive: bool = False


def task_key(task: Task) -> str:
    """Return the digest of all that a task's outcome depends on, in hexadecimal."""
    content = [task.kind, task.parameters, code_digest(task.kind)]
    plain = msgspec.json.encode(content, order="sorted")
    return hashlib.blake2b(plain, digest_size=_KEY_SIZE).hexdigest()


@functools.cache
def code_digest(kind: str) -> str:
    """Return the digest of the code that computes a kind of task, in hexadecimal.

    The version of holdfast alone would not tell what a developer has changed since: the sources
    that a decision can depend on are hashed, and the compiled kernel.

    Raises
    ------
    TaskError
        If there is no such kind.
    """
    package = Path(holdfast.__file__).parent
    module = _place_of(kind).partition(":")[0]
    own = package.joinpath(*module.split(".")[1:]).with_suffix(".py")
    digest = hashlib.blake2b(holdfast.__version__.encode(), digest_size=_KEY_SIZE)
    for path in sorted(package.rglob("*.py")):
        inside = path.relative_to(package)
        if inside.parts[0] not in _WITHOUT_EFFECT or path == own:
            digest.update(str(inside).encode() + b"\0" + path.read_bytes() + b"\0")
    if _kernel.__file__:
        digest.update(Path(_kernel.__file__).read_bytes())
    return digest.hexdigest()


def run_task(task: Task) -> Table:
    """Compute a task in this process.

    Raises
    ------
    TaskError
        If there is no such kind.
    HoldfastError
        If its function refuses the parameters.
    """
    module, _, name = _place_of(task.kind).partition(":")
    function = getattr(importlib.import_module(module), name)
    return cast(Table, function(**task.parameters))


def _place_of(kind: str) -> str:
    try:
        return _FUNCTIONS[kind]
    except KeyError:
        raise TaskError(f"task of kind {kind!r}: there are {', '.join(_FUNCTIONS)}") from None
