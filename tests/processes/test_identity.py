"""Whose certificate is revoked or expires is cut off at once, and nobody else notices."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cryptography import x509
from tests.ports import free_port
from tests.processes.faults import (
    LOCAL_RECOVERY,
    LOST,
    References,
    Service,
    Site,
    Story,
    document_of,
    events_of,
    page,
    wait_until,
)

from holdfast.transport.key_ring import alone_in, make_credentials, revoke_credentials
from holdfast_lab.testbed.records import LogEvent

PEG = "peg_in_hole_2d"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    make_credentials(tmp_path / "home", robots=["anna", "berta"], services=["cloud"])
    return tmp_path / "home"


@pytest.fixture
def elsewhere(tmp_path: Path) -> Iterator[Site]:
    """Where another robot works."""
    directory = tmp_path / "elsewhere"
    directory.mkdir()
    with Site(directory) as site:
        yield site


def cloud_of(site: Site, home: Path, *options: str) -> Service:
    return site.service(
        "--tls", str(home / "cloud"), *options, endpoint=f"tls/127.0.0.1:{free_port()}"
    )


def reload(cloud: Service, count: int = 1) -> LogEvent:
    cloud.process.signal(signal.SIGHUP)
    return cloud.process.wait_for("credentials_reloaded", count)


def robot_beside(
    home: Path,
    cloud: Service,
    site: Site,
    elsewhere: Site,
    references: References,
    happens: Callable[[Story], None],
) -> tuple[list[tuple[str, str]], Path]:
    """Let anna run while berta's run goes on; return anna's changes of status, and her run."""
    document = document_of(PEG)
    bertas = Story(elsewhere, references, document)
    found: list[tuple[list[tuple[str, str]], Path]] = []

    def run_anna() -> None:
        story = Story(site, references, document)
        happens(story)
        robot = story.run(cloud, options=("--tls", str(home / "anna")))
        found.append((robot.statuses(), robot.out))

    bertas.at("perform", 20, run_anna)
    berta = bertas.run(cloud, options=("--tls", str(home / "berta")))
    assert berta.statuses() == []
    assert not [each for each in events_of(berta.out) if each["event"] == "refused"]
    # One link, from the beginning to the end.
    assert len(cloud.process.matching("robot_connected", robot="berta")) == 1
    return found[0]


def certificate_of(directory: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate((directory / "certificate.pem").read_bytes())


def test_a_revoked_robot_is_cut_off_and_no_other(
    home: Path, site: Site, elsewhere: Site, references: References
) -> None:
    cloud = cloud_of(site, home).start()

    def happens(story: Story) -> None:
        def revoke() -> None:
            revoke_credentials(home, names=["anna"])
            told = reload(cloud)
            assert told["links_ended"] == told["num_revoked"] == 1
            until = certificate_of(home / "cloud").not_valid_after_utc
            assert told["valid_until"] == f"{until:%Y-%m-%d %H:%M} UTC"

        story.at("perform", 20, revoke, story.status(LOCAL_RECOVERY))

    statuses, out = robot_beside(home, cloud, site, elsewhere, references, happens)
    assert statuses == [LOST]
    told = " ".join(str(each.get("reason")) for each in events_of(out))
    assert "has a certificate that has been revoked" in told
    (ended,) = cloud.process.matching("robot_disconnected", robot="anna")
    assert ended["reason"] == "has a certificate that has been revoked"


def test_a_robot_without_a_certificate_has_the_name_that_it_says(
    site: Site, references: References
) -> None:
    cloud = site.service().start()
    Story(site, references, document_of(PEG), offload={"name": "anna"}).run(cloud)
    assert cloud.process.matching("robot_connected", robot="anna")


def test_a_robot_with_the_certificate_of_another_is_refused(home: Path, site: Site) -> None:
    file = site.configure(document_of(PEG), offload={"name": "berta"})
    robot = site.run(file, "--tls", home / "anna", services=["tls/127.0.0.1:1"])
    assert robot.wait() == 2
    assert "offload.name 'berta': the certificate in" in robot.output
    assert "is anna's; copy that robot's own credentials here" in robot.output


def test_a_name_that_is_none_is_refused(site: Site) -> None:
    file = site.configure(document_of(PEG), offload={"name": "no name!"})
    robot = site.run(file, services=["tcp/127.0.0.1:1"])
    assert robot.wait() == 2
    assert "offload.name 'no name!': allowed are 1 to 100 letters" in robot.output


class Mounted:
    """Credentials as a cluster mounts them: a link to what is current, put in its place."""

    def __init__(self, directory: Path, first: Path) -> None:
        self.directory = directory
        self._versions = 0
        directory.mkdir()
        self.put(first)
        for file in first.iterdir():
            (directory / file.name).symlink_to(Path("..data") / file.name)

    def put(self, source: Path, **changed: Path) -> None:
        """Put other files in place of those there, all at once."""
        self._versions += 1
        new = Path(shutil.copytree(source, self.directory / f"..{self._versions}"))
        for name, file in changed.items():
            shutil.copy(file, new / f"{name}.pem")
        (self.directory / "..new").symlink_to(new.name)
        (self.directory / "..new").rename(self.directory / "..data")


@pytest.mark.parametrize("processes", [2, pytest.param(1, marks=pytest.mark.slow)])
def test_what_is_renewed_where_it_is_mounted_is_read_without_a_signal(
    processes: int, home: Path, site: Site, references: References, tmp_path: Path
) -> None:
    old = Path(shutil.copytree(home / "cloud", tmp_path / "old"))
    mounted = Mounted(tmp_path / "mounted", old)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    cloud = site.service(
        *("--tls", str(mounted.directory), "--processes", str(processes)), endpoint=endpoint
    ).start()
    make_credentials(home, services=["cloud"], rotate=True, days=30)
    new = home / "cloud"

    # The certificate has come and its key has not: each process says so once.
    mounted.put(old, certificate=new / "certificate.pem")
    cloud.process.wait_for("credentials", processes)
    mounted.put(new)
    until = f"{certificate_of(new).not_valid_after_utc:%Y-%m-%d %H:%M} UTC"
    told = cloud.process.wait_for("credentials_reloaded", processes, valid_until=until)
    assert told["links_ended"] == 0
    for failure in cloud.process.matching("credentials"):
        assert "key.pem: is not the key of" in failure["reason"]
        assert "the previous ones stay in use" in failure["reason"]
    assert len(cloud.process.matching("credentials")) == processes

    revoke_credentials(home, names=["berta"])
    story = Story(site, references, document_of(PEG))
    story.at("perform", 20, lambda: mounted.put(new, revoked=home / "cloud" / "revoked.pem"))
    (mounted.directory / "revoked.pem").symlink_to(Path("..data") / "revoked.pem")
    robot = story.run(cloud, options=("--tls", str(home / "anna")))
    assert robot.statuses() == []
    cloud.process.wait_for("credentials_reloaded", processes, num_revoked=1)
    again = cloud.process.matching("credentials_reloaded")
    assert len(again) == 2 * processes == 2 * len({each["pid"] for each in again})


@pytest.mark.skipif(os.geteuid() != 0, reason="only root mounts")
@pytest.mark.parametrize("processes", [2, pytest.param(1, marks=pytest.mark.slow)])
def test_where_keys_are_mounted_a_rotation_and_then_a_revocation_take_effect(
    processes: int, home: Path, site: Site, references: References, tmp_path: Path
) -> None:
    mount = tmp_path / "mount"
    mount.mkdir()
    address = f"127.0.0.1:{free_port()}"
    cloud = site.service(
        *("--tls", str(mount), "--processes", str(processes)),
        *("--health", address, "--metrics", address),
        endpoint=f"tls/127.0.0.1:{free_port()}",
    )
    binding = f'mount --bind {home / "cloud"} {mount}; exec "$@"'
    cloud.command = ("unshare", "--mount", "sh", "-c", binding, "sh", *cloud.command)
    cloud.start()
    assert page(address, "/readyz") == (200, "ok\n")
    story = Story(site, references, document_of(PEG))

    def rotate() -> None:
        with alone_in(home):
            make_credentials(home, services=["cloud"], rotate=True)
        reload(cloud, count=processes)

    def revoke() -> None:
        with alone_in(home):
            revoke_credentials(home, names=["anna"])
        reload(cloud, count=2 * processes)

    story.at("perform", 10, rotate)
    story.at("perform", 20, revoke, story.status(LOCAL_RECOVERY))
    robot = story.run(cloud, options=("--tls", str(home / "anna")))
    assert robot.statuses() == [LOST]
    assert page(address, "/readyz") == (200, "ok\n")
    assert "\nholdfast_credentials_stale 0.0\n" in page(address, "/metrics")[1]

    # A list that is gone would let her in again.
    (home / "cloud" / "revoked.pem").unlink()
    cloud.process.signal(signal.SIGHUP)
    told = cloud.process.wait_for("credentials", processes)
    assert "revoked.pem: lacks 1 of the 1 certificates that it revoked" in told["reason"]
    metric = f"\nholdfast_credentials_stale {processes}.0\n"
    wait_until(lambda: metric in page(address, "/metrics")[1], "the metric")
    assert page(address, "/readyz") == (200, "ok\n")

    for file in (home / "cloud").iterdir():
        file.unlink()
    cloud.process.signal(signal.SIGHUP)
    gone = (503, f"{mount}/authority.pem: cannot be read: No such file or directory")
    wait_until(lambda: page(address, "/readyz")[0] == gone[0], "the service to be not ready")
    assert page(address, "/readyz")[1].startswith(gone[1])
    assert page(address, "/livez") == (200, "ok\n")
    assert "\nholdfast_ready 0.0\n" in page(address, "/metrics")[1]
