"""When a service reads its credentials again, look by look."""

from __future__ import annotations

import asyncio
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from holdfast.service.credentials import ServiceCredentials
from holdfast.transport.key_ring import make_credentials
from holdfast.transport.service_end import StreamServiceTransport


class Events:
    def __init__(self) -> None:
        self.told: list[tuple[str, dict[str, Any]]] = []

    def event(self, event: str, /, **fields: Any) -> None:
        self.told.append((event, fields))

    def close(self) -> None:
        """Nothing is open."""

    def names(self) -> list[str]:
        return [name for name, _ in self.told]


class Looks(asyncio.SelectorEventLoop):
    """A loop in which the next look comes when it is told to."""

    next_look: Callable[[], object]

    def call_later(  # type: ignore[override]
        self, delay: float, callback: Any, *args: Any, context: Any = None
    ) -> Any:
        self.next_look = partial(callback, *args)

    def look(self, times: int = 1) -> None:
        for _ in range(times):
            self.next_look()


class Service:
    def __init__(self, home: Path) -> None:
        make_credentials(home, services=["cloud"])
        self.home, self.own = home, home / "cloud"
        self.warnings: list[str] = []
        self.events, self.loop = Events(), Looks()
        self.credentials = ServiceCredentials(self.own, self.warnings.append)
        self.transport = StreamServiceTransport(
            "cloud", incarnation="00" * 8, listen=["tls/127.0.0.1:0"], tls=self.credentials.files
        )
        self.credentials.watch(self.loop, self.transport, self.events)

    def renewed(self, days: int = 30) -> Path:
        """Return other credentials; those in use stay where they are."""
        kept = Path(shutil.copytree(self.own, self.home / "kept"))
        make_credentials(self.home, services=["cloud"], rotate=True, days=days)
        new = self.own.rename(self.home / "new")
        kept.rename(self.own)
        self.loop.look(2)  # what was moved about is the same as before, and no news
        self.events.told.clear()
        return new

    def copy(self, new: Path, *names: str) -> None:
        for name in names:
            shutil.copy(new / f"{name}.pem", self.own)


@pytest.fixture
def service(tmp_path: Path) -> Any:
    service = Service(tmp_path / "home")
    yield service
    service.loop.close()


def test_what_has_not_changed_is_not_read(service: Service) -> None:
    service.loop.look(5)
    assert service.events.told == []


def test_what_has_changed_is_read_once_and_only_when_it_has_stayed_so(service: Service) -> None:
    new = service.renewed()
    before_s = service.credentials.expires_s
    service.copy(new, "certificate")
    service.loop.look()
    service.copy(new, "key")
    service.loop.look()
    assert service.events.told == []
    service.loop.look(5)
    assert service.events.names() == ["credentials_reloaded"]
    assert service.credentials.expires_s < before_s


def test_what_does_not_belong_together_is_told_of_once(service: Service) -> None:
    new = service.renewed(days=3)
    before_s = service.credentials.expires_s
    service.copy(new, "certificate")
    service.loop.look(6)
    assert service.events.names() == ["credentials"]
    assert "key.pem: is not the key of" in service.events.told[0][1]["reason"]
    assert service.credentials.expires_s == before_s
    assert service.warnings == []  # that it ends soon is of no interest yet
    service.copy(new, "key")
    service.loop.look(6)
    assert service.events.names() == ["credentials", "credentials_reloaded"]
    (warning,) = service.warnings
    assert "expires in" in warning


def test_who_asks_is_always_told(service: Service) -> None:
    new = service.renewed()
    service.copy(new, "certificate")
    service.loop.look(4)
    service.credentials.reload(service.transport, service.events)
    assert service.events.names() == ["credentials", "credentials"]
    service.copy(new, "key")
    service.credentials.reload(service.transport, service.events)
    service.loop.look(4)
    assert service.events.names() == ["credentials", "credentials", "credentials_reloaded"]


def test_a_copy_that_brings_its_time_along_is_seen(service: Service) -> None:
    new = service.renewed()
    for name in ("certificate", "key"):
        file = service.own / f"{name}.pem"
        before = file.stat()
        service.copy(new, name)
        os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    service.loop.look(2)
    assert service.events.names() == ["credentials_reloaded"]
