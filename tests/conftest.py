"""Options of the tests, and tests that are coroutines."""

from __future__ import annotations

import asyncio
import inspect
import os
from typing import Any

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


COROUTINE_BOUND_S = 120.0
"""For one test; only a hang takes so long."""


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine on a loop of its own.

    What a fixture gives it is closed on that loop, too, if it has a coroutine ``close_on_loop``.
    """
    test: Any = pyfuncitem.obj
    if not inspect.iscoroutinefunction(test):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}

    async def run() -> None:
        try:
            await test(**arguments)
        finally:
            for argument in arguments.values():
                if hasattr(argument, "close_on_loop"):
                    await argument.close_on_loop()

    asyncio.run(asyncio.wait_for(run(), COROUTINE_BOUND_S))
    return True
