"""Sensing that takes time, for environments whose ``perform_sensing`` waits for its observation.

The robot goes on while it senses: ``perform_sensing`` returns :data:`LATER` at once, and each
observation comes with the task action after which it is there. It belongs to the step at which it
was taken (:mod:`holdfast.planning.tracking`).
"""

from __future__ import annotations

import copy
import threading
from collections import deque
from typing import Any

import numpy.typing as npt

from holdfast.errors import EnvironmentFailedError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import Done, MoveResult
from holdfast.robot.environment import LATER, Environment, Later


class SenseInBackground:
    """An environment that senses on a thread while the robot moves.

    Its ``perform_sensing`` and ``perform`` must bear to run at the same time. A sensing action
    waits for the one before, so one observation at most is to come.

    Parameters
    ----------
    environment : Environment
        It waits in ``perform_sensing`` for its observation. If it has no ``steps_performed``, the
        steps of a trial are counted from here, so the trial cannot be gone on with after a crash.
    """

    def __init__(self, environment: Environment) -> None:
        self._environment = environment
        self._count = 0
        self._thread: threading.Thread | None = None
        self._came: deque[tuple[int, npt.ArrayLike]] = deque()
        self._failed: tuple[int, BaseException] | None = None

    def __getattr__(self, name: str) -> Any:
        # steps_performed, close, state: only if the other one has them.
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._environment, name)

    def perform_sensing(self, sensing_action: int) -> Later:
        """Begin to sense; wait first for a sensing action that has not ended."""
        if self._thread is not None:
            self._thread.join()
        self._raise()
        self._thread = threading.Thread(
            target=self._sense, args=(self._steps(), sensing_action), name="sensing", daemon=True
        )
        self._thread.start()
        return LATER

    def perform(self, task_action: FloatArray) -> float | MoveResult | None:
        """Perform a task action."""
        result = self._environment.perform(task_action)
        self._count += 1
        return result

    def is_done(self) -> Done:
        """Return how the task stands."""
        return self._environment.is_done()

    def late_observations(self) -> list[tuple[int, npt.ArrayLike]]:
        """Return what has come; raise what sensing has raised."""
        self._raise()
        return [self._came.popleft() for _ in range(len(self._came))]

    def close(self) -> None:
        """Wait for a sensing action that has not ended, and close the other environment."""
        if self._thread is not None:
            self._thread.join()
        close = getattr(self._environment, "close", None)
        if callable(close):
            close()

    def _steps(self) -> int:
        count = getattr(self._environment, "steps_performed", None)
        return int(count()) if callable(count) else self._count

    def _sense(self, step: int, sensing_action: int) -> None:
        try:
            shown = self._environment.perform_sensing(sensing_action)
            self._came.append((step, copy.deepcopy(shown)))  # type: ignore[arg-type]
        except BaseException as error:  # noqa: BLE001 - raised again where it can be heard
            self._failed = step, error

    def _raise(self) -> None:
        failed, self._failed = self._failed, None
        if failed is not None:
            step, error = failed
            what = f"{type(error).__name__}: {error}"
            raise EnvironmentFailedError(
                f"perform_sensing, begun at step {step} in the background, raised {what}"
            ) from error
