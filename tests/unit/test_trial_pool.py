"""One pool of workers for the trials of several configurations."""

import dataclasses
import multiprocessing
import os
import resource
import signal
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest
from tests.unit.test_trial import configuration_of, failing_configuration, one

from holdfast.errors import DescriptorError, InvalidValueError, TrialError, WorkerDiedError
from holdfast.planning.planner import Planner
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.robot import trial_pool
from holdfast.robot.lost_values import LostValues
from holdfast.robot.trial_pool import Arm, TrialPool


def arms_of(tmp_path: Path) -> tuple[Arm, Arm]:
    configuration = configuration_of(tmp_path)
    first = Arm.of(configuration, "as it is")
    planner = Planner(configuration.problem, configuration.planning, method="random")
    return first, dataclasses.replace(first, planning=planner.settings, label="random")


@pytest.mark.parametrize("jobs", [1, 2])
def test_trials_of_several_arms(tmp_path: Path, jobs: int) -> None:
    """They decide as alone; a result leads to further trials, and an arm is given up."""
    arms = arms_of(tmp_path)
    found = {}
    with TrialPool(jobs) as pool:
        for arm in arms:
            pool.submit(arm, 0)
        for done in pool.run():
            found[done.arm.label, done.trial] = done.result
            assert done.elapsed_s > 0.0
            if done.trial == 0:
                pool.submit(done.arm, 2)
        assert pool.waiting == 0
        assert len(pool._workers) == (0 if jobs == 1 else jobs)
        for trial in range(5):
            pool.submit(arms[0], trial)
        pool.drop(arms[0])
        assert list(pool.run()) == []
        pool.submit(arms[0], 0)
    assert pool.waiting == 0
    assert sorted(found) == [(arm.label, trial) for arm in arms for trial in (0, 2)]
    assert found["as it is", 2].digest == one(configuration_of(tmp_path), 2).digest
    assert found["random", 2].digest != found["as it is", 2].digest


def test_more_workers_than_files_may_be_open_are_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (66, 66))
    with TrialPool(24, overdue=lambda *_: False) as pool:
        pool.submit(arms_of(tmp_path)[0], 0)
        with pytest.raises(DescriptorError, match=r"66 files.*needs 136.*or take fewer jobs"):
            list(pool.run())
        assert pool._workers == []


def test_a_worker_builds_a_problem_once_and_tells_how_each_trial_went(tmp_path: Path) -> None:
    """What runs in a worker process, here without one."""
    runner, arms = trial_pool._Runner(2), arms_of(tmp_path)

    def answers(number: int, trial: int, arm: Arm | None = None) -> list[Any]:
        new = b"" if arm is None else trial_pool._pickled(arm)
        message = msgspec.msgpack.encode(trial_pool._Trial(number, trial, new))
        return [trial_pool._ANSWERS.decode(each) for each in runner.all_answers(message)]

    built, finished = answers(0, 2, arms[0])
    assert isinstance(built, trial_pool._Built)
    assert finished.result.digest == one(configuration_of(tmp_path), 2).digest
    assert finished.elapsed_s > 0.0
    assert [type(each).__name__ for each in answers(1, 2, arms[1])] == ["_Built", "_Finished"]
    known: dict[int, Any] = runner._arms
    assert known[0].problem is known[1].problem
    assert [type(each).__name__ for each in answers(0, 3)] == ["_Finished"]
    assert not answers(2, 0)[0].expected  # an arm that it was never sent
    for own, cores in ((None, 2), (1, 1), (8, 2)):
        sensing = msgspec.structs.replace(arms[0].planning.active_sensing, num_cores=own)
        planning = msgspec.structs.replace(arms[0].planning, active_sensing=sensing)
        answers(3, 0, dataclasses.replace(arms[0], planning=planning))
        assert known[3].planning.active_sensing.num_cores == cores


def test_the_time_of_a_trial_is_a_mean() -> None:
    times = trial_pool._Times()
    for elapsed_s in (1.0, 3.0, 8.0):
        times.add(elapsed_s)
    assert (times.count, times.mean_s) == (3, 4.0)


def test_a_choice_by_results_waits_for_few(tmp_path: Path) -> None:
    """With one process, an iterator has seen all results before it names the next trial."""
    arm, _ = arms_of(tmp_path)
    seen: list[int] = []

    def trials() -> Any:
        for trial in range(3):
            assert len(seen) == trial
            yield arm, trial

    with TrialPool(1) as pool:
        for done in pool.run(trials()):
            seen.append(done.trial)  # noqa: PERF401 - the iterator reads it meanwhile
    assert seen == [0, 1, 2]


def test_a_class_that_only_this_process_knows(tmp_path: Path) -> None:
    pytest.importorskip("cloudpickle")
    configuration = configuration_of(tmp_path)

    class Lazy(PegInHole2D):
        """Nobody can import it."""

        resolution = 0.5

    arm = dataclasses.replace(Arm.of(configuration), problem=Lazy(), plain=None)
    with TrialPool(2) as pool:
        results = {done.trial: done.result for done in pool.run((arm, trial) for trial in (0, 1))}
    with TrialPool(1) as pool:
        assert {done.trial: done.result.digest for done in pool.run([(arm, 0), (arm, 1)])} == {
            trial: result.digest for trial, result in results.items()
        }


class OfANotebook(PegInHole2D):
    __module__ = "__main__"


