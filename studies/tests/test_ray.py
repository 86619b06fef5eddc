"""Tasks on a real Ray cluster, of which a process is killed.

Whoever joins it does so in a process of its own, since Ray's client joins only once in each.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from time import monotonic, sleep
from typing import ParamSpec, TypeVar

import pandas as pd
import pytest
from tests.ray_node import PATIENCE_S, ray_node

from holdfast.errors import HoldfastError, InvalidValueError
from holdfast_lab.testbed.processes import free_port
from studies import executors
from studies.executors import LocalExecutor, RayExecutor
from studies.tasks import Task, code_of, task_key
from studies.trial_batches import TrialSeries, trial_tasks

P = ParamSpec("P")
R = TypeVar("R")

Outcome = dict[str, list[list[object]]]


def with_ray(test: Callable[P, R]) -> Callable[P, R]:
    """Mark a test that needs Ray; it takes half a minute."""
    absent = find_spec("ray") is None
    skip = pytest.mark.skipif(absent, reason="Ray is not installed: pip install 'ray[client]'")
    return pytest.mark.slow(skip(test))


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """A node with two cores."""
    with ray_node(2) as (_, client_address):
        yield client_address


def busy(command: bytes) -> list[int]:
    """Return the processes that compute a task of an executor."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if (folder / "cmdline").read_bytes().startswith(command):
                found.append(int(folder.name))
    return found


def tasks() -> list[Task]:
    series = TrialSeries(problem="peg_in_hole_2d", max_steps=100, seed=4, num_trials=60)
    return list(trial_tasks(series, 3))


def collected(place: str) -> Outcome:
    """Compute the tasks; return what does not depend on the time that it took."""
    found: Outcome = {}

    def keep(task: Task, table: pd.DataFrame) -> None:
        known = table.drop(columns="mean_sensing_ms").astype(object)
        known = known.where(known.notna(), None)
        found[task_key(task)] = [known[name].tolist() for name in known.columns]

    (LocalExecutor(1) if place == "local" else RayExecutor(place)).run(tasks(), keep)
    return found


def refusal(place: str, wanted: list[Task], code: str | None = None) -> str:
    """Return why tasks cannot be computed; if ``code`` is given, as if that were ours."""
    if code is not None:
        setattr(executors, "code_of", lambda _: code)  # noqa: B010
    try:
        RayExecutor(place).run(wanted, lambda *_: None)
    except HoldfastError as error:
        return f"{type(error).__name__}: {error}"
    return ""


def alone(function: Callable[P, R], *arguments: P.args, **named: P.kwargs) -> R:
    """Call a function in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments, **named).result(PATIENCE_S)


@with_ray
def test_a_killed_process_changes_nothing(address: str) -> None:
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        outcome = pool.submit(collected, address)
        began = monotonic()
        while not (found := busy(b"ray::compute_encoded")):
            assert monotonic() < began + PATIENCE_S
            sleep(0.02)
        os.kill(found[0], signal.SIGKILL)
        assert outcome.result(PATIENCE_S) == collected("local")


@with_ray
def test_what_a_task_is_refused_for_comes_back(address: str) -> None:
    unknown = Task(kind="trials", parameters={**tasks()[0].parameters, "problem": "nothing"})
    with pytest.raises(HoldfastError) as here:
        LocalExecutor(1).run([unknown], lambda *_: None)
    assert alone(refusal, address, [unknown]) == f"TaskError: {here.value}"


@with_ray
def test_other_code_is_refused(address: str) -> None:
    text = alone(refusal, address, tasks()[:1], "0123")
    own = code_of(tasks()[0])
    assert f"has other code for tasks of the kind 'trials' (digest {own})" in text
    assert "than the one that asks (digest 0123)" in text


@with_ray
def test_no_cluster() -> None:
    text = alone(refusal, f"ray://127.0.0.1:{free_port()}", tasks())
    assert text.startswith("HoldfastError: the Ray cluster at ray://127.0.0.1:")
    assert "cannot be joined: " in text


def test_without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(HoldfastError, match=r"needs Ray.*: pip install 'ray\[client\]'"):
        RayExecutor("ray").run(tasks(), lambda *_: None)
    # Where nothing is to be computed, nothing is needed.
    RayExecutor("ray").run([], lambda *_: None)
    with pytest.raises(InvalidValueError, match="--executor slurm: must be local, ray "):
        RayExecutor("slurm")
