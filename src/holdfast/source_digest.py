"""Which code decides: digests of sources, equal wherever the same sources lie.

Two processes decide alike only if they run the same code. A version tells that of a release, but
not of a problem that a person is still writing, nor of a checkout in which something was changed.
So what is compared are the sources themselves, byte by byte: neither the machine nor the version of
Python changes them, nor whether a module is compiled. The kernel is told by the sources that it was
built of.

A problem's code is that of its class, of the classes that it is derived from, and of all that these
import from beside them. What nobody can see from there is not part of it: files of data, modules
that are compiled and have no source here, and other packages that are installed.
"""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from holdfast import __version__, _kernel

if TYPE_CHECKING:
    import ast

__all__ = ["core_version", "follow_imports", "problem_digest", "problem_sources"]

_PACKAGE = Path(__file__).resolve().parent
_DIGEST_SIZE = 8
_SOURCE_DIGEST_SIZE = 32

_LIBRARIES = frozenset({"numpy", "msgspec"})
"""Of other people, and the same for all problems; a class may be derived from one of theirs."""


@functools.cache
def core_version() -> str:
    """Return holdfast's version and the digest of what decides in it, such as ``0.1.0+3f...``.

    That is its kernel, its problems, and the modules beside this one.
    """
    digest = hashlib.blake2b(_kernel.sources().encode(), digest_size=_DIGEST_SIZE)
    for path in sorted(_core_files()):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0")
        digest.update(hashlib.blake2b(path.read_bytes()).digest())
    return f"{__version__}+{digest.hexdigest()}"


@functools.cache
def _core_files() -> frozenset[Path]:
    return frozenset((*_PACKAGE.glob("*.py"), *(_PACKAGE / "problems").glob("*.py")))


def problem_digest(problem_class: type) -> str:
    """Return the digest of a problem's code beyond holdfast's core, in hexadecimal."""
    digest = hashlib.blake2b(digest_size=_DIGEST_SIZE)
    for module, source in sorted(problem_sources(problem_class).items()):
        digest.update(f"{module} {source}\n".encode())
    return digest.hexdigest()


def problem_sources(problem_class: type) -> dict[str, str]:
    """Return the digest of each source of a problem's code beyond holdfast's core.

    It is what is on the disk now: whoever wants to know what was loaded asks at once.

    Parameters
    ----------
    problem_class : type

    Returns
    -------
    dict of str
        Digests in hexadecimal by the names of the modules; an empty one for a module that was
        loaded and has no source here.
    """
    found: dict[str, str] = {}
    for name in dict.fromkeys(derived.__module__ for derived in problem_class.__mro__):
        top = name.partition(".")[0]
        if top in _LIBRARIES or top in sys.stdlib_module_names:
            continue
        file = getattr(sys.modules.get(name), "__file__", None)
        if file is None or Path(file).resolve() in _core_files():
            continue
        sources = follow_imports([name], _places_from(name, Path(file)))
        found.setdefault(name, "")
        for module, path in sources.items():
            content = path.read_bytes()
            found[module] = hashlib.blake2b(content, digest_size=_SOURCE_DIGEST_SIZE).hexdigest()
    return found


def _places_from(name: str, file: Path) -> Callable[[str], Path | None]:
    """Return what finds the sources of a module's own package and, if a user's, beside it."""
    base = file.parents[name.count(".") + (file.stem == "__init__")]
    top = name.partition(".")[0]

    def locate(module: str) -> Path | None:
        first = module.partition(".")[0]
        ours = first == _PACKAGE.name
        place = (_PACKAGE.parent if ours else base).joinpath(*module.split("."))
        for path in (place / "__init__.py", place.with_suffix(".py")):
            if path.is_file():
                wanted = path not in _core_files() if ours else True
                return path if wanted and (ours or first == top or _is_beside(path)) else None
        return None

    return locate


def _is_beside(path: Path) -> bool:
    """Tell whether a source is a user's: in a folder of libraries, others' lie beside it."""
    # A service that starts has no need of it, and a robot may wait for that service.
    from holdfast.user_code import is_users_file

    return is_users_file(str(path))


def follow_imports(
    modules: Iterable[str], locate: Callable[[str], Path | None], *, places: bool = False
) -> dict[str, Path]:
    """Return the sources of modules and of all that they import, directly or not.

    The sources are read, not run, so what is imported under a name made at run time is not found.

    Parameters
    ----------
    modules : iterable of str
        Their names.
    locate : callable
        Returns the source of a module, None for one that is not to be followed, and for a name that
        is no module.
    places : bool
        Whether what a string names as ``module:attribute``, as registries do, counts as imported.

    Returns
    -------
    dict of Path
        By the names of the modules.

    Raises
    ------
    OSError
        If a source cannot be read.
    """
    found: dict[str, Path] = {}
    waiting = list(modules)
    seen = set(waiting)
    while waiting:
        name = waiting.pop()
        path = locate(name)
        # A module's own package is imported with it.
        following = [name.rpartition(".")[0]]
        if path is not None:
            found[name] = path
            following += _imported_by(path, name, places=places)
        new = [each for each in dict.fromkeys(following) if each and each not in seen]
        waiting += new
        seen.update(new)
    return found


def _imported_by(path: Path, name: str, *, places: bool) -> list[str]:
    """Return the names that a module imports, and what may be a module's among those."""
    import ast

    try:
        nodes = ast.walk(ast.parse(path.read_bytes()))
    except (SyntaxError, ValueError):
        return []  # it was never imported
    names: list[str] = []
    for node in nodes:
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = _absolute(node, name, path)
            names += [module, *(f"{module}.{alias.name}" for alias in node.names)]
        elif places and isinstance(node, ast.Constant) and isinstance(node.value, str):
            module, _, attribute = node.value.partition(":")
            if attribute.isidentifier() and all(map(str.isidentifier, module.split("."))):
                names.append(module)
    return names


def _absolute(node: ast.ImportFrom, name: str, path: Path) -> str:
    """Return the name of the module from which something is imported."""
    if not node.level:
        return node.module or ""
    parts = name.split(".")
    levels = node.level - (path.stem == "__init__")
    return ".".join([*parts[: len(parts) - levels], *([node.module] if node.module else [])])
