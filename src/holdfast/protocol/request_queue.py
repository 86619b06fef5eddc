"""Which task of one lane a worker gets next, and how long a new request would wait.

Tasks wait in two orders: those that a robot waits for (urgent), and prefetches, which are ahead of
their robots. Urgent ones go first, but not forever: a prefetch that has waited long enough has its
turn.

Within an order the owners take turns, and each owner's tasks go in arrival order. So all sessions
of one certificate together get one robot's turn; all robots without a certificate are one owner. A
task that comes while another of its session and slot runs is held back until that has run.

The wait follows from the expected times of the tasks ahead. A service that would be too slow says
so at once, so that the robot can ask another.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator

from holdfast.protocol.messages import Request
from holdfast.protocol.service_jobs import Job
from holdfast.protocol.service_limits import ServiceLimits
from holdfast.protocol.service_sessions import PREFETCHED, REQUESTED, Owner, PendingTask, Session

_TOGETHER_S = 0.004
"""Expected time of the short tasks that a worker has at a time: nothing else runs meanwhile."""

_MOST_TOGETHER = 32
"""Bound on their number."""


class _RoundRobin:
    """Tasks that wait, their owners by turns."""

    def __init__(self) -> None:
        # Those whose turn comes next first.
        self._of: OrderedDict[Owner, OrderedDict[PendingTask, None]] = OrderedDict()
        self._last_turn: dict[Owner, float] = {}

    def __contains__(self, task: PendingTask) -> bool:
        return task in self._of.get(task.session.owner, ())

    def __iter__(self) -> Iterator[PendingTask]:
        return (task for tasks in self._of.values() for task in tasks)

    def append(self, task: PendingTask) -> None:
        """Queue a task behind those of its owner; a new owner comes last."""
        self._of.setdefault(task.session.owner, OrderedDict())[task] = None

    def remove(self, task: PendingTask) -> None:
        """Remove a task, if it is there."""
        owner = task.session.owner
        tasks = self._of.get(owner)
        if tasks is not None and tasks.pop(task, task) is None and not tasks:
            del self._of[owner]
            self._last_turn.pop(owner, None)

    def end_turn(self, owner: Owner, now: float) -> None:
        """Move an owner to the end."""
        if owner in self._of:
            self._of.move_to_end(owner)
            self._last_turn[owner] = now

    def first(self) -> PendingTask | None:
        """Return the next task; None if none waits."""
        tasks = next(iter(self._of.values()), None)
        return None if tasks is None else next(iter(tasks))

    def waits_since(self, task: PendingTask) -> float:
        """Return when a task arrived, or its owner's previous turn if that was later."""
        return max(task.since, self._last_turn.get(task.session.owner, task.since))


class _Load:
    """Number, bytes and expected time of tasks."""

    def __init__(self) -> None:
        self.num = 0
        self.num_bytes = 0
        self.cost_s = 0.0

    def count(self, task: PendingTask, sign: int) -> None:
        """Add a task, or subtract it."""
        self.num += sign
        self.num_bytes += sign * task.size
        # Sums of floating-point numbers drift; what is empty is exactly empty.
        self.cost_s = self.cost_s + sign * task.cost_s if self.num else 0.0


