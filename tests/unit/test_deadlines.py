"""Deadlines, on a clock that the test moves."""

import threading

from holdfast_ros.deadlines import Deadline


class ManualClock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


class SlowCondition(threading.Condition):
    """A condition whose wait moves the clock by ``late_s`` more than was asked for."""

    def __init__(self, clock: ManualClock, late_s: float) -> None:
        super().__init__()
        self._clock = clock
        self._late_s = late_s
        self.waits: list[float | None] = []

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.waits.append(timeout)
        self._clock.now += timeout + self._late_s
        return False


def test_waits_end_with_the_deadline() -> None:
    clock = ManualClock()
    deadline = Deadline(1.0, "environment.timeout_ms", clock)
    condition = SlowCondition(clock, 0.0)
    deadline.wait(condition, 0.75)
    assert (deadline.is_over(), deadline.waited_s) == (False, 0.75)
    deadline.wait(condition, 0.75)
    assert deadline.is_over()
    deadline.wait(condition, 0.75)
    assert condition.waits == [0.75, 0.25, 0.0]


def test_time_in_which_the_process_was_stopped_does_not_count() -> None:
    clock = ManualClock()
    deadline = Deadline(1.0, "", clock)
    assert deadline.wait(SlowCondition(clock, 60.0), 0.5) == 0.5
    assert not deadline.is_over()
    deadline.wait(SlowCondition(clock, 0.0), 0.5)
    assert deadline.is_over()
