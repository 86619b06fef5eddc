"""Limits of a service, and what it counts."""

from __future__ import annotations

import pytest

from holdfast.protocol.messages import MAX_INPUTS
from holdfast.protocol.service_limits import ServiceLimits, ServiceStatistics


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
