"""Trials on a real Ray cluster: a head, and a node of one core."""

from __future__ import annotations

import csv
import secrets
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from tests.processes.faults import holdfast
from tests.unit.test_tuning_tune import MEAN, OF_MEAN

from holdfast.errors import InvalidValueError
from holdfast.runtime.ray_workers import RayCluster
from holdfast_lab.testbed.processes import free_port
from studies.tests.ray_cluster import RayCluster as StartedCluster

absent = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")


def test_without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InvalidValueError, match=r"Ray cannot be .*pip install 'holdfast\[ray\]'"):
        RayCluster("auto")


@absent
@pytest.mark.slow
def test_it_finds_the_same_and_outlives_its_actors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Whoever reaches a cluster can run code on it, and its ports are open to the network.
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex())
    (tmp_path / "mean.py").write_text(MEAN)
    (tmp_path / "run.yaml").write_text(OF_MEAN)
    words = ("tune", "run.yaml", "--vary", "particles", "--no-check", "--trials", "20")
    nobody = f"127.0.0.1:{free_port()}"
    said = holdfast(tmp_path, *words, "--ray", nobody)
    assert f"error: no Ray cluster can be used at {nobody}: " in said.stderr
    kept: list[dict[tuple[str, ...], tuple[str, ...]]] = []
    with StartedCluster(1) as cluster:
        for place in (
            ("--jobs", "1"),
            ("--ray", cluster.native_address),
            ("--ray", cluster.address),
        ):
            (tmp_path / "flag").unlink(missing_ok=True)
            out = f"out{len(kept)}"
            said = holdfast(tmp_path, *words, *place, "--budget", "60s", "--out", out)
            assert said.returncode == 0, said.stderr
            assert "90 particles was left out: it died: its process " in said.stdout
            with (tmp_path / out / "trials.csv").open(newline="") as file:
                rows = [tuple(row.values())[:5] for row in csv.DictReader(file)]
            kept.append({row[:2]: row for row in rows})
    for other in kept[1:]:
        common = other.keys() & kept[0].keys()
        assert len(common) > 20
        assert {key: other[key] for key in common} == {key: kept[0][key] for key in common}
