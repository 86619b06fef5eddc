"""Brief jobs of several robots, computed at once.

Where many robots wait, most of them ask the same of the same problem: fold one observation in and
plan up to the next sensing step, or choose the sensing action there. Such jobs, with equal
settings, are computed together (:mod:`holdfast.planning.together`). Results are those of
:meth:`Job.run`, bit for bit. All else is left to it: what is unlike, what costs too much, and a
batch in which anything goes wrong, since alone it goes wrong for one robot only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from holdfast.planning.inputs import Moved, Sensed, encode_floats
from holdfast.planning.interruption import Interruption, interruptible
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.together import (
    can_decide_together,
    choose_together,
    observe_together,
    plan_together,
)
from holdfast.protocol.messages import DIGEST_SIZE, MAX_TASK_ACTIONS
from holdfast.protocol.service_jobs import Job, JobResult


class _Begun(NamedTuple):
    """A job, the state from which it starts, and the observation that leads on, if any does."""

    job: Job
    state: PlanningState
    given: Sensed | None


def run_together(jobs: Sequence[Job]) -> dict[Job, JobResult]:
    """Run jobs that are alike (:meth:`Job.is_like`); what has no result is to be run by itself."""
    try:
        return _run_alike(jobs) if len(jobs) > 1 else {}
    except BaseException:  # noqa: BLE001 - whose it is shows when each is run by itself
        return {}


def _run_alike(jobs: Sequence[Job]) -> dict[Job, JobResult]:
    problem = jobs[0].problem
    if problem is None:
        return {}
    planner = Planner(problem, jobs[0].planning)
    if not can_decide_together(planner):
        return {}
    limit = Interruption(jobs[0].interruption.most_s)
    with interruptible(limit):
        limit.start_clock()
        begun = [each for job in jobs if (each := _begin(planner, job)) is not None]
        if len(begun) < 2:
            return {}
        return (_decided if begun[0].given is None else _reached)(planner, begun)


def _begin(planner: Planner, job: Job) -> _Begun | None:
    """Return what a job starts from; None if it is not as usual."""
    state, request, price = job.state, job.request, job.price
    if state is None or price is None or job.too_dear(planner.problem, price) is not None:
        return None
    if request is None:
        return _Begun(job, state, None)
    before = state.step, state.sensed
    new = [each for each in request.inputs if (each.step, isinstance(each, Moved)) >= before]
    if job.kind != "task" or request.checkpoint is not None or len(new) != 1:
        return None
    given = new[0]
    asked = given.step, request.step, request.sensed
    if not isinstance(given, Sensed) or not given.observation or not planner.needs_sensing(state):
        return None
    return _Begun(job, state, given) if asked == (state.step, state.step, True) else None


def _decided(planner: Planner, begun: Sequence[_Begun]) -> dict[Job, JobResult]:
    """Return the results of jobs that choose a sensing action."""
    chosen = choose_together(planner, [each.state for each in begun])
    return {
        job: JobResult(problem=job.problem, sensing_action=index, price=job.price)
        for (job, _, _), index in zip(begun, chosen, strict=True)
    }


def _reached(planner: Planner, begun: Sequence[_Begun]) -> dict[Job, JobResult]:
    """Return the results of jobs that fold an observation in and plan."""
    given = [each.given for each in begun if each.given is not None]
    observations = [each.numbers() for each in given]
    states = observe_together(
        planner,
        [each.state for each in begun],
        [each.sensing_action for each in given],
        [each for each in observations if each is not None],
    )
    rows = [
        (job, state)
        for (job, _, _), state in zip(begun, states, strict=True)
        if job.request is not None and planner.digest(state)[:DIGEST_SIZE] == job.request.digest
    ]
    planned = plan_together(planner, [state for _, state in rows], MAX_TASK_ACTIONS)
    return {
        job: JobResult(
            problem=job.problem,
            state=state,
            num_actions=len(actions),
            actions=encode_floats(actions),
            ahead=ahead,
            ahead_digest=planner.digest(ahead)[:DIGEST_SIZE],
            price=job.price,
        )
        for (job, state), (actions, ahead) in zip(rows, planned, strict=True)
    }
