"""Calls of the robot's environment, on a thread and with a time limit.

A task action takes as long as a robot takes to move, and a controller may never answer. The loop
must not wait for either: it has to react to a dead service meanwhile. So a thread calls the
environment, one call at a time, and each call ends as an event, with the result or the error. A
call that takes too long has failed; its later result is dropped.

A simulated world answers within microseconds. It is called at once, in the loop's own thread.

Results are checked against the environment's contract here, where the method's name is known.
"""

from __future__ import annotations

import abc
import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from time import monotonic
from typing import Any

import numpy as np
import numpy.typing as npt

from holdfast.arrays import FloatArray
from holdfast.config.user_code import account_of_user_error
from holdfast.errors import EnvironmentFailedError, HoldfastError, InvalidValueError
from holdfast.outcome import Done
from holdfast.problems.problem import Problem
from holdfast.protocol.events import (
    Acted,
    EnvironmentEvent,
    EnvironmentFailed,
    EnvironmentReady,
    Sensed,
)
from holdfast.robot.environment import (
    DONE_VALUES,
    Environment,
    EnvironmentMaker,
    ObservationSizes,
    as_done,
)

__all__ = ["EnvironmentRunner", "InlineRunner", "ThreadedRunner", "make_runner"]


Deliver = Callable[[EnvironmentEvent], None]

_SUSPENDED_S = 0.1
"""A watchdog that wakes this much too late was in a stopped process, like what it watches."""


def make_runner(
    maker: EnvironmentMaker,
    trial: int,
    deliver: Deliver,
    *,
    resumed: bool = False,
    performed: Sequence[FloatArray] = (),
) -> EnvironmentRunner:
    """Return the runner of a trial in the configuration's environment."""

    def make() -> Environment:
        return maker(trial, resumed=resumed, performed=performed)

    if maker.simulated:
        return InlineRunner(make, maker.problem, deliver, maker.name, resumed=resumed)
    return ThreadedRunner(
        make, maker.problem, deliver, maker.name, maker.timeout_ms, resumed=resumed
    )


class _CheckedEnvironment:
    """An environment whose results are checked and become events.

    Exceptions of the types ``passed_on`` are raised instead.
    """

    def __init__(
        self,
        make: Callable[[], Environment],
        problem: Problem,
        name: str,
        *,
        resumed: bool,
        passed_on: tuple[type[BaseException], ...] = (),
    ) -> None:
        self._make = make
        self._name = name
        self._resumed = resumed
        self._passed_on = passed_on
        self._sizes = ObservationSizes(problem)
        # The current method. Another thread reads it when the call takes too long.
        self._method = name
        # The reward of the task action that the current call has performed. Also read by another
        # thread.
        self._performed: tuple[float | None] | None = None
        self.environment: Environment | None = None

    def begin(self, step: int) -> EnvironmentEvent:
        try:
            environment = self._make()
            self.environment = environment
            count = None
            ask = getattr(environment, "steps_performed", None)
            if self._resumed and callable(ask):
                self._method = "steps_performed"
                count = self._count(ask())
            self._method = "is_done"
            return EnvironmentReady(self._done(environment.is_done()), count)
        except self._passed_on:
            raise
        except BaseException as error:  # noqa: BLE001 - a SystemExit would end a thread unheard
            return self._failed(step, error)

    def sense(self, step: int, sensing_action: int) -> EnvironmentEvent:
        self._method = "perform_sensing"
        try:
            shown = self._begun().perform_sensing(sensing_action)
            return Sensed(step, self._observation(sensing_action, shown))
        except self._passed_on:
            raise
        except BaseException as error:  # noqa: BLE001 - a SystemExit would end a thread unheard
            return self._failed(step, error)

    def perform(self, step: int, task_action: FloatArray) -> EnvironmentEvent:
        self._performed = None
        self._method = "perform"
        begun = False
        try:
            environment = self._begun()
            # A copy: the robot's own record of the action must stay what it is.
            action = np.array(task_action, dtype=np.float64)
            begun = True
            reward = self._reward(environment.perform(action))
            self._performed = (reward,)
            self._method = "is_done"
            return Acted(step, reward, self._done(environment.is_done()))
        except self._passed_on:
            raise
        except BaseException as error:  # noqa: BLE001 - a SystemExit would end a thread unheard
            return self._failed(step, error, performance_begun=begun)

    def close(self) -> None:
        close = getattr(self.environment, "close", None)
        if callable(close):
            # The trial is over: an error here changes nothing of it.
            try:
                close()
            except self._passed_on:
                raise
            except BaseException:  # noqa: BLE001
                return

    def stalled(
        self, step: int, timeout_ms: float, *, performance_begun: bool
    ) -> EnvironmentFailed:
        """Return the event of a call that takes too long."""
        method = self._method
        made = method == self._name
        called = f"the constructor of {method}" if made else self._called(method)
        text = (
            f"{called} has not returned within {timeout_ms:g} ms, which is environment.timeout_ms"
        )
        return self._failure(step, method, text, performance_begun=performance_begun)

    def _failure(
        self, step: int, method: str, text: str, *, performance_begun: bool
    ) -> EnvironmentFailed:
        performed = self._performed
        if not performance_begun or performed is None:
            asked = getattr(self.environment, "steps_performed", None)
            counts = callable(asked) or not performance_begun
            return EnvironmentFailed(step, method, text, performance_begun, counts_steps=counts)
        # Only is_done has failed: the result of ``perform`` is known.
        return EnvironmentFailed(step, method, text, False, True, *performed)

    def _begun(self) -> Environment:
        if self.environment is None:
            raise EnvironmentFailedError(f"{self._name}: a trial in it has not begun")
        return self.environment

    def _failed(
        self, step: int, error: BaseException, *, performance_begun: bool = False
    ) -> EnvironmentFailed:
        called = self._called(self._method)
        text = account_of_user_error(error, called)
        if text is None and isinstance(error, HoldfastError):
            text = str(error)
        elif text is None:
            message = f": {error}" if str(error) else ""
            text = f"{called} raised {type(error).__name__}{message}"
        return self._failure(step, self._method, text, performance_begun=performance_begun)

    def _called(self, method: str) -> str:
        return self._name if method == self._name else f"{self._name}: {method}"

    def _observation(self, sensing_action: int, value: object) -> FloatArray:
        size = self._sizes[sensing_action]
        array = _numbers(value)
        if array is None or array.ndim != 1 or array.size < 1 or size not in (None, array.size):
            raise self._unusable(value, f"an array of shape ({size or 'n'},)")
        observation = np.array(array, dtype=np.float64)
        if not np.isfinite(observation).all():
            raise self._unusable(value, "finite numbers")
        observation.setflags(write=False)
        return observation

    def _reward(self, value: object) -> float | None:
        if value is None:
            return None
        number = _numbers(value)
        if number is None or number.ndim != 0 or not np.isfinite(number):
            raise self._unusable(value, "a finite number, the reward, or None")
        return float(number)

    def _done(self, value: object) -> Done:
        done = as_done(value)
        if done is None:
            raise self._unusable(value, DONE_VALUES)
        return done

    def _count(self, value: object) -> int:
        number = _numbers(value)
        if number is None or number.ndim != 0 or number.dtype.kind not in "iu" or number < 0:
            raise self._unusable(value, "a whole number >= 0")
        return int(number)

    def _unusable(self, value: object, need: str) -> EnvironmentFailedError:
        came = f"an array of shape {value.shape}: " if isinstance(value, np.ndarray) else ""
        return EnvironmentFailedError(
            f"{self._called(self._method)} returned {came}{value!r:.80}; it must return {need}"
        )


