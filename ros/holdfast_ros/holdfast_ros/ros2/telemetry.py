"""A robot's decisions and beliefs for observers, without delaying a decision.

The robot's loop only notes each order. A thread of low priority makes messages of the notes. If it
falls behind, it drops beliefs first (they hold memory), their entropies with them, and then the
oldest decisions. A service's answer lacks the entropies behind a sensing action. As every decision
is a function of the state, they are recomputed here, with a separate instance of the problem.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic

import numpy as np

from holdfast.config.loader import Configuration
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.planner import Planner, PlanningState
from holdfast.protocol.question import OWN_PLANNER
from holdfast.protocol.robot_events import Act, Sense, Timing
from holdfast.protocol.status import Status
from holdfast.robot.links import RECOVERY_SERVICE

_MAX_STATE_BYTES, _MIN_STATES = 32 << 20, 4
"""Notes keep their states up to this memory, the last four in any case."""

_LATE_S = 1.0  # a belief that is older than this is shown no more
_MAX_NOTES = 1000
_NICENESS = 10
_NOTHING: FloatArray = np.empty(0)

_ENTROPIES = ("action_entropy", "path_entropy", "state_entropy", "action_covariance")
"""Methods that compute something for each sensing action; the others only choose. (What
``expected_return`` computes are returns, which the message has no field for.)"""


@dataclass(slots=True)
class PublishedDecision:
    """An order to the environment, for people."""

    trial: int
    step: int
    stage: int
    sensing_action: int | None  # None for a task action
    entropies: FloatArray  # of shape (J,); empty if they were not computed
    task_action: FloatArray  # of shape (action_size,); empty for a sensing action
    status: str
    decided_by: str
    state: PlanningState | None  # in which it was decided; None if there was no time for it
    noted_at: float  # on the monotonic clock, in seconds


class Telemetry:
    """Publishes orders and beliefs, on its own thread.

    ``on_order`` and ``on_belief`` show them, ``on_notice`` shows what else has changed.
    ``on_failure`` gets the first error of any of these: to look on must not end a run.
    """

    def __init__(
        self,
        configuration: Configuration,
        on_order: Callable[[PublishedDecision], None],
        on_belief: Callable[[PlanningState], None],
        on_notice: Callable[[], None],
        on_failure: Callable[[Exception], None],
        *,
        belief_rate_hz: float,
        wants_entropies: Callable[[], bool],
    ) -> None:
        problem = Configuration.from_plain(configuration.plain()).problem
        self._planner = Planner(problem, configuration.planning)
        self._has_entropies = configuration.planning.selector.method in _ENTROPIES
        self._on_order = on_order
        self._on_belief = on_belief
        self._on_notice = on_notice
        self._on_failure = on_failure
        self._belief_every_s = 1.0 / belief_rate_hz if belief_rate_hz > 0.0 else np.inf
        self._wants_entropies = wants_entropies
        self._changed = threading.Condition()
        self._notes: deque[PublishedDecision] = deque()
        self._notice = False
        self._closed = False
        self._decided_by = {"sensing": "", "task": ""}
        self._decided_last: Timing | None = None
        self._next_belief = 0.0
        self.dropped_decisions = 0
        self.has_failed = False
        self._thread = threading.Thread(target=self._work, name="telemetry", daemon=True)
        self._thread.start()

    def decided_in(self, status: str) -> str:
        """Return who decides in this status; empty before its first decision."""
        timing = self._decided_last
        if timing is None or timing.status != status:
            return ""
        # The robot may still use an answer of the service that has died: it decides no more.
        is_left = status == Status.LOCAL_RECOVERY.value and timing.service != RECOVERY_SERVICE
        return "" if is_left else timing.service

    def time(self, timing: Timing) -> None:
        """Take note of who decided."""
        self._decided_by[timing.kind] = timing.service
        if timing.kind == "sensing" or timing.service != OWN_PLANNER:  # not its own task actions
            self._decided_last = timing

    def order(self, state: PlanningState, order: Act | Sense, status: str) -> None:
        """Take note of an order; returns at once."""
        sensing_action, task_action, kind = None, _NOTHING, "sensing"
        if isinstance(order, Sense):
            sensing_action = order.sensing_action
        else:
            task_action, kind = order.action, "task"
        place = state.trial, state.step, state.stage
        who = self._decided_by[kind]
        note = PublishedDecision(
            *place, sensing_action, _NOTHING, task_action, status, who, state, monotonic()
        )
        keep = max(_MIN_STATES, _MAX_STATE_BYTES // max(1, state.belief.states.nbytes))
        with self._changed:
            self._notes.append(note)
            if len(self._notes) > keep:
                self._notes[-keep - 1].state = None
            if len(self._notes) > _MAX_NOTES:
                self._notes.popleft()
                self.dropped_decisions += 1
            self._changed.notify()

    def notice(self) -> None:
        """Take note that something else has changed; returns at once."""
        with self._changed:
            self._notice = True
            self._changed.notify()

    def close(self, timeout_s: float = 1.0) -> None:
        """Show what there is, within about this time, and then nothing more; may be repeated."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout_s)
        with self._changed:
            self._notes.clear()

    def _work(self) -> None:
        with contextlib.suppress(OSError):  # a thread's own, on Linux
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        while True:
            with self._changed:
                while not (self._notes or self._notice or self._closed):
                    self._changed.wait()
                notice, self._notice = self._notice, False
                note = self._notes.popleft() if self._notes else None
                if note is None and not notice:
                    return
            try:
                if notice:
                    self._on_notice()
                if note is not None:
                    if monotonic() > note.noted_at + _LATE_S:
                        note.state = None
                    self._show(note)
            except Exception as error:  # noqa: BLE001 - the problem is anybody's code
                if not self.has_failed:
                    self.has_failed = True
                    self._on_failure(error)

    def _show(self, shown: PublishedDecision) -> None:
        state = shown.state
        if state is not None and monotonic() >= self._next_belief:
            self._next_belief = monotonic() + self._belief_every_s
            self._on_belief(state)
        is_chosen = self._has_entropies and shown.sensing_action is not None
        if state is not None and is_chosen and self._wants_entropies():
            _, info = self._planner.choose_sensing_action(state)
            if info.entropies is not None:
                shown.entropies = info.entropies
        self._on_order(shown)
