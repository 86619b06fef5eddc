"""Trials on a real Ray cluster: a head, and two nodes of a core each."""

from __future__ import annotations

import secrets
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from holdfast.errors import HoldfastError, InvalidValueError
from holdfast.runtime.ray_workers import RayCluster
from holdfast_lab.testbed.processes import free_port

absent = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")


def test_without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InvalidValueError, match=r"Ray cannot be .*pip install 'holdfast\[ray\]'"):
        RayCluster("auto")


@absent
@pytest.mark.slow
def test_it_finds_the_same_and_outlives_its_actors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # Whoever reaches a cluster can run code on it, and its ports are open to the network.
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex())
    nobody = f"127.0.0.1:{free_port()}"
    with pytest.raises(HoldfastError, match=f"no Ray cluster can be used at {nobody}: "):
        RayCluster(nobody).__enter__()
