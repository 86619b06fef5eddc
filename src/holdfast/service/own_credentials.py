"""A service's credentials: read at its start, and again whenever their files have changed.

Who renews a certificate often has no way to send a signal: cert-manager in a cluster changes what
is mounted, and that is all. So the event loop looks at the files every second. It reads them once
they have stayed as they are from one look to the next, since a set that is being copied is none
yet; and if they cannot be used then, nothing changes until they can.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from holdfast.errors import HoldfastError
from holdfast.runtime.logs import EventSink
from holdfast.transport.credentials import date_text, file_versions, read_credentials
from holdfast.transport.endpoints import TlsFiles

if TYPE_CHECKING:
    import asyncio

    from holdfast.transport.service_end import StreamServiceTransport

__all__ = ["ServiceCredentials"]

_LOOK_EVERY_S = 1.0


class ServiceCredentials:
    """The credentials of this process.

    Parameters
    ----------
    directory : Path
    warn : callable
        Takes texts that somebody should read.

    Attributes
    ----------
    files : TlsFiles
    expires_s : float
        When the certificate does that is in use, in seconds since 1970.

    Raises
    ------
    CredentialsError
        If they cannot be used.
    """

    def __init__(self, directory: Path, warn: Callable[[str], None]) -> None:
        self.files = TlsFiles.of(directory)
        self._directory = directory
        self._warn = warn
        self._used = self._seen = file_versions(self.files)
        self._failure: str | None = None
        self.expires_s = read_credentials(directory, "service", warn=warn).expires_s

    def watch(
        self,
        loop: asyncio.AbstractEventLoop,
        transport: StreamServiceTransport,
        events: EventSink,
    ) -> None:
        """Look at the files from now on."""
        seen = file_versions(self.files)
        if seen == self._seen and seen != self._used:
            self.reload(transport, events, asked=False)
        self._seen = seen
        loop.call_later(_LOOK_EVERY_S, self.watch, loop, transport, events)

    def reload(
        self, transport: StreamServiceTransport, events: EventSink, *, asked: bool = True
    ) -> None:
        """Read the files again; if they cannot be used, those of before stay in use.

        Parameters
        ----------
        transport : StreamServiceTransport
        events : EventSink
        asked : bool
            Whether somebody waits for an answer. Else the same failure is told only once.
        """
        read_at = file_versions(self.files)
        warnings: list[str] = []
        try:
            # It knows more of what can be wrong with them than the transport.
            read = read_credentials(self._directory, "service", warn=warnings.append)
            ended = transport.reload_credentials()
        except HoldfastError as error:
            failure = f"{error}; those of before stay in use"
            if asked or failure != self._failure:
                events.event("credentials", reason=failure)
            self._failure = failure
            return
        self._used, self._failure, self.expires_s = read_at, None, read.expires_s
        for text in warnings:
            self._warn(text)
        events.event(
            "credentials_reloaded",
            links_ended=ended,
            valid_until=date_text(read.expires_s),
            num_revoked=transport.num_revoked,
        )