class Locked(PegInHole2D):
    def __reduce__(self) -> Any:
        raise TypeError("a lock")


class Elsewhere(PegInHole2D):
    def __reduce__(self) -> Any:
        return int, ("x",)


@pytest.mark.parametrize(
    ("problem", "error", "message"),
    [
        (Locked, InvalidValueError, "Locked cannot be sent to worker processes: a lock; with jobs"),
        (
            OfANotebook,
            InvalidValueError,
            r"needs cloudpickle: pip install 'hold.*\[tune\]'",
        ),
        (Elsewhere, TrialError, "peg_in_hole_2d cannot be made again in a worker process: ValueE"),
    ],
)
def test_what_cannot_be_sent_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    problem: type[PegInHole2D],
    error: type[Exception],
    message: str,
) -> None:
    monkeypatch.setitem(sys.modules, "cloudpickle", None)
    arm = dataclasses.replace(Arm.of(configuration_of(tmp_path)), problem=problem(), plain=None)
    with TrialPool(2) as pool, pytest.raises(error, match=message):
        list(pool.run([(arm, 0), (arm, 1)]))


@pytest.mark.parametrize("jobs", [1, 2])
def test_the_others_go_on_without_an_arm_that_fails(tmp_path: Path, jobs: int) -> None:
    good, _ = arms_of(tmp_path)
    bad = Arm.of(failing_configuration(tmp_path, 'ProblemError("too heavy")'), "heavy")
    finished: list[int] = []
    with TrialPool(jobs) as pool:
        for trial in range(3):
            pool.submit(good, trial)
            pool.submit(bad, trial)
        failures = 0
        while pool.waiting:
            try:
                finished.extend(done.trial for done in pool.run())
            except TrialError as error:
                assert error.arm is bad
                assert str(error).endswith("of heavy: too heavy")
                failures += 1
                pool.drop(bad)
    assert failures >= 1
    assert sorted(finished) == [0, 1, 2]


def test_a_dead_worker_is_named_and_costs_no_other_trial(tmp_path: Path) -> None:
    arm, _ = arms_of(tmp_path)
    finished: list[int] = []
    more = ((arm, trial) for trial in range(60))
    with TrialPool(2) as pool:
        with pytest.raises(
            WorkerDiedError, match=r"SIGKILL while it ran trial \d+ of as it is \(often the machine"
        ) as died:
            for done in pool.run(more):
                finished.append(done.trial)
                if len(finished) == 1:
                    pid = pool._workers[0]._process.pid
                    assert pid is not None
                    os.kill(pid, signal.SIGKILL)
        finished += [done.trial for done in pool.run(more)]
    assert (died.value.overdue, died.value.killed) == (False, True)
    assert sorted([*finished, died.value.trial]) == list(range(60))


def test_an_overdue_trial_costs_its_worker_and_no_other_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, _ = arms_of(tmp_path)
    asked: list[tuple[Arm, float]] = []

    def is_overdue(arm: Arm, ran_s: float) -> bool:
        asked.append((arm, ran_s))
        return len(asked) == 1  # while the worker starts

    monkeypatch.setattr(trial_pool, "_TICK_S", 0.0)
    with TrialPool(1, overdue=is_overdue) as pool:
        for trial in range(2):
            pool.submit(arm, trial)
        with pytest.raises(WorkerDiedError, match=r"was ended after 0\.0 s .* 0 of as") as ended:
            list(pool.run())
        assert (ended.value.overdue, ended.value.killed) == (True, False)
        assert "memory" not in str(ended.value)
        assert asked[0][0] is arm
        assert asked[0][1] < 0.0
        assert [done.trial for done in pool.run()] == [1]


def test_a_daemonic_process_starts_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What fails there, and is nothing of its problem, has a note that names the trial."""
    observer = LostValues()
    vars(observer)["trial_began"] = float  # which takes no environment
    arm, _ = arms_of(tmp_path)
    daemon = vars(multiprocessing.current_process())["_config"]
    monkeypatch.setitem(daemon, "daemon", True)
    with TrialPool(2, observer=observer, overdue=lambda *_: True) as pool:
        pool.submit(arm, 4)
        with pytest.raises(TypeError) as failed:
            list(pool.run())
    assert failed.value.__notes__ == ["in trial 4 (seed 3) of as it is"]


class Large(PegInHole2D):
    """More than a pipe holds; never returns while a file is there."""

    def __init__(self, flag: Path) -> None:
        super().__init__()
        self.flag, self.more = flag, bytes(1 << 21)

    def initial_states(self, stream: Any, count: int) -> Any:
        while self.flag.exists():
            pass
        return super().initial_states(stream, count)


def test_a_worker_that_hangs_does_not_hold_up_who_has_more_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trial_pool, "_LOOKAHEAD_S", 1e9)  # all that one worker may be sent at once
    flag = tmp_path / "flag"
    arms = [dataclasses.replace(a, problem=Large(flag), plain=None) for a in arms_of(tmp_path)]
    with TrialPool(1, overdue=lambda _, ran_s: flag.exists() and ran_s > 0.0) as pool:
        assert len(list(pool.run((each, 0) for each in arms))) == 2
        flag.touch()
        for trial in (1, 2):  # the second time a new worker knows neither
            with pytest.raises(WorkerDiedError, match="was ended after"):
                list(pool.run((each, trial) for each in arms))
        flag.unlink()
        assert len(list(pool.run())) == 2
