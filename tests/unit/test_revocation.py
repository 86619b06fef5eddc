"""Revoking certificates: what is written, what a handshake makes of it, and reading the list."""

import base64
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import NameOID
from hypothesis import given
from hypothesis import strategies as st
from tests.unit.test_key_ring import contents_of, run_keys

from holdfast.errors import CredentialsError, TransportError
from holdfast.transport import revocation
from holdfast.transport.credentials import load_credentials
from holdfast.transport.endpoints import REVOKED_FILE, Role
from holdfast.transport.key_ring import list_credentials, make_credentials, revoke_credentials
from holdfast.transport.revocation import revoked_serials

NOW = datetime.now(UTC)
DAY = timedelta(days=1)


def serial_of(directory: Path) -> int:
    path = directory / "certificate.pem"
    return x509.load_pem_x509_certificate(path.read_bytes()).serial_number


def list_in(directory: Path) -> x509.CertificateRevocationList:
    return x509.load_pem_x509_crl((directory / REVOKED_FILE).read_bytes())


@pytest.fixture
def home(tmp_path: Path) -> Path:
    make_credentials(tmp_path, robots=["anna", "berta"], services=["cloud"])
    return tmp_path


@pytest.fixture(scope="module")
def foreign_list(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The list of another authority."""
    other = tmp_path_factory.mktemp("other")
    make_credentials(other)
    revoke_credentials(other, names=["robot"])
    return other / "authority" / REVOKED_FILE


class TestRevoking:
    def test_the_list_is_signed_and_lies_beside_everybodys_credentials(self, home: Path) -> None:
        done = revoke_credentials(home, names=["anna"])
        assert [each.name for each in done] == ["anna"]
        revoked = list_in(home / "authority")
        authority = x509.load_pem_x509_certificate(
            (home / "authority" / "authority.pem").read_bytes()
        )
        key = authority.public_key()
        assert isinstance(key, ec.EllipticCurvePublicKey)
        assert revoked.is_signature_valid(key)
        assert revoked.issuer == authority.subject
        assert [entry.serial_number for entry in revoked] == [serial_of(home / "anna")]
        # A list that expires locks everybody out, and a clock may be a little behind.
        assert revoked.next_update_utc == authority.not_valid_after_utc
        assert revoked.last_update_utc <= datetime.now(UTC) - DAY + timedelta(minutes=10)
        for name in ("anna", "berta", "cloud"):
            assert list_in(home / name) == revoked

    def test_lists_are_numbered_and_only_grow(self, home: Path) -> None:
        numbers, sizes = [], []
        for name in ("anna", "berta", "cloud"):
            revoke_credentials(home, names=[name])
            revoked = list_in(home / "cloud")
            number = revoked.extensions.get_extension_for_class(x509.CRLNumber).value
            numbers.append(number.crl_number)
            sizes.append(len(revoked))
        assert numbers == [1, 2, 3]
        assert sizes == [1, 2, 3]

    def test_again_changes_nothing(self, home: Path) -> None:
        revoke_credentials(home, names=["anna"])
        before = contents_of(home)
        done = revoke_credentials(home, names=["anna"])
        assert done == ()
        assert contents_of(home) == before

    def test_again_finishes_what_was_begun(self, home: Path) -> None:
        revoke_credentials(home, names=["anna"])
        (home / "cloud" / REVOKED_FILE).unlink()
        done = revoke_credentials(home, names=["anna"])
        assert done == ()
        assert revoked_serials(home / "cloud" / REVOKED_FILE) == {serial_of(home / "anna")}

    def test_every_certificate_that_a_name_ever_had(self, home: Path) -> None:
        """A thief of the key may have kept one from before it was renewed."""
        old = [serial_of(home / "anna")]
        make_credentials(home, robots=["anna"], renew=True)
        old.append(serial_of(home / "anna"))
        make_credentials(home, robots=["anna"], rotate=True)
        old.append(serial_of(home / "anna"))
        revoke_credentials(home, names=["anna"])
        assert revoked_serials(home / "cloud" / REVOKED_FILE) == set(old)

    def test_one_from_before_records_were_kept(self, home: Path) -> None:
        (home / "authority" / "issued.csv").unlink()
        revoke_credentials(home, names=["anna"])
        assert revoked_serials(home / "cloud" / REVOKED_FILE) == {serial_of(home / "anna")}

    def test_by_its_number_though_its_files_are_gone(self, home: Path) -> None:
        serial = serial_of(home / "anna")
        shutil.rmtree(home / "anna")
        done = revoke_credentials(home, serials=[serial])
        assert [(each.name, each.serial) for each in done] == [("anna", serial)]
        unknown = revoke_credentials(home, serials=[12345])
        assert [(each.name, each.role) for each in unknown] == [("", None)]
        assert revoked_serials(home / "cloud" / REVOKED_FILE) == {serial, 12345}

    def test_who_is_new_gets_the_list_too(self, home: Path) -> None:
        revoke_credentials(home, names=["anna"])
        make_credentials(home, services=["cloud-2"])
        assert list_in(home / "cloud-2") == list_in(home / "cloud")

    @pytest.mark.parametrize("name", ["", "clara", "authority", "../anna", "anna "])
    def test_a_name_that_has_none(self, home: Path, name: str) -> None:
        before = contents_of(home)
        with pytest.raises(CredentialsError, match="has no certificate of"):
            revoke_credentials(home, names=["anna", name])
        assert contents_of(home) == before

    @pytest.mark.parametrize("serial", [0, -1, 2**159])
    def test_a_number_that_is_none(self, home: Path, serial: int) -> None:
        with pytest.raises(CredentialsError, match="serial number"):
            revoke_credentials(home, serials=[serial])

    def test_the_least_and_the_largest_number(self, home: Path) -> None:
        for serial in (1, 2**159 - 1):
            assert [each.serial for each in revoke_credentials(home, serials=[serial])] == [serial]
        assert revoked_serials(home / "cloud" / REVOKED_FILE) == {1, 2**159 - 1}

    def test_without_the_authoritys_key(self, home: Path) -> None:
        (home / "authority" / "authority.key").unlink()
        with pytest.raises(CredentialsError, match=r"authority\.key: cannot be read"):
            revoke_credentials(home, names=["anna"])

    def test_a_list_of_another_authority_is_not_gone_on_with(
        self, home: Path, foreign_list: Path
    ) -> None:
        shutil.copy(foreign_list, home / "authority" / REVOKED_FILE)
        with pytest.raises(CredentialsError, match=r"revoked\.pem: was not signed by"):
            revoke_credentials(home, names=["anna"])

    def test_a_record_that_is_spoilt(self, home: Path) -> None:
        for text in ("", "serial\n", "serial,name,role,expires\nxyz,anna,robot,2026-01-01\n"):
            (home / "authority" / "issued.csv").write_text(text)
            with pytest.raises(CredentialsError, match=r"issued\.csv: is no record"):
                revoke_credentials(home, names=["anna"])


class TestRotating:
    def test_key_and_certificate_are_new_and_hosts_stay(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, hosts=["10.0.0.7"])
        before = contents_of(tmp_path)
        ring = make_credentials(tmp_path, services=["service"], rotate=True)
        after = contents_of(tmp_path)
        assert {name for name in before if before[name] != after[name]} == {
            "service/certificate.pem",
            "service/key.pem",
            "authority/issued.csv",
        }
        assert set(before) == set(after)
        assert "10.0.0.7" in ring.made[0].hosts
        assert not ring.made[0].renewed
        load_credentials(tmp_path / "service", "service")

    def test_what_was_revoked_gets_a_new_key_only(self, home: Path) -> None:
        revoke_credentials(home, names=["anna"])
        before = contents_of(home)
        with pytest.raises(CredentialsError, match="is revoked, so its key gets no new certif"):
            make_credentials(home, robots=["anna"], renew=True)
        assert contents_of(home) == before
        make_credentials(home, robots=["anna"], rotate=True)
        load_credentials(home / "anna", "robot")

    def test_renew_and_rotate_exclude_each_other(self, home: Path) -> None:
        with pytest.raises(CredentialsError, match="choose one"):
            make_credentials(home, renew=True, rotate=True)


class TestListing:
    def test_all_that_was_made_and_what_is_revoked(self, home: Path) -> None:
        first = serial_of(home / "anna")
        make_credentials(home, robots=["anna"], rotate=True)
        revoke_credentials(home, serials=[first, 77])
        told = {
            each.serial: (each.name, each.role, each.revoked) for each in list_credentials(home)
        }
        assert {serial: name for serial, (name, _, _) in told.items()} == {
            first: "anna",
            serial_of(home / "anna"): "anna",
            serial_of(home / "berta"): "berta",
            serial_of(home / "cloud"): "cloud",
            77: "",
        }
        assert {serial for serial, (_, _, at) in told.items() if at is not None} == {first, 77}
        assert told[serial_of(home / "cloud")][1] == "service"


class TestLoading:
    @pytest.mark.parametrize(("name", "role"), [("anna", "robot"), ("cloud", "service")])
    def test_whose_own_is_revoked_is_told(self, home: Path, name: str, role: Role) -> None:
        revoke_credentials(home, names=[name])
        wanted = rf"certificate\.pem: has been revoked; .*--rotate --{role} NAME"
        with pytest.raises(CredentialsError, match=wanted):
            load_credentials(home / name, role)

    def test_a_list_of_another_authority(self, home: Path, foreign_list: Path) -> None:
        shutil.copy(foreign_list, home / "cloud" / REVOKED_FILE)
        with pytest.raises(CredentialsError, match=r"revoked\.pem: is not of the authority"):
            load_credentials(home / "cloud", "service")

    def test_a_list_that_somebody_changed(self, home: Path) -> None:
        """Its numbers can be read by anybody; that it is the authority's, a handshake shows."""
        revoke_credentials(home, names=["anna"])
        path = home / "cloud" / REVOKED_FILE
        der = bytearray(list_in(home / "cloud").public_bytes(Encoding.DER))
        serial = serial_of(home / "anna").to_bytes(20, "big").lstrip(b"\0")
        at = bytes(der).index(serial)
        der[at + 5] ^= 1
        path.write_bytes(x509.load_der_x509_crl(bytes(der)).public_bytes(Encoding.PEM))
        with pytest.raises(CredentialsError, match=r"revoked\.pem: was not signed by the auth"):
            load_credentials(home / "cloud", "service")

    @pytest.mark.parametrize("content", [b"", b"no list", b"-----BEGIN X509 CRL-----"])
    def test_what_is_no_list(self, home: Path, content: bytes) -> None:
        (home / "cloud" / REVOKED_FILE).write_bytes(content)
        with pytest.raises(CredentialsError, match=r"revoked\.pem: is no revocation list"):
            load_credentials(home / "cloud", "service")

    def test_a_certificate_in_its_place_is_not_believed(
        self, home: Path, tmp_path_factory: pytest.TempPathFactory
    ) -> None:
        """What the library loads as a list may hold authorities as well: these would count."""
        other = tmp_path_factory.mktemp("other")
        make_credentials(other)
        revoke_credentials(home, names=["anna"])
        path = home / "cloud" / REVOKED_FILE
        path.write_bytes(path.read_bytes() + (other / "robot" / "authority.pem").read_bytes())
        with pytest.raises(CredentialsError, match=r"revoked\.pem: is no revocation list"):
            load_credentials(home / "cloud", "service")


KEY = ec.generate_private_key(ec.SECP256R1())


def list_of(serials: list[int], *, number: int | None, until: bool) -> bytes:
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "authority")])
    builder = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(name)
        .last_update(NOW)
        .next_update(NOW + DAY if until else NOW + 20_000 * DAY)
    )
    if number is not None:
        builder = builder.add_extension(x509.CRLNumber(number), critical=False)
    for serial in serials:
        entry = x509.RevokedCertificateBuilder(serial, NOW)
        if serial % 2:
            reason = x509.CRLReason(x509.ReasonFlags.key_compromise)
            entry = entry.add_extension(reason, critical=False)
        builder = builder.add_revoked_certificate(entry.build())
    return builder.sign(KEY, hashes.SHA256()).public_bytes(Encoding.PEM)


