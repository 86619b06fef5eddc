"""Credentials: what is made, what is found wrong with them, and what links make of them.

The refusals are tested on real links, because what a TLS library checks is its own affair: whom it
lets in decides, not what the certificates say.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import socket
import subprocess
import sys
import textwrap
import time
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from holdfast.files import NewFile, OutputError, create_directory_atomically
from holdfast.session.events import Appeared, Ended, Replied
from holdfast.transport.contract import IncomingCall
from holdfast.transport.credentials import (
    CredentialsError,
    CredentialsWarning,
    Role,
    load_credentials,
)
from holdfast.transport.endpoints import ServiceAddress, TlsFiles
from holdfast.transport.key_ring import list_credentials, make_credentials
from holdfast.transport.robot_end import StreamRobotTransport
from holdfast.transport.service_end import StreamServiceTransport

PATIENCE_S = 60.0
LEASE_MS = 30_000.0
NOW = datetime.now(UTC)
DAY = timedelta(days=1)
FILES = {"authority.pem", "certificate.pem", "key.pem"}


def certificate_of(directory: Path, name: str = "certificate.pem") -> x509.Certificate:
    return x509.load_pem_x509_certificate((directory / name).read_bytes())


def usages_of(certificate: x509.Certificate) -> list[x509.ObjectIdentifier]:
    return list(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)


def hosts_of(certificate: x509.Certificate) -> list[object]:
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    return [name.value for name in names]


def contents_of(directory: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(directory)): path.read_bytes()
        for path in sorted(directory.rglob("*"))
        if path.is_file()
    }


def mode_of(path: Path) -> int:
    return path.stat().st_mode & 0o777


class TestWhatIsMade:
    def test_without_names_a_service_and_a_robot(self, tmp_path: Path) -> None:
        home = tmp_path / "deep" / "keys"
        ring = make_credentials(home)
        assert {path.name for path in home.iterdir()} == {"authority", "service", "robot"}
        assert {path.name for path in (home / "authority").iterdir()} == {
            "authority.pem",
            "authority.key",
            "issued.csv",
        }
        for name in ("service", "robot"):
            assert {path.name for path in (home / name).iterdir()} == FILES
            assert mode_of(home / name) == 0o700
            assert mode_of(home / name / "key.pem") == 0o600
        assert mode_of(home) == mode_of(home / "authority") == 0o700
        assert mode_of(home / "authority" / "authority.key") == 0o600
        assert [(made.name, made.role, made.directory) for made in ring.made] == [
            ("service", "service", home / "service"),
            ("robot", "robot", home / "robot"),
        ]
        assert ring.authority_is_new
        assert ring.authority_key == home / "authority" / "authority.key"

    def test_each_role_has_its_own_usage(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, now=NOW)
        authority = certificate_of(tmp_path / "authority", "authority.pem")
        for role, usage in (
            ("service", ExtendedKeyUsageOID.SERVER_AUTH),
            ("robot", ExtendedKeyUsageOID.CLIENT_AUTH),
        ):
            certificate = certificate_of(tmp_path / role)
            certificate.verify_directly_issued_by(authority)
            assert usages_of(certificate) == [usage]
            basic = certificate.extensions.get_extension_for_class(x509.BasicConstraints)
            assert basic.critical
            assert not basic.value.ca
            assert certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == role
            assert certificate_of(tmp_path / role, "authority.pem") == authority
            key = serialization.load_pem_private_key(
                (tmp_path / role / "key.pem").read_bytes(), None
            )
            assert key.public_key() == certificate.public_key()
        basic = authority.extensions.get_extension_for_class(x509.BasicConstraints)
        assert basic.value == x509.BasicConstraints(ca=True, path_length=0)

    def test_services_are_reached_at_this_machine_and_at_the_hosts_named(
        self, tmp_path: Path
    ) -> None:
        ring = make_credentials(tmp_path, hosts=["10.0.0.7", "Planner.Lan", "localhost", "fd00::7"])
        hosts = hosts_of(certificate_of(tmp_path / "service"))
        expected = [
            *("localhost", ip_address("127.0.0.1"), ip_address("::1")),
            *(ip_address("10.0.0.7"), "planner.lan", ip_address("fd00::7")),
        ]
        assert [host for host in hosts if host != socket.gethostname().lower()] == expected
        assert ring.made[0].hosts == tuple(map(str, hosts))
        # A robot that had a host's name could be taken for a service by a lenient reader.
        with pytest.raises(x509.ExtensionNotFound):
            hosts_of(certificate_of(tmp_path / "robot"))

    def test_days_bound_the_validity_and_the_authority_bounds_them(self, tmp_path: Path) -> None:
        start = NOW.replace(microsecond=0)
        ring = make_credentials(tmp_path, days=30, now=start)
        assert ring.made[0].expires == start + 30 * DAY
        certificate = certificate_of(tmp_path / "service")
        assert certificate.not_valid_after_utc == start + 30 * DAY
        # A clock that is a little behind must not refuse it.
        assert certificate.not_valid_before_utc == start - DAY
        assert ring.authority_expires == start + 3650 * DAY
        later = make_credentials(tmp_path, robots=["late"], days=365, now=start + 3600 * DAY)
        assert later.made[0].expires == ring.authority_expires

    def test_again_adds_keys_of_the_same_authority_and_changes_nothing(
        self, tmp_path: Path
    ) -> None:
        make_credentials(tmp_path)
        before = contents_of(tmp_path)
        ring = make_credentials(tmp_path, robots=["left", "right"], services=["cloud-2.lab"])
        assert not ring.authority_is_new
        assert [made.name for made in ring.made] == ["cloud-2.lab", "left", "right"]
        after = contents_of(tmp_path)
        record = before.pop("authority/issued.csv")
        assert after["authority/issued.csv"].startswith(record)
        assert {name: after[name] for name in before} == before
        authority = certificate_of(tmp_path / "authority", "authority.pem")
        for name in ("left", "right", "cloud-2.lab"):
            certificate_of(tmp_path / name).verify_directly_issued_by(authority)

    def test_only_the_names_given_are_made(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, robots=["arm"])
        assert {path.name for path in tmp_path.iterdir()} == {"authority", "arm"}

    def test_two_authorities_have_different_names(self, tmp_path: Path) -> None:
        subjects = set()
        for name in ("a", "b"):
            make_credentials(tmp_path / name, robots=["robot"])
            subjects.add(certificate_of(tmp_path / name / "robot").issuer)
        assert len(subjects) == 2


class TestNothingIsOverwritten:
    def test_the_file_that_exists_is_named_and_nothing_is_changed(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, robots=["left"])
        before = contents_of(tmp_path)
        with pytest.raises(CredentialsError, match=r"left/certificate\.pem: exists already"):
            make_credentials(tmp_path, robots=["right", "left"], services=["cloud"])
        assert contents_of(tmp_path) == before

    def test_other_peoples_files_are_left_alone(self, tmp_path: Path) -> None:
        (tmp_path / "robot").mkdir()
        (tmp_path / "robot" / "notes.txt").write_text("mine")
        with pytest.raises(CredentialsError, match=r"robot/notes\.txt: exists already"):
            make_credentials(tmp_path)
        (tmp_path / "service").write_text("a file")
        with pytest.raises(CredentialsError, match="service: exists already"):
            make_credentials(tmp_path, services=["service"])
        assert contents_of(tmp_path) == {"robot/notes.txt": b"mine", "service": b"a file"}

    def test_a_directory_is_created_whole_or_not_at_all(self, tmp_path: Path) -> None:
        place = tmp_path / "place"
        files = {"a": NewFile(b"1", 0o600), "b": NewFile(b"2", 0o644)}
        create_directory_atomically(place, files)
        with pytest.raises(OutputError, match="place: cannot be created: it exists already"):
            create_directory_atomically(place, {"c": NewFile(b"3", 0o600)})
        with pytest.raises(OutputError, match="No such file"):
            create_directory_atomically(tmp_path / "other", {"no/where": NewFile(b"", 0o600)})
        assert contents_of(tmp_path) == {"place/a": b"1", "place/b": b"2"}
        assert (mode_of(place), mode_of(place / "a")) == (0o700, 0o600)
        assert [path.name for path in tmp_path.iterdir()] == ["place"]

    def test_a_process_that_is_killed_leaves_only_whole_directories(self, tmp_path: Path) -> None:
        home = tmp_path / "keys"
        program = textwrap.dedent("""
            import sys
            from pathlib import Path
            from holdfast.transport.key_ring import make_credentials
            make_credentials(Path(sys.argv[1]), robots=[f"r{i}" for i in range(400)])
        """)
        with subprocess.Popen([sys.executable, "-c", program, str(home)]) as process:
            deadline = time.monotonic() + 60.0
            while not (home / "r20").exists() and time.monotonic() < deadline:
                time.sleep(0.002)
            process.kill()
        assert process.returncode == -signal.SIGKILL
        made = [path for path in home.iterdir() if not path.name.startswith(".")]
        assert 20 < len(made) < 401
        for path in made:
            if path.name != "authority":
                load_credentials(path, "robot")
        assert (home / "authority" / "authority.key").exists()
        make_credentials(home, robots=["after"])
        load_credentials(home / "after", "robot")


class TestRenewal:
    def test_the_certificate_is_new_and_the_key_stays(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, hosts=["10.0.0.7"], now=NOW - 400 * DAY)
        with pytest.raises(CredentialsError, match="has expired"):
            load_credentials(tmp_path / "service", "service")
        before = contents_of(tmp_path)
        ring = make_credentials(tmp_path, services=["service"], hosts=["cloud.lan"], renew=True)
        after = contents_of(tmp_path)
        assert {name for name in after if after[name] != before[name]} == {
            "service/certificate.pem",
            "authority/issued.csv",
        }
        assert ring.made[0].renewed
        assert {"10.0.0.7", "cloud.lan", "localhost"} <= set(ring.made[0].hosts)
        load_credentials(tmp_path / "service", "service")

    def test_without_names_all_are_renewed(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, robots=["a", "b"], services=["c"], now=NOW - 400 * DAY)
        ring = make_credentials(tmp_path, renew=True)
        assert {(made.name, made.role) for made in ring.made} == {
            ("a", "robot"),
            ("b", "robot"),
            ("c", "service"),
        }
        for made in ring.made:
            load_credentials(made.directory, made.role)

    def test_it_needs_no_key_at_home(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, robots=["robot"])
        key = (tmp_path / "robot" / "key.pem").rename(tmp_path / "moved_to_the_robot.pem")
        make_credentials(tmp_path, robots=["robot"], renew=True)
        shutil.copy(key, tmp_path / "robot" / "key.pem")
        load_credentials(tmp_path / "robot", "robot")

    def test_a_robot_does_not_become_a_service(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, robots=["arm"])
        with pytest.raises(CredentialsError, match="is not a service's certificate"):
            make_credentials(tmp_path, services=["arm"], renew=True)
        assert usages_of(certificate_of(tmp_path / "arm")) == [ExtendedKeyUsageOID.CLIENT_AUTH]

    def test_what_another_authority_signed_is_left_alone(self, tmp_path: Path) -> None:
        make_credentials(tmp_path / "a", robots=["arm"])
        make_credentials(tmp_path / "b", robots=["other"])
        shutil.copytree(tmp_path / "b" / "other", tmp_path / "a" / "other")
        with pytest.raises(CredentialsError, match=r"other/certificate\.pem: is not of the auth"):
            make_credentials(tmp_path / "a", robots=["other"], renew=True)

    def test_nothing_to_renew_is_said(self, tmp_path: Path) -> None:
        with pytest.raises(CredentialsError, match="has no certificates to renew"):
            make_credentials(tmp_path, renew=True)
        assert list(tmp_path.iterdir()) == []


class TestArguments:
    @pytest.mark.parametrize(
        "name", ["", ".", "..", "a/b", "-x", ".hidden", "authority", "a" * 65, "a b", "é", "a\n"]
    )
    def test_names_that_are_no_directories_are_refused(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(CredentialsError, match="name "):
            make_credentials(tmp_path, robots=[name])
        assert list(tmp_path.iterdir()) == []

    def test_a_name_stands_once(self, tmp_path: Path) -> None:
        with pytest.raises(CredentialsError, match="'x': stands twice"):
            make_credentials(tmp_path, robots=["x"], services=["x"])

    @pytest.mark.parametrize(
        "host", ["", "tls/10.0.0.7:7447", "10.0.0.7:7447", "[::1]", "a..b", "*.lan", "é.lan", "a b"]
    )
    def test_hosts_that_are_none_are_refused(self, tmp_path: Path, host: str) -> None:
        with pytest.raises(CredentialsError, match="is no host name and no IP address"):
            make_credentials(tmp_path, hosts=[host])
        assert list(tmp_path.iterdir()) == []

    def test_a_host_without_a_service_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(CredentialsError, match=r"host '10\.0\.0\.7': only services"):
            make_credentials(tmp_path, robots=["arm"], hosts=["10.0.0.7"])

    @pytest.mark.parametrize("days", [0, -1, 3651])
    def test_days_have_bounds(self, tmp_path: Path, days: int) -> None:
        with pytest.raises(CredentialsError, match=f"days: {days} is not between 1 and 3650"):
            make_credentials(tmp_path, days=days)


class TestAuthority:
    def test_without_its_key_nothing_is_made(self, tmp_path: Path) -> None:
        make_credentials(tmp_path)
        (tmp_path / "authority" / "authority.key").unlink()
        with pytest.raises(CredentialsError, match=r"authority\.key: cannot be read: No such"):
            make_credentials(tmp_path, robots=["new"])
        assert not (tmp_path / "new").exists()

    def test_another_authoritys_key_is_found(self, tmp_path: Path) -> None:
        for name in ("a", "b"):
            make_credentials(tmp_path / name)
        shutil.copy(
            tmp_path / "b" / "authority" / "authority.key",
            tmp_path / "a" / "authority" / "authority.key",
        )
        with pytest.raises(CredentialsError, match=r"authority\.key: is not the key of"):
            make_credentials(tmp_path / "a", robots=["new"])

    def test_an_expired_one_signs_no_more(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, now=NOW - 3651 * DAY)
        with pytest.raises(CredentialsError, match=r"authority\.pem: has expired on "):
            make_credentials(tmp_path, robots=["new"])

    def test_a_key_that_others_can_read_is_warned_of(self, tmp_path: Path) -> None:
        make_credentials(tmp_path)
        (tmp_path / "authority" / "authority.key").chmod(0o640)
        said: list[str] = []
        make_credentials(tmp_path, robots=["new"], warn=said.append)
        assert len(said) == 1
        assert "authority.key: others can read this key (mode 640)" in said[0]


def sign_with_names(home: Path, like: str, name: str, names: list[str]) -> None:
    """Make credentials like others of the same authority, whose certificate has these names."""
    shutil.copytree(home / like, home / name)
    model = certificate_of(home / like)
    authority = certificate_of(home / "authority", "authority.pem")
    signing_key = serialization.load_pem_private_key(
        (home / "authority" / "authority.key").read_bytes(), None
    )
    assert isinstance(signing_key, ec.EllipticCurvePrivateKey)
    builder = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, each) for each in names]))
        .issuer_name(authority.subject)
        .public_key(model.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(model.not_valid_before_utc)
        .not_valid_after(model.not_valid_after_utc)
    )
    for extension in model.extensions:
        builder = builder.add_extension(extension.value, extension.critical)
    certificate = builder.sign(signing_key, hashes.SHA256())
    (home / name / "certificate.pem").write_bytes(
        certificate.public_bytes(serialization.Encoding.PEM)
    )


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Good keys (``home``), and all sorts of bad ones."""
    top = tmp_path_factory.mktemp("keys")
    home = top / "home"
    # Old enough for certificates that have expired already.
    make_credentials(
        home,
        robots=["expired_robot"],
        services=["expired_service"],
        days=30,
        now=NOW - 100 * DAY,
    )
    make_credentials(
        home, robots=["future_robot"], services=["future_service"], now=NOW + 100 * DAY
    )
    make_credentials(home, robots=["robot"], services=["service"])
    for role in ("robot", "service"):
        sign_with_names(home, role, f"nameless_{role}", [])
        sign_with_names(home, role, f"two_names_{role}", ["one", "two"])
    make_credentials(top / "other")
    # Theirs trust our authority, but are not of it.
    for name in ("robot", "service"):
        shutil.copytree(top / "other" / name, home / f"foreign_{name}")
        shutil.copy(home / name / "authority.pem", home / f"foreign_{name}" / "authority.pem")
    return home


