"""Which modules a module imports: its source is read, not run."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import ast


def follow_imports(
    modules: Iterable[str],
    locate: Callable[[str], Path | None],
    *,
    loaded: Callable[[str], Path | None] | None = None,
    places: bool = False,
) -> dict[str, Path]:
    """Return the sources of modules and of all that they import, directly or not, by name.

    The sources are read, not run, so what is imported under a name made at run time is not found.

    ``locate`` returns the source of a module, None for one that is not to be followed, and for a
    name that is no module. ``loaded`` is asked as well where that has none, but only for what a
    module imports while it is itself imported: in each process that has loaded the one, the other
    is loaded, too. With ``places``, what a string names as ``module:attribute``, as registries do,
    counts as imported.
    """
    found: dict[str, Path] = {}
    waiting = [(name, False) for name in modules]
    seen = set(waiting)
    while waiting:
        name, at_once = waiting.pop()
        path = found.get(name) or locate(name)
        if path is None and at_once and loaded is not None:
            path = loaded(name)
        # A module's own package is imported with it.
        following = [(name.rpartition(".")[0], at_once)]
        if path is not None and name not in found:
            found[name] = path
            following += _imported_by(path, name, places=places)
        new = [each for each in dict.fromkeys(following) if each[0] and each not in seen]
        waiting += new
        seen.update(new)
    return found


def _imported_by(path: Path, name: str, *, places: bool) -> list[tuple[str, bool]]:
    """Return the names that a module imports, and what may be a module's among those.

    With each goes whether it is imported at once, when the module is, not while a function runs.
    """
    import ast

    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError):
        return []  # it was never imported
    names: list[tuple[str, bool]] = []
    waiting: deque[tuple[ast.AST, bool]] = deque([(tree, True)])
    while waiting:
        node, at_once = waiting.popleft()
        names += [(module, at_once) for module in _imported_in(node, path, name, places=places)]
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            at_once = False
        inside = ast.iter_child_nodes(node)
        if isinstance(node, ast.If):
            test = ast.unparse(node.test)
            if test.endswith("TYPE_CHECKING") and not test.startswith("not "):
                inside = iter([node.test, *node.orelse])
        waiting.extend((each, at_once) for each in inside)
    return names


def _imported_in(node: ast.AST, path: Path, name: str, *, places: bool) -> list[str]:
    """Return the names that one node of a module's syntax imports."""
    import ast

    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        module = _absolute(node, name, path)
        return [module, *(f"{module}.{alias.name}" for alias in node.names)]
    if isinstance(node, ast.Call) and node.args:
        called = node.func.attr if isinstance(node.func, ast.Attribute) else node.func
        called = called.id if isinstance(called, ast.Name) else called
        wanted = node.args[0]
        if called in ("import_module", "__import__") and isinstance(wanted, ast.Constant):
            return [wanted.value] if isinstance(wanted.value, str) else []
    if places and isinstance(node, ast.Constant) and isinstance(node.value, str):
        module, _, attribute = node.value.partition(":")
        if attribute.isidentifier() and all(map(str.isidentifier, module.split("."))):
            return [module]
    return []


def _absolute(node: ast.ImportFrom, name: str, path: Path) -> str:
    """Return the name of the module from which something is imported."""
    if not node.level:
        return node.module or ""
    parts = name.split(".")
    levels = node.level - (path.stem == "__init__")
    return ".".join([*parts[: len(parts) - levels], *([node.module] if node.module else [])])