def _numbers(value: object) -> npt.NDArray[Any] | None:
    """Return real numbers as an array; None if the value is anything else."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # a list of lists of different lengths
        return None
    return array if array.dtype.kind in "fiu" else None


class EnvironmentRunner(abc.ABC):
    """Calls the environment of one trial, one call at a time.

    Each call leads to one event: at once, or later from another thread. After a failure every
    further call fails. After ``close`` no event comes. ``deliver`` takes the events; it must not
    block.
    """

    _passed_on: tuple[type[BaseException], ...] = ()

    def __init__(
        self,
        make: Callable[[], Environment],
        problem: Problem,
        deliver: Deliver,
        name: str,
        *,
        resumed: bool = False,
    ) -> None:
        self._checked = _CheckedEnvironment(
            make, problem, name, resumed=resumed, passed_on=self._passed_on
        )
        self._deliver = deliver
        self._name = name
        self._failed: EnvironmentFailed | None = None
        self._closed = False

    def begin(self, step: int = 0) -> None:
        """Make the environment: :class:`Begun`. Comes first."""
        self._call(step, "begin", lambda: self._checked.begin(step))

    def sense(self, step: int, sensing_action: int) -> None:
        """Perform a sensing action: :class:`Sensed`."""
        self._call(step, "sense", lambda: self._checked.sense(step, sensing_action))

    def perform(self, step: int, task_action: FloatArray) -> None:
        """Perform a task action, and ask whether the task is done: :class:`Acted`."""
        self._call(step, "perform", lambda: self._checked.perform(step, task_action))

    @abc.abstractmethod
    def close(self, timeout_s: float = 1.0) -> None:
        """Call the environment's ``close``, if it has one, within about this time.

        An environment that is still in a call after that is abandoned. May be repeated.
        """

    @abc.abstractmethod
    def _call(self, step: int, kind: str, function: Callable[[], EnvironmentEvent]) -> None:
        """Call the environment, and deliver the event."""


class InlineRunner(EnvironmentRunner):
    """Calls a simulated world at once, in the caller's thread; KeyboardInterrupt passes through."""

    _passed_on = (KeyboardInterrupt,)

    @property
    def environment(self) -> Environment | None:
        """The environment, once the trial has begun."""
        return self._checked.environment

    def close(self, timeout_s: float = 1.0) -> None:
        """Call the environment's ``close``, if it has one."""
        del timeout_s
        if not self._closed:
            self._closed = True
            self._checked.close()

    def _call(self, step: int, kind: str, function: Callable[[], EnvironmentEvent]) -> None:
        del kind
        if self._closed:
            return
        if self._failed is not None:
            self._deliver(_again(self._failed, step))
            return
        event = function()
        if isinstance(event, EnvironmentFailed):
            self._failed = event
        self._deliver(event)


