"""Options of the tests."""

from __future__ import annotations

import os

import pytest

# Images for containers set it. The processes that tests start would compile all of holdfast each
# time: half a second, in tests of how soon something is noticed or launched.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--rewrite-stories",
        action="store_true",
        help="write the traces of tests/scenarios anew instead of comparing them",
    )
