"""Options of the tests, tests that are coroutines, and which are about decisions alone.

Most tests come out the same on any machine at any speed: they touch no socket, wait for nobody and
look at no clock. The others start real processes or talk over real sockets. They are the marker
``real``, which is set here, by where a test stands, and nowhere else; whatever is not named here is
held to it, since a socket or a sleep is an error there.
"""

from __future__ import annotations

import asyncio
import faulthandler
import gc
import inspect
import os
import signal
import sys
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, NoReturn

import pytest
from hypothesis import settings

# Images for containers set it. The processes that tests start would compile all of holdfast each
# time: half a second, in tests of how soon something is noticed or launched. And pytest would
# rewrite the assertions of all tests at every start, in each of its processes: ten seconds.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Threads of NumPy's BLAS, which have no work here, spin after NumPy's import: a short command takes
# 0.34 s of processor time with them, and 0.24 s without.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Importing tests leaves little garbage: half a second of looking for it in each process.
gc.disable()

ROOT = Path(__file__).parent

# How long an example takes says how busy the machine is, and every run tries the same ones.
settings.register_profile("repeatable", deadline=None, derandomize=True, database=None)
settings.load_profile("repeatable")

DEPLOY = "deploy/"
"""The folder of what needs an engine of containers, tunnels or a machine of its own."""

ROS = "ros/"
"""The folder of what needs a real ROS."""

REAL = (
    DEPLOY,
    ROS,
    "processes/",
    "contracts/test_datagram_addresses.py",
    "contracts/test_datagram_links.py",
    "contracts/test_dialer.py",
    "contracts/test_listener.py",
    "contracts/test_robot_end.py",
    "contracts/test_service_end.py",
    "contracts/test_transport_contract.py",
    "contracts/test_transport_links.py",
    "studies/tests/test_offload_break_even.py::test_the_whole_study",
    "studies/tests/test_command.py::test_interrupted_and_gone_on_with",
    "studies/tests/test_ray.py",
    "studies/tests/test_thesis_chapter_6.py::test_over_a_proxy",
    "studies/tests/test_thesis_chapter_6.py::test_really",
    "fuzz/test_fuzz_processes.py",
    "lab/tests/test_chaos_command.py",
    "lab/tests/test_demo_command.py",
    "lab/tests/test_testbed_driver.py",
    "lab/tests/test_testbed_namespace.py",
    "lab/tests/test_testbed_processes.py",
    "lab/tests/test_testbed_proxy.py",
    "lab/tests/test_testbed_wide_area.py",
    "unit/test_key_ring.py::TestNothingIsOverwritten",
    "unit/test_transport_credentials.py::TestOnRealLinks",
    "unit/test_datagram_sockets.py",
    "unit/test_endpoints.py::test_loopback_is_what_only_this_machine_can_reach",
    "unit/test_config_reading.py::test_what_is_no_file_is_refused",
    "unit/test_monitoring.py",
    "unit/test_ros1_calls.py",
    "unit/test_ros1_node.py",
    "unit/test_environment_runner.py::TestStalls",
    "unit/test_service_listening.py",
    "unit/test_service_shell.py",
    "unit/test_stream_credentials.py",
    "unit/test_ending_signals.py",
    "unit/test_robot_links.py",
    "unit/test_loop_thread.py",
    "unit/test_master_settings.py",
    "unit/test_probe.py",
    "unit/test_ray_workers.py::test_it_finds_the_same_and_outlives_its_actors",
    "unit/test_recovery_launcher.py",
    "unit/test_ros1_client.py",
    "unit/test_standby.py",
    "unit/test_survey.py",
)
"""Folders, files, classes and tests with real sockets, waits or signals, without ``tests/``."""

IN_PROCESS = "[in_process"
"""How the parameters begin with which a test of a wire has no wire."""

FORBIDDEN = {
    "socket.bind": "a socket",
    "socket.connect": "a socket",
    "socket.getaddrinfo": "a look at the network",
    "socket.sendto": "a socket",
}
"""What Python tells its audit hooks of, and what that is."""

_guarded: str | None = None


def _refuse(what: str) -> NoReturn:
    raise AssertionError(
        f"{what} in {_guarded}, which is about decisions alone: hand in a clock or a transport, or "
        "name it in REAL in conftest.py"
    )


def _audit(event: str, arguments: tuple[object, ...]) -> None:
    if _guarded is not None and event in FORBIDDEN:
        _refuse(f"{FORBIDDEN[event]} ({event})")


def _sleep(seconds: float, _really: Callable[[float], None] = time.sleep) -> None:
    # It is how the end of a process is waited for, which comes whatever the time.
    if sys._getframe(1).f_globals["__name__"] != "subprocess":
        _refuse(f"a sleep of {seconds} s")
    _really(seconds)


# For good, since Python takes no hook back.
sys.addaudithook(_audit)


_stderr = -1  # the run's own, which is not captured


