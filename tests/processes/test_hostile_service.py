"""A service that comes and goes a thousand times a second cannot fill a robot's log."""

from __future__ import annotations

import collections
import datetime as dt
import json

import zenoh
from tests.ports import free_port
from tests.processes.faults import (
    LOCAL_RECOVERY,
    LOST,
    QUICK,
    References,
    Site,
    Story,
    document_of,
    events_of,
)

from holdfast.runtime.transport.zenoh_transport import KEY_VERSION
from holdfast.session.messages import sealed

FLAPS = 3000
BURST = 20


class HostileService:
    """Answers everything with rubbish, and says again and again that it is there and gone."""

    def __init__(self, endpoint: str) -> None:
        settings = {
            "mode": "peer",
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "listen": {"endpoints": [endpoint]},
        }
        self.session = zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
        self._prefix = f"holdfast/{KEY_VERSION}/cloud"
        self._queryable = self.session.declare_queryable(
            f"{self._prefix}/*/decide", zenoh.handlers.Callback(self._answer, indirect=False)
        )
        # While one stays, the robot keeps the link.
        self._stays = self.session.liveliness().declare_token(f"{self._prefix}/stays/alive")

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, sealed(b"rubbish"))

    def flap(self) -> None:
        for number in range(FLAPS):
            boot = f"{self._prefix}/b{number % 50}"
            self.session.liveliness().declare_token(f"{boot}/alive").undeclare()


def test_it_cannot_fill_the_log(site: Site, references: References) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    service = HostileService(endpoint)
    try:
        story = Story(site, references, document_of("peg_in_hole_2d"), offload=QUICK)
        story.at("perform", 20, story.status(LOCAL_RECOVERY), service.flap)
        robot = story.run(endpoint)
    finally:
        service.session.close()
    assert robot.statuses() == [LOST]
    told: dict[str, list[float]] = collections.defaultdict(list)
    omitted: collections.Counter[str] = collections.Counter()
    for event in events_of(robot.out):
        if event.get("service") == endpoint:
            moment = dt.datetime.fromisoformat(event["time"])
            told[event["event"]].append(moment.timestamp())
            omitted[event["event"]] += event.get("similar_lines_omitted", 0)
    for name, moments in told.items():
        assert len(moments) <= BURST + 2 + (moments[-1] - moments[0]), name
    # So many came; what was not told was counted.
    for name in ("service_appeared", "service_vanished"):
        assert len(told[name]) + omitted[name] >= FLAPS
