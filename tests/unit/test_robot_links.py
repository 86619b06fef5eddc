"""From a configuration to a robot's links."""

from pathlib import Path
from typing import Any

import pytest
from tests.unit.test_runtime_events import RecordingSink

from holdfast.config.loader import Configuration, load
from holdfast.errors import HoldfastError, TransportError
from holdfast.robot.links import RECOVERY_SERVICE, check_services, make_links
from holdfast.robot.memo_cache import MemoizingPlanner
from holdfast.runtime.events import BoundedEventLog

EXAMPLE = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"


def configuration(**changes: Any) -> Configuration:
    return load(EXAMPLE, overrides=changes)


def test_without_services_the_planner_is_in_process() -> None:
    links = make_links(configuration(), None, BoundedEventLog())
    assert (links.transport, links.launcher) == (None, None)
    problem = configuration().problem
    first, second = (links.make_planner(problem, configuration().planning) for _ in range(2))
    assert isinstance(first, MemoizingPlanner)
    assert first.init(3, 0) is second.init(3, 0)


def test_with_services_there_is_a_local_one_unless_it_is_never_launched() -> None:
    changes = {"offload.services": ["tcp/127.0.0.1:7600"]}
    links = make_links(configuration(**changes), None, BoundedEventLog())
    assert links.launcher is not None
    assert RECOVERY_SERVICE in links.launcher._command
    never = make_links(
        configuration(**changes, **{"recovery.launch": "never"}), None, BoundedEventLog()
    )
    assert never.launcher is None


def test_a_link_without_encryption_to_another_machine_is_reported() -> None:
    events = RecordingSink()
    make_links(configuration(**{"offload.services": ["tcp/192.0.2.1:7600"]}), None, events)
    assert [name for name, _ in events.events] == ["insecure"]


def test_a_service_that_cannot_be_used_is_refused_with_its_key() -> None:
    settings = configuration(**{"offload.services": ["tcp/127.0.0.1:7600", "nonsense"]})
    with pytest.raises(TransportError, match=r"robot.yaml: offload.services\[1\]"):
        check_services(settings, "robot.yaml: ")
    with pytest.raises(HoldfastError):
        make_links(settings, None, BoundedEventLog())
    check_services(configuration())