def pytest_configure(config: pytest.Config) -> None:
    global _stderr
    _stderr = os.dup(2)


def _end_unless_it_goes_on(config: pytest.Config, bounds: float = 1.0) -> None:
    """End this process, with the stacks of its threads, unless it goes on within so many bounds."""
    if (bound_s := float(config.getini("faulthandler_timeout") or 0.0)) > 0.0:
        faulthandler.dump_traceback_later(bounds * bound_s, exit=True, file=_stderr)


@pytest.hookimpl(trylast=True)
def pytest_exception_interact(node: pytest.Item | pytest.Collector) -> None:
    """Bound the end of a test that has failed, too: pytest has just given its own bound up."""
    if isinstance(node, pytest.Item) and not node.config.getoption("usepdb"):
        _end_unless_it_goes_on(node.config)


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

    What its fixtures give is closed on that loop, too, if it has a coroutine ``close_on_loop``.
    """
    test: Any = pyfuncitem.obj
    if not inspect.iscoroutinefunction(test):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}

    async def run() -> None:
        try:
            await test(**arguments)
        finally:
            for argument in pyfuncitem.funcargs.values():
                if hasattr(argument, "close_on_loop"):
                    await argument.close_on_loop()

    asyncio.run(asyncio.wait_for(run(), COROUTINE_BOUND_S))
    return True


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files of which ``-m`` chooses nothing: to import them all takes many seconds."""
    if collection_path.suffix != ".py":
        return None
    chosen = config.option.markexpr.split(" and ")
    place = collection_path.relative_to(ROOT).as_posix().removeprefix("tests/")
    real = place.startswith(REAL)
    in_part = any(each.startswith(place) for each in REAL)
    # Of the contracts' tests some have a wire within the process.
    in_process = place.startswith("contracts/")
    useless = ("real" in chosen and not (real or in_part)) or (
        "not real" in chosen and real and not in_process
    )
    return useless or None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is real before ``-m`` chooses."""
    for item in items:
        path = item.path.relative_to(ROOT).as_posix().removeprefix("tests/")
        place = f"{path}::{item.nodeid.partition('::')[2]}"
        if place.startswith(REAL) and IN_PROCESS not in place:
            item.add_marker(pytest.mark.real)
        if place.startswith(DEPLOY):
            item.add_marker(pytest.mark.deploy)
        if place.startswith(ROS):
            item.add_marker(pytest.mark.ros)
    _spread(items)


def _spread(items: list[pytest.Item]) -> None:
    """Let each worker begin with its share of the files whose tests wait most of their time.

    At first each gets tests that follow each other. Were those at the end of somebody's, the others
    would have nothing more to do meanwhile.
    """
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    files = dict.fromkeys(item.path for item in items if item.path.parent.name == "processes")
    # A little after where a worker's begin, since not all shares have as many.
    shares = {path: (index % workers + 0.1) / workers for index, path in enumerate(files)}
    if workers > 1:
        places = {item: index / len(items) for index, item in enumerate(items)}
        items.sort(key=lambda item: shares.get(item.path, places[item]))


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Let no search for garbage look through all tests again: that took 5 % of their time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000)
    gc.enable()


_path: list[str] = []  # where a test begins to look for modules


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Note where modules are looked for, which a test's configurations may change."""
    _path[:] = sys.path


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown() -> None:
    """Forget the modules of users that a test has loaded: others have copies of them elsewhere."""
    sys.path[:] = _path
    user_modules = sys.modules.get("holdfast.config.user_modules")
    found = [] if user_modules is None else list(user_modules._FOUND.values())
    for directory, names in found:
        if directory == ROOT:  # the studies, which tests have imported as well
            continue
        for name, module in list(sys.modules.items()):
            if name.partition(".")[0] in names:
                file = getattr(module, "__file__", None)
                if file is None or Path(file).is_relative_to(directory):
                    del sys.modules[name]
    if user_modules is not None:
        user_modules._FOUND.clear()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Hold a test that is not real to what it says of itself."""
    global _guarded
    try:
        if item.get_closest_marker("real"):
            return (yield)
        _guarded = item.nodeid
        with pytest.MonkeyPatch.context() as patch:
            # Python tells the hook of it from 3.13 on.
            patch.setattr(time, "sleep", _sleep)
            return (yield)
    finally:
        _guarded = None
        # Until the next one, for which a worker may wait as long as a test of another one takes, or
        # until the end of the process. While a test runs, pytest's bound holds (pyproject.toml).
        _end_unless_it_goes_on(item.config, 2.0)


@pytest.fixture
def workplace(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """Return a directory in which commands are run."""
    from tests.command_line import Workplace

    return Workplace(tmp_path, capsys)


@pytest.fixture(scope="session", autouse=True)
def _signals_are_heard() -> None:
    """Let tests and their processes hear signals that a shell, or nohup, has its jobs ignore."""
    handlers: dict[int, Any] = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGQUIT: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    for number, handler in handlers.items():
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, handler)
