"""A connection to one address of a service, for checks: a robot's own link, and its requests."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import ipaddress
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Final, TypeVar

from holdfast.errors import TransportError
from holdfast.protocol.messages import Progress, Reply, Request, decode_reply, encode
from holdfast.transport.credentials import date_text
from holdfast.transport.endpoints import Endpoint, system_words
from holdfast.transport.frames import CALL, END, LAST, REPLY, Frame, Hello
from holdfast.transport.link_settings import LinkSettings
from holdfast.transport.links import Link, LinkOwner
from holdfast.transport.schemes import load_scheme
from holdfast.transport.tls import TlsStream

__all__ = [
    "CLOSES_AT_TLS",
    "AddressPath",
    "WatchedTls",
    "account_of",
    "certificate_at",
    "in_thread",
    "interface_of",
]

GREETING_S: Final = 3.0
"""For the handshake and the other end's hello."""

_SIOCGIFADDR: Final = 0x8915

CLOSES_AT_TLS: Final = "closes connections at the first bytes of TLS"
_SAYS_NOTHING: Final = f"takes connections and says nothing for {GREETING_S:g} s"

_T = TypeVar("_T")


class WatchedTls(TlsStream):
    """A handshake of which it is remembered how it failed."""

    error: OSError | None = None

    def describe_error(self, error: OSError) -> str:
        """Return what an error means, and remember it."""
        self.error = error
        return super().describe_error(error)

    def hosts(self) -> str:
        """Return the hosts that the other end's certificate names."""
        named: Any = (self._tls.getpeercert() or {}).get("subjectAltName", ())
        return ", ".join(
            str(ipaddress.ip_address(host)) if kind == "IP Address" else str(host)
            for kind, host in named
        )

    def shown(self) -> bytes:
        """Return the other end's certificate."""
        return self._tls.getpeercert(binary_form=True) or b""


class AddressPath(LinkOwner):
    """One address, as far as it was followed: the owner of its link."""

    def __init__(self, family: socket.AddressFamily, address: Any, text: str) -> None:
        self.family = family
        self.address = address
        self.text = text
        self.stream: socket.socket | None = None
        self.tls: WatchedTls | None = None
        self.link: Link | None = None
        self.clock_ahead_s: float | None = None
        self._settled: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._calls: dict[int, asyncio.Queue[bytes | None]] = {}

    async def greet(
        self, settings: LinkSettings, endpoint: Endpoint, tls: WatchedTls | None
    ) -> None:
        """Make a link, and wait until the service has said who it is, or the link has ended."""
        assert self.stream is not None
        self.tls = tls
        scheme = load_scheme(endpoint.protocol)
        self.link = scheme.make_link(self, settings, endpoint, tls, role="robot", dialled=True)
        await self.link.connect(self.stream)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(GREETING_S):
                await asyncio.shield(self._settled)

    @property
    def is_greeted(self) -> bool:
        """Whether the service has said who it is, and the link stands."""
        return self.link is not None and self.link.hello is not None and not self.link.ended

    @property
    def why_not(self) -> str:
        """Why no hello has come, as the rest of a sentence about the service."""
        assert self.link is not None
        if not self.link.ended:
            return _SAYS_NOTHING
        return self.link.reason

    async def ask(self, request: Request, limit_s: float) -> list[Reply]:
        """Return all replies but progress reports.

        Raises
        ------
        TimeoutError
        HoldfastError
            If the link ends, or what comes is no reply.
        """
        assert self.link is not None
        queue: asyncio.Queue[bytes | None] = asyncio.Queue()
        self._calls[request.number] = queue
        replies: list[Reply] = []
        async with asyncio.timeout(limit_s):
            self.link.send_message(CALL, request.number, encode(request))
            while not self.link.ended and (payload := await queue.get()) is not None:
                reply = decode_reply(payload)
                if not isinstance(reply, Progress):
                    replies.append(reply)
        if self.link.ended:
            raise TransportError(f"the link has ended: {self.link.reason or 'closed'}")
        return replies

    def close(self) -> None:
        """Say goodbye."""
        if self.link is not None:
            self.link.end("", goodbye="")
        elif self.stream is not None:
            self.stream.close()

    # -- events of the link -----------------------------------------------------------------------

    def refusal(self, link: Link, hello: Hello) -> str | None:
        """Refuse another robot."""
        del link
        return None if hello.role == "service" else "is a robot, and a service was expected"

    def on_hello(self, link: Link, hello: Hello) -> None:
        """Take the service's hello."""
        del link
        if hello.clock_s > 0.0:
            self.clock_ahead_s = time.time() - hello.clock_s
        self._settle()

    def on_frame(self, link: Link, frame: Frame) -> None:
        """Take a reply."""
        del link
        queue = self._calls.get(frame.call)
        if queue is not None:
            if frame.kind in (REPLY, LAST):
                queue.put_nowait(frame.payload)
            if frame.kind in (END, LAST):
                queue.put_nowait(None)

    def on_ended(self, link: Link) -> None:
        """End all calls."""
        del link
        self._settle()
        for queue in self._calls.values():
            queue.put_nowait(None)

    def _settle(self) -> None:
        if not self._settled.done():
            self._settled.set_result(None)


