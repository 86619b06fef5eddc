"""Many trials, on one core or on several.

A trial depends on nothing but the configuration and its number, so the order and the place in which
trials are run change no result. The first trials are run in this process; worker processes are
started only once the time that a trial takes shows that they would pay for their own start.

Each worker is sent trial numbers, and answers with one message for each. It holds only a few
numbers at a time, so ten million trials are never queued anywhere.
"""

from __future__ import annotations

import os
import traceback
from collections import deque
from collections.abc import Callable, Collection, Iterator
from itertools import chain
from multiprocessing.connection import Connection, wait
from time import perf_counter
from typing import Any

import msgspec

from holdfast.config.loader import Configuration
from holdfast.config.user_code import account_of_user_error
from holdfast.errors import (
    HoldfastError,
    InvalidValueError,
    TrialCrashError,
    TrialError,
    WorkerDiedError,
)
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.problem import Problem
from holdfast.robot.trial import (
    NULL_OBSERVER,
    SensingStep,
    TaskStep,
    TrialObserver,
    run_trial,
)
from holdfast.runtime.command_line import MAX_JOBS
from holdfast.runtime.workers import WorkerProcess, end_workers

__all__ = [
    "TrialError",
    "available_cores",
    "run_trials",
]

_WORKER_START_S = 1.0
"""About what it costs to start workers; they must save more than this."""

_LOOKAHEAD_S = 0.1
"""A worker is sent trials for about this long, so that it never waits for the next number."""

_MAX_LOOKAHEAD = 16


class _Finished(msgspec.Struct, tag="finished"):
    result: TrialResult
    elapsed_s: float


class _Failed(msgspec.Struct, tag="failed"):
    text: str
    expected: bool


_MESSAGE_DECODER = msgspec.msgpack.Decoder(_Finished | _Failed)


class _TrialIsLongError(Exception):
    """Not an error: the trial that runs in this process is worth starting workers for."""


class _Watch(TrialObserver):
    """Gives a trial up once it has taken longer than workers need to start."""

    def __init__(self) -> None:
        self._deadline = perf_counter() + _WORKER_START_S

    def sensed(self, step: SensingStep) -> None:
        """Look at the clock."""
        del step
        self._check()

    def acted(self, step: TaskStep) -> None:
        """Look at the clock."""
        del step
        self._check()

    def _check(self) -> None:
        if perf_counter() > self._deadline:
            raise _TrialIsLongError


class _Worker(WorkerProcess):
    """A worker, and the trials that it has been sent."""

    def __init__(self, number: int, plain: dict[str, Any], threads: int) -> None:
        super().__init__(f"holdfast-worker-{number}", _work, (plain, threads), threads)
        self.outstanding: deque[int] = deque()

    def send_trial(self, trial: int) -> None:
        # If it is dead, its pipe tells when it is read, where we know which trial it had.
        self.outstanding.append(trial)
        self.send(trial.to_bytes(8, "little"))


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_trials(
    configuration: Configuration,
    jobs: int,
    finished: Collection[int],
    on_result: Callable[[TrialResult], None],
    observer: TrialObserver = NULL_OBSERVER,
) -> None:
    """Run the trials of a configuration that are not yet finished.

    Parameters
    ----------
    jobs : int
        Largest number of processes; 1 runs all trials in this one. Changes time only.
    finished : collection of int
        Numbers of the trials to leave out.
    on_result : callable
        Called in this process with the result of each trial as soon as it is there, in any order.
    observer : TrialObserver
        Observes the trials that are run in this process because no worker could help: all of them
        if ``jobs`` is 1, else the last one at most.

    Raises
    ------
    TrialError
        If holdfast refuses something in a trial, for example what a problem's function returned,
        or if such a function raises; the message then has the frames of that function.
    WorkerDiedError
        If a worker process was killed; the message names the trial that it was running.
    TrialCrashError
        If anything else went wrong in a worker process. In this process that error is raised as
        it is, with a note that names the trial.
    KeyboardInterrupt
        After the workers have been ended.
    """
    if not 1 <= jobs <= MAX_JOBS:
        raise InvalidValueError(f"jobs is {jobs}; it must be from 1 to {MAX_JOBS}")
    num_trials = configuration.simulator.num_trials
    finished = finished if isinstance(finished, (set, frozenset, range)) else set(finished)
    pending: Iterator[int] = (trial for trial in range(num_trials) if trial not in finished)
    remaining = num_trials - sum(1 for trial in finished if 0 <= trial < num_trials)

    serial = jobs == 1 or remaining <= 1
    elapsed_s = mean_s = 0.0
    for count, trial in enumerate(pending, start=1):
        started = perf_counter()
        try:
            result = _run_one(
                configuration, configuration.planning, trial, observer if serial else _Watch()
            )
        except _TrialIsLongError:
            # It decides the same when a worker runs it again; only the time so far is lost.
            pending, mean_s = chain((trial,), pending), _WORKER_START_S
            break
        elapsed_s += perf_counter() - started
        mean_s = elapsed_s / count
        remaining -= 1
        on_result(result)
        serial = serial or remaining == 1  # the last one: no worker could help
        if not serial and remaining * mean_s * (1.0 - 1.0 / min(jobs, remaining)) > _WORKER_START_S:
            break
    else:
        return
    _run_in_workers(configuration, jobs, pending, remaining, mean_s, on_result)