class TestLoading:
    @pytest.mark.parametrize("role", ["robot", "service"])
    def test_good_ones_are_found_good(self, keys: Path, role: Role) -> None:
        files = load_credentials(str(keys / role), role)
        assert [files.authority, files.certificate, files.key] == [
            keys / role / name for name in ("authority.pem", "certificate.pem", "key.pem")
        ]

    @pytest.mark.parametrize(
        ("name", "role", "reason"),
        [
            ("robot", "service", r"robot/certificate\.pem: is not for a service"),
            ("service", "robot", r"service/certificate\.pem: is not for a robot"),
            (
                "expired_robot",
                "robot",
                r"certificate\.pem: has expired \(valid from 20.*--renew --robot NAME",
            ),
            ("expired_service", "service", r"certificate\.pem: has expired"),
            ("future_robot", "robot", r"is not valid yet; is a clock wrong\? \(valid from 20"),
            ("future_service", "service", "is not valid yet"),
            ("foreign_robot", "robot", r"was not signed by the authority in authority\.pem"),
            ("foreign_service", "service", r"was not signed by the authority in authority\.pem"),
            ("nameless_robot", "robot", r"certificate\.pem: has 0 common names, and must have one"),
            ("two_names_service", "service", "has 2 common names, and must have one"),
            ("absent", "robot", r"absent/authority\.pem: cannot be read: .*holdfast keys"),
            (".", "robot", r"did you mean .*robot\?"),
        ],
    )
    def test_bad_ones_are_found_before_a_link_is_opened(
        self, keys: Path, name: str, role: Role, reason: str
    ) -> None:
        with pytest.raises(CredentialsError, match=reason):
            load_credentials(keys / name, role)

    @pytest.mark.parametrize("name", sorted(FILES))
    def test_a_file_that_is_missing_or_broken_is_named(
        self, keys: Path, tmp_path: Path, name: str
    ) -> None:
        place = tmp_path / "robot"
        shutil.copytree(keys / "robot", place)
        for content in (b"", b"no PEM", (place / name).read_bytes()[:-60]):
            (place / name).write_bytes(content)
            with pytest.raises(CredentialsError, match=f"robot/{name}"):
                load_credentials(place, "robot")
        (place / name).unlink()
        with pytest.raises(CredentialsError, match=f"robot/{name}: cannot be read: No such file"):
            load_credentials(place, "robot")
        (place / name).mkdir()
        with pytest.raises(CredentialsError, match=f"robot/{name}: cannot be read: Is a dir"):
            load_credentials(place, "robot")

    def test_the_key_of_another_certificate_is_found(self, keys: Path, tmp_path: Path) -> None:
        shutil.copytree(keys / "robot", tmp_path / "robot")
        shutil.copy(keys / "service" / "key.pem", tmp_path / "robot" / "key.pem")
        with pytest.raises(CredentialsError, match=r"key\.pem: is not the key of .*certificate"):
            load_credentials(tmp_path / "robot", "robot")

    def test_an_encrypted_key_asks_nobody_for_a_password(self, keys: Path, tmp_path: Path) -> None:
        shutil.copytree(keys / "robot", tmp_path / "robot")
        path = tmp_path / "robot" / "key.pem"
        key = serialization.load_pem_private_key(path.read_bytes(), None)
        encrypted = key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"secret"),
        )
        path.write_bytes(encrypted)
        with pytest.raises(CredentialsError, match=r"key\.pem: is encrypted"):
            load_credentials(tmp_path / "robot", "robot")

    @pytest.mark.skipif(os.geteuid() == 0, reason="root can read everything")
    def test_a_file_that_may_not_be_read_is_named(self, keys: Path, tmp_path: Path) -> None:
        shutil.copytree(keys / "robot", tmp_path / "robot")
        (tmp_path / "robot" / "key.pem").chmod(0)
        with pytest.raises(CredentialsError, match=r"key\.pem: cannot be read: Permission denied"):
            load_credentials(tmp_path / "robot", "robot")

    def test_what_somebody_should_look_at_is_said(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, days=3)
        (tmp_path / "robot" / "key.pem").chmod(0o644)
        said: list[str] = []
        load_credentials(tmp_path / "robot", "robot", warn=said.append)
        assert len(said) == 2
        assert "key.pem: others can read this key (mode 644)" in said[0]
        assert "certificate.pem: expires in 3.0 days, on 20" in said[1]
        with pytest.warns(CredentialsWarning, match="expires in"):
            load_credentials(tmp_path / "service", "service")

    def test_a_key_that_a_service_manager_or_a_cluster_hands_over_is_not_open(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """It belongs to root, and this user reads it by its group, or by a right of its own."""
        make_credentials(tmp_path)
        key = tmp_path / "robot" / "key.pem"
        owner = key.stat().st_uid
        for user, mode, is_open in (
            (owner + 1, 0o440, False),
            (owner + 1, 0o444, True),
            (owner + 1, 0o460, True),
            (owner, 0o440, True),
        ):
            key.chmod(mode)
            monkeypatch.setattr(os, "geteuid", lambda user=user: user)
            said: list[str] = []
            load_credentials(tmp_path / "robot", "robot", warn=said.append)
            assert bool(said) is is_open, (user, mode)

    def test_loading_needs_no_package_and_making_says_which_it_needs(self, keys: Path) -> None:
        program = textwrap.dedent("""
            import importlib, sys
            sys.modules["cryptography"] = None
            from pathlib import Path
            from holdfast.transport.credentials import *
            keys = Path(sys.argv[1])
            print(load_credentials(keys / "robot", "robot").key)
            for attempt in (
                lambda: load_credentials(keys / "expired_robot", "robot"),
                lambda: importlib.import_module("holdfast.transport.key_ring"),
            ):
                try:
                    attempt()
                except CredentialsError as error:
                    print(error)
        """)
        done = subprocess.run(
            [sys.executable, "-c", program, str(keys)], capture_output=True, text=True, check=True
        )
        good, expired, making = done.stdout.splitlines()
        assert good == str(keys / "robot" / "key.pem")
        assert "certificate.pem: has expired; 'holdfast keys DIR --renew" in expired
        assert "pip install cryptography" in making

    def test_loading_imports_nothing_heavy(self, keys: Path) -> None:
        program = (
            "import sys; from holdfast.transport.credentials import load_credentials; "
            f"load_credentials({str(keys / 'service')!r}, 'service'); print(*sys.modules)"
        )
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True
        )
        assert not set(done.stdout.split()) & {"cryptography", "numpy", "asyncio", "typer", "rich"}


