"""A simulated world that outlives the robot's process, and is a witness of what was done to it.

A robot that is killed in the midst of a move must not make that move twice, nor leave it out.
Whether it did cannot be asked of the robot. So this world is a file: a task action is performed at
the moment at which its line is appended, by one call of the system, and the line stays whatever
becomes of the process. A world that is made again for a trial that goes on stands where its lines
have led it. In the end the lines are compared with those of a run that nothing disturbed.

The operating system's memory outlives a process, so nothing is forced to the disk: no fault that is
made here ends the machine.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from holdfast.errors import EnvironmentFailedError
from holdfast.problems.problem import FloatArray, Problem
from holdfast.runtime.environment import SimulatedEnvironment

__all__ = ["Performance", "WitnessedWorld", "difference_of_performances", "performances"]

_FIELDS = 5


class Performance(NamedTuple):
    """A task action that was performed.

    Attributes
    ----------
    trial, step : int
        The step is counted by the world.
    action : str
        The bytes of its numbers, as hexadecimal.
    process : int
        Whose robot did it.
    at : float
        When, in seconds since the epoch.
    """

    trial: int
    step: int
    action: str
    process: int
    at: float


class WitnessedWorld:
    """The world of one trial: see :class:`~holdfast.runtime.environment.CountingEnvironment`.

    Parameters
    ----------
    path : str
        The file of the run's performances; appended to.
    problem : Problem
    seed, trial : int
    resumed : bool
        Whether the trial goes on after the end of another robot's process.

    Raises
    ------
    EnvironmentFailedError
        If the file is not one of performances.
    """

    def __init__(
        self, path: str, problem: Problem, seed: int, trial: int, resumed: bool = False
    ) -> None:
        self._trial = trial
        self._process = os.getpid()
        before = []
        if resumed and Path(path).exists():
            before = [
                np.frombuffer(bytes.fromhex(each.action))
                for each in performances(Path(path))
                if each.trial == trial
            ]
        self._world = SimulatedEnvironment.after(problem, seed, trial, before)
        self._descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        """Draw an observation of the true state; that changes nothing, so it leaves no line."""
        return self._world.perform_sensing(sensing_action)

    def perform(self, task_action: FloatArray) -> float | None:
        """Append the action's line: with that it is performed."""
        action = np.ascontiguousarray(task_action, dtype=np.float64)
        line = (
            f"{self._trial} {self._world.step} {action.tobytes().hex()} "
            f"{self._process} {time.time():.6f}\n"
        )
        os.write(self._descriptor, line.encode())
        return self._world.perform(action)

    def is_done(self) -> bool:
        """Tell whether the true state is a goal."""
        return self._world.is_done()

    def steps_performed(self) -> int:
        """Return the number of the trial's lines."""
        return self._world.steps_performed()

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)


def performances(path: Path) -> Iterator[Performance]:
    """Yield what was performed, in order.

    Parameters
    ----------
    path : Path
        The file of a :class:`WitnessedWorld`.

    Raises
    ------
    EnvironmentFailedError
        If a line cannot be read.
    """
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        fields = line.split(" ")
        try:
            if len(fields) != _FIELDS:
                raise ValueError  # noqa: TRY301
            trial, step, action, process, at = fields
            yield Performance(int(trial), int(step), action, int(process), float(at))
        except ValueError:
            raise EnvironmentFailedError(
                f"{path}, line {number}: is no performance, but {line[:80]!r}"
            ) from None


def difference_of_performances(expected: Path, found: Path) -> str | None:
    """Say where two worlds were first acted on differently; None if nowhere.

    Parameters
    ----------
    expected, found : Path
        Their files. One that does not exist has no lines.

    Returns
    -------
    str or None
        Trial, step and what was done there: once too often, out of order, not at all, otherwise.
        Also if two processes acted in turns, for only one robot may act at a time.
    """
    first, second = (
        [] if not path.exists() else list(performances(path)) for path in (expected, found)
    )
    for index in range(max(len(first), len(second))):
        one = first[index] if index < len(first) else None
        other = second[index] if index < len(second) else None
        if one is not None and other is not None and one[:3] == other[:3]:
            continue
        return f"performance {index}: expected {_named(one)}, found {_named(other)}"
    seen: list[int] = []
    for each in second:
        if each.process not in seen:
            seen.append(each.process)
        elif each.process != seen[-1]:
            return (
                f"trial {each.trial}, step {each.step}: process {each.process} acts again after "
                f"process {seen[-1]} has acted"
            )
    return None


def _named(performance: Performance | None) -> str:
    if performance is None:
        return "nothing"
    action = np.frombuffer(bytes.fromhex(performance.action)).tolist()
    return f"trial {performance.trial}, step {performance.step}, {action}"
