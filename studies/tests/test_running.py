"""Tasks, where they are computed, and what is kept of them."""

import contextlib
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec
import pandas as pd
import pytest

import holdfast
import holdfast_lab
import studies
from holdfast import _kernel
from holdfast.errors import HoldfastError, InvalidValueError, OutputError
from studies import executors, tasks
from studies.command import studies_of
from studies.errors import TaskError
from studies.executors import LocalExecutor, compute_encoded, encode_task, table_of
from studies.running import ResultCache, Workload, compute, write_report
from studies.statistics import Interval
from studies.study import Number, Part, Report, Scale, Study
from studies.tasks import Task, run_task, task_key
from studies.trial_batches import TrialSeries, trial_tasks


def series(**changes: object) -> TrialSeries:
    plain = {"problem": "peg_in_hole_2d", "max_steps": 20, "seed": 4, "num_trials": 7, **changes}
    return msgspec.convert(plain, TrialSeries)


def outcome(computed: Sequence[pd.DataFrame]) -> list[list[object]]:
    """Return what does not depend on the time that it took."""
    kept = [table.drop(columns="mean_sensing_ms") for table in computed]
    # Nothing where there is no number, which would not be equal to itself.
    known = [table.astype(object).where(table.notna(), None) for table in kept]
    return [[table[name].tolist() for name in table.columns] for table in known]


def worker_processes() -> list[int]:
    """Return the processes that this one has started to compute."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(fields[1]) == os.getpid() and b"spawn_main" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
    return found


class TestTasks:
    def test_a_series_is_cut_into_batches(self) -> None:
        found = list(trial_tasks(series(), 3))
        assert [task.units for task in found] == [3, 3, 1]
        whole = run_task(next(trial_tasks(series(), 100)))
        parts = pd.concat([run_task(task) for task in found])
        assert outcome([whole]) == outcome([parts])
        assert parts["trial"].tolist() == list(range(7))

    def test_the_key_names_all_that_matters(self) -> None:
        def key(**changes: object) -> str:
            return task_key(next(trial_tasks(series(**changes), 100)))

        assert key() == key()
        others = {
            key(seed=5),
            key(max_steps=21),
            key(num_trials=8),
            key(model={"hole_tolerance": 0.2}),
            key(planning={"selector": {"method": "random"}}),
        }
        assert len(others | {key()}) == 6

    def test_the_key_names_the_code(self, monkeypatch: pytest.MonkeyPatch) -> None:
        task = next(trial_tasks(series(), 100))
        before = task_key(task)
        monkeypatch.setattr(tasks, "code_of", lambda task: f"another {task.kind}")
        assert task_key(task) != before

    def test_an_edited_source_is_noticed(self, tmp_path: Path) -> None:
        """In a process of its own, whose package is a copy."""
        for package in (holdfast, holdfast_lab, studies):
            shutil.copytree(
                Path(str(package.__file__)).parent,
                tmp_path / package.__name__,
                ignore=shutil.ignore_patterns("__pycache__", "tests"),
            )
        for kernel in Path(_kernel.__file__).parent.glob("_kernel*.so"):
            shutil.copy(kernel, tmp_path / "holdfast")
        program = """
from pathlib import Path
import holdfast
from studies.tasks import Task, code_of
def digests():
    places = ("peg_in_hole_2d", "studies.light_dark:LightDark")
    return [code_of(Task(kind="trials", parameters={"problem": place})) for place in places]
first = digests()
assert digests() == first
root = Path(holdfast.__file__).parents[1]
for name in ("studies/light_dark.py", "holdfast/planning/belief.py", "holdfast_lab/chaos/trial.py"):
    with (root / name).open("a") as source:
        source.write("# edited")
    second = digests()
    print(name, [before != now for before, now in zip(first, second)])
    first = second
