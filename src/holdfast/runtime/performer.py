"""A robot's world, asked off the loop's thread and with an eye on the clock.

A task action takes as long as a robot takes to move, and a controller may never answer. The robot's
loop must not wait for either: while the robot moves it hears that a service has died, and asks the
next one. So the environment is called on a thread of its own, one call at a time, and each call
ends as an event, like everything else that the loop hears of: with the result, or with what went
wrong. A call that takes too long counts as failed; what it returns later is dropped.

A simulated world answers within microseconds. It is called at once, in the loop's own thread.

What an environment returns is held to its contract here, because here it is still known which
method returned it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from time import monotonic
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from holdfast.errors import EnvironmentFailedError, HoldfastError, InvalidValueError
from holdfast.outcome import Done
from holdfast.problems.problem import Problem
from holdfast.runtime.environment import (
    DONE_VALUES,
    Environment,
    EnvironmentMaker,
    as_done,
    observation_size,
)
from holdfast.session.events import Acted, Begun, EnvironmentEvent, EnvironmentFailed, Sensed
from holdfast.user_code import account_of_user_error

__all__ = ["InlinePerformer", "Performer", "ThreadedPerformer", "make_performer"]

FloatArray = npt.NDArray[np.float64]

Deliver = Callable[[EnvironmentEvent], None]

_SUSPENDED_S = 0.1
"""A watchdog that wakes so much too late was not running: nor was whatever it watches."""


class Performer(Protocol):
    """Calls the environment of one trial, one call at a time.

    Each call is answered by one event, which goes to a callable that was given at the beginning:
    at once, or later from another thread. After a failure every further call fails. After
    ``close`` no event comes.
    """

    def begin(self, step: int = 0) -> None:
        """Make the environment: :class:`Begun`. Comes first.

        Parameters
        ----------
        step : int
            At which the trial begins, or goes on; names the failure, if it is one.
        """
        ...

    def sense(self, step: int, sensing_action: int) -> None:
        """Perform a sensing action: :class:`Sensed`."""
        ...

    def perform(self, step: int, task_action: FloatArray) -> None:
        """Perform a task action, and ask whether the task is done: :class:`Acted`."""
        ...

    def close(self, timeout_s: float = 1.0) -> None:
        """Call the environment's ``close``, if it has one, within about this time.

        An environment that still is in a call after that is left alone. May be repeated.
        """
        ...


def make_performer(
    maker: EnvironmentMaker,
    trial: int,
    deliver: Deliver,
    *,
    resumed: bool = False,
    performed: Sequence[FloatArray] = (),
) -> Performer:
    """Return what performs a trial in the environment that the configuration names.

    Parameters
    ----------
    maker : EnvironmentMaker
    trial : int
    deliver : callable
        Takes the events. It must not block.
    resumed : bool, optional
        Whether the robot's process has died in the middle of this trial; then an environment that
        counts its task actions is asked for the count.
    performed : sequence of array, optional
        Task actions performed in this trial before that.
    """

    def make() -> Environment:
        return maker(trial, resumed=resumed, performed=performed)

    if maker.simulated:
        return InlinePerformer(make, maker.problem, deliver, maker.name, resumed=resumed)
    return ThreadedPerformer(
        make, maker.problem, deliver, maker.name, maker.timeout_ms, resumed=resumed
    )


class _CheckedEnvironment:
    """An environment whose every answer is an event, and is what its contract says.

    Parameters
    ----------
    make : callable
        Makes the environment.
    problem : Problem
        Tells how large an observation is.
    name : str
        Of the environment.
    resumed : bool
    passed_on : tuple of type
        Which exceptions do not become an event.
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
        self._problem = problem
        self._name = name
        self._resumed = resumed
        self._passed_on = passed_on
        self._sizes: dict[int, int | None] = {}
        # What is being called. Read by another thread when it takes too long.
        self._method = name
        # The reward of the task action that was performed in the call that goes on, if one was.
        # Read by another thread, too.
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
            return Begun(self._done(environment.is_done()), count)
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
            # The trial is over: whatever its end brings changes nothing of it.
            try:
                close()
            except self._passed_on:
                raise
            except BaseException:  # noqa: BLE001
                return

    def stalled(
        self, step: int, timeout_ms: float, *, performance_begun: bool
    ) -> EnvironmentFailed:
        """Return what is said of a call that takes too long."""
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
            return EnvironmentFailed(step, method, text, performance_begun, counts=counts)
        # Nobody but is_done has failed: what ``perform`` came to is known.
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
        size = self._observation_size(sensing_action)
        array = _numbers(value)
        if array is None or array.ndim != 1 or array.size < 1 or size not in (None, array.size):
            raise self._unusable(value, f"an array of shape ({size or 'n'},)")
        observation = np.array(array, dtype=np.float64)
        if not np.isfinite(observation).all():
            raise self._unusable(value, "finite numbers")
        observation.setflags(write=False)
        return observation

    def _observation_size(self, sensing_action: int) -> int | None:
        if sensing_action not in self._sizes:
            self._sizes[sensing_action] = observation_size(self._problem, sensing_action)
        return self._sizes[sensing_action]

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


