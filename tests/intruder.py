"""A client of an honest service that would like to be the service.

It has what a stolen robot has: the service's address and, where there are any, a robot's
certificate. All else it learns from the service, as every robot does. It speaks plain Zenoh, in
whichever mode, so nothing of holdfast's own ends keeps it from saying what it likes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from typing import Literal, Self, TypeAlias, TypeVar

import zenoh

from holdfast.runtime.transport.zenoh_transport import KEY_VERSION
from holdfast.transport.endpoints import TlsFiles

Mode: TypeAlias = Literal["client", "peer", "router"]

MODES: tuple[Mode, ...] = ("client", "peer", "router")

FORGED_BOOT = "forged"
"""A service that nobody is."""

_PREFIX = f"holdfast/{KEY_VERSION}"
_PATIENCE_S = 30.0

Answer = TypeVar("Answer")


class Intruder:
    """Says that it is the service, and notes what it is told.

    Once it is made, all that it says has reached the service: it has asked the service after that,
    on the same link.

    Parameters
    ----------
    endpoint : str
        The service's.
    mode : {"client", "peer", "router"}
        As what it connects.
    answer : callable
        Makes the forged reply to a request.
    tls : TlsFiles or None
        Its certificate.

    Attributes
    ----------
    boots : list of tuple of str
        Names and boots of the services that it has seen.
    received : list of bytes
        Requests that were not meant for it.
    overheard : list of str
        Keys of what others published.
    """

    def __init__(
        self,
        endpoint: str,
        mode: Mode,
        answer: Callable[[bytes], bytes] = bytes,
        *,
        tls: TlsFiles | None = None,
    ) -> None:
        self._answer = answer
        self.received: list[bytes] = []
        self.overheard: list[str] = []
        self.session = open_session(endpoint, mode, tls=tls)
        try:
            self.boots = self._look()
            self._pretend()
            self._wait_until_heard()
        except BaseException:
            self.session.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def _look(self) -> list[tuple[str, str]]:
        """Learn the service's name and boot, as robots do."""

        def look() -> list[list[str]]:
            replies = self.session.liveliness().get(f"{_PREFIX}/*/*/alive", timeout=_PATIENCE_S)
            return [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]

        return [(key[2], key[3]) for key in _in_time(look)]

    def _pretend(self) -> None:
        liveliness = self.session.liveliness()
        self._declared: list[object] = []
        for name, boot in (*self.boots, *((name, FORGED_BOOT) for name, _ in self.boots)):
            prefix = f"{_PREFIX}/{name}/{boot}"
            self._declared += [
                self._queryable(f"{prefix}/decide"),
                liveliness.declare_token(f"{prefix}/alive"),
            ]
        self._declared += [
            self._queryable(f"{_PREFIX}/**"),
            self._queryable("**"),
            self.session.declare_subscriber(
                "**",
                zenoh.handlers.Callback(self._overhear, indirect=False),
                allowed_origin=zenoh.Locality.REMOTE,
            ),
        ]

    def _queryable(self, key: str) -> object:
        return self.session.declare_queryable(
            key, zenoh.handlers.Callback(self._take, indirect=False), complete=True
        )

    def _take(self, query: zenoh.Query) -> None:
        with query:
            payload = b"" if query.payload is None else query.payload.to_bytes()
            self.received.append(payload)
            query.reply(query.key_expr, self._answer(payload))

    def _overhear(self, sample: zenoh.Sample) -> None:
        self.overheard.append(str(sample.key_expr))

    def ask(self, key: str) -> list[bytes]:
        """Return what others than the intruder itself reply to a question."""
        replies = self.session.get(
            key,
            payload=b"question",
            target=zenoh.QueryTarget.ALL,
            allowed_destination=zenoh.Locality.REMOTE,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=_PATIENCE_S,
        )
        return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

    def _wait_until_heard(self) -> None:
        """Ask the service, and have it answer: what was said before has arrived."""
        for name, boot in self.boots:
            # It may be seen a moment before it can be asked.
            _in_time(partial(self.ask, f"{_PREFIX}/{name}/{boot}/decide"))
        self.received.clear()


def _in_time(ask: Callable[[], list[Answer]]) -> list[Answer]:
    """Ask until there is an answer."""
    deadline_s = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline_s:
        if answers := ask():
            return answers
        time.sleep(0.02)
    raise AssertionError("the intruder was not let in, so this shows nothing")


def open_session(endpoint: str, mode: Mode, *, tls: TlsFiles | None = None) -> zenoh.Session:
    """Open a plain session that is connected to one endpoint."""
    settings: dict[str, object] = {
        "mode": mode,
        "scouting": {"multicast": {"enabled": False}},
        "listen": {"endpoints": []},
        "connect": {"endpoints": [endpoint]},
    }
    if tls is not None:
        settings["transport"] = {
            "link": {
                "tls": {
                    "root_ca_certificate": str(tls.authority),
                    "connect_private_key": str(tls.key),
                    "connect_certificate": str(tls.certificate),
                    "enable_mtls": True,
                }
            }
        }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
