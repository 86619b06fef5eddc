"""Calls of the robot's environment, on a thread and with a time limit.

A task action takes as long as a robot takes to move, and a controller may never answer. The loop
must not wait for either: it has to react to a dead service meanwhile. So a thread calls the
environment, one call at a time, and each call ends as an event, with the result or the error. A
call that takes too long has failed; its later result is dropped.

A simulated world answers within microseconds. It is called at once, in the loop's own thread.
"""

from __future__ import annotations

import abc
import asyncio
import functools
from collections.abc import Callable, Sequence
from time import monotonic
from typing import Any, NamedTuple, TypeAlias

from holdfast.config.user_code import account_of_user_error
from holdfast.errors import HoldfastError, InvalidValueError
from holdfast.numerics.arrays import FloatArray
from holdfast.protocol.robot_events import EnvironmentEvent, EnvironmentFailed
from holdfast.robot.environment import CheckedEnvironment
from holdfast.robot.environment_maker import EnvironmentMaker
from holdfast.runtime.pool import ThreadPool

Deliver: TypeAlias = Callable[[EnvironmentEvent, float], None]
"""Takes an event and its time, in seconds; it must not block."""

_SUSPENDED_S = 0.1
"""If a timer fires this much too late, the process was stopped, and with it the environment."""


def make_runner(
    maker: EnvironmentMaker,
    trial: int,
    deliver: Deliver,
    *,
    resumed: bool = False,
    performed: Sequence[FloatArray] = (),
) -> EnvironmentRunner:
    """Return the runner of a trial in the configuration's environment."""
    kind = InlineRunner if maker.simulated else ThreadedRunner
    return kind(maker, trial, deliver, resumed=resumed, performed=performed)


class _Call(NamedTuple):
    """A call of the environment, and what makes its event; ``kind`` is the runner's method."""

    step: int
    kind: str
    function: Callable[[], EnvironmentEvent]


class EnvironmentRunner(abc.ABC):
    """Calls the environment of one trial, one call at a time.

    Each call leads to one event: at once, or later on the event loop that runs. After a failure
    every further call fails. After ``close`` no event comes. All methods are called on the loop's
    thread. If the trial is ``resumed``, the environment is asked how many task actions it has
    performed.
    """

    _passed_on: tuple[type[BaseException], ...] = ()
    """Exceptions that are no failures of the environment."""

    def __init__(
        self,
        maker: EnvironmentMaker,
        trial: int,
        deliver: Deliver,
        *,
        resumed: bool = False,
        performed: Sequence[FloatArray] = (),
    ) -> None:
        self._make = functools.partial(maker, trial, resumed=resumed, performed=performed)
        self._deliver = deliver
        self._name = maker.name
        self._resumed = resumed
        # Read when a call takes too long, too.
        self.world = CheckedEnvironment(maker.problem, maker.name, maker.max_missing_in_a_row)
        self._failed: EnvironmentFailed | None = None
        self._closed = False

    def begin(self, step: int = 0) -> None:
        """Make the environment: :class:`EnvironmentReady`. Comes first."""
        self._call(_Call(step, "begin", self._made))

    def sense(self, step: int, sensing_action: int) -> None:
        """Perform a sensing action: :class:`Sensed`."""
        self._call(_Call(step, "sense", lambda: self.world.sense(step, sensing_action)))

    def perform(self, step: int, task_action: FloatArray) -> None:
        """Perform a task action, and ask whether the task is done: :class:`Acted`."""
        self._call(_Call(step, "perform", lambda: self.world.perform(step, task_action)))

    @abc.abstractmethod
    def close(self, timeout_s: float = 1.0) -> None:
        """Call the environment's ``close``, if it has one, within about this time.

        An environment that is still in a call after that is abandoned. May be repeated.
        """

    @abc.abstractmethod
    def _call(self, call: _Call) -> None:
        """Call the environment, and deliver the event."""

    def _made(self) -> EnvironmentEvent:
        self.world.environment = self._make()
        return self.world.ready(resumed=self._resumed)

    def _event_of(self, call: _Call) -> EnvironmentEvent:
        """Call the environment; an exception is an event, too."""
        try:
            return call.function()
        except self._passed_on:
            raise
        except BaseException as error:  # noqa: BLE001 - a SystemExit would end a thread unheard
            called = self.world.called
            text = account_of_user_error(error, called)
            if text is None and isinstance(error, HoldfastError):
                text = str(error)
            elif text is None:
                message = f": {error}" if str(error) else ""
                text = f"{called} raised {type(error).__name__}{message}"
            return self._failure(call, text)

    def _failure(self, call: _Call, text: str) -> EnvironmentFailed:
        method, performed = self.world.method, self.world.performed
        if call.kind != "perform":
            return EnvironmentFailed(call.step, method, text, False)
        if performed is None:
            counts = callable(getattr(self.world.environment, "steps_performed", None))
            return EnvironmentFailed(call.step, method, text, True, counts_steps=counts)
        # Only what came after it has failed: the result of ``perform`` is known.
        return EnvironmentFailed(call.step, method, text, False, performed)

    def _refused(self, call: _Call) -> bool:
        """Return whether no call is made any more; deliver the earlier failure, if there is one."""
        if self._closed:
            return True
        if self._failed is not None:
            again = EnvironmentFailed(call.step, self._failed.what, self._failed.text, False)
            self._deliver(again, monotonic())
        return self._failed is not None

    def _finish(self, event: EnvironmentEvent, at: float) -> None:
        if isinstance(event, EnvironmentFailed):
            self._failed = event
        self._deliver(event, at)

    def _close_environment(self) -> None:
        close = getattr(self.world.environment, "close", None)
        if callable(close):
            # The trial is over: an error here changes nothing of it.
            try:
                close()
            except self._passed_on:
                raise
            except BaseException:  # noqa: BLE001
                return