"""
        done = subprocess.run(
            [sys.executable, "-S", "-c", program],
            cwd=tmp_path,
            env={
                "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)]),
                "PYTHONDONTWRITEBYTECODE": "1",
            },
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.splitlines() == [
            "studies/light_dark.py [False, True]",
            "holdfast/planning/belief.py [True, True]",
            "holdfast_lab/chaos/trial.py [False, False]",
        ]

    def test_who_has_other_code_refuses(self, monkeypatch: pytest.MonkeyPatch) -> None:
        task = next(trial_tasks(series(), 100))
        asked = encode_task(task)
        assert len(table_of(compute_encoded(asked))) == 7
        monkeypatch.setattr(executors, "code_of", lambda _: "another")
        with pytest.raises(TaskError, match="has other code for tasks of the kind 'trials'"):
            table_of(compute_encoded(asked))

    def test_the_key_of_times_names_the_machine(self, monkeypatch: pytest.MonkeyPatch) -> None:
        task = next(trial_tasks(series(), 100))
        timed = msgspec.structs.replace(task, exclusive=True)
        before = task_key(task), task_key(timed)
        monkeypatch.setattr(tasks, "_machine", lambda: {"processor": "another"})
        assert task_key(task) == before[0]
        assert task_key(timed) != before[1]

    def test_the_sources_behind_a_task(self) -> None:
        """What a trial is made of is among them; what only shows or moves it is not."""
        names = set(tasks._sources_behind("studies.trial_batches"))
        assert {
            "holdfast.planning.belief",
            "holdfast.planning.sensing",
            "holdfast.problems.peg_in_hole_3d",  # named in a registry alone
            "studies.trial_batches",
            "holdfast",
        } <= names
        others = ("holdfast.cli", "holdfast.reports", "holdfast_lab")
        assert not [name for name in names if name.startswith(others)]
        assert "studies.tasks" not in names

    def test_unknown_kinds_are_refused(self) -> None:
        with pytest.raises(TaskError, match="'dance': there are trials"):
            run_task(Task(kind="dance", parameters={}))

    def test_what_a_trial_is_refused_for_names_it(self) -> None:
        planning = {
            "active_sensing": {"num_nearest_neighbors": 300},
            "selector": {"estimator": "nearest_neighbor"},
        }
        task = next(trial_tasks(series(planning=planning), 100))
        with pytest.raises(TaskError, match=r"trial 0 \(seed 4\) of peg_in_hole_2d: .*neighbors"):
            run_task(task)


class TestCache:
    def test_what_is_kept_comes_back(self, tmp_path: Path) -> None:
        cache, task = ResultCache(tmp_path), Task(kind="trials", parameters={"a": 1})
        assert cache.load(task) is None
        table = pd.DataFrame({"reward": [1.5, None, float("-inf")], "words": ["a", "b", ""]})
        cache.store(task, table)
        pd.testing.assert_frame_equal(cache.load(task), table)
        assert cache.load(Task(kind="trials", parameters={"a": 2})) is None

    @pytest.mark.parametrize("damage", [b"", b"\0", b"\xff" * 40])
    def test_what_is_damaged_is_computed_again(self, tmp_path: Path, damage: bytes) -> None:
        cache, task = ResultCache(tmp_path), Task(kind="trials", parameters={})
        cache.store(task, pd.DataFrame({"reward": [1.5]}))
        (file,) = (path for path in tmp_path.rglob("*") if path.is_file())
        file.write_bytes(damage or file.read_bytes()[:-9])
        assert cache.load(task) is None

    def test_what_is_of_another_task_is_computed_again(self, tmp_path: Path) -> None:
        cache = ResultCache(tmp_path)
        one, other = (Task(kind="trials", parameters={"a": (n, 2.5)}) for n in (1, 2))
        for task in (one, other):
            cache.store(task, pd.DataFrame({"a": [task.parameters["a"][0]]}))
        first, second = (cache._path_of(task) for task in (one, other))
        first.write_bytes(second.read_bytes())
        assert cache.load(one) is None
        loaded = cache.load(other)
        assert loaded is not None
        assert loaded["a"].tolist() == [2]

    def test_what_cannot_be_kept_says_where(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(OutputError, match="file"):
            ResultCache(tmp_path / "file").store(
                Task(kind="trials", parameters={}), pd.DataFrame({})
            )


class TestLocalExecutor:
    def computed(self, executor: LocalExecutor, num_tasks: int = 4) -> list[pd.DataFrame]:
        wanted = list(trial_tasks(series(num_trials=2 * num_tasks), 2))
        found: dict[str, pd.DataFrame] = {}
        executor.run(wanted, lambda task, table: found.update({task_key(task): table}))
        return [found[task_key(task)] for task in wanted]

    def test_processes_change_nothing(self) -> None:
        assert outcome(self.computed(LocalExecutor(2))) == outcome(self.computed(LocalExecutor(1)))
        assert multiprocessing.active_children() == []

    def test_a_killed_process_is_told_of(self) -> None:
        wanted = list(trial_tasks(series(num_trials=2), 1))
        ended = threading.Event()

        def kill_all() -> None:
            while not ended.wait(0.02):
                for child in worker_processes():
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(child, signal.SIGKILL)

        killer = threading.Thread(target=kill_all)
        killer.start()
        try:
            with pytest.raises(TaskError, match=r"a process was killed by SIGKILL with trials "):
                LocalExecutor(2).run(wanted, lambda *_: None)
        finally:
            ended.set()
            killer.join()
        assert worker_processes() == []

    def test_an_error_ends_it_and_its_processes(self) -> None:
        wrong = Task(kind="trials", parameters={"first_trial": 0, "problem": "nothing"})
        with pytest.raises(Exception, match="nothing"):
            LocalExecutor(2).run([wrong, wrong, wrong], lambda *_: None)
        assert multiprocessing.active_children() == []

    @pytest.mark.parametrize("count", [0, -1, 100_000])
    def test_bounds(self, count: int) -> None:
        with pytest.raises(InvalidValueError, match=f"--jobs {count}: must be from 1 to"):
            LocalExecutor(count)


class OneSeries(Study):
    """A study of seven trials."""

    name = "one_series"
    title = "Seven trials"

    def parts(self, scale: Scale) -> list[Part]:
        return [Part({"way": "ours"}, list(trial_tasks(series(seed=scale.seed), 3)), self.name)]

    def report_of(self, tables: Mapping[str, pd.DataFrame]) -> Report:
        mean = float(tables[self.name]["reward"].mean())
        return Report(
            summary={"means": pd.DataFrame({"reward": [mean]})},
            numbers=[Number("mean reward", Interval(mean, mean, mean), n=7)],
        )


class TestWorkload:
    def test_what_is_known_is_not_computed_again(self, tmp_path: Path) -> None:
        study, scale = OneSeries(), Scale(seed=4)
        first = Workload([study], scale, tmp_path)
        assert (first.units, first.finished_units, len(first.pending)) == (7, 0, 3)

        class GivenUpError(Exception):
            pass

        def give_up(finished: int) -> None:
            if finished >= 6:
                raise GivenUpError

        with pytest.raises(GivenUpError):
            compute(first, LocalExecutor(1), give_up)
        second = Workload([study], scale, tmp_path)
        assert (second.finished_units, len(second.pending)) == (6, 1)
        compute(second, LocalExecutor(1), lambda _: None)
        third = Workload([study, study], scale, tmp_path)
        assert third.pending == []
        assert third.units == 7, "what two studies need is computed once"
        rows = study.report(scale, third.result_of).raw["one_series"]
        assert rows["way"].tolist() == ["ours"] * 7
        assert outcome([rows.drop(columns="way")]) == outcome(
            [run_task(next(trial_tasks(series(), 100)))]
        )

    def test_what_is_written(self, tmp_path: Path) -> None:
        study, scale = OneSeries(), Scale(seed=4)
        workload = Workload([study], scale, tmp_path)
        compute(workload, LocalExecutor(1), lambda _: None)
        report = study.report(scale, workload.result_of)
        names = write_report(study, scale, report, tmp_path / "one_series")
        assert names == ["means.csv", "numbers.csv", "one_series_trials.csv", "origin.json"]
        origin = msgspec.json.decode((tmp_path / "one_series" / "origin.json").read_bytes())
        assert (origin["seed"], origin["quick"]) == (4, False)
        mean = report.summary["means"]["reward"].iloc[0]
        lines = (tmp_path / "one_series" / "numbers.csv").read_text().splitlines()
        assert lines == [
            "name,value,value_low,value_high,unit,n",
            f"mean reward,{mean},{mean},{mean},,7",
        ]
        assert "processor" in origin["machine"]

    def test_what_was_computed_by_edited_code_is_not_kept(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        workload = Workload([OneSeries()], Scale(seed=4), tmp_path)
        monkeypatch.setattr(tasks, "code_of", lambda _: "edited")
        with pytest.raises(TaskError, match="'trials' was edited while they were computed"):
            compute(workload, LocalExecutor(1), lambda _: None)
        assert not list(tmp_path.rglob("*.table"))

    @pytest.mark.skipif(not Path("/proc/self").exists(), reason="nothing can be made in /proc")
    def test_where_nothing_can_be_kept_nothing_is_computed(self) -> None:
        with pytest.raises(OutputError, match="/proc/results: cannot be written in: No such"):
            Workload([OneSeries()], Scale(), Path("/proc/results"))


def test_missing_packages_are_told_of_first(monkeypatch: pytest.MonkeyPatch) -> None:
    assert studies_of(["selectors"])
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(HoldfastError, match=r"need scipy, pandas, .*; make install"):
        studies_of(["selectors"])


def test_exclusive_tasks_come_last_and_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[tuple[int, str]] = []

    class Noting:
        description = "somewhere else"

        def run(
            self, some: Sequence[Task], on_result: Callable[[Task, pd.DataFrame], None]
        ) -> None:
            for task in some:
                ran.append((int(task.parameters["a"]), "there"))
                on_result(task, pd.DataFrame({}))

    class Both(OneSeries):
        def parts(self, scale: Scale) -> list[Part]:
            tasks = [
                Task(kind="trials", parameters={"a": number}, exclusive=number == 0)
                for number in range(3)
            ]
            return [Part({}, tasks)]

    def run_here(task: Task) -> pd.DataFrame:
        ran.append((int(task.parameters["a"]), "here"))
        return pd.DataFrame({})

    monkeypatch.setattr(executors, "run_task", run_here)
    compute(Workload([Both()], Scale(), tmp_path), Noting(), lambda _: None)
    assert ran == [(1, "there"), (2, "there"), (0, "here")]
