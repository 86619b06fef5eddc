"""How many runs the simulator makes, with interpreted and with compiled state machines."""

from __future__ import annotations

import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from benchmarks.common import Context
from benchmarks.report import Bar, Result, Table, paragraph

__all__ = ["simulated"]

RUNS_BAR_PER_S = 200.0

_CHILD = Path(__file__).with_name("simulated_runs.py")
_COMPILED = Path(__file__).parents[1] / ".venv-compiled" / "bin" / "python"
_SEEDS_OF_A_TURN = 50


def simulated(context: Context) -> Result:
    """Time the same seeds with both kinds of machines, in turns, each in a process of its own."""
    turns = 2 if context.quick else 16
    pythons = [sys.executable, *([str(_COMPILED)] if _COMPILED.exists() else [])]
    with ExitStack() as processes:
        children: dict[str, subprocess.Popen[str]] = {}
        for python in pythons:
            child = processes.enter_context(_started(python))
            children[_line_of(child)] = child
        seconds: dict[str, list[float]] = {kind: [] for kind in children}
        for turn in range(turns):
            first = turn * _SEEDS_OF_A_TURN
            for kind, child in children.items():
                assert child.stdin is not None
                child.stdin.write(f"{first} {first + _SEEDS_OF_A_TURN}\n")
                child.stdin.flush()
                seconds[kind].append(float(_line_of(child)))
            context.progress((turn + 1) / turns)
        for child in children.values():
            assert child.stdin is not None
            child.stdin.close()
    rates = {kind: _SEEDS_OF_A_TURN / float(np.median(own)) for kind, own in seconds.items()}
    rows = [[kind, f"{rate:.0f}", f"{1e3 / rate:.2f} ms"] for kind, rate in rates.items()]
    if {"compiled", "interpreted"} <= seconds.keys():
        ratio = np.median(np.divide(seconds["interpreted"], seconds["compiled"]))
        rows.append(["compiled over interpreted", f"{ratio:.2f}", ""])
    text = f"""The seeds 0:{turns * _SEEDS_OF_A_TURN} of `holdfast simulate`, on one core, in turns
        of {_SEEDS_OF_A_TURN}; processor time, so that others on the machine count less. Compiled
        state machines are those of `.venv-compiled` (`make simulate` makes it)."""
    bars = [
        Bar("simulated runs a second, one core", rates[kind], RUNS_BAR_PER_S, "", at_least=True)
        for kind in rates
        if kind == "compiled"
    ]
    return Result(
        [paragraph(text), Table(("state machines", "runs a second", "one run"), rows)], bars
    )


def _started(python: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [python, "-P", str(_CHILD)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def _line_of(child: subprocess.Popen[str]) -> str:
    assert child.stdout is not None
    line = child.stdout.readline().strip()
    if not line:
        raise RuntimeError(f"{_CHILD.name} ended with {child.wait()}")
    return line