class InlineRunner(EnvironmentRunner):
    """Calls a simulated world at once, in the caller's thread; KeyboardInterrupt passes through."""

    _passed_on = (KeyboardInterrupt,)

    def close(self, timeout_s: float = 1.0) -> None:
        """Call the environment's ``close``, if it has one."""
        del timeout_s
        if not self._closed:
            self._closed = True
            self._close_environment()

    def _call(self, call: _Call) -> None:
        if not self._refused(call):
            self._finish(self._event_of(call), monotonic())


class ThreadedRunner(EnvironmentRunner):
    """Calls an environment on its own thread, and gives up a call that takes too long.

    The environment is made, called and closed on one thread, and never called again after a call
    was given up. The thread is a daemon: an environment that never returns does not keep the
    process alive. Time in which this whole process was stopped is no time of a call.
    """

    def __init__(
        self, maker: EnvironmentMaker, trial: int, deliver: Deliver, **resumption: Any
    ) -> None:
        super().__init__(maker, trial, deliver, **resumption)
        self._timeout_ms = maker.timeout_ms
        self._thread = ThreadPool(1, "environment")
        self._current: _Call | None = None
        self._timer: asyncio.TimerHandle | None = None

    def close(self, timeout_s: float = 1.0) -> None:
        """Call the environment's ``close``, within about this time, unless it is in a call."""
        last = None if self._closed else self._close_environment
        self._closed = True
        if self._timer is not None:
            self._timer.cancel()
        self._thread.close(timeout_s, last)

    def _call(self, call: _Call) -> None:
        if self._refused(call):
            return
        if self._current is not None:
            raise InvalidValueError(
                f"{self._name}: {call.kind} of step {call.step} while {self._current.kind} of "
                f"step {self._current.step} has not ended; one call at a time is allowed"
            )
        self._current = call
        self._thread.submit(
            lambda: (self._event_of(call), monotonic()), functools.partial(self._returned, call)
        )
        self._watch(call, 1e-3 * self._timeout_ms)

    def _returned(self, call: _Call, came: tuple[EnvironmentEvent, float]) -> None:
        if self._current is call and self._timer is not None:  # else it was given up
            self._current = None
            self._timer.cancel()
            self._finish(*came)

    def _watch(self, call: _Call, within_s: float) -> None:
        self._timer = asyncio.get_running_loop().call_later(
            within_s, self._overdue, call, monotonic() + within_s
        )

    def _overdue(self, call: _Call, due_at: float) -> None:
        now = monotonic()
        if now - due_at > _SUSPENDED_S:
            self._watch(call, min(now - due_at, 1e-3 * self._timeout_ms))
            return
        self._current = None
        called = self.world.called
        if self.world.method == self._name:
            called = f"the constructor of {called}"
        limit = f"{self._timeout_ms:g} ms, which is environment.timeout_ms"
        self._finish(self._failure(call, f"{called} has not returned within {limit}"), now)