class RequestQueue:
    """The tasks of one lane that wait, or run on so many workers.

    ``room`` is its share of the limits on what may wait.
    """

    def __init__(self, workers: int, limits: ServiceLimits, room: float = 1.0) -> None:
        self._workers = workers
        self._limits = limits
        self._max_waiting = room * limits.max_waiting
        self._max_waiting_bytes = room * limits.max_waiting_bytes
        self._urgent, self._later = _RoundRobin(), _RoundRobin()
        self._patience_s = 1e-3 * limits.prefetch_patience_ms
        self.running: dict[Job, PendingTask] = {}  # tasks that workers have
        self._started_at: dict[Job, float] = {}  # since when
        # A task that comes while one of its session and slot runs is held back, so that a robot has
        # no more than its turn. Only prefetches that waited together may run together.
        self._running_of: dict[tuple[Session, int], PendingTask] = {}
        self._held: dict[tuple[Session, int], PendingTask] = {}
        self.waiting = _Load()  # tasks not yet begun
        # Only of owners with waiting tasks.
        self._waiting_of: dict[Owner, _Load] = {}

    # -- waiting ---------------------------------------------------------------------------------

    def enqueue(self, task: PendingTask) -> None:
        """Queue a task."""
        self._count(task, 1)
        slot = task.session, task.slot
        if slot in self._running_of:
            self._held[slot] = task
        else:
            self._order_of(task).append(task)

    def replace(self, task: PendingTask, request: Request, *, sensing: bool, size: int) -> None:
        """Give a waiting task's turn to a newer request."""
        self._count(task, -1)
        task.become(request, sensing=sensing, size=size)
        self._count(task, 1)

    def remove(self, task: PendingTask) -> None:
        """Remove a task that was not begun."""
        slot = task.session, task.slot
        if self._held.get(slot) is task:
            del self._held[slot]
        else:
            self._order_of(task).remove(task)
        self._count(task, -1)

    def promote(self, task: PendingTask) -> None:
        """Make a prefetch urgent: its robot waits for it now."""
        task.urgent = True  # also if it is held back yet
        if task in self._later:
            self._later.remove(task)
            self._urgent.append(task)

    def _order_of(self, task: PendingTask) -> _RoundRobin:
        return self._urgent if task.urgent else self._later

    def _count(self, task: PendingTask, sign: int) -> None:
        owner = task.session.owner
        load = self._waiting_of.setdefault(owner, _Load())
        for each in (self.waiting, load):
            each.count(task, sign)
        if not load.num:
            del self._waiting_of[owner]

    # -- running ---------------------------------------------------------------------------------

    def take(self, now: float, room_bytes: float = math.inf) -> PendingTask | None:
        """Remove and return the next task; None if none waits or no worker is free.

        None, too, if it takes more than ``room_bytes`` of memory; it keeps its turn.
        """
        task = self._next() if self.waiting.num else None
        if task is None or task.num_bytes > room_bytes or not self._is_free_for(task):
            return None
        order = self._order_of(task)
        order.remove(task)
        order.end_turn(task.session.owner, now)
        self._count(task, -1)
        return task

    def _is_free_for(self, task: PendingTask) -> bool:
        """Return whether a worker is free, or takes a short task together with other short ones."""
        if len(self.running) < self._workers:
            return True
        if len(self.running) >= _MOST_TOGETHER:
            return False
        running_s = sum(job.expected_s for job in self.running)
        return running_s + task.predicted_s(task.starts_at()) <= _TOGETHER_S

    def _next(self) -> PendingTask | None:
        urgent, later = self._urgent.first(), self._later.first()
        if urgent is None or later is None:
            return urgent or later
        due = self._waits_since(later) + self._patience_s
        return urgent if self._waits_since(urgent) <= due else later

    def _waits_since(self, task: PendingTask) -> float:
        """Return since when a task waits for its turn.

        An owner's many tasks wait for each other; that must not put them before another owner's new
        one.
        """
        if len(self._waiting_of) == 1:
            return task.since
        return self._order_of(task).waits_since(task)

    def handed_out(self, task: PendingTask, job: Job, now: float) -> None:
        """Note that a worker has a task."""
        task.running = True
        self._running_of[task.session, task.slot] = task
        self.running[job] = task
        self._started_at[job] = now

    def started(self, job: Job, now: float) -> None:
        """Note that a worker starts its task only now."""
        self._started_at[job] = now

    def end(self, job: Job) -> tuple[PendingTask, float]:
        """Note that a worker is free; return its task, and when it was started."""
        task = self.running.pop(job)
        task.running = False
        # Two prefetches that waited together run together; the first end frees the slot.
        self._running_of.pop((task.session, task.slot), None)
        return task, self._started_at.pop(job)

    def release_held(self, session: Session) -> None:
        """Queue a session's tasks that were held back behind those that have run."""
        for slot in ((session, REQUESTED), (session, PREFETCHED)) if self._held else ():
            if slot in self._held and slot not in self._running_of:
                held = self._held.pop(slot)
                self._order_of(held).append(held)

    # -- the wait --------------------------------------------------------------------------------

    def is_overloaded(self, now: float, owner: Owner) -> bool:
        """Return whether a new request is to be turned away."""
        if self.waiting.num < self._workers:
            return False
        ahead, ahead_s = self._ahead(now, owner)
        if ahead < self._workers:
            return False
        return (
            self.waiting.num >= self._max_waiting
            or self.waiting.num_bytes >= self._max_waiting_bytes
            or self._has_its_share(owner)
            or 1e3 * ahead_s > self._limits.max_wait_ms * self._workers
        )

    def wait_s(self, now: float, owner: Owner) -> float:
        """Estimate the wait of a new request."""
        return self._ahead(now, owner)[1] / self._workers

    def _has_its_share(self, owner: Owner) -> bool:
        """Return whether an owner has as many waiting tasks as one may have."""
        own = self._waiting_of.get(owner)
        if owner is None or own is None:
            return False
        return (
            own.num >= self._limits.max_waiting_per_robot
            or 2 * own.num_bytes >= self._max_waiting_bytes
        )

    def _ahead(self, now: float, owner: Owner) -> tuple[int, float]:
        """Return number and time of the tasks that go before an owner's next one.

        These are those that run, the owner's own, and of each other owner as many, and one more.
        """
        running_s = sum(
            max(0.0, task.cost_s - (now - self._started_at[job]))
            for job, task in self.running.items()
        )
        whole, own = self.waiting, self._waiting_of.get(owner)
        if own is not None and len(self._waiting_of) == 1:
            return whole.num, running_s + whole.cost_s
        turns = 1 + (0 if own is None else own.num)
        num, cost_s = 0, 0.0
        for load in self._waiting_of.values():
            going = min(load.num, turns)
            num += going
            cost_s += load.cost_s * going / load.num
        return num, running_s + cost_s
