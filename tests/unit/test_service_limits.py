"""Limits of a service, and what it counts."""

from pathlib import Path

import pytest
import yaml

from holdfast.planning.inputs import MAX_INPUTS
from holdfast.protocol.service_limits import ServiceLimits, ServiceStatistics
from holdfast.service import shell


def test_each_service_counts_its_own_refusals() -> None:
    first, second = ServiceStatistics(), ServiceStatistics()
    first.refusals["invalid"] = 1
    assert second.refusals == {}


def test_a_request_of_the_largest_size_is_within_the_limits() -> None:
    limits = ServiceLimits()
    assert limits.max_steps >= MAX_INPUTS
    assert 2 * limits.max_waiting_per_robot <= limits.max_waiting
    with pytest.raises(AttributeError):
        limits.max_steps = 0  # type: ignore[misc]


def test_all_bounds_on_memory_fit_the_manifest() -> None:
    root = Path(__file__).parents[2]
    path = root / "deploy" / "kubernetes" / "base" / "deployment.yaml"
    container = yaml.safe_load(path.read_text())["spec"]["template"]["spec"]["containers"][0]
    (workers,) = (
        int(each.removeprefix("--workers="))
        for each in container["args"]
        if each.startswith("--workers=")
    )
    limits, empty_bytes = ServiceLimits(), 64 << 20
    needed = (
        empty_bytes
        + limits.max_state_bytes
        + limits.max_configuration_bytes
        + limits.max_waiting_bytes
        + shell._MAX_UNDECODED_BYTES
        + limits.max_decision_bytes
        + workers * limits.max_medium_bytes
    )
    assert container["resources"]["limits"]["memory"] == "1Gi"
    assert needed <= 1 << 30
