"""Pure functions are computed once.

A decision, and a state that follows from another, are the same in every run of a trial, so what was
computed in one run is taken over into the next. That they *are* pure is not taken on trust: of what
is taken over, a share is computed again, and must come to the same.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, ClassVar, Generic, TypeVar

from holdfast.planning.planner import PlanningState, digest
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.problem import Problem
from holdfast.protocol.service_batches import run_together
from holdfast.protocol.service_jobs import Job, JobResult
from holdfast.robot.memo_cache import MemoCache, MemoizingPlanner, key_of
from holdfast_lab.errors import Violation

_MOST = 20_000
_COMPUTED_AGAIN = 61
"""One of so many that are known is computed all the same."""

Key = TypeVar("Key")
Value = TypeVar("Value")


class Memo(Generic[Key, Value]):
    """Results by key. Once there are ``most`` of them, all are forgotten.

    ``check`` gets a result that is taken over and, now and then, the same computed again.
    """

    def __init__(
        self, most: int = _MOST, check: Callable[[Value, Value], None] | None = None
    ) -> None:
        self._most = most
        self._check = check
        self._known: dict[Key, Value] = {}
        self._taken_over = 0

    def get(self, key: Key, compute: Callable[[], Value]) -> Value:
        """Return the result of a key, computed if it is not known."""
        known = self._known.get(key)
        if known is None:
            if len(self._known) >= self._most:
                self._known.clear()
            result = self._known[key] = compute()
            return result
        if self._check is not None:
            self._taken_over += 1
            if self._taken_over % _COMPUTED_AGAIN == 0:
                self._check(known, compute())
        return known


class JobCache:
    """Outcomes of the services' jobs, by what the jobs were made with."""

    def __init__(self) -> None:
        self._outcomes: Memo[tuple[object, ...], tuple[str, JobResult]]
        self._outcomes = Memo(check=_check_outcomes)
        self._digests: Memo[int, tuple[PlanningState, bytes]] = Memo()
        self._runs = 0

    def outcome(self, job: Job) -> JobResult:
        """Return the outcome of a job; another one than the last time is a Violation."""
        if job.interruption.is_set:
            return job.run()  # its outcome follows from that, and not from what it was made with
        state = job.state
        known = None
        if state is not None:
            known = self._digests.get(id(state), lambda: (state, digest(state)))[1]
        return self._outcomes.get((job.identity, known), lambda: (job.kind, self._run(job)))[1]

    def _run(self, job: Job) -> JobResult:
        """Compute a job alone and, in turns, together with others, as far as it can be."""
        self._runs += 1
        together = run_together([job, job]) if self._runs % 2 else {}
        return together.get(job) or job.run()


def _check_outcomes(known: tuple[str, JobResult], now: tuple[str, JobResult]) -> None:
    if _comparable(now[1]) != _comparable(known[1]):
        raise Violation(f"a {now[0]} job came to another outcome than before")


def _comparable(outcome: JobResult) -> tuple[object, ...]:
    states = (outcome.state, outcome.ahead)
    return (
        *(None if state is None else digest(state) for state in states),
        *outcome._replace(problem=None, state=None, ahead=None),
    )


class CheckedPlanner(MemoizingPlanner):
    """The robot's planner, which knows the states and decisions that it has come to before."""

    shared: ClassVar[tuple[str, ...]] = (*MemoizingPlanner.shared, "decide")

    def __init__(self, problem: Problem, settings: PlanningSettings) -> None:
        super().__init__(problem, settings, _CheckedCache())


class _CheckedCache(MemoCache):
    """A cache that keeps more than the robot's, and checks a share of what it returns."""

    def __init__(self) -> None:
        super().__init__()
        # By the identity of a state, which is kept with the result and so stays the state's own.
        self._kept: Memo[Hashable, tuple[tuple[Any, ...], Any]]
        self._kept = Memo(5 * _MOST, _check_states)

    def once(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return what a function returns, computed if it is not known."""
        key = key_of(function, arguments)
        return self._kept.get(key, lambda: (arguments, function(*arguments)))[1]


def _check_states(known: tuple[tuple[Any, ...], Any], now: tuple[tuple[Any, ...], Any]) -> None:
    before, after = _state_of(known[1]), _state_of(now[1])
    if before is not None and after is not None and digest(before) != digest(after):
        raise Violation(f"the same events lead to another state of step {after.step} than before")


def _state_of(result: Any) -> PlanningState | None:
    """Return the state that a result is, or begins with."""
    first = result[0] if type(result) is tuple else result
    return first if isinstance(first, PlanningState) else None