class Ends:
    """Robots' and services' ends with credentials of all kinds, closed after the test."""

    def __init__(self, keys: Path) -> None:
        self._keys = keys
        self._ends: list[StreamRobotTransport | StreamServiceTransport] = []

    def files(self, name: str) -> TlsFiles:
        return TlsFiles.of(self._keys / name)

    async def service(self, name: str, host: str = "127.0.0.1") -> str:
        """Start a service that answers with the question backwards; return its endpoint."""
        service = StreamServiceTransport(
            "cloud", boot="b1", listen=[f"tls/{host}:0"], lease_ms=LEASE_MS, tls=self.files(name)
        )
        self._ends.append(service)

        def answer(call: IncomingCall) -> None:
            call.reply(f"{call.robot}: ".encode() + call.payload[::-1])
            call.end()

        await service.start(answer)
        return service.endpoints[0]

    async def ask(self, name: str, endpoint: str) -> list[object]:
        """Connect as a robot and ask; return the replies, or why it is refused."""
        said: asyncio.Queue[object] = asyncio.Queue()
        robot = StreamRobotTransport(
            {"cloud": ServiceAddress(endpoint)},
            lease_ms=LEASE_MS,
            tls=self.files(name),
            on_unreachable=lambda _, reason: said.put_nowait(reason),
        )
        self._ends.append(robot)
        robot.start(said.put_nowait)
        first = await asyncio.wait_for(said.get(), PATIENCE_S)
        if not isinstance(first, Appeared):
            return [first]
        robot.call("cloud", 1, b"abc")
        return [await asyncio.wait_for(said.get(), PATIENCE_S) for _ in range(2)]

    async def close_on_loop(self) -> None:
        for end in self._ends:
            await end.close()


