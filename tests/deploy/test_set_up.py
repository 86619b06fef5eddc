"""``deploy/cloud-init/set-up`` with an ssh that says no: what it sends where, and to whom."""

import os
import subprocess
from pathlib import Path

import pytest
from tests.deploy.docker import PATIENCE_S, ROOT
from tests.programs import completed

from holdfast.transport.key_ring import make_credentials

SSH = """\
#!/bin/sh
echo "$1 $2 $3 $4 $5" >>{directory}/called
{does}
"""


class Place:
    """A directory with keys, a wheel, and an ``ssh`` that does as a test says."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        make_credentials(directory / "keys")
        (directory / "holdfast.whl").write_bytes(b"")

    def set_up(self, does: str) -> subprocess.CompletedProcess[str]:
        ssh = self.directory / "ssh"
        ssh.write_text(SSH.format(directory=self.directory, does=does))
        ssh.chmod(0o755)
        keys = self.directory / "keys" / "service"
        words = ("admin@host", "cloud", "--keys", keys, "--wheel", self.directory / "holdfast.whl")
        return completed(
            [str(word) for word in (ROOT / "deploy/cloud-init/set-up", *words)],
            env={**os.environ, "SSH": str(ssh)},
            timeout=PATIENCE_S,
        )

    def called(self) -> list[str]:
        return (self.directory / "called").read_text().splitlines()


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path)


def test_no_key_goes_to_a_host_that_nobody_has_looked_at(place: Place) -> None:
    done = place.set_up('echo "Host key verification failed." >&2; exit 255')
    assert done.returncode == 2
    assert "admin@host is not known here, or its key is another" in done.stderr
    (options,) = place.called()
    assert "StrictHostKeyChecking=ask" in options


def test_what_goes_there_is_the_parcel_with_the_list_of_packages(place: Place) -> None:
    done = place.set_up(f'case "$*" in *tar*) tar -t >{place.directory}/parcel ;; esac')
    assert done.returncode == 0, done.stderr
    assert all("StrictHostKeyChecking=ask" in options for options in place.called())
    parcel = set((place.directory / "parcel").read_text().splitlines())
    assert {"./install", "./holdfast-cloud.service", "./requirements.txt"} <= parcel
    assert {"./keys/service/key.pem", "./wheel/holdfast.whl"} <= parcel
    assert not [name for name in parcel if "authority/" in name]