SPECIMEN = x509.load_pem_x509_crl(list_of([5, 7], number=1, until=True)).public_bytes(Encoding.DER)


def pem_of(der: bytes) -> bytes:
    head, tail = b"-----BEGIN X509 CRL-----\n", b"-----END X509 CRL-----\n"
    return head + base64.encodebytes(der) + tail


class TestReading:
    @given(
        st.lists(st.integers(1, 2**159 - 1), max_size=40, unique=True),
        st.one_of(st.none(), st.integers(0, 2**100)),
        st.booleans(),
    )
    def test_numbers_are_those_that_cryptography_wrote(
        self,
        tmp_path_factory: pytest.TempPathFactory,
        serials: list[int],
        number: int | None,
        until: bool,
    ) -> None:
        path = tmp_path_factory.getbasetemp() / "read.pem"
        path.write_bytes(list_of(serials, number=number, until=until))
        assert revoked_serials(path) == set(serials)

    @given(st.data())
    def test_damage_is_refused_or_read(
        self, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
    ) -> None:
        der = bytearray(SPECIMEN)
        for _ in range(data.draw(st.integers(1, 3))):
            at = data.draw(st.integers(0, len(der) - 1))
            der[at] = data.draw(st.integers(0, 255))
        cut = data.draw(st.integers(0, len(der)))
        path = tmp_path_factory.getbasetemp() / "damaged.pem"
        path.write_bytes(pem_of(bytes(der[:cut])))
        try:
            read = revoked_serials(path)
        except TransportError as error:
            assert "revocation list" in str(error)
        else:
            assert all(isinstance(serial, int) for serial in read)

    def test_malformed_values_are_named(self, tmp_path: Path) -> None:
        path, left = tmp_path / REVOKED_FILE, len(SPECIMEN) - 4
        for der, says in (
            (SPECIMEN[:-1], f"a value of {left + 1} bytes where {left} are left"),
            (b"\x31" + SPECIMEN[1:], "a value with the tag 0x31 where 0x30 belongs"),
            (b"\x30\x85" + SPECIMEN, "a length of 5 bytes"),
            (b"\x30\x80" + SPECIMEN, "a length of 0 bytes"),
        ):
            path.write_bytes(pem_of(der))
            with pytest.raises(TransportError, match=f"is a malformed revocation list: {says}"):
                revoked_serials(path)

    def test_the_size_of_a_list_is_bounded(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (path := tmp_path / REVOKED_FILE).write_bytes(pem := pem_of(SPECIMEN))
        monkeypatch.setattr(revocation, "_MAX_LIST_BYTES", len(pem) - 1)
        with pytest.raises(TransportError, match=f"is larger than {len(pem) - 1} bytes"):
            revoked_serials(path)

    def test_no_file_is_an_empty_list(self, tmp_path: Path) -> None:
        assert revoked_serials(tmp_path / REVOKED_FILE) == frozenset()

    def test_a_directory_is_named(self, tmp_path: Path) -> None:
        (tmp_path / REVOKED_FILE).mkdir()
        with pytest.raises(TransportError, match=r"revoked\.pem: cannot be read: Is a directory"):
            revoked_serials(tmp_path / REVOKED_FILE)


class TestCommand:
    def test_it_revokes_and_makes_nothing(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path
    ) -> None:
        make_credentials(tmp_path, robots=["anna"], services=["cloud"])
        done = run_keys(capsys, tmp_path, "--revoke", "anna")
        assert (done.code, done.stderr) == (0, "")
        assert f"certificate {serial_of(tmp_path / 'anna'):040x}, robot 'anna'" in done.stdout
        assert f"lacks {tmp_path / 'authority' / REVOKED_FILE} still admits them" in done.stdout
        assert {path.name for path in tmp_path.iterdir()} == {"authority", "anna", "cloud"}
        again = run_keys(capsys, tmp_path, "--revoke", "anna")
        assert again.code == 0
        assert "were revoked before" in again.stdout

    def test_it_revokes_by_number_and_lists(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path
    ) -> None:
        make_credentials(tmp_path, robots=["anna"], services=["cloud"])
        serial = f"{serial_of(tmp_path / 'anna'):x}"
        done = run_keys(capsys, tmp_path, "--revoke-serial", serial, "--list")
        assert done.code == 0
        lines = [line for line in done.stdout.splitlines() if ", valid until" in line]
        assert [("revoked on" in line, "'anna'" in line) for line in lines[-2:]] == [
            (False, False),
            (True, True),
        ]

    def test_rotating_and_revoking_at_once_revokes_the_old_one(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path
    ) -> None:
        make_credentials(tmp_path, robots=["anna"], services=["cloud"])
        old = serial_of(tmp_path / "anna")
        done = run_keys(capsys, tmp_path, "--rotate", "--robot", "anna", "--revoke", "anna")
        assert done.code == 0, done.stderr
        assert revoked_serials(tmp_path / "cloud" / REVOKED_FILE) == {old}
        load_credentials(tmp_path / "anna", "robot")

    @pytest.mark.parametrize(
        ("arguments", "says"),
        [
            (["--revoke", "clara"], "name 'clara': has no certificate of"),
            (["--revoke-serial", "xyz"], "'xyz'; allowed are hexadecimal numbers"),
            (["--list", "--host", "a.example"], "--host a.example: stands in a service's"),
        ],
    )
    def test_what_cannot_be(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: list[str], says: str
    ) -> None:
        make_credentials(tmp_path, robots=["anna"], services=["cloud"])
        done = run_keys(capsys, tmp_path, *arguments)
        assert done.code == 2
        assert done.stderr.startswith("holdfast: error: ")
        assert says in done.stderr
