"""A check in a process of its own, which the problem's code may end, hang or crash.

A problem is a user's own code: it may call ``os._exit``, crash in a library, never return, or leave
threads behind. So a command checks it in a child process, says what that did not, and kills it.

A slow problem is looked at in part when the budget is over, which is no error. A single call that
takes longer than :data:`PATIENCE_S` is one.
"""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import pickle
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, NoReturn

from holdfast.config.loader import Configuration
from holdfast.config.user_code import is_users_file
from holdfast.errors import HoldfastError, ProblemError, TrialCrashError
from holdfast.runtime.workers import WorkerProcess, end_workers
from holdfast.tuning.findings import Finding, OutOfTimeError
from holdfast.tuning.problem_check import check_problem

if TYPE_CHECKING:
    from types import FrameType


PATIENCE_S = 30.0  # a single call of the problem's code that takes longer is an error
_OURS = str(Path(__file__).parent)
_TICK_S = 1.0
_LONGEST_CHECK_S = 20.0


def check_apart(
    load: Callable[[], Configuration],
    *,
    on_check: Callable[[str], None] = lambda _: None,
    **how: Any,
) -> list[Finding]:
    """Return what :func:`check_problem` finds in a process of its own.

    ``load``, which must be picklable, returns the configuration there; ``how``, with ``budget_s``,
    is for :func:`check_problem`. HoldfastError is that of ``load``.
    """
    if multiprocessing.current_process().daemon:  # which may have no children
        return _checked(load, on_check, how)
    worker = WorkerProcess("holdfast-check", _work, (load, PATIENCE_S, how), threads=1)
    doing = "import"
    try:
        worker.start()
        while (answer := worker.receive()) is not None:
            message = pickle.loads(answer)
            if isinstance(message, Exception):
                raise message
            if isinstance(message, list):
                return message
            doing = message
            on_check(doing)
        ending, _ = worker.how_it_ended()
    finally:
        end_workers([worker])
    seen = f"the problem's code ended the process of the check: it {ending} in the part {doing!r}"
    advice = "Look for what ends a process, such as a library that crashes."
    return [Finding("error", "contract", seen, advice)]


def require_right(
    configuration: Configuration,
    budget_s: float,
    on_warning: Callable[[Finding], None] = lambda _: None,
    check: str = "holdfast.check_problem",
) -> None:
    """Check a problem before it is tuned, for a tenth of that budget and at most 20 s.

    ProblemError if it finds an error, with how to ``check`` the same at length.
    """
    load = functools.partial(Configuration.from_plain, configuration.plain())
    errors = []
    for each in check_apart(load, budget_s=min(_LONGEST_CHECK_S, 0.1 * budget_s), trials=0):
        if each.severity == "warning":
            on_warning(each)
        elif each.severity == "error":
            errors.append(each)
    if errors:
        raise ProblemError(
            f"{errors[0].check}: {errors[0].seen}. {check} says more of {len(errors)} error"
            f"{'s' * (len(errors) > 1)}; --no-check (check=False) tunes all the same"
        )


def _checked(
    load: Callable[[], Configuration], on_check: Callable[[str], None], how: dict[str, Any]
) -> list[Finding]:
    found = load()
    limit = found.simulator.max_steps
    return check_problem(found.problem, found.planning, max_steps=limit, on_check=on_check, **how)


def _work(
    connection: Connection, load: Callable[[], Configuration], patience: float, how: dict[str, Any]
) -> None:
    """Check, and send the name of each check and then the findings, or an error."""

    def tell(message: object) -> None:
        connection.send_bytes(pickle.dumps(message))

    os._exit = _refuse_to_end
    try:
        # What the problem's code prints is no finding.
        with contextlib.redirect_stdout(sys.stderr), _clock(how["budget_s"], patience):
            tell(_checked(load, tell, how))
    except HoldfastError as error:
        tell(error)
    except Exception:  # noqa: BLE001 - whatever it is, the parent raises it again
        tell(TrialCrashError(f"in the process of the check:\n{traceback.format_exc()}"))


class ProcessEndError(BaseException):
    """The problem's code has called ``os._exit``; raised there, so that its lines are known."""


def _refuse_to_end(status: int) -> NoReturn:
    raise ProcessEndError(f"os._exit({status}) would end the process")


@contextlib.contextmanager
def _clock(budget_s: float, patience_s: float) -> Iterator[None]:
    """End what runs over the budget, and as an error what does not return."""
    began = since = perf_counter()
    running: FrameType | None = None

    def look(_: int, frame: FrameType | None) -> None:
        nonlocal running, since
        call = None
        while frame is not None and not frame.f_code.co_filename.startswith(_OURS):
            if is_users_file(frame.f_code.co_filename):
                call = frame
            frame = frame.f_back
        now = perf_counter()
        if call is None or frame is None:
            running = None
        elif call is not running:
            running, since = call, now
            if now - began > budget_s + _TICK_S:
                raise OutOfTimeError
        elif now - since > patience_s:
            raise TimeoutError(f"it has not returned in {patience_s:g} s")

    before = signal.signal(signal.SIGALRM, look)
    signal.setitimer(signal.ITIMER_REAL, _TICK_S, _TICK_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
