"""The testbed's loop, its scripts, and how its processes end."""

from collections.abc import Callable
from pathlib import Path

import pytest

from holdfast_lab.errors import NoProgressError, ProcessEndedError
from holdfast_lab.testbed.driver import Script, Testbed
from holdfast_lab.testbed.processes import free_port

PATIENCE_S = 60.0


def test_scripts_run_beside_each_other(tmp_path: Path) -> None:
    order: list[str] = []

    def script(name: str, waits_for: Callable[[], bool]) -> Script:
        yield waits_for
        order.append(name)

    with Testbed(tmp_path) as testbed:
        testbed.run_script(script("second", lambda: "first" in order))
        testbed.run_script(script("first", lambda: True))
        testbed.run_script(script("never", lambda: False))
        testbed.wait_until(lambda: len(order) == 2, "both", PATIENCE_S)
    assert order == ["first", "second"]


def test_the_limit_begins_anew_with_progress(tmp_path: Path) -> None:
    turns = iter(range(100))
    seen: list[int] = []
    with Testbed(tmp_path, on_turn=lambda: seen.append(next(turns))) as testbed:
        testbed.wait_until(lambda: len(seen) == 50, "the turns", 0.0, lambda: len(seen))
        with pytest.raises(NoProgressError, match="waited 0 s in vain for the end"):
            testbed.wait_until(lambda: False, "the end", 0.0)


def test_a_service_is_killed_and_started_again(tmp_path: Path) -> None:
    with Testbed(tmp_path) as testbed:
        service = testbed.add_service(f"tcp/127.0.0.1:{free_port()}")
        assert service.is_away
        assert testbed.start_services() > 0.0
        first = service.process
        first.kill()
        assert service.is_away
        first.close(PATIENCE_S)
        testbed.start_services()
        assert service.process is not first
        assert (service.ready_at or 0.0) > (first.killed_at or 0.0)
    assert service.process.process.poll() is not None
    assert testbed.left_behind == []
    assert not testbed.temporary.exists()


def test_a_service_that_ends_by_itself(tmp_path: Path) -> None:
    with Testbed(tmp_path) as testbed:
        testbed.add_service("tcp/nowhere")
        with pytest.raises(ProcessEndedError) as raised:
            testbed.start_services()
    assert str(raised.value).startswith(
        f"the cloud service ended with exit code 2; see {tmp_path / 'cloud.log'}; its last line: "
    )
