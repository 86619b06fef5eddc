"""How many small mistakes in the product do its tests notice?

    python -m tests.mutants [PART ...] [--sample 300] [--seed 1] [--minutes 60] [--all]

A mutant is the product with one mistake: a comparison turned round, a number off by one, a call
left out. A seed draws as many from each part. A process of its own imports each one and runs the
tests that are named after its module, then those that import it: a test that fails has killed it.
A mutant that survives needs a test, or makes no difference. ``--all`` runs all that are named
after the module, and says which of them kill nothing that another does not kill as well. Results
are appended to a file, so a second call goes on.
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import json
import os
import random
import re
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.machinery import ModuleSpec, SourceFileLoader
from itertools import zip_longest
from pathlib import Path
from types import CodeType
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = ROOT / "src"
PARTS = ("numerics", "planning/belief", "planning/sensing", "planning/tracking", "protocol",
         "robot/trial", "journal/journal", "journal/tables", "reports/csv_export",
         "transport/revocation", "transport/datagram_cipher", "transport/credentials")  # fmt: skip
"""What is mutated unless something else is named: how paths in the package begin."""

BOUND_S = 300
"""For the tests of one mutant, which may hang; that is noticed as well."""

PAIRS = ("Lt LtE", "Gt GtE", "Eq NotEq", "Is IsNot", "In NotIn", "And Or", "Add Sub", "Mult Div")
OPPOSITES: dict[type[ast.AST], type[ast.AST]] = {
    getattr(ast, one): getattr(ast, other)
    for pair in PAIRS
    for one, other in (pair.split(), reversed(pair.split()))
} | dict.fromkeys((ast.FloorDiv, ast.Mod, ast.Pow), ast.Mult)


def places(tree: ast.AST, within: bool = False) -> Iterator[ast.AST]:
    """Yield what can be mutated: within functions, and not in annotations and messages."""
    for field, value in ast.iter_fields(tree):
        if field in {"annotation", "returns", "decorator_list"}:
            continue
        for node in value if isinstance(value, list) else [value]:
            if isinstance(node, ast.AST) and not isinstance(node, ast.Raise | ast.JoinedStr):
                if within and mistake(node, make=False):
                    yield node
                yield from places(node, within or isinstance(node, ast.FunctionDef))


def mistake(node: ast.AST, *, make: bool) -> str:
    """Return the mistake that a node can have, or nothing; and make it."""
    match node:
        case ast.Return(value=ast.Constant(value=None)):
            return ""
        case ast.Compare(ops=[operator]) if type(operator) in OPPOSITES:
            if make:
                node.ops = [OPPOSITES[type(operator)]()]  # type: ignore[list-item]
        case ast.BinOp(op=operator) | ast.AugAssign(op=operator) | ast.BoolOp(op=operator) if (
            type(operator) in OPPOSITES
        ):
            if make:
                node.op = OPPOSITES[type(operator)]()  # type: ignore[assignment]
        case ast.If() | ast.IfExp() | ast.While():
            if make:
                node.test = ast.UnaryOp(ast.Not(), node.test)
        case ast.Constant(value=bool() | int() | float() as value):
            if make:
                node.value = not value if isinstance(value, bool) else value + 1
        case ast.Expr(value=ast.Call() | ast.Await()) | ast.Return(value=ast.expr()):
            if make:
                node.value = ast.Constant(None)
        case _:
            return ""
    return type(node).__name__


def mutants_of(path: Path) -> list[tuple[str, int, str]]:
    """Return the mutants of a module: its file, the number of the place, and how that reads."""
    text = path.read_text(encoding="utf-8")
    lines, name = text.splitlines(), path.relative_to(SOURCES).as_posix()
    return [
        (name, number, f"{mistake(node, make=False)}, line {line}: {lines[line - 1].strip()}")
        for number, node in enumerate(places(ast.parse(text)))
        for line in [node.lineno]  # type: ignore[attr-defined]
    ]


class Mutated(SourceFileLoader):
    """Finds a module before anyone else does, and loads it with its mistake."""

    def __init__(self, file: str, number: int) -> None:
        super().__init__(file.removesuffix(".py").replace("/", "."), str(SOURCES / file))
        self.number = number

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        found = importlib.util.spec_from_file_location(name, self.path, loader=self)
        return found if name == self.name else None

    def get_code(self, fullname: str) -> CodeType:
        tree = ast.parse(Path(self.path).read_bytes())
        mistake(list(places(tree))[self.number], make=True)
        return compile(ast.fix_missing_locations(tree), self.path, "exec")


class Failures:
    """Notes which tests fail, as a plugin of pytest."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and report.nodeid not in self.seen:
            self.seen.append(report.nodeid)