@pytest.fixture
def ends(keys: Path) -> Ends:
    return Ends(keys)


class TestOnRealLinks:
    @pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
    async def test_a_robot_and_a_service_talk(self, ends: Ends, host: str) -> None:
        endpoint = await ends.service("service", host)
        assert await ends.ask("robot", endpoint) == [Replied(1, b"robot: cba"), Ended(1)]

    @pytest.mark.parametrize(
        ("name", "reason"),
        [
            ("foreign_robot", "not signed by the authority in authority.pem there"),
            (
                "expired_robot",
                "expired by the clock there; 'holdfast keys DIR --renew --robot NAME'",
            ),
            ("future_robot", "it is not valid yet by the clock there"),
            ("service", "it is not for a robot"),
            ("nameless_robot", "which has a certificate that has 0 common names, and must have"),
            ("two_names_robot", "which has a certificate that has 2 common names, and must have"),
        ],
    )
    async def test_a_service_lets_nobody_in_who_is_no_robot_of_its_authority(
        self, ends: Ends, name: str, reason: str
    ) -> None:
        endpoint = await ends.service("service")
        (refusal,) = await ends.ask(name, endpoint)
        assert isinstance(refusal, str)
        assert reason in refusal
        assert await ends.ask("robot", endpoint) == [Replied(1, b"robot: cba"), Ended(1)]

    @pytest.mark.parametrize(
        ("name", "reason"),
        [
            ("robot", "is not for a service"),
            ("foreign_service", "was not signed by the authority in authority.pem"),
            ("expired_service", "has expired"),
            ("future_service", "is not valid yet; is a clock wrong?"),
            ("nameless_service", "has 0 common names, and must have one"),
            ("two_names_service", "has 2 common names, and must have one"),
        ],
    )
    async def test_a_robot_believes_nobody_who_is_no_service_of_its_authority(
        self, ends: Ends, name: str, reason: str
    ) -> None:
        (refusal,) = await ends.ask("robot", await ends.service(name))
        assert isinstance(refusal, str)
        assert refusal.startswith(f"has a certificate that {reason}")

    async def test_a_robot_believes_a_service_only_at_its_own_hosts(self, ends: Ends) -> None:
        # Everything in 127/8 is this machine, but the certificate is for 127.0.0.1 alone.
        endpoint = await ends.service("service", "0.0.0.0")
        (refusal,) = await ends.ask("robot", endpoint.replace("0.0.0.0", "127.0.0.2"))
        assert isinstance(refusal, str)
        assert "does not name this host" in refusal
        assert "--renew --service NAME --host HOST" in refusal
        assert "127.0.0.2" in refusal
        right = await ends.ask("robot", endpoint.replace("0.0.0.0", "127.0.0.1"))
        assert right == [Replied(1, b"robot: cba"), Ended(1)]


