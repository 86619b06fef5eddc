"""A simulated world in a file, which outlives the robot's process and records what it performed.

A robot that is killed during a move must neither repeat nor omit that move, and the robot itself is
no witness. So a task action counts as performed once its line is appended, by one system call, and
the line survives the process. A world that is made for a resumed trial continues after its lines.
In the end the lines are compared with those of the reference run.

Nothing is forced to the disk: a file survives the end of a process, and no fault here ends the
machine.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from holdfast.errors import EnvironmentFailedError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import Done, MoveResult
from holdfast.problems.problem import Problem
from holdfast.robot.environment import SimulatedEnvironment

_FIELDS = 5


class Performance(NamedTuple):
    """A task action that was performed."""

    trial: int
    step: int
    action: str  # the bytes of its numbers, as hexadecimal
    process: int
    at: float  # in seconds since the epoch


class WitnessedWorld:
    """The world of one trial: see :class:`~holdfast.robot.environment.Environment`.

    A resumed trial goes on after the lines of another robot's process. Raises
    EnvironmentFailedError if the file is not one of performances.
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

    def perform(self, task_action: FloatArray) -> float | MoveResult | None:
        """Append the action's line; now it is performed."""
        action = np.ascontiguousarray(task_action, dtype=np.float64)
        line = (
            f"{self._trial} {self._world.step} {action.tobytes().hex()} "
            f"{self._process} {time.time():.6f}\n"
        )
        os.write(self._descriptor, line.encode())
        return self._world.perform(action)

    def is_done(self) -> Done:
        """Tell how the task stands."""
        return self._world.is_done()

    def steps_performed(self) -> int:
        """Return the number of the trial's lines."""
        return self._world.steps_performed()

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)


def witnessed_by(path: Path) -> dict[str, Any]:
    """Return the section ``environment`` of a configuration with this world."""
    return {
        "object": f"{WitnessedWorld.__module__}:{WitnessedWorld.__qualname__}",
        "arguments": {"path": str(path.resolve())},
    }


def performances(path: Path) -> Iterator[Performance]:
    """Yield the performed task actions, in order.

    Raises EnvironmentFailedError if a line cannot be read.
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
    """Describe the first difference between two worlds' performances; None if there is none.

    Two processes that acted alternately are one, for only one robot may act at a time. A file that
    does not exist has no lines.
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
