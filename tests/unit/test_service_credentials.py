"""When a service reads its credentials again, look by look."""

import asyncio
import os
import shutil
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from tests.unit.test_runtime_events import RecordingSink

from holdfast.service.credentials import ServiceCredentials
from holdfast.service.options import ServeOptions
from holdfast.service.process import _say_ready
from holdfast.transport.key_ring import make_credentials, revoke_credentials
from holdfast.transport.service_end import StreamServiceTransport


class Events(RecordingSink):
    def names(self) -> list[str]:
        return [name for name, _ in self.events]


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
        new = Path(shutil.copytree(self.home, self.home.with_name("new")))
        make_credentials(new, services=["cloud"], rotate=True, days=days)
        return new / "cloud"

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
    assert service.events.events == []


def test_what_has_changed_is_read_once_and_only_when_it_has_stayed_so(service: Service) -> None:
    new = service.renewed()
    before_s = service.credentials.expires_s
    service.copy(new, "certificate")
    service.loop.look()
    service.copy(new, "key")
    service.loop.look()
    assert service.events.events == []
    service.loop.look(5)
    assert service.events.names() == ["credentials_reloaded"]
    assert service.credentials.expires_s < before_s


def test_what_does_not_belong_together_is_told_of_once(service: Service) -> None:
    new = service.renewed(days=3)
    before_s = service.credentials.expires_s
    service.copy(new, "certificate")
    service.loop.look(6)
    assert service.events.names() == ["credentials"]
    assert "key.pem: is not the key of" in service.events.events[0][1]["reason"]
    assert service.events.events[0][1]["pid"] == os.getpid()
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


def test_what_is_gone_is_said_until_it_is_back(service: Service) -> None:
    assert service.credentials.why_gone() is None
    kept = Path(shutil.copytree(service.own, service.home / "kept"))
    for name in ("authority", "certificate", "key"):
        (service.own / f"{name}.pem").unlink()
        service.loop.look(2)
        assert f"{name}.pem: cannot be read: No such file" in str(service.credentials.why_gone())
        assert service.credentials.is_stale
        service.copy(kept, name)
        service.loop.look(2)
        assert (service.credentials.why_gone(), service.credentials.is_stale) == (None, False)


def test_what_has_expired_meanwhile_is_gone(service: Service) -> None:
    service.credentials.expires_s = time.time()
    assert "certificate.pem: has expired" in str(service.credentials.why_gone())
    assert not service.credentials.is_stale


@pytest.mark.parametrize("how", ["expired", "revoked"])
def test_what_no_robot_would_believe_is_gone(service: Service, how: str) -> None:
    if how == "expired":
        past = datetime.now(UTC) - timedelta(hours=36)
        make_credentials(service.home, services=["cloud"], rotate=True, days=1, now=past)
    else:
        revoke_credentials(service.home, names=["cloud"])
    service.loop.look(3)
    assert f"certificate.pem: has {'been ' * (how == 'revoked')}{how}" in str(
        service.credentials.why_gone()
    )


def test_what_is_only_wrong_is_stale_and_not_gone(service: Service) -> None:
    (service.own / "key.pem").write_text("half a k")
    service.loop.look(3)
    assert (service.credentials.why_gone(), service.credentials.is_stale) == (None, True)


@pytest.mark.parametrize("left", ["nothing", "an older list"])
def test_a_list_that_became_shorter_lets_nobody_in_again(service: Service, left: str) -> None:
    path = service.own / "revoked.pem"
    revoke_credentials(service.home, serials=[7])
    older = path.read_bytes()
    revoke_credentials(service.home, serials=[8])
    service.loop.look(3)
    assert service.transport.num_revoked == 2
    path.unlink()
    if left == "an older list":
        path.write_bytes(older)
    service.loop.look(3)
    assert service.events.names() == ["credentials_reloaded", "credentials"]
    assert service.transport.num_revoked == 2
    assert service.credentials.is_stale


def test_a_service_without_a_list_says_so_as_it_begins(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--log", "json", "--tls", str(service.own)]
    for each in (words, words[2:]):
        _say_ready(ServeOptions.parse("serve", each), {"listen": ["tls/h:1"]})
    for line in capsys.readouterr().out.splitlines():
        assert "revokes" in line and str(service.own / "revoked.pem") in line
    revoke_credentials(service.home, serials=[7])
    _say_ready(ServeOptions.parse("serve", words), {"listen": ["tls/h:1"]})
    assert "revoke" not in capsys.readouterr().out


def test_another_authority_comes_with_a_list_of_its_own(service: Service, tmp_path: Path) -> None:
    revoke_credentials(service.home, serials=[7])
    service.loop.look(3)
    make_credentials(tmp_path / "other", services=["cloud"])
    (service.own / "revoked.pem").unlink()
    service.copy(tmp_path / "other" / "cloud", "authority", "certificate", "key")
    service.loop.look(3)
    assert service.events.names() == ["credentials_reloaded"] * 2
    assert service.transport.num_revoked == 0