async def certificate_at(path: AddressPath) -> tuple[bytes, str]:
    """Return whatever certificate is shown at an address, believed or not, or why there is none.

    The handshake is not finished, so it leaves no line in a service's log.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    tls = WatchedTls(context)
    loop = asyncio.get_running_loop()
    reason = CLOSES_AT_TLS
    with socket.socket(path.family, socket.SOCK_STREAM) as stream:
        stream.setblocking(False)
        try:
            async with asyncio.timeout(GREETING_S):
                await loop.sock_connect(stream, path.address)
                tls.begin()
                while not tls.established:
                    # It may ask for a key of another kind before it shows anything.
                    await loop.sock_sendall(stream, tls.take())
                    if not (data := await loop.sock_recv(stream, 65536)):
                        break
                    tls.receive(data)
        except TimeoutError:
            reason = _SAYS_NOTHING
        except ssl.SSLError as error:
            reason = tls.describe_error(error)
        except OSError as error:
            reason = system_words(error.errno)
    return (tls.shown(), "") if tls.established else (b"", reason)


def account_of(der: bytes) -> str:
    """Say what a certificate that is not believed says of itself, if there is what reads it."""
    try:
        from cryptography import x509
    except ImportError:
        return ""
    if not der:
        return ""
    try:
        read = x509.load_der_x509_certificate(der)
        begins, ends = read.not_valid_before_utc, read.not_valid_after_utc
        names = [str(name.value) for name in read.subject] or ["nobody"]
        issuer = [str(name.value) for name in read.issuer] or ["nobody"]
        with contextlib.suppress(x509.ExtensionNotFound):
            hosts = read.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            names.append(f"for {', '.join(str(host.value) for host in hosts)}")
    except ValueError:
        return ""
    return (
        f"shown is {' '.join(names)}, of the authority {' '.join(issuer)}, valid from "
        f"{date_text(begins.timestamp())} to {date_text(ends.timestamp())}"
    )


def interface_of(local: str) -> str:
    """Return the name of the interface that has an address and a comma; else nothing."""
    wanted = ipaddress.ip_address(local.partition("%")[0])
    if wanted.version == 6:
        with contextlib.suppress(OSError):
            for line in Path("/proc/net/if_inet6").read_text().splitlines():
                fields = line.split()
                if bytes.fromhex(fields[0]) == wanted.packed:
                    return f"{fields[-1]}, "
        return ""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):
                asked = struct.pack("256s", name.encode())
                if fcntl.ioctl(probe, _SIOCGIFADDR, asked)[20:24] == wanted.packed:
                    return f"{name}, "
    return ""


def in_thread(function: Callable[[], _T]) -> Future[_T]:
    """Call what cannot be broken off; unlike asyncio's threads it does not hold the process up."""
    done: Future[_T] = Future()
    done.set_running_or_notify_cancel()

    def call() -> None:
        try:
            done.set_result(function())
        except BaseException as error:  # noqa: BLE001 - the waiting caller gets it
            done.set_exception(error)

    threading.Thread(target=call, daemon=True).start()
    return done
