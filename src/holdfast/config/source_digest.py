"""Which code decides: digests of sources, equal wherever the same sources lie.

Two processes decide alike only if they run the same code. A version identifies a release, but not a
problem that its author is still writing, nor a changed checkout. So the sources themselves are
compared, byte by byte: they do not depend on the machine, on the version of Python or on whether a
module is compiled. For the kernel these are the sources that it was built from.

A problem's code is the module that a configuration names, the module of the problem's class, those
of its base classes, and all that these import from beside them, or from a folder below that they
have put on the import path. It is read from the sources, because of two processes with the same
code one may have loaded more. Not part of it are files of data, compiled modules without source,
other installed packages, a module imported under a name made at run time, one in another folder
that is imported only while a function runs, and imports for type checkers alone.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import sys
from collections.abc import Callable
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

from holdfast import __version__, _kernel
from holdfast.config.imports import follow_imports

_PACKAGE = Path(__file__).resolve().parents[1]
_DIGEST_SIZE = 8
_SOURCE_DIGEST_SIZE = 32

_LIBRARIES = frozenset({"numpy", "msgspec"})
"""Libraries that a problem's class may be derived from; they are no part of its code."""


@functools.cache
def core_version() -> str:
    """Return holdfast's version and the digest of what decides in it, such as ``0.1.0+3f...``.

    That is its kernel, the modules at its top, its numerics, problems and planning, and what makes
    problems of names and configurations.
    """
    digest = hashlib.blake2b(_kernel.sources().encode(), digest_size=_DIGEST_SIZE)
    for path in sorted(_core_files()):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0")
        digest.update(hashlib.blake2b(path.read_bytes()).digest())
    return f"{__version__}+{digest.hexdigest()}"


@functools.cache
def _core_files() -> frozenset[Path]:
    rooms = ("numerics", "problems", "planning", "config")
    folders = (_PACKAGE, *(_PACKAGE / room for room in rooms))
    return frozenset(path for folder in folders for path in folder.glob("*.py"))


def machines() -> str:
    """Return whether the state machines of sessions are ``compiled`` or ``interpreted``."""
    found = importlib.util.find_spec("holdfast.protocol.robot")
    origin = (found and found.origin) or ""
    return "compiled" if origin.endswith(tuple(EXTENSION_SUFFIXES)) else "interpreted"


def problem_digest(problem_class: type, named_in: str | None = None) -> str:
    """Return the digest of :func:`problem_sources`, in hexadecimal."""
    digest = hashlib.blake2b(digest_size=_DIGEST_SIZE)
    for module, source in sorted(problem_sources(problem_class, named_in).items()):
        digest.update(f"{module} {source}\n".encode())
    return digest.hexdigest()


def problem_sources(problem_class: type, named_in: str | None = None) -> dict[str, str]:
    """Return the digest of each source of a problem's code beyond holdfast's core, by module.

    The digests are hexadecimal; that of a module that was loaded and has no source here is empty.
    The sources are read from the disk now: to identify loaded code, call this at once.
    ``named_in`` is the module that the problem's name in a configuration leads to
    (:func:`holdfast.config.registry.problem_module`). It need not be the one in which the class is
    defined, and may have made the class or changed it.
    """
    found: dict[str, str] = {}
    defined_in = [derived.__module__ for derived in problem_class.__mro__]
    for start in dict.fromkeys([named_in or defined_in[0], *defined_in]):
        file = getattr(sys.modules.get(start), "__file__", None)
        if file is None or Path(file).resolve() in _core_files():
            continue
        top = start.partition(".")[0]
        # A user's module may be called as one of the standard library's.
        if top in _LIBRARIES or (top in sys.stdlib_module_names and not _is_users(Path(file))):
            continue
        base = Path(file).parents[start.count(".") + (Path(file).stem == "__init__")]
        sources = follow_imports(
            [start], _places_from(top, base), loaded=functools.partial(_loaded_below, base)
        )
        found.setdefault(start, "")
        for module, path in sources.items():
            content = path.read_bytes()
            found[module] = hashlib.blake2b(content, digest_size=_SOURCE_DIGEST_SIZE).hexdigest()
    return found


def _places_from(top: str, base: Path) -> Callable[[str], Path | None]:
    """Return what finds the sources of a package and, if a user's, those beside it."""

    def locate(module: str) -> Path | None:
        first = module.partition(".")[0]
        ours = first == _PACKAGE.name
        place = (_PACKAGE.parent if ours else base).joinpath(*module.split("."))
        for path in (place / "__init__.py", place.with_suffix(".py")):
            if path.is_file():
                wanted = path not in _core_files() if ours else True
                return path if wanted and (ours or first == top or _is_users(path)) else None
        return None

    return locate


def _loaded_below(base: Path, module: str) -> Path | None:
    """Return the source of a user's module that is loaded from a folder below another's."""
    file = getattr(sys.modules.get(module), "__file__", None)
    if file is None or not Path(file).resolve().is_relative_to(base.resolve()):
        return None
    return Path(file) if Path(file).suffix == ".py" and _is_users(Path(file)) else None


def _is_users(path: Path) -> bool:
    """Tell whether a source is a user's: in a folder of libraries, others' lie beside it."""
    # A service that starts has no need of it, and a robot may wait for that service.
    from holdfast.config.user_code import is_users_file

    return is_users_file(str(path))
