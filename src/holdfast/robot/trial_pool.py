"""A pool of worker processes that runs simulated trials of several configurations.

A trial depends on nothing but its arm (a problem, planning settings, seed and limit) and its
number, so the order and the process in which trials are run change no result.

How to use it::

    with TrialPool(jobs, expected=200) as pool:
        for finished in pool.run((arm, trial) for trial in range(100) for arm in arms):
            finished.arm, finished.trial, finished.result, finished.elapsed_s

Results come in any order. :meth:`TrialPool.run` asks for the next trial only when there is room for
it, so an iterator of ten million trials is never queued anywhere, and one that chooses by the
results so far (a race) has seen all but the trials of :attr:`TrialPool.waiting`. Where the next
trials follow from results, submit them in the loop: :meth:`TrialPool.submit`, and
:meth:`TrialPool.drop` takes back what no worker has begun. Leaving the ``with`` ends the workers at
once, also on Ctrl-C. A worker that dies costs the trial that it ran: its other trials go to another
one, and a further call of :meth:`TrialPool.run` goes on.

The first trials are run in this process, until the time that a trial takes shows that workers would
pay for their own start. Each worker holds trials for a tenth of a second, at most 16.
"""

from __future__ import annotations

import multiprocessing
import pickle
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from time import perf_counter
from typing import Any, NamedTuple

import msgspec

from holdfast.config.loader import Configuration
from holdfast.config.user_code import account_of_user_error
from holdfast.errors import (
    HoldfastError,
    InvalidValueError,
    TrialCrashError,
    TrialError,
    WorkerDiedError,
    how_to_install,
)
from holdfast.numerics.arrays import integer
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner
from holdfast.planning.settings import LostSettings, PlanningSettings
from holdfast.printable import brief
from holdfast.problems.problem import Problem
from holdfast.robot.lost_values import LostValues
from holdfast.robot.trial import run_trial
from holdfast.runtime.command_line import MAX_JOBS
from holdfast.runtime.descriptors import NEEDED, allow_descriptors
from holdfast.runtime.machine import available_cores
from holdfast.runtime.ray_workers import RayCluster, RayProcess
from holdfast.runtime.workers import WorkerProcess, end_workers

_WORKER_START_S = 1.0  # about what it costs to start workers; they must save more than this
_LOOKAHEAD_S = 0.1  # of trials that a worker is sent, so that it never waits for the next one
_MAX_LOOKAHEAD = 16
_TICK_S = 0.25  # between two looks at trials that may be overdue
_BUILD_S = 60.0  # for a worker to start and to build a problem, before a trial's time begins
_DESCRIPTORS = 3  # that a worker takes here: its pipe, and two of multiprocessing


@dataclass(frozen=True, eq=False)
class Arm:
    """What trials are run of, told apart by identity. Of one seed they meet the same worlds.

    ``problem_name`` and ``label`` are for messages; the label tells it from other arms, and is
    empty if there is only one. ``plain`` is :meth:`Configuration.plain` of the configuration that
    built the problem, from which a worker builds it again; if it is None, the problem itself is
    sent, as a pickle in the pipe.
    """

    problem: Problem
    planning: PlanningSettings
    seed: int
    max_steps: int
    lost: LostSettings
    problem_name: str
    label: str = ""
    plain: dict[str, Any] | None = None

    @classmethod
    def of(cls, configuration: Configuration, label: str = "") -> Arm:
        """Return the arm of a configuration."""
        return cls(
            configuration.problem,
            configuration.planning,
            configuration.simulator.seed,
            configuration.simulator.max_steps,
            configuration.lost,
            configuration.problem_name,
            label,
            configuration.plain(),
        )


class FinishedTrial(NamedTuple):
    """A trial that is finished, the seconds that it took, and :class:`LostValues` of it."""

    arm: Arm
    trial: int
    result: TrialResult
    elapsed_s: float
    lost_values: tuple[str, ...]


