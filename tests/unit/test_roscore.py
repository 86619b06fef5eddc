"""What belongs to a master: how processes end."""

import pytest

from ros1_master_guard.roscore import how_it_ended


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0, "it ended with exit code 0"),
        (-9, "it was ended by SIGKILL"),
        (-200, "it ended with exit code -200"),
    ],
)
def test_how_a_process_ended(code: int, text: str) -> None:
    assert how_it_ended(code) == text
