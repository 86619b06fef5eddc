"""Which task a worker gets next, and how long a new request would wait.

Tasks wait in three orders: those that a known robot waits for (urgent), those of newcomers, which
were never served, and prefetches, which are ahead of their robots. Urgent ones go first, but not
forever: a prefetch that has waited long enough has its turn. A new identity costs nothing, so one
client can be thousands of newcomers; together they get at most every second turn while an urgent
task of others waits.

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
from holdfast.protocol.service_sessions import (
    PREFETCHED,
    REQUESTED,
    Owner,
    PendingTask,
    Session,
)

__all__ = ["RequestQueue"]


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


class _Loads:
    """The load of known robots and of newcomers."""

    def __init__(self) -> None:
        self.known = _Load()
        self.newcomers = _Load()

    @property
    def num(self) -> int:
        return self.known.num + self.newcomers.num

    @property
    def num_bytes(self) -> int:
        return self.known.num_bytes + self.newcomers.num_bytes

    def of(self, *, newcomer: bool) -> _Load:
        return self.newcomers if newcomer else self.known


class RequestQueue:
    """The tasks that wait or run.

    Parameters
    ----------
    workers : int
        Tasks that may run at a time.
    """

    def __init__(self, workers: int, limits: ServiceLimits) -> None:
        self._workers = workers
        self._limits = limits
        self._urgent, self._newcomers, self._later = _RoundRobin(), _RoundRobin(), _RoundRobin()
        self._patience_s = 1e-3 * limits.prefetch_patience_ms
        self._patience_of_newcomers_s = 1e-3 * limits.max_wait_ms
        # Whether a newcomer had the last turn for which others waited too.
        self._newcomer_went_first = False
        self._running: dict[Job, PendingTask] = {}
        # A task that comes while one of its session and slot runs is held back, so that a robot has
        # no more than its turn. Only prefetches that waited together may run together.
        self._running_of: dict[tuple[Session, int], PendingTask] = {}
        self._held: dict[tuple[Session, int], PendingTask] = {}
        self._waiting = _Loads()
        # Only of owners with waiting tasks.
        self._waiting_of: dict[Owner, _Loads] = {}

    @property
    def num_waiting(self) -> int:
        """Tasks not yet begun."""
        return self._waiting.num

    @property
    def num_running(self) -> int:
        """Tasks that workers have."""
        return len(self._running)

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
            self._remove_from_order(task)
        self._count(task, -1)

    def promote(self, task: PendingTask) -> None:
        """Make a prefetch urgent: its robot waits for it now."""
        task.urgent = True  # also if it is held back yet
        if task in self._later:
            self._later.remove(task)
            self._urgent.append(task)

    def _order_of(self, task: PendingTask) -> _RoundRobin:
        if not task.urgent:
            return self._later
        return self._newcomers if task.newcomer else self._urgent

    def _remove_from_order(self, task: PendingTask) -> None:
        for order in (self._urgent, self._newcomers, self._later):
            order.remove(task)

    def _count(self, task: PendingTask, sign: int) -> None:
        owner = task.session.owner
        loads = self._waiting_of.setdefault(owner, _Loads())
        for each in (self._waiting, loads):
            each.of(newcomer=task.newcomer).count(task, sign)
        if not loads.num:
            del self._waiting_of[owner]

    # -- running ---------------------------------------------------------------------------------

    def take(self, now: float, room_bytes: float = math.inf) -> PendingTask | None:
        """Remove and return the next task; None if none waits or no worker is free.

        None, too, if it takes more than ``room_bytes`` of memory; it keeps its turn.
        """
        if len(self._running) >= self._workers:
            return None
        known, newcomer = self._next_of_known(), self._newcomers.first()
        task = known or newcomer
        if known is not None and newcomer is not None and self._goes_first(newcomer, known, now):
            task = newcomer
        if task is None or task.num_bytes > room_bytes:
            return None
        if known is not None and newcomer is not None:
            self._newcomer_went_first = task is newcomer
        order = self._order_of(task)
        order.remove(task)
        order.end_turn(task.session.owner, now)
        self._count(task, -1)
        return task

    def _next_of_known(self) -> PendingTask | None:
        """Return the next task of robots that were served before; None if none waits."""
        urgent, later = self._urgent.first(), self._later.first()
        if urgent is None or later is None:
            return urgent or later
        due = self._waits_since(later) + self._patience_s
        return urgent if self._waits_since(urgent) <= due else later

    def _goes_first(self, newcomer: PendingTask, known: PendingTask, now: float) -> bool:
        """Return whether a newcomer goes before a robot that was served before."""
        came, known_since = self._waits_since(newcomer), self._waits_since(known)
        if known.urgent:
            return not self._newcomer_went_first and (
                known_since > came + self._patience_of_newcomers_s
            )
        if now <= known_since + self._patience_s:
            return True
        return not self._newcomer_went_first and came <= known_since + self._patience_s

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
        task.started_at = now
        self._running_of[task.session, task.slot] = task
        self._running[job] = task

    @property
    def running_bytes(self) -> float:
        """Estimated memory of all running tasks."""
        return sum(task.num_bytes for task in self._running.values())

    def running(self) -> list[tuple[Job, PendingTask]]:
        """Return the jobs that workers have, and their tasks."""
        return list(self._running.items())

    def runs(self, job: Job) -> bool:
        """Return whether a worker has a job of this queue."""
        return job in self._running

    def job_of(self, task: PendingTask) -> Job:
        """Return the job of a running task."""
        return next(job for job, other in self._running.items() if other is task)

    def started(self, job: Job, now: float) -> None:
        """Note that a worker starts its task only now."""
        self._running[job].started_at = now

    def end(self, job: Job) -> PendingTask:
        """Note that a worker is free; return its task."""
        task = self._running.pop(job)
        task.running = False
        # Two prefetches that waited together run together; the first end frees the slot.
        self._running_of.pop((task.session, task.slot), None)
        return task

    def release_held(self, session: Session) -> None:
        """Queue a session's tasks that were held back behind those that have run."""
        for slot in ((session, REQUESTED), (session, PREFETCHED)):
            if slot in self._held and slot not in self._running_of:
                held = self._held.pop(slot)
                self._order_of(held).append(held)

    # -- the wait --------------------------------------------------------------------------------

    def is_overloaded(self, now: float, owner: Owner, *, newcomer: bool) -> bool:
        """Return whether a new request is to be turned away."""
        limits, waiting = self._limits, self._waiting
        ahead, ahead_s = self._ahead(now, owner, newcomer=newcomer)
        if ahead < self._workers:
            return False
        newcomers = waiting.newcomers
        return (
            waiting.num >= limits.max_waiting
            or waiting.num_bytes >= limits.max_waiting_bytes
            # Half of the room is kept for those that were served before.
            or (newcomer and 2 * newcomers.num >= limits.max_waiting)
            or (newcomer and 2 * newcomers.num_bytes >= limits.max_waiting_bytes)
            or self._has_its_share(owner)
            # Nobody who was served before is turned away because of newcomers.
            or 1e3 * ahead_s > limits.max_wait_ms * self._workers
        )

    def wait_s(self, now: float, owner: Owner, *, newcomer: bool) -> float:
        """Estimate the wait of a new request."""
        _, ahead_s = self._ahead(now, owner, newcomer=newcomer)
        if not newcomer:
            # Of the newcomers as many at most are ahead as of the others: the two take turns.
            ahead_s += min(ahead_s, self._goes_before(owner, newcomer=True)[1])
        return ahead_s / self._workers

    def _has_its_share(self, owner: Owner) -> bool:
        """Return whether an owner has as many waiting tasks as one may have."""
        own = self._waiting_of.get(owner)
        if owner is None or own is None:
            return False
        limits = self._limits
        return (
            own.num >= limits.max_waiting_per_robot or 2 * own.num_bytes >= limits.max_waiting_bytes
        )

    def _ahead(self, now: float, owner: Owner, *, newcomer: bool) -> tuple[int, float]:
        """Return number and time of the tasks ahead; newcomers count only for newcomers."""
        ahead, ahead_s = self._goes_before(owner, newcomer=False)
        if newcomer:
            others, others_s = self._goes_before(owner, newcomer=True)
            ahead, ahead_s = ahead + others, ahead_s + others_s
        for task in self._running.values():
            ahead_s += max(0.0, task.cost_s - (now - task.started_at))
        return ahead, ahead_s

    def _goes_before(self, owner: Owner, *, newcomer: bool) -> tuple[int, float]:
        """Return number and time of the tasks in an order that go before an owner's next one.

        These are the owner's own, and of each other owner as many, and one more.
        """
        whole = self._waiting.of(newcomer=newcomer)
        own = self._waiting_of.get(owner)
        if not whole.num or (own is not None and len(self._waiting_of) == 1):
            return whole.num, whole.cost_s
        turns = 1 + (0 if own is None else own.of(newcomer=newcomer).num)
        num, cost_s = 0, 0.0
        for loads in self._waiting_of.values():
            load = loads.of(newcomer=newcomer)
            if load.num:
                going = min(load.num, turns)
                num += going
                cost_s += load.cost_s * going / load.num
        return num, cost_s
