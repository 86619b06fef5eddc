"""The key ring: what it makes, renews and refuses, and that nothing is ever half done."""

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
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from tests.command_line import Said, run_here

from holdfast.errors import CredentialsError, OutputError
from holdfast.runtime.files import NewFile, create_directory_atomically
from holdfast.transport import key_ring
from holdfast.transport.credentials import load_credentials
from holdfast.transport.key_ring import list_credentials, make_credentials, revoke_credentials

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
        assert [made.name for made in ring.made] == ["cloud-2.lab", "left", "right"]
        after = contents_of(tmp_path)
        record = before.pop("authority/issued.csv")
        assert after["authority/issued.csv"].startswith(record)
        assert {name: after[name] for name in before} == before
        authority = certificate_of(tmp_path / "authority", "authority.pem")
        for name in ("left", "right", "cloud-2.lab"):
            certificate_of(tmp_path / name).verify_directly_issued_by(authority)

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


class TestRotation:
    def test_the_directory_stays_the_same_one(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, robots=["anna"], services=["cloud"])
        mounted = os.open(tmp_path / "cloud", os.O_RDONLY)  # as a container's mount is
        try:
            before = certificate_of(tmp_path / "cloud").serial_number
            make_credentials(tmp_path, rotate=True)
            there = Path(f"/proc/self/fd/{mounted}")
            assert load_credentials(there, "service").name == "cloud"
            assert certificate_of(there).serial_number != before
        finally:
            os.close(mounted)

    @pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
    def test_whoever_could_read_a_file_can_read_the_next(self, tmp_path: Path) -> None:
        make_credentials(tmp_path, services=["cloud"])
        place = tmp_path / "cloud"
        for path in (place, *place.iterdir()):
            os.chown(path, 10001, 10002)
        (place / "key.pem").chmod(0o640)
        before = os.umask(0o077)
        try:
            make_credentials(tmp_path, services=["cloud"], renew=True)
            make_credentials(tmp_path, services=["cloud"], rotate=True)
            revoke_credentials(tmp_path, serials=[7])
        finally:
            os.umask(before)
        assert {path.name: mode_of(path) for path in place.iterdir()} == {
            "authority.pem": 0o644,
            "certificate.pem": 0o644,
            "key.pem": 0o640,
            "revoked.pem": 0o644,
        }
        for path in place.iterdir():
            assert (path.stat().st_uid, path.stat().st_gid) == (10001, 10002), path

    def test_a_second_authority_beside_it_stays(self, tmp_path: Path) -> None:
        make_credentials(tmp_path / "a", services=["cloud"])
        make_credentials(tmp_path / "b", robots=["anna"])
        authority = tmp_path / "a" / "cloud" / "authority.pem"
        both = authority.read_bytes() + (tmp_path / "b" / "anna" / "authority.pem").read_bytes()
        authority.write_bytes(both)
        make_credentials(tmp_path / "a", rotate=True)
        assert authority.read_bytes() == both
        load_credentials(tmp_path / "a" / "cloud", "service")


