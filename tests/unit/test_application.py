"""The command line itself: what is imported when, and how it ends."""

import signal
import subprocess
import sys

import pytest
from tests.programs import completed

from holdfast.cli.exit_codes import EndedBySignal, ended_by_signals, signal_of


def python(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return completed([sys.executable, "-c", program, *arguments], timeout=60)


def test_a_service_does_not_wait_for_the_command_line() -> None:
    """Its start-up time is recovery time: what is made for people is not imported."""
    program = """
import sys, types

def main(arguments):
    heavy = {"rich", "yaml", "matplotlib", "importlib.metadata"}
    print(arguments, sorted(heavy & sys.modules.keys()))
    return 7

module = types.ModuleType("holdfast.service.process")
module.main = main
sys.modules[module.__name__] = module
import holdfast.cli
holdfast.cli.main()
"""
    done = python(program, "serve", "--name", "a", "--help")
    assert done.stdout == "['--name', 'a', '--help'] []\n"
    assert done.returncode == 7


def test_help_imports_no_numbers() -> None:
    program = """
import sys
import holdfast.cli
try:
    holdfast.cli.main()
finally:
    print(sorted({"numpy", "msgspec", "yaml", "sqlite3", "asyncio", "ssl"} & sys.modules.keys()))
"""
    said = python(program, "--help").stdout
    assert said.endswith("\n[]\n")
    assert {"run", "serve", "compare"} <= set(said.partition("\ncommands ")[2].split())


def test_errors_are_one_message_and_exit_code_2() -> None:
    done = python("import holdfast.cli; holdfast.cli.main()", "run", "missing.yaml")
    assert done.returncode == 2
    assert done.stderr == "holdfast: error: missing.yaml: there is no such file\n"


def test_another_package_of_the_name_is_told_of() -> None:
    """Installed later, it puts its own ``holdfast/__init__.py`` over ours; removed, it takes it."""
    program = """
import importlib.util, sys, types
theirs = types.ModuleType("holdfast")
theirs.__path__ = importlib.util.find_spec("holdfast").submodule_search_locations
sys.modules["holdfast"] = theirs
import holdfast.cli
holdfast.cli.main()
"""
    done = python(program, "--version")
    assert done.returncode == 2
    assert "pip uninstall holdfast; pip install --force-reinstall --no-deps" in done.stderr


def test_ctrl_c_while_a_class_is_made() -> None:
    program = """
import holdfast.cli

def load(arguments):
    raise RuntimeError("Error calling __set_name__") from KeyboardInterrupt()  # as Python 3.11 does

holdfast.cli.main(load)
"""
    assert (python(program).returncode, python(program).stderr) == (130, "")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_in_order(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with pytest.raises(SystemExit) as ended, ended_by_signals():
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt as interruption:
            assert isinstance(interruption, EndedBySignal)
            assert signal_of(interruption) == number
            # A second one does not cut short what the first one began.
            signal.raise_signal(number)
            raise
    assert ended.value.code == 128 + number
    assert signal.getsignal(number) == before


def test_what_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with ended_by_signals():
            signal.raise_signal(signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
