"""What is about decisions alone can open no socket and cannot sleep; what can is named."""

import runpy
import socket
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
REAL: tuple[str, ...] = runpy.run_path(str(ROOT / "conftest.py"))["REAL"]


def test_a_socket_is_refused() -> None:
    with socket.socket() as made:
        with pytest.raises(AssertionError, match=r"socket\.bind.*test_guard.*REAL"):
            made.bind(("127.0.0.1", 0))
        with pytest.raises(AssertionError, match=r"socket\.connect"):
            made.connect(("127.0.0.1", 1))


def test_a_sleep_is_refused() -> None:
    with pytest.raises(AssertionError, match=r"a sleep of 0\.001 s"):
        time.sleep(0.001)


def test_what_is_named_is_there() -> None:
    for place in REAL:
        where, *names = place.split("::")
        path = next(each for each in (ROOT / where, ROOT / "tests" / where) if each.exists())
        for name in names:
            text = path.read_text()
            assert f"class {name}:" in text or f"def {name}(" in text, place
