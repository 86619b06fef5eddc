"""A service that comes and goes many times a second cannot fill a robot's log."""

from __future__ import annotations

import collections
import contextlib
import datetime as dt
import socket
import threading

from tests.ports import free_port
from tests.processes import faults

from holdfast.protocol.messages import with_checksum
from holdfast.transport.frames import CALL, LAST, FrameDecoder, encode_frame, encode_hello

FLAPS = 80
BURST = 20


class HostileService:
    """Answers everything with rubbish, and lets links end as soon as they are there."""

    def __init__(self, endpoint: str) -> None:
        host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
        self._listener = socket.create_server((host, int(port)))
        self._links = 0
        self._flaps = threading.Event()
        self._link: socket.socket | None = None
        self._changed = threading.Condition()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                link, _ = self._listener.accept()
                with self._changed:
                    self._links += 1
                    self._link = link
                    self._changed.notify_all()
                link.sendall(encode_hello("service", "cloud", f"b{self._links % 50}", 60_000.0))
                if self._flaps.is_set():
                    link.close()
                else:
                    threading.Thread(target=self._answer, args=(link,), daemon=True).start()

    def _answer(self, link: socket.socket) -> None:
        decoder = FrameDecoder(1 << 26)
        with link, contextlib.suppress(OSError):
            while data := link.recv(65536):
                for frame in decoder.feed(data):
                    if frame.kind == CALL:
                        link.sendall(encode_frame(LAST, frame.call, with_checksum(b"rubbish")))

    def flap(self) -> None:
        """End the link, and as many that the robot opens after it."""
        with self._changed:
            assert self._link is not None
            self._flaps.set()
            enough = self._links + FLAPS
            self._link.shutdown(socket.SHUT_RDWR)
            assert self._changed.wait_for(lambda: self._links >= enough, faults.PATIENCE_S)
            self._flaps.clear()

    def close(self) -> None:
        self._listener.close()


def test_it_cannot_fill_the_log(site: faults.Site, references: faults.References) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    service = HostileService(endpoint)
    try:
        story = faults.Story(
            site, references, faults.document_of("peg_in_hole_2d"), offload=faults.QUICK
        )
        story.at("perform", 20, story.status(faults.LOCAL_RECOVERY), service.flap)
        robot = story.run(endpoint)
    finally:
        service.close()
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
        assert len(told[name]) + omitted[name] >= FLAPS
