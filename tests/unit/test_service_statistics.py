"""What a service counts."""

from __future__ import annotations

from holdfast.protocol.service_statistics import ServiceStatistics


def test_each_service_counts_its_own_refusals() -> None:
    first, second = ServiceStatistics(), ServiceStatistics()
    first.refusals["invalid"] = 1
    assert second.refusals == {}