class TrialPool:
    """Runs trials in this process or in workers; the module says how to use it.

    There are at most ``jobs`` processes; 1 runs all trials in this one. Of ``expected`` trials, as
    far as known, so few and short ones that workers would not pay start none; None starts them for
    the first one. ``observer`` observes the trials that are run in this process because no worker
    could help: all of them if ``jobs`` is 1, else the last one at most. ``overdue`` is asked of
    each trial that runs, with its arm and the seconds so far, whether its worker is to be ended;
    with it no trial is run in this process, which none can end or hold up. The workers may be on a
    ``cluster`` in place of this machine, with ``overdue``.
    """

    def __init__(
        self,
        jobs: int,
        *,
        expected: int | None = None,
        observer: LostValues | None = None,
        overdue: Callable[[Arm, float], bool] | None = None,
        cluster: RayCluster | None = None,
    ) -> None:
        if integer(jobs) is None or not 1 <= jobs <= MAX_JOBS:
            raise InvalidValueError(f"jobs is {brief(jobs)}; it must be from 1 to {MAX_JOBS}")
        # A worker of multiprocessing's pools, which is daemonic, may start no processes.
        alone = multiprocessing.current_process().daemon
        self._jobs = 1 if alone else jobs
        self._expected = expected
        self._observer = observer or LostValues()
        self._overdue = None if alone else overdue
        self._cluster = cluster
        self._queue: deque[tuple[Arm, int]] = deque()
        self._workers: list[_Worker] = []
        self._times: dict[Arm, _Times] = {}
        self._all_times = _Times()
        self._a_trial_is_long = False
        self._wanted = 0

    def __enter__(self) -> TrialPool:
        return self

    def __exit__(self, *exception: object) -> None:
        self._queue.clear()
        end_workers(self._workers)
        self._workers.clear()

    @property
    def waiting(self) -> int:
        """Trials that were submitted and are not finished."""
        return len(self._queue) + sum(len(worker.outstanding) for worker in self._workers)

    def submit(self, arm: Arm, trial: int) -> None:
        """Add a trial, which :meth:`run` yields when it is finished."""
        self._queue.append((arm, trial))

    def drop(self, arm: Arm | None = None) -> None:
        """Take back trials, an arm's or all, that no worker has; the others are still yielded."""
        self._queue = deque(job for job in self._queue if arm not in (None, job[0]))

    def run(self, trials: Iterable[tuple[Arm, int]] = ()) -> Iterator[FinishedTrial]:
        """Yield trials as they are finished, in any order, until none is left.

        ``trials`` are submitted one by one, when there is room. Raises TrialError if holdfast
        refuses something in a trial, for example what a problem's function returned, or if such a
        function raises; the message then has the frames of that function, and another call can go
        on. WorkerDiedError if a worker process ended or was overdue; TrialCrashError if anything
        else went wrong in a worker process. (In this process that error is raised as it is, with a
        note that names the trial.) Each has the trial's ``arm``.
        """
        more = iter(trials)
        here = self._jobs == 1 and self._overdue is None
        room = 1 if here else self._jobs * _MAX_LOOKAHEAD
        while True:
            while len(self._queue) < room and (job := next(more, None)) is not None:
                self.submit(*job)
            if self._workers:
                self._feed()
                if not self.waiting:
                    return
                yield from self._receive()
            elif not self._queue:
                return
            elif self._workers_pay():
                self._start_workers()
            elif (finished := self._run_here()) is not None:
                yield finished

    def _remaining(self) -> int:
        """Return how many trials are left, as far as known; many if it is not."""
        if self._expected is None:
            return MAX_JOBS
        return max(self._expected - self._all_times.count, len(self._queue))

    def _workers_pay(self) -> bool:
        if self._overdue is not None:
            return True
        remaining = self._remaining()
        if self._jobs == 1 or remaining <= 1:
            return False
        if self._a_trial_is_long or self._expected is None:
            return True
        saved_s = remaining * self._all_times.mean_s * (1.0 - 1.0 / min(self._jobs, remaining))
        return self._all_times.count > 0 and saved_s > _WORKER_START_S

    def _run_here(self) -> FinishedTrial | None:
        """Run the next trial in this process; return None if that takes too long."""
        no_help = self._jobs == 1 or self._remaining() <= 1
        arm, trial = self._queue.popleft()
        observer = self._observer if no_help else _Watch()
        started = perf_counter()
        try:
            result = _run_one(arm, trial, observer)
        except _TrialIsLongError:
            # It decides the same when a worker runs it again; only the time so far is lost.
            self._queue.appendleft((arm, trial))
            self._a_trial_is_long = True
            return None
        elapsed_s = perf_counter() - started
        return self._finished(FinishedTrial(arm, trial, result, elapsed_s, observer.lost))

    def _finished(self, finished: FinishedTrial) -> FinishedTrial:
        for times in (self._all_times, self._times.setdefault(finished.arm, _Times())):
            times.add(finished.elapsed_s)
        return finished

    def _start_workers(self) -> None:
        """Start workers one by one, each noted first, so that they can always be ended."""
        if not self._wanted:
            self._wanted = min(self._jobs, self._remaining())
            needed = NEEDED + _DESCRIPTORS * self._wanted
            allow_descriptors(needed, needed, "; or take fewer jobs (--jobs)")
        threads = max(1, available_cores() // self._wanted) if self._cluster is None else 1
        limit = self._queue[0][0].planning.active_sensing.num_cores or threads
        while (number := len(self._workers)) < self._wanted:
            self._workers.append(_Worker(number, threads, min(threads, limit), self._cluster))
            self._workers[-1].start()

    def _feed(self) -> None:
        """Send trials, each to the worker with the least to do."""
        if self._queue:
            self._start_workers()  # in place of those that died
        while self._queue:
            worker = min(self._workers, key=lambda each: (bool(each.outstanding), each.expected_s))
            arm, trial = self._queue[0]
            times = self._times.get(arm)
            # One whose time nobody knows may be long.
            expected_s = _LOOKAHEAD_S if times is None else times.mean_s
            # An arm may be larger than a pipe, so it waits for a worker that reads: one that runs a
            # trial may never end, or wait until its answers are read.
            if worker.outstanding and (
                len(worker.outstanding) == _MAX_LOOKAHEAD
                or worker.expected_s + expected_s > _LOOKAHEAD_S
                or arm not in worker.arms
            ):
                return
            worker.send_trial(arm, trial, expected_s)
            self._queue.popleft()

    def _receive(self) -> Iterator[FinishedTrial]:
        by_connection = {worker.connection: worker for worker in self._workers}
        ready = wait(list(by_connection), None if self._overdue is None else _TICK_S)
        for connection in ready:
            assert isinstance(connection, Connection)
            worker = by_connection[connection]
            answer = worker.receive()
            if answer is None:
                self._lose(worker, *worker.how_it_ended())
                continue
            message = _ANSWERS.decode(answer)
            if isinstance(message, _Built):
                worker.began_s = perf_counter()
                continue
            arm, trial = worker.take_finished()
            if isinstance(message, _Failed):
                crash = TrialCrashError(f"in a worker process:\n{message.text}")
                error = TrialError(message.text) if message.expected else crash
                error.arm = arm
                raise error
            yield self._finished(FinishedTrial(arm, trial, *msgspec.structs.astuple(message)))
        for connection, worker in by_connection.items():
            if self._overdue is not None and connection not in ready and worker.outstanding:
                ran_s = perf_counter() - worker.began_s
                if self._overdue(worker.outstanding[0][0], ran_s):
                    self._lose(worker, f"was ended after {max(0.0, ran_s):.1f} s", False, True)

    def _lose(self, worker: _Worker, how: str, killed: bool, overdue: bool = False) -> None:
        """Take leave of a worker; raise WorkerDiedError if it had a trial."""
        self._workers.remove(worker)
        end_workers([worker])
        if not worker.outstanding:
            return
        (arm, trial, _), *others = worker.outstanding
        self._queue.extendleft((arm, trial) for arm, trial, _ in reversed(others))
        what = f"trial {trial}{f' of {arm.label}' if arm.label else ''}"
        if killed:
            what += " (often the machine is out of memory: use fewer jobs or fewer particles)"
        error = WorkerDiedError(
            f"a worker process {how} while it ran {what}; finished trials are kept"
        )
        error.arm, error.trial = arm, trial
        error.how, error.killed, error.overdue = how, killed, overdue
        raise error


@dataclass
class _Times:
    """How long trials took."""

    count: int = 0
    mean_s: float = 0.0

    def add(self, elapsed_s: float) -> None:
        self.count += 1
        self.mean_s += (elapsed_s - self.mean_s) / self.count


class _TrialIsLongError(Exception):
    """Not an error: the trial that runs in this process is worth starting workers for."""


class _Watch(LostValues):
    """Gives a trial up once it has taken longer than workers need to start."""

    def __init__(self) -> None:
        self._deadline = perf_counter() + _WORKER_START_S

    def sensed(self, step: object) -> None:
        """Look at the clock."""
        del step
        if perf_counter() > self._deadline:
            raise _TrialIsLongError

    acted = sensed


def _run_one(arm: Arm, trial: int, observer: LostValues) -> TrialResult:
    where = f"trial {trial} (seed {arm.seed}){f' of {arm.label}' if arm.label else ''}"
    try:
        return run_trial(
            Planner(arm.problem, arm.planning),
            arm.seed,
            trial,
            max_steps=arm.max_steps,
            observer=observer,
            lost=arm.lost,
        )
    except (_TrialIsLongError, KeyboardInterrupt):
        raise
    except BaseException as error:
        ours = isinstance(error, HoldfastError)
        text = str(error) if ours else account_of_user_error(error, arm.problem_name)
        if text is not None:
            failed = TrialError(f"{where}: {text}")
            failed.arm = arm
            raise failed from error
        error.add_note(f"in {where}")
        raise


# -- workers ---------------------------------------------------------------------------------------


class _Trial(msgspec.Struct):
    """A trial of an arm, by the arm's number in that worker; with its first one the arm itself."""

    arm: int
    trial: int
    new: bytes = b""


class _Finished(msgspec.Struct, tag="finished"):
    result: TrialResult
    elapsed_s: float
    lost_values: tuple[str, ...]


class _Built(msgspec.Struct, tag="built"):
    """The arm of a trial is built; its first trial there begins."""


class _Failed(msgspec.Struct, tag="failed"):
    text: str
    expected: bool


_REQUESTS = msgspec.msgpack.Decoder(_Trial)
_ANSWERS = msgspec.msgpack.Decoder(_Finished | _Built | _Failed)
_ENCODE = msgspec.msgpack.Encoder().encode


class _Worker(WorkerProcess):
    """A worker, and the trials that it has been sent."""

    def __init__(self, number: int, threads: int, blas: int, cluster: RayCluster | None) -> None:
        super().__init__(f"holdfast-worker-{number}", _work, (threads,), blas)
        if cluster is not None:
            self._process = RayProcess(cluster, _Runner, self._theirs, threads)
        self.outstanding: deque[tuple[Arm, int, float]] = deque()
        self.expected_s = self.began_s = 0.0
        self.arms: dict[Arm, int] = {}  # those that it was sent

    def send_trial(self, arm: Arm, trial: int, expected_s: float) -> None:
        # If it is dead, its pipe tells when it is read, where we know which trial it had.
        new = b"" if arm in self.arms else _pickled(arm)
        if not self.outstanding:
            self.began_s = perf_counter() + (_BUILD_S if new else 0.0)
        number = self.arms.setdefault(arm, len(self.arms))
        self.outstanding.append((arm, trial, expected_s))
        self.expected_s += expected_s
        self.send(_ENCODE(_Trial(number, trial, new)))

    def take_finished(self) -> tuple[Arm, int]:
        """Return the trial that an answer was about: they come in order."""
        arm, trial, expected_s = self.outstanding.popleft()
        self.expected_s = self.expected_s - expected_s if self.outstanding else 0.0
        self.began_s = perf_counter()
        return arm, trial


_OF_THE_PROBLEM = ("problem", "problem_directory", "model", "state_space_planner")  # sections

_NEEDS_CLOUDPICKLE = (
    "a problem that a notebook or a script defines needs cloudpickle: "
    f"{how_to_install('cloudpickle', 'tune')}, or put its class into a module of its own, or use "
    "jobs=1"
)


def _pickled(arm: Arm) -> bytes:
    """Return an arm for the pipe; its problem within, pickled too, unless ``plain`` builds it."""
    problem: Any = None if arm.plain is not None else _pickled_problem(arm.problem)
    return pickle.dumps(replace(arm, problem=problem))


def _pickled_problem(problem: Problem) -> bytes:
    """Return a problem; cloudpickle takes along the class that a notebook defines."""
    try:
        import cloudpickle as pickler
    except ImportError:
        pickler = pickle
        if type(problem).__module__ == "__main__":
            raise InvalidValueError(_NEEDS_CLOUDPICKLE) from None
    try:
        pickled: bytes = pickler.dumps(problem)
    except Exception as error:
        raise InvalidValueError(
            f"{type(problem).__name__} cannot be sent to worker processes: {error}; with jobs=1 "
            "its trials are run in this one"
        ) from error
    return pickled


def _work(connection: Connection, threads: int) -> None:
    """Run trials until the parent closes the pipe."""
    runner = _Runner(threads)
    while True:
        for answer in runner.answers(connection.recv_bytes()):
            connection.send_bytes(answer)


class _Runner:
    """What runs the trials in a worker, which has as many threads as its share of the cores."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._arms: dict[int, Arm | bytes] = {}
        self._problems: dict[bytes, Problem] = {}

    def all_answers(self, message: bytes) -> list[bytes]:
        """Return what there is to answer, for who cannot wait for it one by one."""
        return list(self.answers(message))

    def answers(self, message: bytes) -> Iterator[bytes]:
        """Yield what there is to answer, as soon as it is known."""
        request = _REQUESTS.decode(message)
        if request.new:
            self._arms[request.arm] = request.new
        started, observer = perf_counter(), LostValues()
        try:
            arm = self._arms[request.arm]
            if isinstance(arm, bytes):
                self._arms[request.arm] = arm = _arm_in_worker(arm, self._threads, self._problems)
                yield _ENCODE(_Built())
            result = _run_one(arm, request.trial, observer)
            answer = _ENCODE(_Finished(result, perf_counter() - started, observer.lost))
        except HoldfastError as error:
            answer = _ENCODE(_Failed(str(error), True))
        except Exception:  # noqa: BLE001 - whatever it is, the parent raises it again
            answer = _ENCODE(_Failed(traceback.format_exc(), False))
        yield answer


def _arm_in_worker(pickled: bytes, threads: int, problems: dict[bytes, Problem]) -> Arm:
    """Build an arm in a worker.

    Arms that differ in their settings alone share a problem of ``problems``: it may be large.
    """
    arm: Arm = pickle.loads(pickled)
    if arm.plain is not None:
        sections = arm.plain["configuration"]
        key = _ENCODE([arm.plain["path"], *map(sections.get, _OF_THE_PROBLEM)])
        if key not in problems:
            problems[key] = Configuration.from_plain(arm.plain).problem
        problem = problems[key]
    else:
        try:
            problem = pickle.loads(arm.problem)  # type: ignore[arg-type]
        except Exception as error:
            raise InvalidValueError(
                f"{arm.problem_name} cannot be made again in a worker process: "
                f"{type(error).__name__}: {error}; {_NEEDS_CLOUDPICKLE}"
            ) from error
    own = arm.planning.active_sensing
    own = msgspec.structs.replace(own, num_cores=min(threads, own.num_cores or threads))
    planning = msgspec.structs.replace(arm.planning, active_sensing=own)
    return replace(arm, problem=problem, planning=planning)
