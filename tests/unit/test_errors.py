"""What an error says beside its own words."""

import errno

import pytest

from holdfast.errors import OutputError, RunError, TrialError


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_a_run_that_a_full_disk_ends_goes_on_once_there_is_room(number: int) -> None:
    more = "" if number == errno.EIO else "; make room on the disk first"
    written, outer = OutputError("journal.bin: cannot be written"), TrialError("trial 1")
    written.__cause__, outer.__cause__ = OSError(number, "as the system says"), written
    assert str(RunError(outer, "holdfast run")) == f"trial 1{more}\nGo on with: holdfast run"
    assert RunError(written, None).reason == f"journal.bin: cannot be written{more}"
