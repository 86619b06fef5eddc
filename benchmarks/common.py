"""What the cases share."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.report import Result
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.problem import Problem
from holdfast.runtime.machine import available_cores

__all__ = [
    "SIZES",
    "THREADS",
    "Case",
    "Context",
    "child",
    "decide",
    "evenly_spread",
    "threads_in_words",
]

SIZES = (100, 200, 300, 400, 500)
THREADS = (1, 2) if available_cores() > 1 else (1,)

_CHILD = Path(__file__).with_name("child.py")


class Context(NamedTuple):
    """What a case is given.

    Attributes
    ----------
    quick : bool
        Measure less.
    progress : callable
        To be told the fraction of the case that is done.
    """

    quick: bool
    progress: Callable[[float], None]


class Case(NamedTuple):
    """One section: its name on the command line, its title and its rough duration."""

    name: str
    title: str
    run: Callable[[Context], Result]
    seconds: float
    quick_seconds: float


def decide(
    problem: Problem, settings: PlanningSettings, state: PlanningState
) -> Callable[[], object]:
    """Return a call of one decision."""
    return lambda: Planner(problem, settings).choose_sensing_action(state)


def evenly_spread(states: list[PlanningState], number: int) -> list[PlanningState]:
    """Return states evenly spread over a trial, the first and the last among them."""
    picked = np.unique(np.linspace(0, len(states) - 1, number).round().astype(int))
    return [states[index] for index in picked]


def threads_in_words(threads: int) -> str:
    """Return ``1 thread`` or ``2 threads``."""
    return f"{threads} thread" + ("s" if threads > 1 else "")


def child(request: dict[str, Any], **environment: str) -> dict[str, Any]:
    """Measure something in a process of its own; see child.py."""
    done = subprocess.run(
        [sys.executable, str(_CHILD), json.dumps(request)],
        env={**os.environ, **environment},
        check=True,
        capture_output=True,
        text=True,
    )
    result: dict[str, Any] = json.loads(done.stdout)
    return result
