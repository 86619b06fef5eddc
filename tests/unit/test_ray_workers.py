"""Trials on a real Ray cluster: a head, and a node of one core."""

import csv
import sys
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from tests.processes.faults import holdfast
from tests.ray_node import ray_node
from tests.unit.test_tuning_tune import MEAN, OF_MEAN, RUN, tuned

from holdfast.errors import InvalidValueError
from holdfast.runtime.ray_workers import RayCluster
from holdfast_lab.testbed.processes import free_port

absent = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")


def test_without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(
        InvalidValueError, match=r"Ray cannot be .*pip install 'holdfast-sensing\[ray\]'"
    ):
        RayCluster("auto")


class FakeRay(ModuleType):
    """Ray's part that is used, of which the actors are in this process; the first one is lost."""

    def __init__(self) -> None:
        super().__init__("ray")
        self.calls: list[str] = []

    def init(self, **_: Any) -> None:
        self.calls.append("init")

    def shutdown(self) -> None:
        self.calls.append("shutdown")

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 1.0}

    def get(self, asked: Callable[[], list[bytes]]) -> list[bytes]:
        return asked()

    def kill(self, actor: Any) -> None:
        self.calls.append("kill")

    def remote(self, **_: Any) -> Callable[[type], Any]:
        self.calls.append("actor")
        lost = self.calls.count("actor") == 1

        def answers(runner: Any, message: bytes) -> list[bytes]:
            if lost:
                raise RuntimeError("The node\nhas died.")
            return runner.all_answers(message)  # type: ignore[no-any-return]

        def started(kind: type, threads: int) -> Any:
            runner = kind(threads)
            method = SimpleNamespace(remote=lambda message: partial(answers, runner, message))
            return SimpleNamespace(all_answers=method)

        return lambda kind: SimpleNamespace(remote=lambda threads: started(kind, threads))


def test_a_lost_actor_costs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run.yaml").write_text(RUN)
    here = tuned(tmp_path / "run.yaml")
    fake = FakeRay()
    monkeypatch.setitem(sys.modules, "ray", fake)
    there = tuned(tmp_path / "run.yaml", jobs=None, ray="auto")
    assert there.comparisons == here.comparisons
    assert fake.calls == ["init", "actor", "kill", "actor", "kill", "shutdown"]


@absent
@pytest.mark.slow
def test_it_finds_the_same_and_outlives_its_actors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))  # of what mean.py imports
    (tmp_path / "mean.py").write_text(MEAN)
    (tmp_path / "run.yaml").write_text(OF_MEAN)
    words = ("tune", "run.yaml", "--vary", "particles", "--no-check", "--trials", "20")
    nobody = f"127.0.0.1:{free_port()}"
    said = holdfast(tmp_path, *words, "--ray", nobody)
    assert f"error: no Ray cluster can be used at {nobody}: " in said.stderr
    kept: list[dict[tuple[str, ...], tuple[str, ...]]] = []
    with ray_node(1) as (address, _):
        for place in (("--jobs", "1"), ("--ray", address)):
            (tmp_path / "flag").unlink(missing_ok=True)
            out = f"out{len(kept)}"
            said = holdfast(tmp_path, *words, *place, "--budget", "600s", "--out", out)
            assert said.returncode == 0, said.stderr
            assert "90 particles was left out: it died: its process " in said.stdout
            with (tmp_path / out / "trials.csv").open(newline="") as file:
                rows = [tuple(row.values())[:5] for row in csv.DictReader(file)]
            kept.append({row[:2]: row for row in rows})
    here, there = kept
    common = here.keys() & there.keys()
    assert len(common) > 20
    assert {key: here[key] for key in common} == {key: there[key] for key in common}
