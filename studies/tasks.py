"""Tasks: the pieces of work that studies are made of.

A task is plain data: the name of a function and its parameters. Its result depends on nothing else,
whichever process or machine computes it. So a task can be repeated when its process is killed, and
its result can be kept under the digest of the parameters and the code.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import importlib.util
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

import holdfast
from holdfast import _kernel
from holdfast.config.imports import follow_imports
from studies.errors import TaskError

if TYPE_CHECKING:
    import pandas as pd


_FUNCTIONS: Mapping[str, str] = {
    "trials": "studies.trial_batches:run_trials_of",
    "cloud_trials": "studies.cloud_trials:run_cloud_trials",
    "emulation_2017": "studies.emulation_2017:run_emulation",
    "vdp_tag": "studies.published_worlds:run_vdp_tag",
    "sensing_times": "studies.sensing_times:measure_sensing",
}
"""Where the function of each kind of task is; imported when it is needed."""

_OF_PROCESSES = frozenset({"cloud_trials"})
"""Kinds that start processes of the whole program, whose sources no import leads to."""

_PLACE = re.compile(r"\w+(\.\w+)+:\w+")

_PROGRAM = ("holdfast", "holdfast_lab")
_PACKAGES = (*_PROGRAM, "studies")
"""Whose code results depend on."""

_KEY_SIZE = 16

_OF_THE_DAY = ("date", "holdfast")
"""Entries of a machine's description that are no part of the machine."""


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """A piece of work: a kind of function, and its arguments as JSON has them."""

    kind: str
    parameters: dict[str, Any]
    units: int = 1
    """How much work it is, in trials: for progress and for the time left."""
    exclusive: bool = False
    """Whether it measures times: it is computed on this machine, alone, after all others."""


def task_key(task: Task) -> str:
    """Return the digest of all that a task's result depends on, in hexadecimal."""
    content: list[Any] = [task.kind, task.parameters, code_of(task)]
    if task.exclusive:
        content.append(_machine())  # times depend on it as well
    plain = msgspec.json.encode(content, order="sorted")
    return hashlib.blake2b(plain, digest_size=_KEY_SIZE).hexdigest()


@functools.cache
def _machine() -> dict[str, str]:
    from holdfast_lab.testbed.machine import describe  # the golden table has no laboratory

    return {name: value for name, value in describe().items() if name not in _OF_THE_DAY}


def code_of(task: Task) -> str:
    """Return the digest of the code that computes a task, as it is on the disk now, in hexadecimal.

    The version of holdfast alone would not tell what a developer has changed since. Hashed are the
    sources of the function's module, of the problems that the parameters name by their place, and
    of all modules that these import, and the compiled kernel; if the function starts processes, all
    that these may be made of. TaskError if there is no such kind, or a source cannot be read.
    """
    digests = [_digest_behind(_place_of(task.kind), task.kind in _OF_PROCESSES)]
    digests += [_digest_behind(place) for place in _places_in(task.parameters)]
    return hashlib.blake2b("".join(digests).encode(), digest_size=_KEY_SIZE).hexdigest()


_HASHED: dict[tuple[str, bool], tuple[str, list[Path], list[tuple[int, int]]]] = {}
"""Digests, with the files that they cover and their times and sizes, which an edit changes."""


def _digest_behind(place: str, whole_program: bool = False) -> str:
    try:
        known, files, stats = _HASHED.get((place, whole_program), ("", [], []))
        if known and stats == _stats_of(files):
            return known
        sources = _sources_behind(place.partition(":")[0])
        if whole_program:
            for folder in map(_folder, _PROGRAM):
                for path in folder.rglob("*.py"):
                    sources[str(path.relative_to(folder.parent))] = path
        if _kernel.__file__:
            sources["kernel"] = Path(_kernel.__file__)
        files = list(sources.values())
        stats = _stats_of(files)
        digest = hashlib.blake2b(holdfast.__version__.encode(), digest_size=_KEY_SIZE)
        for name, path in sorted(sources.items()):
            digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    except OSError as error:
        raise TaskError(f"{error.filename}: cannot be read: {error.strerror}") from error
    _HASHED[place, whole_program] = digest.hexdigest(), files, stats
    return digest.hexdigest()


@functools.cache
def _folder(package: str) -> Path:
    """Return where a package is, which need not be imported for that."""
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise TaskError(f"the package {package} is not installed here; make install brings it")
    return Path(spec.origin).parent


def _stats_of(files: Iterable[Path]) -> list[tuple[int, int]]:
    return [(stat.st_mtime_ns, stat.st_size) for stat in (path.stat() for path in files)]


def run_task(task: Task) -> pd.DataFrame:
    """Compute a task in this process; HoldfastError if its function refuses the parameters."""
    module, _, name = _place_of(task.kind).partition(":")
    function = getattr(importlib.import_module(module), name)
    return function(**task.parameters)


def _sources_behind(module: str) -> dict[str, Path]:
    """Return the files of a module and of all that it imports of our packages, by module.

    What a string names as ``module:attribute``, as registries do, counts as imported.
    """

    def locate(name: str) -> Path | None:
        top, *rest = name.split(".")
        # This module knows all functions.
        if top not in _PACKAGES or name == __name__:
            return None
        place = _folder(top).joinpath(*rest)
        path = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        return path if path.is_file() else None

    return follow_imports([module], locate, places=True)


def _places_in(plain: object) -> list[str]:
    """Return the places ``module:attribute`` of our packages that plain data names, in order."""
    if isinstance(plain, dict):
        return [place for value in plain.values() for place in _places_in(value)]
    if isinstance(plain, list | tuple):
        return [place for value in plain for place in _places_in(value)]
    if isinstance(plain, str) and _PLACE.fullmatch(plain):
        return [plain] if plain.split(".")[0] in _PACKAGES else []
    return []


def _place_of(kind: str) -> str:
    try:
        return _FUNCTIONS[kind]
    except KeyError:
        raise TaskError(f"task of kind {kind!r}: there are {', '.join(_FUNCTIONS)}") from None
