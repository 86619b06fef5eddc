"""A region dies and comes back, in virtual time: benchmarks/region_world.py says what is simulated.

Each decision is compared with the undisturbed one as it is performed.
"""

import msgspec
import pytest
from _pytest.mark import ParameterSet
from benchmarks.region_world import Scenario, broken_promises, make_setup, scenarios, simulate

from holdfast.transport import dialer

_SMALL = Scenario(robots=120, processes=3, act_s=0.25, down_s=3.0, after_s=6.0)
_LARGE = Scenario(robots=10_000, processes=10, act_s=1.0, down_s=10.0, after_s=18.0)
_QUICK = ("silently, all at once", "it is busy for five seconds", "robots in phase")


def _named(base: Scenario) -> list[ParameterSet]:
    return [pytest.param(each, id=name) for name, each in scenarios(base)]


@pytest.mark.parametrize("scenario", [each for each in _named(_SMALL) if each.id in _QUICK])
def test_120_robots(scenario: Scenario) -> None:
    assert broken_promises(scenario, simulate(scenario, make_setup())) == []


@pytest.mark.slow
@pytest.mark.parametrize("scenario", [*_named(_SMALL), *_named(_LARGE)])
def test_10_000_robots(scenario: Scenario) -> None:
    assert broken_promises(scenario, simulate(scenario, make_setup())) == []


def test_without_jitter_all_would_come_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dialer, "_JITTER", 0.0)
    together = msgspec.structs.replace(_SMALL, robots=50, in_phase=True)
    outcome = simulate(together, make_setup())
    assert broken_promises(together, outcome) == ["connections in 10 ms: 50.000 > 25.654"]