class InlinePerformer:
    """Performs at once, in the thread of its caller: for simulated worlds.

    The event is delivered before a call returns. Ctrl-C passes through.

    Parameters
    ----------
    make : callable
        Makes the environment.
    problem : Problem
    deliver : callable
        Takes the events.
    name : str
        Of the environment, for messages.
    resumed : bool, optional
        Whether to ask how many task actions have been performed.
    """

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
            make, problem, name, resumed=resumed, passed_on=(KeyboardInterrupt,)
        )
        self._deliver = deliver
        self._failed: EnvironmentFailed | None = None
        self._closed = False

    @property
    def environment(self) -> Environment | None:
        """The environment, once the trial has begun."""
        return self._checked.environment

    def begin(self, step: int = 0) -> None:
        """Make the environment."""
        self._call(step, lambda: self._checked.begin(step))

    def sense(self, step: int, sensing_action: int) -> None:
        """Perform a sensing action."""
        self._call(step, lambda: self._checked.sense(step, sensing_action))

    def perform(self, step: int, task_action: FloatArray) -> None:
        """Perform a task action."""
        self._call(step, lambda: self._checked.perform(step, task_action))

    def close(self, timeout_s: float = 1.0) -> None:
        """Call the environment's ``close``, if it has one."""
        del timeout_s
        if not self._closed:
            self._closed = True
            self._checked.close()

    def _call(self, step: int, function: Callable[[], EnvironmentEvent]) -> None:
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
    """Return what a call gets after a failure: it is not even begun."""
    return EnvironmentFailed(step, failed.what, failed.text, False)


class _Call:
    """A call that the worker has been given."""

    __slots__ = ("deadline", "function", "kind", "step")

    def __init__(
        self, step: int, kind: str, function: Callable[[], EnvironmentEvent], deadline: float
    ) -> None:
        self.step = step
        self.kind = kind
        self.function = function
        self.deadline = deadline


class ThreadedPerformer:
    """Performs on a thread of its own, and gives a call up that takes too long.

    The environment is made, called and closed on one and the same thread, and never called again
    after a call of it was given up. Both threads are daemons: an environment that never returns
    does not keep the process.

    Parameters
    ----------
    make : callable
        Makes the environment.
    problem : Problem
    deliver : callable
        Takes the events, from another thread; it must not block, and must not call the performer.
    name : str
        Of the environment, for messages.
    timeout_ms : float
        Longest time that a call may take. Time in which this whole process was stopped does not
        count.
    resumed : bool, optional
        Whether to ask how many task actions have been performed.
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
        self._checked = _CheckedEnvironment(
            make,
            problem,
            name,
            resumed=resumed,
        )
        self._deliver = deliver
        self._name = name
        self._timeout_ms = timeout_ms
        self._calls: SimpleQueue[_Call | None] = SimpleQueue()
        # Guards the four fields below. Events are delivered while it is held, so that none comes
        # after close, and one call never gets two.
        self._changed = threading.Condition()
        self._current: _Call | None = None
        self._failed: EnvironmentFailed | None = None
        self._closed = False
        self._watchdog_idles = False
        self._worker = threading.Thread(target=self._work, name="environment", daemon=True)
        self._watchdog = threading.Thread(
            target=self._watch, name="environment-watchdog", daemon=True
        )
        self._worker.start()
        self._watchdog.start()

    def begin(self, step: int = 0) -> None:
        """Make the environment."""
        self._call(step, "begin", lambda: self._checked.begin(step))

    def sense(self, step: int, sensing_action: int) -> None:
        """Perform a sensing action."""
        self._call(step, "sense", lambda: self._checked.sense(step, sensing_action))

    def perform(self, step: int, task_action: FloatArray) -> None:
        """Perform a task action."""
        self._call(step, "perform", lambda: self._checked.perform(step, task_action))

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
            call = _Call(step, kind, function, monotonic() + 1e-3 * self._timeout_ms)
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
                # Most calls have long ended by then and others come, which the next round sees;
                # so a call costs no switch to this thread.
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
