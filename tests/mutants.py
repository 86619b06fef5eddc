"""How many small mistakes in the product do its tests notice?

    python -m tests.mutants [PART ...] [--sample 300] [--seed 1] [--minutes 60] [--all]

A mutant is the product with one mistake: a comparison turned round, a number off by one, a call
left out. A seed draws as many from each part. The tests that are named after its module judge it,
then those that import it: one that fails has killed it. They are collected once for all mutants of
a module. Each mutant gets a fork of that process, in which the code of the module's functions is
exchanged; a mistake that is made on import gets a process that collects anew.

A mutant that survives needs a test, or makes no difference: ``equivalent_mutants.toml`` says why,
by module, kind and line of code. ``--all`` runs all that are named after the module, and says which
of them kill nothing that another does not kill as well. Results are appended to a file, so a second
call goes on.
"""

import argparse
import ast
import gc
import importlib.util
import json
import os
import random
import re
import resource
import signal
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from types import CodeType, FunctionType
from typing import TypeAlias

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = ROOT / "src"
PARTS = ("numerics", "planning/belief", "planning/sensing", "planning/tracking", "protocol",
         "robot/trial", "journal/journal", "journal/tables", "reports/csv_export",
         "transport/revocation", "transport/datagram_cipher", "transport/credentials")  # fmt: skip
"""What is mutated unless something else is named: how paths in the package begin."""

BOUND_S = 300
"""For the tests of one mutant, which may hang; that is noticed as well."""

QUICK_S = 0.3
"""Tests that take no longer come first."""

EQUIVALENT = tomllib.loads(Path(__file__).with_name("equivalent_mutants.toml").read_text("utf-8"))
"""Why mutants make no difference, by module and by :func:`entry_of`."""

AT_ONCE = 40
"""Mutants for which tests are collected once."""

Mutant: TypeAlias = tuple[str, int, str]
"""The file of a module, the number of the place in it, and how that reads."""

Answer: TypeAlias = tuple[list[str] | None, dict[str, float]]
"""Which tests fail, None if that cannot be told; and how long each took."""

Tell: TypeAlias = Callable[[Mutant, list[str] | None], None]

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


def mutants_of(path: Path) -> list[Mutant]:
    """Return the mutants of a module."""
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


def functions_of(code: CodeType) -> Iterator[tuple[tuple[str, int], CodeType]]:
    """Yield the code of all functions within, each with its name and line."""
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield (inner.co_qualname, inner.co_firstlineno), inner
            yield from functions_of(inner)


def exchange(file: str, number: int) -> bool:
    """Make a mistake in the functions of a module; return whether that could be done."""
    loader = Mutated(file, number)
    if loader.name not in sys.modules:
        sys.meta_path.insert(0, loader)
        return True
    before = functions_of(compile(Path(loader.path).read_bytes(), loader.path, "exec"))
    after = dict(functions_of(loader.get_code(loader.name)))
    changed = {where: after[where] for where, code in before if after.get(where, code) != code}
    found = [each for each in gc.get_objects() if isinstance(each, FunctionType)]
    found = [each for each in found if each.__code__.co_filename == loader.path]
    codes = [
        changed.get((each.__code__.co_qualname, each.__code__.co_firstlineno)) for each in found
    ]
    try:
        for each, code in zip(found, codes, strict=True):
            each.__code__ = code or each.__code__
    except ValueError:  # it needs other variables of the function around it
        return False
    return any(codes)


class Judge:
    """A plugin of pytest: runs the tests that were collected on each mutant in turn, in a fork."""

    def __init__(
        self, every: bool, mutants: Sequence[Mutant] = (), tell: Tell | None = None
    ) -> None:
        self.every, self.mutants, self.tell = every, mutants, tell
        self.failed: list[str] = []
        self.took: dict[str, float] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note which tests fail."""
        if report.failed and report.nodeid not in self.failed:
            self.failed.append(report.nodeid)

    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        """Make sure that the tests pass without a mistake; then judge."""
        if self.tell is None:
            return None
        failed, self.took = in_fork(lambda: self._run(session.items, None))
        if session.testsfailed or failed:
            os._exit(1)
        quick_first = sorted(session.items, key=lambda test: self.took[test.nodeid] > QUICK_S)
        for mutant in self.mutants:
            self.tell(mutant, in_fork(partial(self._run, quick_first, mutant))[0])
        os._exit(0)

    def _run(self, tests: Sequence[pytest.Item], mutant: Mutant | None) -> Answer:
        if mutant is not None:
            limit = int(time.process_time() + 4.0 * sum(self.took.values())) + 15
            resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
            if not exchange(mutant[0], mutant[1]):
                return None, {}
        took = {}
        for test, following in zip(tests, [*tests[1:], None], strict=True):
            started = time.process_time()
            test.config.hook.pytest_runtest_protocol(item=test, nextitem=following)
            took[test.nodeid] = time.process_time() - started
            if self.failed and not self.every:
                break
        return self.failed, took


def in_fork(work: Callable[[], Answer]) -> Answer:
    """Return what a function returns in a process of its own."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(BOUND_S)
        with os.fdopen(write, "w") as told:
            json.dump(work(), told)
        os._exit(0)
    os.close(write)
    with os.fdopen(read) as told:
        text = told.read()
    os.waitpid(child, 0)
    return tuple(json.loads(text)) if text else (["it hung, or its process died"], {})


