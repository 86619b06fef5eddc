"""Whose certificate is revoked or expires is cut off at once, and nobody else notices."""

import os
import shutil
import signal
from pathlib import Path

import pytest
from cryptography import x509
from tests.command_line import run_here
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


def reload(cloud: Service, count: int = 1) -> LogEvent:
    cloud.process.signal(signal.SIGHUP)
    return cloud.process.wait_for("credentials_reloaded", count)


def certificate_of(directory: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate((directory / "certificate.pem").read_bytes())


def test_a_robot_without_a_certificate_has_the_name_that_it_says(
    site: Site, references: References
) -> None:
    cloud = site.service().start()
    Story(site, references, document_of(PEG), offload={"name": "anna"}).run(cloud)
    cloud.process.wait_for("robot_connected", robot="anna")


@pytest.mark.parametrize(
    ("name", "tls", "said"),
    [
        ("berta", True, "offload.name 'berta': the certificate in"),
        ("berta", True, "is anna's; copy that robot's own credentials here"),
        ("no name!", False, "offload.name 'no name!': allowed are 1 to 100 letters"),
    ],
)
def test_a_name_that_is_not_the_robots_is_refused(
    name: str, tls: bool, said: str, home: Path, site: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    file = site.configure(document_of(PEG), offload={"name": name})
    words = ["--tls", str(home / "anna"), "--service", "tls/127.0.0.1:1"]
    words = words if tls else ["--service", "tcp/127.0.0.1:1"]
    refused = run_here(capsys, site.directory, "run", str(file), "--out", "out", *words)
    assert refused.code == 2
    assert said in " ".join(refused.stderr.split())


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
    revoked = "has a certificate that has been revoked"
    assert revoked in " ".join(str(each.get("reason")) for each in events_of(robot.out))
    reloads = cloud.process.matching("credentials_reloaded", num_revoked=1)
    assert sum(each["links_ended"] for each in reloads) == 1
    (ended,) = cloud.process.matching("robot_disconnected", robot="anna")
    assert ended["reason"] == revoked
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
