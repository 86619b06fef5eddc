"""A service's credentials: read at its start, and again when their files change.

A tool that renews certificates often cannot send a signal: cert-manager in a cluster only changes
mounted files. So the event loop checks the files every second. It reads them when they are the same
in two checks, because a set may be half copied. If credentials cannot be used, the previous ones
stay in use, and revocations since then are not known: the log, a metric and its alert say so. Where
they are gone altogether, no new robot should come.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from holdfast.errors import CredentialsGoneError, HoldfastError
from holdfast.runtime.events import EventSink
from holdfast.transport.credentials import date_text, load_credentials
from holdfast.transport.endpoints import TlsFiles

if TYPE_CHECKING:
    import asyncio

    from holdfast.transport.service_end import StreamServiceTransport

_CHECK_INTERVAL_S = 1.0


class ServiceCredentials:
    """The credentials of this process; ``warn`` takes warnings as text.

    Raises CredentialsError if they cannot be used.
    """

    def __init__(self, directory: Path, warn: Callable[[str], None]) -> None:
        self.files = TlsFiles.of(directory)
        self._directory = directory
        self._warn = warn
        self._used = self._seen = self.files.versions()
        self._failure: str | None = None
        self._gone: str | None = None
        # When the certificate in use expires, in seconds since 1970.
        self.expires_s = load_credentials(directory, "service", warn=warn).expires_s

    @property
    def is_stale(self) -> bool:
        """Whether they could not be read the last time, so that older ones are in use."""
        return self._failure is not None

    def why_gone(self) -> str | None:
        """Return what is missing, unreadable, expired or revoked; None if nothing is."""
        if time.time() >= self.expires_s:
            return f"{self.files.certificate}: has expired"
        return self._gone

    def watch(
        self, loop: asyncio.AbstractEventLoop, transport: StreamServiceTransport, events: EventSink
    ) -> None:
        """Check the files from now on."""
        seen = self.files.versions()
        if seen == self._seen and seen != self._used:
            self.reload(transport, events, requested=False)
        self._seen = seen
        loop.call_later(_CHECK_INTERVAL_S, self.watch, loop, transport, events)

    def reload(
        self, transport: StreamServiceTransport, events: EventSink, *, requested: bool = True
    ) -> None:
        """Read the files again; if they cannot be used, the previous ones stay in use.

        Unless an operator has requested it, a repeated failure is logged only once.
        """
        read_at = self.files.versions()
        warnings: list[str] = []
        try:
            # This check names more faults than the transport's.
            read = load_credentials(self._directory, "service", warn=warnings.append)
            ended = transport.reload_credentials()
        except HoldfastError as error:
            failure = f"{error}; the previous ones stay in use"
            if requested or failure != self._failure:
                events.event("credentials", reason=failure, pid=os.getpid())
            self._failure = failure
            self._gone = str(error) if isinstance(error, CredentialsGoneError) else None
            return
        self._used, self.expires_s = read_at, read.expires_s
        self._failure = self._gone = None
        for text in warnings:
            self._warn(text)
        events.event(
            "credentials_reloaded",
            links_ended=ended,
            valid_until=date_text(read.expires_s),
            num_revoked=transport.num_revoked,
            pid=os.getpid(),
        )
