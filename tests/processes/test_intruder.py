"""Whoever may ask a service cannot steer the robots that it decides for.

An intruder with the certificate of a stolen robot says in every mode that it is the service, and
has a wrong answer ready at once (``tests/intruder.py``). Nothing reaches it, and the run is the
same as undisturbed, bit for bit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.intruder import MODES, Intruder
from tests.processes.faults import References, Site, Story, document_of
from tests.processes.test_tls import secure

from holdfast.session.messages import (
    MessageError,
    Refused,
    Request,
    TaskAnswer,
    decode_request,
    encode,
    numbers_to,
)
from holdfast.transport.endpoints import TlsFiles

DOCUMENT = document_of("peg_in_hole_2d")
INTERVAL = DOCUMENT["simulator"]["sensing_intervals"] + 1
ACTION_SIZE = 3


def wrong_actions(request: Request) -> bytes:
    """Return moves that are nearly eighty times as long as the problem's longest."""
    count = INTERVAL - request.step % INTERVAL
    return encode(TaskAnswer(request.number, count, numbers_to([7.77] * (ACTION_SIZE * count)), 1))


def stale_epoch(request: Request) -> bytes:
    """Return what stops a robot: that another process has taken its run over."""
    return encode(Refused(request.number, "stale_epoch", "epoch 1: epoch 2 is there"))


def forging(forge: Callable[[Request], bytes]) -> Callable[[bytes], bytes]:
    def answer(payload: bytes) -> bytes:
        try:
            return forge(decode_request(payload))
        except MessageError:
            return b""  # the other intruders' questions

    return answer


@pytest.mark.parametrize("forge", [wrong_actions, stale_epoch])
@pytest.mark.parametrize("protocol", ["tcp", "tls", "quic"])
def test_an_intruder_changes_nothing(
    protocol: str,
    forge: Callable[[Request], bytes],
    keys: Path,
    site: Site,
    references: References,
) -> None:
    stolen: TlsFiles | None = None
    options: tuple[str, ...] = ()
    if protocol == "tcp":
        cloud = site.service().start()
    else:
        cloud = secure(site, keys, protocol).start()
        robot_keys = keys / "ours" / "robot"
        options = ("--tls", str(robot_keys))
        stolen = TlsFiles(
            *(robot_keys / name for name in ("authority.pem", "certificate.pem", "key.pem"))
        )
    story = Story(site, references, DOCUMENT)
    with contextlib.ExitStack() as stack:

        def come() -> list[Intruder]:
            return [
                stack.enter_context(Intruder(cloud.endpoint, mode, forging(forge), tls=stolen))
                for mode in MODES
            ]

        intruders = come()
        # Others come when the robot is there already.
        story.at("perform", 20, lambda: intruders.extend(come()))
        robot = story.run(cloud, options=options)
        assert [intruder.received for intruder in intruders] == [[]] * 6
    assert robot.statuses() == []
    assert len(robot.matching("service_appeared", service=cloud.endpoint)) == 1
    assert not robot.matching("disagreement")