class TestArguments:
    @pytest.mark.parametrize(
        ("says", "what", "values"),
        [
            ("at most 64", "robots", ["", "..", "a/b", "-x", ".b", "authority", "a" * 65, "é\n"]),
            ("'service': stands twice", "robots", ["service"]),
            ("is no host name and no IP", "hosts", ["", "tls/10.0.0.7:7447", "10.0.0.7:7447"]),
            ("is no host name and no IP", "hosts", ["[::1]", "a..b", "*.lan", "é.lan", "a b"]),
        ],
    )
    def test_names_and_hosts_that_are_none_are_refused(
        self, tmp_path: Path, says: str, what: str, values: list[str]
    ) -> None:
        for value in values:
            named: dict[str, Any] = {"services": ["service"], what: [value]}
            with pytest.raises(CredentialsError, match=says):
                make_credentials(tmp_path, **named)
        assert list(tmp_path.iterdir()) == []

    def test_a_host_without_a_service_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(CredentialsError, match=r"10\.0\.0\.7': .*\(--service NAME;"):
            make_credentials(tmp_path, robots=["arm"], hosts=["10.0.0.7"])

    def test_days_have_bounds(self, tmp_path: Path) -> None:
        for days in (0, -1, 3651):
            with pytest.raises(CredentialsError, match=f"days: {days} is not between 1 and 3650"):
                make_credentials(tmp_path, days=days)
        for days in (1, 3650):
            made = make_credentials(tmp_path / str(days), robots=["arm"], days=days)
            assert made.made[0].expires - datetime.now(UTC) > (days - 1) * DAY

    def test_a_name_of_64_letters_and_an_empty_directory_of_it(self, tmp_path: Path) -> None:
        (tmp_path / ("x" * 64)).mkdir()
        make_credentials(tmp_path, robots=["x" * 64])
        load_credentials(tmp_path / ("x" * 64), "robot")

    def test_as_many_names_as_one_call_may_have(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(key_ring, "MAX_PARTIES", 2)
        make_credentials(tmp_path, robots=["a"], services=["b"])
        with pytest.raises(CredentialsError, match="3 names are more than 2 at once"):
            make_credentials(tmp_path, robots=["c", "d"], services=["e"])


def run_keys(capsys: pytest.CaptureFixture[str], home: Path, *arguments: str) -> Said:
    return run_here(capsys, home.parent, "keys", str(home), *arguments)


KILLED_AT_EACH_MOMENT = """
import os, shutil, signal, sys
from pathlib import Path
import holdfast.cli
import holdfast.transport.key_ring
from holdfast.transport.credentials import load_credentials

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
        for name in ("open", "fchmod", "fsync", "rename", "replace", "unlink", "rmdir"):
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
    # At this moment, before anybody completes it.
    load_credentials(copy / "anna", "robot")
    load_credentials(copy / "cloud", "service")
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
                for name in ("anna", "cloud"):
                    assert {path.name for path in (copy / name).iterdir()} == FILES

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
                said = second.stderr.readline()
                first.stdin.write("go on\n")  # before anything fails: the second waits for it
                first.stdin.flush()
                assert "another 'holdfast keys' is at work" in said
                _, errors = second.communicate(timeout=60)
            assert (first.wait(60), second.returncode, errors) == (0, 0, "")
        load_credentials(tmp_path / "anna", "robot")
        serials = [each.serial for each in list_credentials(tmp_path)]
        assert len(serials) == 3
        assert serials[0] == before
        assert serials[2] == certificate_of(tmp_path / "anna").serial_number

    def test_it_makes_keys_and_says_what_goes_where(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path
    ) -> None:
        home = tmp_path / "keys"
        done = run_keys(capsys, home, "--host", "10.0.0.7", "--days", "30")
        assert (done.code, done.stderr) == (0, "")
        assert f"{home / 'authority' / 'authority.key'} stays here" in done.stdout
        assert f"--tls {home / 'service'}" in done.stdout
        assert f"--tls {home / 'robot'}" in done.stdout
        assert "--service tls/10.0.0.7:7447" in done.stdout
        load_credentials(home / "service", "service")

    def test_again_it_refuses_and_renews_if_told_to(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path
    ) -> None:
        assert run_keys(capsys, tmp_path).code == 0
        done = run_keys(capsys, tmp_path)
        assert done.code == 2
        assert done.stderr.startswith("holdfast: error: ")
        assert "service/certificate.pem: exists already" in done.stderr
        done = run_keys(capsys, tmp_path, "--renew")
        assert done.code == 0
        assert f"{tmp_path / 'robot' / 'certificate.pem'} for robot 'robot'" in done.stdout

    def test_names_are_repeated_options(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path
    ) -> None:
        done = run_keys(capsys, tmp_path, "--robot", "a", "--robot", "b", "--service", "c")
        assert done.code == 0
        assert {path.name for path in tmp_path.iterdir()} == {"authority", "a", "b", "c"}
        # Each has its own command.
        commands = [line.split() for line in done.stdout.splitlines() if "--tls" in line]
        places = [(each[1], Path(each[-1]).relative_to(tmp_path).name) for each in commands]
        assert places == [("serve", "c"), ("run", "a"), ("run", "b")]