def _again(failed: EnvironmentFailed, step: int) -> EnvironmentFailed:
    """Return the event of a call after a failure: it has not begun."""
    return EnvironmentFailed(step, failed.what, failed.text, False)


class _EnvironmentCall:
    """A call for the worker thread."""

    __slots__ = ("deadline", "function", "kind", "step")

    def __init__(
        self, step: int, kind: str, function: Callable[[], EnvironmentEvent], deadline: float
    ) -> None:
        self.step = step
        self.kind = kind
        self.function = function
        self.deadline = deadline


class ThreadedRunner(EnvironmentRunner):
    """Calls an environment on its own thread, and gives up a call that takes too long.

    The environment is made, called and closed on one thread, and never called again after a call
    was given up. Both threads are daemons: an environment that never returns does not keep the
    process alive.

    Parameters
    ----------
    timeout_ms : float
        Longest time of a call. Time in which this whole process was stopped does not count.
    """

    def __init__(
        self,
        make: Callable[[], Environment],
        problem: Problem,
        deliver: Deliver,
        name: str,
        timeout_ms: float,
        *,
        resumed: bool = False,
    ) -> None:
        if not timeout_ms > 0.0:
            raise InvalidValueError(f"environment.timeout_ms {timeout_ms}: must be above 0")
        super().__init__(make, problem, deliver, name, resumed=resumed)
        self._timeout_ms = timeout_ms
        self._calls: SimpleQueue[_EnvironmentCall | None] = SimpleQueue()
        # Guards the fields below, _failed and _closed. Events are delivered while it is held, so
        # that none comes after close, and no call leads to two.
        self._changed = threading.Condition()
        self._current: _EnvironmentCall | None = None
        self._watchdog_idles = False
        self._worker = threading.Thread(target=self._work, name="environment", daemon=True)
        self._watchdog = threading.Thread(
            target=self._watch, name="environment-watchdog", daemon=True
        )
        self._worker.start()
        self._watchdog.start()

    def close(self, timeout_s: float = 1.0) -> None:
        """Call the environment's ``close``, within about this time, unless it is in a call."""
        with self._changed:
            if not self._closed:
                self._closed = True
                self._calls.put(None)
                self._changed.notify_all()
        self._watchdog.join(timeout_s)
        self._worker.join(timeout_s)

    def _call(self, step: int, kind: str, function: Callable[[], EnvironmentEvent]) -> None:
        with self._changed:
            if self._closed:
                return
            if self._failed is not None:
                self._deliver(_again(self._failed, step))
                return
            if self._current is not None:
                raise InvalidValueError(
                    f"{self._name}: {kind} of step {step} while {self._current.kind} of step "
                    f"{self._current.step} has not ended; one call at a time is allowed"
                )
            call = _EnvironmentCall(step, kind, function, monotonic() + 1e-3 * self._timeout_ms)
            self._current = call
            self._calls.put(call)
            if self._watchdog_idles:
                self._changed.notify_all()

    def _work(self) -> None:
        while (call := self._calls.get()) is not None:
            event = call.function()
            with self._changed:
                if self._current is call:
                    self._current = None
                    self._finish(event)
        self._checked.close()

    def _watch(self) -> None:
        with self._changed:
            while not self._closed:
                call = self._current
                if call is None:
                    self._watchdog_idles = True
                    self._changed.wait()
                    self._watchdog_idles = False
                    continue
                # Most calls end long before, and the next round sees the later ones. So a call
                # costs no switch to this thread.
                wakes_at = call.deadline
                self._changed.wait(max(0.0, wakes_at - monotonic()))
                if self._closed or self._current is not call:
                    continue
                now = monotonic()
                if now - wakes_at > _SUSPENDED_S:
                    call.deadline = now + min(now - wakes_at, 1e-3 * self._timeout_ms)
                elif now >= call.deadline:
                    self._current = None
                    begun = call.kind == "perform"
                    self._finish(
                        self._checked.stalled(call.step, self._timeout_ms, performance_begun=begun)
                    )

    def _finish(self, event: EnvironmentEvent) -> None:
        if isinstance(event, EnvironmentFailed):
            self._failed = event
        if not self._closed:
            self._deliver(event)
