"""How long a decision takes, and where the time goes.

Each function of the problem is replaced, in a copy of the object, by one that measures the
processor time of its thread. What is left is the kernel and what NumPy does around it. Other work
on the machine makes nothing look slow; a decision with several threads takes less time than this.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from time import thread_time
from typing import Any

import msgspec
import numpy as np

from holdfast.planning.planner import Planner
from holdfast.problems.attributes import PARAMETERS, has_own
from holdfast.tuning.findings import Inspection
from holdfast.tuning.trial_check import SensedBelief

__all__ = ["FunctionTimes", "check_decision_time"]

_DECISIONS = 5

_STAND_FOR = {
    "expected_move": ("move",),
    "expected_path": ("policy", "execute", "move", "next_stage"),
    "move_each": ("move",),
}
"""Functions that are not used if a class replaces one of these and inherits them."""

_DEAR = 0.5
"""Share of a decision from which on a function is worth a word."""


class FunctionTimes:
    """Measures the functions of a copy of a problem.

    Attributes
    ----------
    problem : Problem
        The copy.
    seconds : dict of str to float
        Processor time in each function; in one that another one calls it counts for that.
    calls : dict of str to int
    """

    def __init__(self, problem: Any) -> None:
        self.seconds: dict[str, float] = {}
        self.calls: dict[str, int] = {}
        self._inside = False
        self.problem = copy.copy(problem)
        for name in PARAMETERS:
            own = getattr(problem, name, None)
            if own is None or (name in _STAND_FOR and not has_own(problem, name, _STAND_FOR[name])):
                continue
            object.__setattr__(self.problem, name, self._timed(name, own))

    def _timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def timed(*arguments: Any) -> Any:
            if self._inside:
                return function(*arguments)
            self._inside = True
            began = thread_time()
            try:
                return function(*arguments)
            finally:
                self._inside = False
                self.seconds[name] = self.seconds.get(name, 0.0) + thread_time() - began
                self.calls[name] = self.calls.get(name, 0) + 1

        return timed


def check_decision_time(inspection: Inspection, beliefs: list[SensedBelief]) -> None:
    """Say how many milliseconds a choice of what to sense takes, and in which functions."""
    settings = inspection.settings
    active = msgspec.structs.replace(settings.active_sensing, num_cores=1)
    settings = msgspec.structs.replace(settings, active_sensing=active)
    late = inspection.deadline(0.15)
    try:
        times = FunctionTimes(inspection.problem)
    except (AttributeError, TypeError):
        times = None  # a class with slots
    planner = Planner(inspection.problem if times is None else times.problem, settings)
    state = inspection.ask("a decision", lambda: planner.init(inspection.seed, 0), "time")
    taken: list[float] = []
    own: dict[str, list[float]] = {}
    calls: dict[str, int] = {}
    starts = [(state.belief, 0), *((each.belief, each.stage) for each in beliefs)]
    # The first one, which may load something, does not count.
    for number, (belief, stage) in enumerate([starts[0], *starts[:: max(1, len(starts) // 5)]]):
        if number > _DECISIONS or (late() and taken):
            break
        at = state._replace(belief=belief, stage=stage)
        if times is not None:
            times.seconds, times.calls = {}, {}
        began = thread_time()
        inspection.ask("a decision", lambda at=at: planner.choose_sensing_action(at), "time")  # type: ignore[misc]
        elapsed = thread_time() - began
        if number == 0:
            continue
        taken.append(elapsed)
        if times is not None:
            for name, seconds in times.seconds.items():
                own.setdefault(name, []).append(seconds)
            calls = times.calls
    if not taken:
        return
    whole = float(np.median(taken))
    particles = settings.particle_filter.num_particles
    text = (
        f"a choice of what to sense takes {whole * 1e3:.2g} ms of processor time "
        f"({settings.selector.method}, {particles} particles)"
    )
    sums = {name: float(sum(each)) / len(taken) for name, each in own.items()}
    parts = [
        f"{name} {seconds * 1e3:.2g} ms in {calls.get(name, 0)} calls"
        for name, seconds in sorted(sums.items(), key=lambda item: -item[1])
        if seconds > 0.02 * whole
    ]
    mean = float(np.mean(taken))
    if times is not None and mean > 0.0:
        rest = max(0.0, mean - sum(sums.values()))
        parts.append(f"the kernel and what is around it {rest * 1e3:.2g} ms")
    advice = ""
    dearest = max(sums, key=lambda name: sums[name], default="")
    if dearest and sums[dearest] > _DEAR * mean and whole > 5e-3:
        advice = (
            f"{dearest} takes most of it: use whole arrays in it, no loop over states, and look "
            "whether fewer active_sensing.num_observation_samples choose as well."
        )
    seen = f"{text}: {', '.join(parts)}" if parts else text
    inspection.add("information", "time", seen, advice, "docs/settings.md")
