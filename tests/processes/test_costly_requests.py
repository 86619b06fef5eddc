"""A service whose robots ask for what is costly: it lives, and others get their decisions."""

from __future__ import annotations

import pytest
from tests.fuzz.costly import attack, costly_requests
from tests.processes.faults import Site

from holdfast.protocol.messages import decode_request

_SECONDS = 8.0

_STANDSTILL_S = 5.0
"""No robot waits so long on the busiest machine, unless it stands still: it was 25 s and more."""


def test_the_same_seed_asks_the_same() -> None:
    one, same = (costly_requests(3) for _ in range(2))
    requests = [next(one) for _ in range(30)]
    assert requests == [next(same) for _ in range(30)]
    methods = set()
    for payload in requests:
        configuration = decode_request(payload).session_configuration
        assert configuration is not None
        methods.add(configuration.planning.selector.method)
    assert len(methods) >= 4


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_costly_requests_stop_nobody(site: Site, workers: int) -> None:
    service = site.service("--workers", str(workers)).start()
    outcome = attack(service.endpoint, _SECONDS)
    assert outcome.turns > 10
    assert outcome.longest_s < _STANDSTILL_S
    assert outcome.counts["Refused"] > 0
    assert service.process.process.poll() is None
