"""Where a service's datagrams go: to an address that has proved that it receives them.

Anybody can write any source address on a datagram, a robot with a certificate as well. So a new
address gets nothing but *probes* with a secret, and the answers go on to the old address until the
secret has come back from the new one (as in QUIC: RFC 9000, section 8.2). An attacker beside the
path can copy a robot's datagram, send it from an address of its own, and carry the probe to the
robot. So the old address is probed as well: a robot that is still reached there stays there
(section 9.3.3). ``docs/datagrams.md`` has the rules. Nothing here knows sockets, keys or clocks.
"""

from __future__ import annotations

import os
from typing import Any, Final, NamedTuple

SECRET_BYTES: Final = 8

_PROBE_INTERVAL_S: Final = 0.002
"""Between probes: a robot that writes a foreign address has at most 500 a second sent there."""

_REVERT_S: Final = 1.0
"""For so long after a change the old address may still show that it reaches the robot."""


class Probe(NamedTuple):
    """What is sent to an address, and comes back if the robot is there."""

    address: Any
    secret: bytes


class ReturnPath:
    """The address to which one link's datagrams go; ``address`` is None until one is proved."""

    def __init__(self) -> None:
        self._current: Probe | None = None
        self._previous: Probe | None = None
        self._candidate: Probe | None = None
        self._changed_at = self._probed_at = float("-inf")

    @property
    def address(self) -> Any:
        """The address that was proved last."""
        return None if self._current is None else self._current.address

    def heard(self, address: Any, now: float, *, newest: bool) -> tuple[Probe, ...]:
        """Take note of an authentic datagram that is no echo; return the probes to send.

        ``newest`` says whether its counter is the highest so far: one that was held back must not
        begin a change.
        """
        if address == self.address:
            return ()
        if self._candidate is None or self._candidate.address != address:
            if not newest:
                return ()
            self._candidate = Probe(address, os.urandom(SECRET_BYTES))
            if self._current is not None:
                self._current = Probe(self.address, os.urandom(SECRET_BYTES))
        if now < self._probed_at + _PROBE_INTERVAL_S:
            return ()
        self._probed_at = now
        return (self._candidate,) if self._current is None else (self._candidate, self._current)

    def echoed(self, secret: bytes, address: Any, now: float) -> None:
        """Take note of a secret that the robot has sent back."""
        if (address, secret) == self._candidate:
            self._previous, self._current = self._current, self._candidate
            self._candidate = None
            self._changed_at = now
        elif self._current is not None and secret == self._current.secret:
            self._candidate = None
        elif (
            self._previous is not None
            and secret == self._previous.secret
            and now < self._changed_at + _REVERT_S
        ):
            # Whatever address the echo comes from, the old one still reaches the robot.
            self._current, self._previous = self._previous, None
