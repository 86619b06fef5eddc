"""Tasks on a real Ray cluster: a head and two workers, of which a process is killed.

Whoever joins it does so in a process of its own, since Ray's client joins only once in each.
"""

from __future__ import annotations

import multiprocessing
import os
import secrets
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from time import monotonic, sleep
from typing import ParamSpec, TypeVar

import pandas as pd
import pytest

from holdfast.errors import HoldfastError, InvalidValueError
from holdfast_lab.testbed.processes import free_port
from studies import ray_executor
from studies.executors import LocalExecutor
from studies.ray_executor import RayExecutor
from studies.tasks import Task, code_of, task_key
from studies.tests.ray_cluster import RayCluster
from studies.trial_batches import TrialSeries, trial_tasks

P = ParamSpec("P")
R = TypeVar("R")

PATIENCE_S = 180.0

Outcome = dict[str, list[list[object]]]


def with_ray(test: Callable[P, R]) -> Callable[P, R]:
    """Mark a test that needs Ray; it takes half a minute."""
    absent = find_spec("ray") is None
    skip = pytest.mark.skipif(absent, reason="Ray is not installed: pip install 'ray[client]'")
    return pytest.mark.slow(skip(test))


@pytest.fixture(scope="module")
def cluster() -> Iterator[RayCluster]:
    with pytest.MonkeyPatch.context() as patch:
        # Whoever reaches a cluster can run code on it, and its ports are open to the network.
        patch.setenv("RAY_AUTH_MODE", "token")
        patch.setenv("RAY_AUTH_TOKEN", secrets.token_hex())
        with RayCluster(2) as started:
            yield started


@contextmanager
def alone(function: Callable[P, R], *arguments: P.args, **named: P.kwargs) -> Iterator[Future[R]]:
    """Call a function in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        yield pool.submit(function, *arguments, **named)


def tasks() -> list[Task]:
    series = TrialSeries(problem="peg_in_hole_2d", max_steps=100, seed=4, num_trials=60)
    return list(trial_tasks(series, 3))


def collected(executor: LocalExecutor | RayExecutor) -> Outcome:
    """Compute the tasks; return what does not depend on the time that it took."""
    found: Outcome = {}

    def keep(task: Task, table: pd.DataFrame) -> None:
        known = table.drop(columns="mean_sensing_ms").astype(object)
        known = known.where(known.notna(), None)
        found[task_key(task)] = [known[name].tolist() for name in known.columns]

    executor.run(tasks(), keep)
    return found


def on_cluster(address: str | None) -> Outcome:
    return collected(RayExecutor(address))


def refusal(address: str | None, wanted: list[Task], code: str | None) -> str:
    """Return why tasks cannot be computed; if ``code`` is given, as if that were ours."""
    if code is not None:
        setattr(ray_executor, "code_of", lambda _: code)  # noqa: B010
    try:
        RayExecutor(address).run(wanted, lambda *_: None)
    except HoldfastError as error:
        return f"{type(error).__name__}: {error}"
    return ""


@pytest.fixture(scope="module")
def here() -> Outcome:
    return collected(LocalExecutor(2))


def wait_until_busy(cluster: RayCluster, count: int = 1) -> list[int]:
    began = monotonic()
    while len(busy := cluster.busy()) < count:
        assert monotonic() < began + PATIENCE_S
        sleep(0.02)
    return busy


@with_ray
def test_a_killed_process_changes_nothing(cluster: RayCluster, here: Outcome) -> None:
    with alone(on_cluster, cluster.address) as outcome:
        killed = wait_until_busy(cluster, 2)[0]
        os.kill(killed, signal.SIGKILL)
        assert outcome.result(PATIENCE_S) == here
    assert len(here) == len(tasks())


@with_ray
def test_the_cluster_of_this_machine(
    cluster: RayCluster, here: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", cluster.native_address)
    with alone(on_cluster, None) as outcome:
        assert outcome.result(PATIENCE_S) == here


@with_ray
def test_what_a_task_is_refused_for_comes_back(cluster: RayCluster) -> None:
    unknown = Task(kind="trials", parameters={**tasks()[0].parameters, "problem": "nothing"})
    with pytest.raises(HoldfastError) as here:
        LocalExecutor(1).run([unknown], lambda *_: None)
    with alone(refusal, cluster.address, [unknown], None) as told:
        assert told.result(PATIENCE_S) == f"TaskError: {here.value}"


@with_ray
def test_other_code_is_refused(cluster: RayCluster) -> None:
    with alone(refusal, cluster.address, tasks()[:1], "0123") as told:
        text = told.result(PATIENCE_S)
    own = code_of(tasks()[0])
    assert f"has other code for tasks of the kind 'trials' (digest {own}, of holdfast" in text
    assert "than the one that asks (digest 0123)" in text


@with_ray
@pytest.mark.parametrize("how", ["client", "environment", "file"])
def test_no_cluster(how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    address = f"127.0.0.1:{free_port()}"
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    if how == "environment":
        monkeypatch.setenv("RAY_ADDRESS", address)
    elif how == "file":
        monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
        (tmp_path / "ray").mkdir()
        (tmp_path / "ray" / "ray_current_cluster").write_text(address)
    with alone(refusal, f"ray://{address}" if how == "client" else None, tasks(), None) as told:
        text = told.result(PATIENCE_S)
    assert text.startswith("HoldfastError: no Ray cluster can be joined at ")
    assert address in text
    assert "Connection refused" in text
    assert ("ray start --head" in text) == (how != "client")


def test_without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(HoldfastError, match=r"needs Ray.*: pip install 'ray\[client\]'"):
        RayExecutor(None).run(tasks(), lambda *_: None)
    # Where nothing is to be computed, nothing is needed.
    RayExecutor(None).run([], lambda *_: None)


@pytest.mark.parametrize(
    ("place", "where"),
    [
        ("ray", "this machine"),
        ("ray://planner.example:10001", "planner.example:10001"),
        ("ray://127.0.0.1:1", "127.0.0.1:1"),
        ("ray://[::1]:65535", "[::1]:65535"),
    ],
)
def test_places(place: str, where: str) -> None:
    assert RayExecutor.of(place).description == f"the Ray cluster at {where}"


@pytest.mark.parametrize(
    "place",
    [
        *("", "slurm", "Ray", "rays", "ray:", "ray:/", "ray://", "ray://host", "ray://host:"),
        *("ray://:10001", "ray://host:0", "ray://host:65536", "ray://host:1e3", "ray://ho st:1"),
        *("ray://host:10001/", "ray://user@host:10001", "ray://::1:10001", "ray://host:10001\n"),
    ],
)
def test_places_that_there_are_not(place: str) -> None:
    with pytest.raises(InvalidValueError) as caught:
        RayExecutor.of(place)
    assert str(caught.value).startswith(f"--executor {place}: must be local, ray (")
    assert "ray://HOST:PORT" in str(caught.value)
