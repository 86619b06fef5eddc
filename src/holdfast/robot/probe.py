"""A connection to one address of a service, for checks: a robot's own link, and its requests."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import ipaddress
import os
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from itertools import count
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec

from holdfast.errors import TransportError
from holdfast.protocol.messages import Progress, Reply, Request, decode_reply, encode
from holdfast.transport.credentials import date_text
from holdfast.transport.endpoints import Endpoint
from holdfast.transport.frames import CALL, END, LAST, REPLY, Frame, Hello
from holdfast.transport.links import Link, LinkOwner
from holdfast.transport.robot_end import StreamRobotTransport
from holdfast.transport.schemes import link_maker
from holdfast.transport.tls import TlsStream

_GREETING_S: Final = 3.0
"""For the handshake and the other end's hello."""

_LEASE_MS: Final = 30_000.0
"""The robot may be silent for so long; it never is."""

_SIOCGIFADDR: Final = 0x8915

_SAYS_NOTHING: Final = f"takes connections and says nothing for {_GREETING_S:g} s"

_T = TypeVar("_T")


class ShownTls(TlsStream):
    """A handshake that tells what the other end's certificate says.

    Without a context any certificate will do, and the link ends with the handshake.
    """

    def __init__(self, context: ssl.SSLContext | None, host: str | None) -> None:
        if context is None:
            host, context = None, ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
            context.minimum_version = ssl.TLSVersion.TLSv1_3
            context.check_hostname = False
            context.verify_mode = ssl.CERT_NONE
        super().__init__(context, host)

    def certificate(self) -> bytes:
        """Return the other end's certificate, once established."""
        return self._tls.getpeercert(binary_form=True) or b""

    def hosts(self) -> str:
        """Return the hosts that it names."""
        named: Any = (self._tls.getpeercert() or {}).get("subjectAltName", ())
        return ", ".join(
            str(ipaddress.ip_address(host)) if kind == "IP Address" else str(host)
            for kind, host in named
        )


class AddressPath(LinkOwner):
    """One address of a service, as far as it was followed: the owner of its link."""

    def __init__(
        self, endpoint: Endpoint, robot: str, family: socket.AddressFamily, address: Any
    ) -> None:
        self._endpoint = endpoint
        self._robot = robot
        self.family = family
        self.address = address
        self.text = address if endpoint.is_local_socket else str(address[0])
        self._stream: socket.socket | None = None
        self.tls: ShownTls | None = None
        self._link: Link | None = None
        self._numbers = count(1)
        self.clock_ahead_s: float | None = None
        # Frames of calls; None for the hello and for the end of the link.
        self._arrived: asyncio.Queue[Frame | None] = asyncio.Queue()

    async def connect(self) -> None:
        """Connect; raise OSError if that fails."""
        self._stream = stream = socket.socket(self.family, socket.SOCK_STREAM)
        stream.setblocking(False)
        await asyncio.get_running_loop().sock_connect(stream, self.address)

    async def greet(self, context: ssl.SSLContext | None) -> None:
        """Make a link, and wait until the service has said who it is, or the link has ended.

        Where links are encrypted and there is no context, it ends with the service's certificate.
        """
        assert self._stream is not None
        endpoint = self._endpoint
        if endpoint.is_encrypted:
            self.tls = ShownTls(context, endpoint.host)
        robot = StreamRobotTransport(
            {}, name=self._robot, incarnation=os.urandom(8).hex(), lease_ms=_LEASE_MS
        )
        make_link = link_maker(endpoint.protocol, "robot")
        self._link = make_link(self, robot.settings, tls=self.tls)
        await self._link.connect(self._stream)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_GREETING_S):
                await self._arrived.get()

    @property
    def link(self) -> Link:
        """The link, once it is made."""
        assert self._link is not None
        return self._link

    @property
    def why_not(self) -> str:
        """Why no hello has come, as the rest of a sentence about the service."""
        return self.link.reason if self.link.ended else _SAYS_NOTHING

    async def ask(self, request: Request) -> list[Reply]:
        """Send a request under a number of its own; return all replies but progress reports.

        Raises HoldfastError if the link ends, or what comes is no reply.
        """
        replies: list[Reply] = []
        number = next(self._numbers)
        message = encode(msgspec.structs.replace(request, number=number))
        self.link.send_message(CALL, number, message)
        while not self.link.ended:
            frame = await self._arrived.get()
            if frame is None or frame.call != number:
                continue  # of one that was given up
            if frame.kind in (REPLY, LAST):
                replies.append(decode_reply(frame.payload))
            if frame.kind in (END, LAST):
                return [reply for reply in replies if not isinstance(reply, Progress)]
        raise TransportError(f"the link has ended: {self.link.reason or 'closed'}")

    async def certificate(self) -> bytes:
        """Return whatever certificate is shown here, believed or not; empty if there is none."""
        other = AddressPath(self._endpoint, self._robot, self.family, self.address)
        try:
            async with asyncio.timeout(_GREETING_S):
                await other.connect()
                await other.greet(None)
        except OSError:
            pass
        finally:
            other.close()
        tls = other.tls
        return b"" if tls is None or not tls.established else tls.certificate()

    def close(self) -> None:
        """Say goodbye."""
        if self._link is not None:
            self._link.end("", goodbye="")
        elif self._stream is not None:
            self._stream.close()

    # -- events of the link -----------------------------------------------------------------------

    def refusal(self, link: Link, hello: Hello) -> str | None:
        """Refuse another robot."""
        del link
        return None if hello.role == "service" else "is a robot, and a service was expected"

    def on_hello(self, link: Link, hello: Hello) -> None:
        """Take the service's hello."""
        if hello.clock_s > 0.0:
            self.clock_ahead_s = time.time() - hello.clock_s
        self.on_ended(link)

    def on_frame(self, link: Link, frame: Frame) -> None:
        """Take a reply."""
        del link
        self._arrived.put_nowait(frame)

    def on_ended(self, link: Link) -> None:
        """Wake up what waits."""
        del link
        self._arrived.put_nowait(None)


def account_of(der: bytes) -> str:
    """Say what a certificate that is not believed says of itself, if there is what reads it."""
    try:
        from cryptography import x509

        from holdfast.transport.authority import hosts_of

        read = x509.load_der_x509_certificate(der)
        begins, ends = read.not_valid_before_utc, read.not_valid_after_utc
        names = [str(name.value) for name in read.subject] or ["nobody"]
        issuer = [str(name.value) for name in read.issuer] or ["nobody"]
        if hosts := hosts_of(read):
            names.append(f"for {', '.join(hosts)}")
    except (ImportError, ValueError):
        return ""
    return (
        f"shown is {' '.join(names)}, of the authority {' '.join(issuer)}, valid from "
        f"{date_text(begins.timestamp())} to {date_text(ends.timestamp())}"
    )


def interface_of(local: str) -> str:
    """Return the name of the interface that has an address and a comma; else nothing."""
    wanted = ipaddress.ip_address(local.partition("%")[0]).packed
    return next((f"{name}, " for name, packed in _interface_addresses() if packed == wanted), "")


def _interface_addresses() -> Iterator[tuple[str, bytes]]:
    with contextlib.suppress(OSError):
        for line in Path("/proc/net/if_inet6").read_text().splitlines():
            packed, *_, name = line.split()
            yield name, bytes.fromhex(packed)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):
                asked = struct.pack("256s", name.encode())
                yield name, fcntl.ioctl(probe, _SIOCGIFADDR, asked)[20:24]


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