def run_keys(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "holdfast", "keys", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
    )


KILLED_AT_EACH_MOMENT = """
import os, shutil, signal, sys
from pathlib import Path
import holdfast.cli
import holdfast.transport.key_ring

home, copies = Path(sys.argv[1]), Path(sys.argv[2])

def run(moment, *arguments):
    child = os.fork()
    if child == 0:
        left = [moment]
        def dying(change):
            def call(*arguments, **options):
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
                left[0] -= 1
                return change(*arguments, **options)
            return call
        for name in ("rename", "replace", "unlink", "rmdir"):
            setattr(os, name, dying(getattr(os, name)))
        sys.argv[1:] = ["keys", *arguments]
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        holdfast.cli.main()
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

for moment in range(100):
    copy = copies / str(moment)
    shutil.copytree(home, copy)
    status = run(moment, str(copy), "--rotate")
    if status != -signal.SIGKILL:
        sys.exit(status)
    if status := run(-1, str(copy), "--list"):
        sys.exit(status)
"""


WORKS_FOR_A_WHILE = """
import sys
from pathlib import Path
from holdfast.transport import key_ring

write = key_ring._write_issued

def wait_and_write(*arguments):
    print("has read the record", flush=True)
    sys.stdin.readline()
    write(*arguments)

key_ring._write_issued = wait_and_write
with key_ring.alone_in(Path(sys.argv[1])):
    key_ring.make_credentials(Path(sys.argv[1]), robots=["anna"], rotate=True)
"""