@cache
def tests_of(file: str) -> tuple[list[str], list[str]]:
    """Return the files of tests that are named after a module, and others that import it."""
    *folders, name = file.removesuffix(".py").split("/")[1:]
    names = {f"test_{'_'.join([*folders[start:], name.lstrip('_')])}.py" for start in range(9)}
    module = re.compile(rf"\b{re.escape(file.removesuffix('.py').replace('/', '.'))}\b")
    found = [
        path for path in sorted((ROOT / "tests").rglob("test_*.py")) if "ros" not in path.parts
    ]
    named = [str(path) for path in found if path.name in names]
    importing = [str(p) for p in found if p.name not in names and module.search(p.read_text())]
    return named, importing


def killers(file: str, number: int, tests: Sequence[str], *options: str) -> list[str]:
    """Run tests on a mutant, in a process of its own; return those that fail, or how it ended."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(BOUND_S)
        null = os.open(os.devnull, os.O_RDWR)
        for stream in range(3):
            os.dup2(null, stream)
        if number >= 0:
            sys.meta_path.insert(0, Mutated(file, number))
        failures = Failures()
        plain = ["-q", "-p", "no:cacheprovider", "-m", "not real and not slow"]
        code = pytest.main([*plain, *options, *tests], plugins=[failures])
        seen = failures.seen or ([] if code in {0, 5} else [f"pytest ended with {int(code)}"])
        with os.fdopen(write, "w") as answer:
            json.dump(seen, answer)
        os._exit(0)
    os.close(write)
    with os.fdopen(read) as answer:
        told = answer.read()
    os.waitpid(child, 0)
    return list(json.loads(told)) if told else ["it hung, or its process died"]


@cache
def require_sound(tests: tuple[str, ...]) -> None:
    """Make sure that tests pass without a mistake."""
    if failed := tests and killers("", -1, tests, "-x"):
        sys.exit(f"without a mistake, these fail: {failed}")


def judged(file: str, number: int, every: bool) -> list[str]:
    """Return what kills a mutant: all tests that are named after its module, or the first."""
    for tests in tests_of(file)[: 1 if every else 2]:
        require_sound(tuple(tests))
        if tests and (found := killers(file, number, tests, *([] if every else ["-x"]))):
            return found
    return []


def main() -> int:
    """Draw, run and report."""
    parser = argparse.ArgumentParser(description="mutate the product, and run its tests")
    parser.add_argument("parts", nargs="*", default=PARTS)
    parser.add_argument("--sample", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--all", action="store_true")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "mutants.jsonl")
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.touch()
    lines = options.out.read_text(encoding="utf-8").splitlines()
    known = {(row["file"], row["mistake"], row["all"]): row for row in map(json.loads, lines)}
    drawn = []
    for part in options.parts:
        modules = [p for p in SOURCES.rglob("*.py") if f"holdfast/{part}" in p.as_posix()]
        found = [mutant for path in sorted(modules) for mutant in mutants_of(path)]
        random.Random(options.seed).shuffle(found)
        drawn.append(found[: -(-options.sample // len(options.parts))])
    until, rows = time.monotonic() + 60.0 * options.minutes, []
    for mutant in (each for together in zip_longest(*drawn) for each in together if each):
        file, number, how = mutant
        row: dict[str, Any] | None = known.get((file, how, options.all))
        if row is None and time.monotonic() < until:
            row = {"file": file, "mistake": how, "all": options.all}
            row["by"] = judged(file, number, options.all)
            with options.out.open("a", encoding="utf-8") as results:
                results.write(json.dumps(row) + "\n")
        if row is not None:
            rows.append(row)
            print("killed  " if row["by"] else "SURVIVES", file, how, flush=True)
    killed = sum(bool(row["by"]) for row in rows)
    print(f"{killed} of {len(rows)} killed, {killed / max(len(rows), 1):.0%}")
    by_functions = [{test.partition("[")[0] for test in row["by"]} for row in rows]
    alone = {test for tests in by_functions if len(tests) == 1 for test in tests}
    for test in sorted(set().union(*by_functions) - alone) if options.all else ():
        print("kills nothing alone:", test)
    return 0


if __name__ == "__main__":
    sys.exit(main())
