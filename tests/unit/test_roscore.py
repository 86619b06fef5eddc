"""What belongs to a master: pauses between starts, and how processes end."""

from __future__ import annotations

import pytest

from ros1_master_guard.roscore import how_it_ended, restart_delay_s


def test_the_pause_doubles_up_to_a_second() -> None:
    assert [restart_delay_s(failures) for failures in range(6)] == [0.1, 0.2, 0.4, 0.8, 1.0, 1.0]
    assert restart_delay_s(10_000) == 1.0


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