class TestCommand:
    def test_whoever_is_killed_in_a_rotation_leaves_what_the_next_one_finishes(
        self, tmp_path: Path
    ) -> None:
        home, copies = tmp_path / "home", tmp_path / "copies"
        make_credentials(home, robots=["anna"], services=["cloud"], hosts=["10.0.0.7"])
        hosts = hosts_of(certificate_of(home / "cloud"))
        copies.mkdir()
        program = [sys.executable, "-c", KILLED_AT_EACH_MOMENT, str(home), str(copies)]
        done = subprocess.run(program, capture_output=True, text=True, timeout=120)
        assert (done.returncode, done.stderr) == (0, "")
        moments = sorted(copies.iterdir(), key=lambda path: int(path.name))
        assert len(moments) > 15
        for copy in moments:
            for rotates in (False, True):
                if rotates:
                    make_credentials(copy, rotate=True)
                load_credentials(copy / "anna", "robot")
                load_credentials(copy / "cloud", "service")
                assert hosts_of(certificate_of(copy / "cloud")) == hosts
                # No key of before is left.
                assert {path.name for path in copy.iterdir()} == {"authority", "anna", "cloud"}

    def test_what_was_broken_off_is_said_to_whoever_needs_it(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, robots=["anna"])
        (tmp_path / "anna").rename(tmp_path / ".anna.old")
        with pytest.raises(
            CredentialsError, match=f'"holdfast keys {tmp_path} --list" brings back'
        ):
            load_credentials(tmp_path / "anna", "robot")
        assert run_keys(str(tmp_path), "--list").returncode == 0
        load_credentials(tmp_path / "anna", "robot")

    def test_two_at_once_work_one_after_the_other(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, robots=["anna"])
        before = certificate_of(tmp_path / "anna").serial_number
        command = [sys.executable, "-c", WORKS_FOR_A_WHILE, str(tmp_path)]
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as first:
            assert first.stdin is not None
            assert first.stdout is not None
            assert first.stdout.readline() == "has read the record\n"
            command = [sys.executable, "-m", "holdfast", "keys", str(tmp_path), "--rotate"]
            with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as second:
                assert second.stderr is not None
                assert "another 'holdfast keys' is at work" in second.stderr.readline()
                first.stdin.write("go on\n")
                first.stdin.flush()
                _, errors = second.communicate(timeout=60)
            assert (first.wait(60), second.returncode, errors) == (0, 0, "")
        load_credentials(tmp_path / "anna", "robot")
        serials = [each.serial for each in list_credentials(tmp_path)]
        assert len(serials) == 3
        assert serials[0] == before
        assert serials[2] == certificate_of(tmp_path / "anna").serial_number

    def test_it_makes_keys_and_says_what_goes_where(self, tmp_path: Path) -> None:
        home = tmp_path / "keys"
        done = run_keys(str(home), "--host", "10.0.0.7", "--days", "30")
        assert (done.returncode, done.stderr) == (0, "")
        assert f"{home / 'authority' / 'authority.key'} stays here" in done.stdout
        assert f"--tls {home / 'service'}" in done.stdout
        assert f"--tls {home / 'robot'}" in done.stdout
        assert "10.0.0.7" in done.stdout
        load_credentials(home / "service", "service")

    def test_again_it_refuses_and_renews_if_told_to(self, tmp_path: Path) -> None:
        assert run_keys(str(tmp_path)).returncode == 0
        done = run_keys(str(tmp_path))
        assert done.returncode == 2
        assert done.stderr.startswith("holdfast: error: ")
        assert "service/certificate.pem: exists already" in done.stderr
        done = run_keys(str(tmp_path), "--renew")
        assert done.returncode == 0
        assert f"{tmp_path / 'robot' / 'certificate.pem'} for robot 'robot'" in done.stdout

    def test_names_are_repeated_options(self, tmp_path: Path) -> None:
        done = run_keys(str(tmp_path), "--robot", "a", "--robot", "b", "--service", "c")
        assert done.returncode == 0
        assert {path.name for path in tmp_path.iterdir()} == {"authority", "a", "b", "c"}
        # Each has its own command.
        commands = [line.split() for line in done.stdout.splitlines() if "--tls" in line]
        assert [(each[1], each[-1]) for each in commands] == [
            ("serve", str(tmp_path / "c")),
            ("run", str(tmp_path / "a")),
            ("run", str(tmp_path / "b")),
        ]

    def test_the_default_of_days_is_the_librarys(self) -> None:
        from holdfast.transport.key_ring import DEFAULT_DAYS

        assert f"[default: {DEFAULT_DAYS}]" in run_keys("--help").stdout