def _run_one(
    configuration: Configuration, planning: PlanningSettings, trial: int, observer: TrialObserver
) -> TrialResult:
    problem: Problem = configuration.problem
    simulator = configuration.simulator
    where = f"trial {trial} (seed {simulator.seed})"
    try:
        return run_trial(
            Planner(problem, planning),
            simulator.seed,
            trial,
            max_steps=simulator.max_steps,
            observer=observer,
            lost=configuration.lost,
        )
    except (_TrialIsLongError, KeyboardInterrupt):
        raise
    except HoldfastError as error:
        raise TrialError(f"{where}: {error}") from error
    except BaseException as error:
        account = account_of_user_error(error, configuration.problem_name)
        if account is not None:
            raise TrialError(f"{where}: {account}") from error
        error.add_note(f"in {where}")
        raise


def _run_in_workers(
    configuration: Configuration,
    jobs: int,
    pending: Iterator[int],
    remaining: int,
    mean_s: float,
    on_result: Callable[[TrialResult], None],
) -> None:
    workers: list[_Worker] = []
    try:
        _start_workers(workers, configuration, min(jobs, remaining))
        by_connection = {worker.connection: worker for worker in workers}
        elapsed_s = 0.0
        count = 0
        _feed(workers, pending, mean_s)
        while any(worker.outstanding for worker in workers):
            for connection in wait(list(by_connection)):
                assert isinstance(connection, Connection)
                worker = by_connection[connection]
                answer = worker.receive()
                if answer is None:
                    raise _worker_died(worker)
                message = _MESSAGE_DECODER.decode(answer)
                if isinstance(message, _Failed):
                    if message.expected:
                        raise TrialError(message.text)
                    raise TrialCrashError(f"in a worker process:\n{message.text}")
                worker.outstanding.popleft()
                elapsed_s += message.elapsed_s
                count += 1
                on_result(message.result)
            if count:
                mean_s = elapsed_s / count
            _feed(workers, pending, mean_s)
    finally:
        end_workers(workers)


def _feed(workers: list[_Worker], pending: Iterator[int], mean_s: float) -> None:
    """Send trials round by round, so that the last ones are spread over all workers."""
    depth = max(1, min(_MAX_LOOKAHEAD, int(_LOOKAHEAD_S / max(mean_s, 1e-6))))
    for level in range(depth):
        for worker in workers:
            if len(worker.outstanding) <= level:
                trial = next(pending, None)
                if trial is None:
                    return
                worker.send_trial(trial)


def _start_workers(workers: list[_Worker], configuration: Configuration, count: int) -> None:
    """Append ``count`` started workers, one by one, so that the caller can always end them."""
    threads = max(1, available_cores() // count)
    limit = configuration.planning.active_sensing.num_cores
    if limit:
        threads = min(threads, limit)
    plain = configuration.plain()
    for number in range(count):
        workers.append(_Worker(number, plain, threads))
        workers[-1].start()


def _work(connection: Connection, plain: dict[str, Any], threads: int) -> None:
    """Run trials by number until the parent closes the pipe or one of them fails."""
    encode = msgspec.msgpack.Encoder().encode
    configuration: Configuration | None = None
    while True:
        trial = int.from_bytes(connection.recv_bytes(), "little")
        started = perf_counter()
        message: _Finished | _Failed
        try:
            if configuration is None:
                configuration = Configuration.from_plain(plain)
                planning = msgspec.structs.replace(
                    configuration.planning,
                    active_sensing=msgspec.structs.replace(
                        configuration.planning.active_sensing, num_cores=threads
                    ),
                )
            result = _run_one(configuration, planning, trial, NULL_OBSERVER)
            message = _Finished(result, perf_counter() - started)
        except HoldfastError as error:
            message = _Failed(str(error), True)
        except Exception:  # noqa: BLE001 - whatever it is, the parent raises it again
            message = _Failed(traceback.format_exc(), False)
        connection.send_bytes(encode(message))
        if isinstance(message, _Failed):
            return


def _worker_died(worker: _Worker) -> WorkerDiedError:
    how, killed = worker.how_it_ended()
    advice = " (often the machine is out of memory: use fewer jobs or fewer particles)"
    trial = worker.outstanding[0] if worker.outstanding else None
    what = "before it had a trial to run" if trial is None else f"while it ran trial {trial}"
    return WorkerDiedError(
        f"a worker process {how} {what}{advice if killed else ''}; finished trials are kept"
    )
