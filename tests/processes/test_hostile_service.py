"""A service that comes and goes many times a second cannot fill a robot's log."""

import collections
import contextlib
import datetime as dt
import socket
import threading
from collections.abc import Callable, Iterator

import pytest
from tests.ports import free_port
from tests.processes import faults
from tests.wire import hello_of

FLAPS = 40
BURST = 20


@pytest.fixture
def flapping() -> Iterator[tuple[str, Callable[[], bool]]]:
    """Return where every link ends as soon as it is there, and whether there were enough."""
    port, links = free_port(), [0]
    with socket.create_server(("127.0.0.1", port)) as listener:

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    link, _ = listener.accept()
                    with link:
                        link.sendall(hello_of("service", "cloud", f"b{links[0]}"))
                    links[0] += 1

        threading.Thread(target=accept, daemon=True).start()
        yield f"tcp/127.0.0.1:{port}", lambda: links[0] >= FLAPS


def test_it_cannot_fill_the_log(
    flapping: tuple[str, Callable[[], bool]], site: faults.Site, references: faults.References
) -> None:
    endpoint, is_enough = flapping
    offload = {"startup_timeout_ms": 100.0}
    story = faults.Story(site, references, faults.document_of("peg_in_hole_2d"), offload=offload)
    story.at("perform", 20, lambda: faults.wait_until(is_enough, "links that end"))
    robot = story.run(endpoint)
    assert robot.statuses() == [faults.LOST]
    told: dict[str, list[float]] = collections.defaultdict(list)
    omitted: collections.Counter[str] = collections.Counter()
    for event in faults.events_of(robot.out):
        if event.get("service") == endpoint:
            moment = dt.datetime.fromisoformat(event["time"])
            told[event["event"]].append(moment.timestamp())
            omitted[event["event"]] += event.get("similar_lines_omitted", 0)
    for name, moments in told.items():
        assert len(moments) <= BURST + 2 + (moments[-1] - moments[0]), name
    # So many came; what was not told was counted.
    for name in ("service_appeared", "service_vanished"):
        assert len(told[name]) + omitted[name] >= FLAPS - 1
