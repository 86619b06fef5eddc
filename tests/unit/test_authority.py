"""The authority: whose certificate and key it is, and for how long."""

import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509

from holdfast.errors import CredentialsError
from holdfast.transport import authority
from holdfast.transport.key_ring import make_credentials

NOW = datetime.now(UTC)
DAY = timedelta(days=1)


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

    def test_the_second_of_its_end_is_no_part_of_its_time(self, tmp_path: Path) -> None:
        end = make_credentials(tmp_path).authority_expires
        home = tmp_path / "authority"
        last = authority.Authority.read(home, end - timedelta(seconds=1), lambda _: None)
        assert last.certificate.not_valid_after_utc == end
        with pytest.raises(CredentialsError, match="has expired on"):
            authority.Authority.read(home, end, lambda _: None)

    def test_a_key_that_others_can_read_is_warned_of(self, tmp_path: Path) -> None:
        make_credentials(tmp_path)
        (tmp_path / "authority" / "authority.key").chmod(0o640)
        said: list[str] = []
        make_credentials(tmp_path, robots=["new"], warn=said.append)
        assert len(said) == 1
        assert "authority.key: others can read this key (mode 640)" in said[0]


class TestSignatures:
    def test_it_knows_its_own_certificates_by_their_signature_not_their_name(self) -> None:
        ours, other = authority.Authority.new(NOW), authority.Authority.new(NOW)
        key = authority.new_key()
        made = ours.certify("anna", "robot", (), key.public_key(), NOW, NOW + DAY)
        assert authority.is_signed_by(ours.certificate, made)
        assert not authority.is_signed_by(other.certificate, made)
        assert authority.common_name_of(made) == "anna"
        assert authority.role_of(made) == "robot"
        assert made.public_key() == key.public_key()
        assert authority.role_of(ours.certificate) is None

    def test_a_list_grows_and_keeps_what_was_revoked_when(self, tmp_path: Path) -> None:
        ours = authority.Authority.new(NOW)
        for moment, serial in ((NOW, 7), (NOW + DAY, 8)):
            before = authority.read_revocations(tmp_path, ours.certificate)
            content = ours.revoke(before, [serial], moment)
            (tmp_path / "revoked.pem").write_bytes(content)
        revoked = authority.read_revocations(tmp_path, ours.certificate)
        assert revoked is not None
        assert [entry.serial_number for entry in revoked] == [7, 8]
        number = revoked.extensions.get_extension_for_class(x509.CRLNumber).value
        assert number.crl_number == 2
        assert revoked.last_update_utc == ours._begin(NOW + DAY).replace(microsecond=0)
        assert ours._begin(NOW + DAY) < NOW + DAY
        # Of an authority that is newer than that, its own beginning.
        assert ours._begin(NOW - DAY) == ours.certificate.not_valid_before_utc
        later, earlier = (each.revocation_date_utc for each in (revoked[1], revoked[0]))
        assert later - earlier == DAY
        other = authority.Authority.new(NOW)
        with pytest.raises(CredentialsError, match="was not signed by"):
            authority.read_revocations(tmp_path, other.certificate)


@pytest.mark.parametrize(
    ("host", "is_one"),
    [
        ("10.0.0.7", True),
        ("fe80::1", True),
        ("1:2:3:4:5:6:7:8:9", False),
        ("localhost", True),
        ("x" * 63, True),
        ("x" * 64, False),
        (".".join(["x" * 63] * 3 + ["x" * 61]), True),  # 253
        (".".join(["x" * 63] * 3 + ["x" * 62]), False),
        ("a..b", False),
        ("-a", False),
        ("", False),
    ],
)
def test_what_a_certificate_can_name(host: str, is_one: bool) -> None:
    assert authority.is_host(host) is is_one
