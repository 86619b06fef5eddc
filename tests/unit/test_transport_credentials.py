"""Credentials: loaded, checked before a link is opened, and on real links."""

import asyncio
import errno
import importlib
import os
import re
import shutil
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from holdfast.errors import CredentialsError, CredentialsGoneError
from holdfast.protocol.robot_events import CallEnded, ReplyReceived, ServiceAppeared
from holdfast.transport.contract import IncomingCall
from holdfast.transport.credentials import load_credentials
from holdfast.transport.endpoints import Role, TlsFiles
from holdfast.transport.key_ring import make_credentials
from holdfast.transport.robot_end import StreamRobotTransport
from holdfast.transport.service_end import StreamServiceTransport

PATIENCE_S = 60.0
LEASE_MS = 30_000.0
NOW = datetime.now(UTC)
DAY = timedelta(days=1)
FILES = {"authority.pem", "certificate.pem", "key.pem"}
TRUST = (Path(__file__).parents[2] / "docs" / "trust.md").read_text(encoding="utf-8")
SENTENCES = [
    sentence
    for row in re.findall(r"^\|.*", TRUST, re.MULTILINE)
    for sentence in re.findall(r"`([^`]{20,})`", row)
]
"""What docs/trust.md says that a robot's log has of each refusal."""


def assert_documented(said: str) -> None:
    assert any(sentence in said for sentence in SENTENCES), said


def certificate_of(directory: Path, name: str = "certificate.pem") -> x509.Certificate:
    return x509.load_pem_x509_certificate((directory / name).read_bytes())


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
        home, robots=["expired_robot"], services=["expired_service"], days=30, now=NOW - 100 * DAY
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
        files = load_credentials(str(keys / role), role).files
        assert [files.authority, files.certificate, files.key] == [
            keys / role / name for name in ("authority.pem", "certificate.pem", "key.pem")
        ]

    @pytest.mark.parametrize(
        ("name", "role", "reason"),
        [
            ("robot", "service", r"robot/certificate\.pem: is not for a service; a service"),
            ("service", "robot", "'holdfast keys DIR' makes DIR/robot"),
            (
                "expired_robot",
                "robot",
                r"certificate\.pem: has expired \(valid from 20.*--renew --robot NAME",
            ),
            ("future_robot", "robot", r"is not valid yet; is a clock wrong\? \(valid from 20"),
            ("foreign_robot", "robot", r"was not signed by the authority in authority\.pem"),
            ("nameless_robot", "robot", r"certificate\.pem: has 0 common names, and must have one"),
            ("two_names_service", "service", "has 2 common names, and must have one"),
            ("absent", "robot", r"absent/authority\.pem: cannot be read: .*holdfast keys"),
            (".", "robot", r"did you mean .*robot\?"),
        ],
    )
    def test_bad_ones_are_found_before_a_link_is_opened(
        self, keys: Path, name: str, role: Role, reason: str
    ) -> None:
        with pytest.raises(CredentialsError, match=reason) as refused:
            load_credentials(keys / name, role)
        gone = name in (".", "absent", "expired_robot")
        assert isinstance(refused.value, CredentialsGoneError) is gone
        assert not str(refused.value).endswith("None")
        if role == "robot" and name.partition("_")[0] in ("expired", "future", "foreign"):
            assert_documented(str(refused.value))

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

    def test_a_file_that_may_not_be_read_is_named(
        self, keys: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def refuse(*_: object) -> None:
            raise PermissionError(errno.EACCES, "Permission denied")

        monkeypatch.setattr(Path, "open", refuse)
        with pytest.raises(CredentialsError, match=r"cannot be read: Permission .* is user \d+$"):
            load_credentials(keys / "robot", "robot")

    def test_what_somebody_should_look_at_is_said(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, days=3)
        (tmp_path / "robot" / "key.pem").chmod(0o644)
        said: list[str] = []
        load_credentials(tmp_path / "robot", "robot", warn=said.append)
        assert len(said) == 2
        assert "key.pem: others can read this key (mode 644)" in said[0]
        assert "certificate.pem: expires in 3.0 days, on 20" in said[1]
        make_credentials(tmp_path, services=["service"], renew=True, days=1)
        with pytest.warns(UserWarning, match=r"expires in 24\.0 hours"):
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

    def test_loading_needs_no_package_and_making_says_which_it_needs(
        self, keys: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "cryptography", None)
        for module in ("key_ring", "authority"):
            monkeypatch.delitem(sys.modules, f"holdfast.transport.{module}")
        load_credentials(keys / "robot", "robot")
        with pytest.raises(CredentialsError, match=r"pem: has expired; 'holdfast keys DIR --renew"):
            load_credentials(keys / "expired_robot", "robot")
        with pytest.raises(CredentialsError, match="pip install cryptography"):
            importlib.import_module("holdfast.transport.key_ring")

    def test_loading_imports_nothing_heavy(self, keys: Path) -> None:
        program = (
            "import sys; from holdfast.transport.credentials import load_credentials; "
            f"load_credentials({str(keys / 'service')!r}, 'service'); print(*sys.modules)"
        )
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True
        )
        assert not set(done.stdout.split()) & {"cryptography", "numpy", "asyncio", "rich"}


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
            "cloud",
            incarnation="b1",
            listen=[f"tls/{host}:0"],
            lease_ms=LEASE_MS,
            tls=self.files(name),
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
            {"cloud": endpoint},
            lease_ms=LEASE_MS,
            tls=self.files(name),
            on_event=lambda _, **fields: said.put_nowait(fields["reason"]),
        )
        self._ends.append(robot)
        robot.start(said.put_nowait)
        first = await asyncio.wait_for(said.get(), PATIENCE_S)
        if not isinstance(first, ServiceAppeared):
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
        assert await ends.ask("robot", endpoint) == [ReplyReceived(1, b"robot: cba"), CallEnded(1)]

    @pytest.mark.parametrize(
        ("name", "reason"),
        [
            ("foreign_robot", "not signed by the authority in authority.pem there"),
            (
                "expired_robot",
                "expired by the clock there; 'holdfast keys DIR --renew --robot NAME'",
            ),
            ("future_robot", "it is not valid yet by the clock there"),
            ("service", "it is not for a robot; a robot shows its own"),
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
        if "names" not in reason:
            assert_documented(refusal)
        assert await ends.ask("robot", endpoint) == [ReplyReceived(1, b"robot: cba"), CallEnded(1)]

    @pytest.mark.parametrize(
        ("name", "reason"),
        [
            ("robot", "is not for a service; a service"),
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
        if "names" not in reason:
            assert_documented(refusal)

    async def test_a_robot_believes_a_service_only_at_its_own_hosts(self, ends: Ends) -> None:
        # Everything in 127/8 is this machine, but the certificate is for 127.0.0.1 alone.
        endpoint = await ends.service("service", "0.0.0.0")
        (refusal,) = await ends.ask("robot", endpoint.replace("0.0.0.0", "127.0.0.2"))
        assert isinstance(refusal, str)
        assert "does not name this host" in refusal
        assert_documented(refusal)
        assert "--renew --service NAME --host HOST" in refusal
        assert "127.0.0.2" in refusal
        right = await ends.ask("robot", endpoint.replace("0.0.0.0", "127.0.0.1"))
        assert right == [ReplyReceived(1, b"robot: cba"), CallEnded(1)]
