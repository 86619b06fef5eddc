"""Limits of a service."""

from __future__ import annotations

import pytest

from holdfast.protocol.messages import MAX_OBSERVATIONS
from holdfast.protocol.service_limits import ServiceLimits


def test_a_request_of_the_largest_size_is_within_the_limits() -> None:
    limits = ServiceLimits()
    assert limits.max_steps >= MAX_OBSERVATIONS
    assert 2 * limits.max_waiting_per_robot <= limits.max_waiting
    with pytest.raises(AttributeError):
        limits.max_steps = 0  # type: ignore[misc]