def run_pytest(tests: Sequence[str], judge: Judge, *options: str) -> int:
    """Run tests without a word; return how pytest ends."""
    null = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(null, stream)
    plain = ["-q", "-p", "no:cacheprovider", "-m", "not real and not slow"]
    return int(pytest.main([*plain, *options, *tests], plugins=[judge]))


def imported_anew(mutant: Mutant, tests: Sequence[str], every: bool) -> Answer:
    """Return which tests fail where the module is imported with its mistake."""
    sys.meta_path.insert(0, Mutated(mutant[0], mutant[1]))
    judge = Judge(every)
    code = run_pytest(tests, judge, *([] if every else ["-x"]))
    return judge.failed or ([] if code in {0, 5} else [f"pytest ended with {code}"]), {}


def judge_all(mutants: Sequence[Mutant], tests: Sequence[str], every: bool, tell: Tell) -> None:
    """Let tests judge mutants of one module."""
    child = os.fork()
    if child == 0:
        run_pytest(tests, Judge(every, mutants, tell))
        os._exit(1)  # it could not collect them
    if os.waitpid(child, 0)[1]:
        sys.exit(f"without a mistake, some of these fail: {' '.join(tests)}")


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


class Results:
    """What became of each mutant, in a file of JSON lines."""

    def __init__(self, path: Path, every: bool) -> None:
        self.path, self.every = path, every
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()

    def write(self, stage: int, mutant: Mutant, by: list[str] | None) -> None:
        """Note what has killed a mutant; None if that can only be told where it is imported."""
        row = {"mutant": mutant, "all": self.every, "stage": stage, "by": by}
        with self.path.open("a", encoding="utf-8") as results:
            results.write(json.dumps(row) + "\n")

    def read(self) -> dict[Mutant, tuple[int, list[str] | None]]:
        """Return the last stage that judged each mutant, and what has killed it."""
        rows = map(json.loads, self.path.read_text(encoding="utf-8").splitlines())
        return {
            tuple(row["mutant"]): (row["stage"], row["by"])
            for row in rows
            if row["all"] == self.every
        }

    def complete(self, drawn: Sequence[Mutant], until: float) -> None:
        """Judge what is not judged yet, module by module."""
        for file in dict.fromkeys(mutant[0] for mutant in drawn):
            own = [mutant for mutant in drawn if mutant[0] == file]
            for stage, tests in enumerate(tests_of(file)[: 1 if self.every else 2]):
                known, tell = self.read(), partial(self.write, stage)
                todo = [
                    m for m in own if m not in known or (known[m][0] < stage and not known[m][1])
                ]
                for start in range(0, len(todo) * bool(tests), AT_ONCE):
                    if time.monotonic() < until:
                        judge_all(todo[start : start + AT_ONCE], tests, self.every, tell)
                for mutant, (_, by) in self.read().items():
                    if mutant in todo and by is None:
                        tell(mutant, in_fork(partial(imported_anew, mutant, tests, self.every))[0])


def entry_of(mutant: Mutant) -> str:
    """Return the key of a mutant in ``equivalent_mutants.toml``."""
    return re.sub(", line [0-9]+", "", mutant[2])


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
    drawn: list[Mutant] = []
    for part in options.parts:
        modules = [p for p in SOURCES.rglob("*.py") if f"holdfast/{part}" in p.as_posix()]
        found = [mutant for path in sorted(modules) for mutant in mutants_of(path)]
        random.Random(options.seed).shuffle(found)
        drawn += found[: -(-options.sample // len(options.parts))]
    results = Results(options.out, options.all)
    results.complete(drawn, time.monotonic() + 60.0 * options.minutes)
    known = results.read()
    rows = [(mutant, known[mutant][1] or []) for mutant in drawn if mutant in known]
    killed = excused = 0
    for mutant, by in rows:
        why = EQUIVALENT.get(mutant[0], {}).get(entry_of(mutant), "")
        killed += bool(by)
        excused += not by and bool(why)
        if not by:
            print("the same " if why else "SURVIVES ", mutant[0], mutant[2], *([why] * bool(why)))
    print(f"{killed} of {len(rows)} killed, {killed / max(len(rows) - excused, 1):.1%} of those")
    print(f"that make a difference; {excused} make none; {len(drawn) - len(rows)} not judged yet")
    of_functions = [{test.partition("[")[0] for test in by} for _, by in rows if by]
    for test in sorted(set().union(*of_functions)) if options.all else ():
        if all(len(tests) > 1 for tests in of_functions if test in tests):
            print("kills nothing that the others do not kill:", test)
            of_functions = [tests - {test} for tests in of_functions]
    return 0


if __name__ == "__main__":
    sys.exit(main())
