"""What ``holdfast keys`` refuses before it makes anything; test_key_ring.py has the keys."""

from pathlib import Path

import pytest
from tests.command_line import run_here

from holdfast.cli import keys
from holdfast.transport import key_ring
from holdfast.transport.authority import AUTHORITY_DAYS


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--days", "0"], "--days is '0'; allowed are whole numbers from 1 to 3650"),
        (["--revoke-serial", "xyz"], "--revoke-serial is 'xyz'; allowed are hexadecimal numbers"),
        (["--rotat"], "did you mean --rotate?"),
    ],
)
def test_bad_options(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    said = run_here(capsys, tmp_path, "keys", "mine", *arguments)
    assert said.code == 2
    assert message in said.stderr
    assert list(tmp_path.iterdir()) == []


def test_limits_that_are_stated_twice_agree() -> None:
    assert key_ring.DEFAULT_DAYS == keys._DEFAULT_DAYS
    assert AUTHORITY_DAYS == keys._MAX_DAYS
