"""Fuzzing of the decoders, guided by what of their code was reached.

    python -m tests.fuzz.decoders TARGET --runs 100000 --seed 1

What is Python is instrumented. msgspec's C code is not, so half of the messages are made from valid
ones by what knows the format (``mutations.py``). A finding ends the process with an error and
leaves the bytes in a file ``crash-*`` in the directory of ``--crashes``.
"""

import argparse
import random
import sys
import tempfile
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from tests.fuzz import targets
from tests.fuzz.mutations import Mutator

from holdfast.config import yaml_document
from holdfast.planning import inputs
from holdfast.planning import planner as planning
from holdfast.protocol import messages
from holdfast.transport import frames

_INSTRUMENTED: dict[str, tuple[types.ModuleType, ...]] = {
    "hello": (targets, frames),
    "request": (targets, messages),
    "reply": (targets, messages),
    "record": (targets, inputs),
    "checkpoint": (targets, planning),
    "configuration": (
        targets,
        yaml_document,
        yaml.reader,
        yaml.scanner,
        yaml.parser,
        yaml.composer,
        yaml.resolver,
    ),
}

_MAX_BYTES = 4096
"""The largest state among the specimens fits; the rest of a longer message repeats itself."""

_KEPT_TO_LIBFUZZER = 0.5
_RSS_LIMIT_MB = 1024
_SECONDS_EACH = 5


def _functions_of(module: types.ModuleType) -> Iterator[types.FunctionType]:
    """Return the functions and methods that a module defines."""
    kept: list[Any] = list(vars(module).values())
    for each in kept:
        if getattr(each, "__module__", None) != module.__name__:
            continue
        if isinstance(each, types.FunctionType):
            yield each
        elif isinstance(each, type):
            yield from (part for part in vars(each).values() if type(part) is types.FunctionType)


def main() -> None:
    """Fuzz one decoder so many times."""
    import atheris

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("target", choices=sorted(targets.TARGETS))
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--crashes", type=Path, default=Path(), help="directory for what leads to an error"
    )
    options = parser.parse_args()
    for module in _INSTRUMENTED[options.target]:
        for function in _functions_of(module):
            # In place: an editable installation has an importer of its own, which atheris misses.
            atheris.instrument_func(function)
    check = targets.TARGETS[options.target]

    def mutate(data: bytes, max_size: int, seed: int) -> bytes:
        chance = random.Random(seed)
        if chance.random() < _KEPT_TO_LIBFUZZER:
            mutated: bytes = atheris.Mutate(data, max_size)
            return mutated
        return Mutator(chance, [data, *targets.SPECIMENS[options.target]]).spoilt()[:max_size]

    with tempfile.TemporaryDirectory(prefix="holdfast-fuzz-") as corpus:
        for number, specimen in enumerate(targets.SPECIMENS[options.target]):
            Path(corpus, f"{number:03d}").write_bytes(specimen)
        atheris.Setup(
            [
                sys.argv[0],
                f"-runs={options.runs}",
                f"-seed={options.seed}",
                f"-max_len={_MAX_BYTES}",
                "-len_control=0",
                f"-rss_limit_mb={_RSS_LIMIT_MB}",
                f"-timeout={_SECONDS_EACH}",
                f"-artifact_prefix={options.crashes}/",
                corpus,
            ],
            check,
            custom_mutator=mutate,
        )
        atheris.Fuzz()


if __name__ == "__main__":
    main()
