"""Findings about a problem, and the inspection that collects them.

A problem is a user's own code and may do anything. So an inspection calls it through
:meth:`Inspection.ask`: whatever the code raises becomes a finding with the user's own lines, that
one check ends, and the next one begins.

A statistical test is wrong now and then. All tests of an inspection share one false-alarm rate:
they are collected, and only at the end, when their number is known, each is compared with its share
(Bonferroni's correction).
"""

from __future__ import annotations

import contextlib
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np

from holdfast.config.user_code import account_of_user_error, in_words
from holdfast.errors import HoldfastError
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning.settings import PlanningSettings
from holdfast.printable import one_line
from holdfast.problems.attributes import name_of, sensing_labels, state_labels

__all__ = [
    "FALSE_ALARM_RATE",
    "CheckEndedError",
    "Finding",
    "Inspection",
    "Severity",
    "Walk",
    "spread_out",
]

FALSE_ALARM_RATE = 0.001
"""Probability that the statistical tests of a right problem, all together, find an error."""

Severity = Literal["error", "warning", "information"]
"""An error makes decisions wrong, a warning makes them worse, information is to be read."""

_ORDER = ("error", "warning", "information")

CONTRACT = "docs/problems.md#your-own"
CHECKS = "docs/problems.md#check-it"

ResultT = TypeVar("ResultT")


class Finding(NamedTuple):
    """One thing that a check has found.

    Attributes
    ----------
    severity : {"error", "warning", "information"}
    check : str
        Which check found it: contract, purity, streams, goals, likelihood, ...
    seen : str
        What was seen, with numbers.
    advice : str
        What to do; empty for information.
    where : str
        The part of the documentation that says more.
    details : str
        The lines of the user's code that raised, if any did.
    """

    severity: Severity
    check: str
    seen: str
    advice: str = ""
    where: str = CHECKS
    details: str = ""

    def __str__(self) -> str:
        lines = [f"{self.severity}: {self.check}: {self.seen}"]
        lines += [self.details] if self.details else []
        lines += [f"-> {self.advice} ({self.where})"] if self.advice else []
        return "\n".join(lines)


class CheckEndedError(Exception):
    """A check cannot go on, and why is among the findings."""


class Walk(NamedTuple):
    """Trials in which the state is known: the policy is followed from n initial states.

    Attributes
    ----------
    states : array of shape (t, n, state_size)
        At a few steps, the first of them 0.
    stages : array of shape (t, n)
    reached, failed : array of shape (n,)
        The step at which a trial came to the goal, or failed; -1 if it did not.
    steps : int
        How many steps were taken.
    """

    states: FloatArray
    stages: IntArray
    reached: IntArray
    failed: IntArray
    steps: int


class _Test(NamedTuple):
    p: float
    finding: Finding


class Inspection:
    """What the checks of one problem share: its settings, random streams, time and findings.

    Parameters
    ----------
    problem : Problem
    settings : PlanningSettings
    max_steps : int
        Steps after which a simulated trial has failed.
    seed : int
        Names every random draw.
    budget_s : float
        Time after which no further work is begun. What is found does not depend on it unless it
        runs out, which is a finding.

    Attributes
    ----------
    findings : list of Finding
    walk : Walk or None
        Set by the check of goals.
    rewards : list of float
        Of simulated steps.
    """

    def __init__(
        self,
        problem: Any,
        settings: PlanningSettings,
        max_steps: int,
        seed: int,
        budget_s: float,
    ) -> None:
        self.problem, self.settings, self.max_steps, self.seed = problem, settings, max_steps, seed
        self.findings: list[Finding] = []
        self.walk: Walk | None = None
        self.rewards: list[float] = []
        self.num_tests = 0
        self._tests: list[_Test] = []
        self._budget_s = budget_s
        self._end = perf_counter() + budget_s
        self._warned: set[str] = set()
        self._blamed: set[str] = set()

    @property
    def name(self) -> str:
        """What messages call the problem."""
        return name_of(self.problem)

    def random(self, purpose: int, number: int = 0) -> Stream:
        """Return a stream that no other check has."""
        return stream(self.seed, purpose, number, Purpose.INITIAL_BELIEF)

    def label(self, sensing_action: int) -> str:
        """Return what messages call a sensing action."""
        return f"sensing action {sensing_action} ({sensing_labels(self.problem)[sensing_action]})"

    def coordinate(self, number: int) -> str:
        """Return what messages call a coordinate of a state."""
        labels = state_labels(self.problem)
        return labels[number] if labels else f"coordinate {number} of a state"

    def deadline(self, share: float) -> Callable[[], bool]:
        """Return a function that tells whether a check has used up its share of the time."""
        end = min(self._end, perf_counter() + share * self._budget_s)
        return lambda: perf_counter() > end

    def add(
        self,
        severity: Severity,
        check: str,
        seen: str,
        advice: str = "",
        where: str = CHECKS,
        details: str = "",
    ) -> None:
        """Add a finding, unless it is there."""
        found = Finding(severity, check, one_line(seen), advice, where, details)
        if found not in self.findings:
            self.findings.append(found)

    def test(self, p: float, finding: Finding) -> None:
        """Add a finding if the p-value of a test is too small for chance, which shows later."""
        self.num_tests += 1
        self._tests.append(_Test(p, finding))

    def judge_tests(self) -> None:
        """Add the findings of the tests whose p-value is below their share of the false alarms.

        Of several findings of one check about one function, the one with the least p-value counts.
        """
        least: dict[tuple[str, str], _Test] = {}
        for test in sorted(self._tests, key=lambda test: test.p):
            least.setdefault((test.finding.check, test.finding.seen.partition(":")[0]), test)
        for test in least.values():
            if test.p * self.num_tests < FALSE_ALARM_RATE:
                seen = f"{test.finding.seen} (p = {test.p:.1g}, of {self.num_tests} tests)"
                self.add(**test.finding._replace(seen=seen)._asdict())
        self._tests.clear()

    def sorted_findings(self) -> list[Finding]:
        """Return the findings, errors first."""
        return sorted(self.findings, key=lambda found: _ORDER.index(found.severity))

    def part(self) -> contextlib.suppress:
        """Return a context in which a check may end early without ending the inspection."""
        return contextlib.suppress(CheckEndedError)

    def ask(self, function: str, call: Callable[[], ResultT], check: str = "contract") -> ResultT:
        """Return what a call of the problem's code returns.

        Raises
        ------
        CheckEndedError
            If it raises; that is a finding about ``function`` then. Ctrl-C passes.
        """
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                found = call()
            except (KeyboardInterrupt, CheckEndedError):
                raise
            except BaseException as error:
                self._add_error(function, check, error)
                raise CheckEndedError from error
        for warning in caught:
            self._add_warning(function, warning)
        return found

    def _add_error(self, function: str, check: str, error: BaseException) -> None:
        account = account_of_user_error(error, function)
        words = in_words(error)
        if account is not None:
            header = f"{function} raised {words}"
            seen, details = header, account.removeprefix(header).strip("\n")
        else:
            words = str(error) if isinstance(error, HoldfastError) else words
            seen, details = words if function in words else f"{function}: {words}", ""
        # One finding for what is broken, whoever calls it and with whatever states.
        to_blame = _to_blame(words, details) or f"{function} {type(error).__name__}"
        if to_blame in self._blamed:
            return
        self._blamed.add(to_blame)
        advice = "Look at what it returns there; the documentation says what is needed."
        if details:
            advice = "These are the lines of your own code."
        if isinstance(error, ValueError | IndexError | TypeError) or "need" in words:
            advice = (
                "Make it take states of any leading shape, (), (n,) or (t, n), with the "
                "coordinates last (states[..., 0]), and return what the table there says, as "
                "float64."
            )
        if "read-only" in words:
            advice = "It changes the array that it is given. Take a copy: states = states.copy()."
        elif isinstance(error, TimeoutError):
            advice = "Look for a loop that need not end, such as one that draws until it fits."
        elif "a stream is for" in words:
            advice = "Draw from the stream of this call alone, and do not keep it."
        self.add("error", check, seen, advice, CONTRACT, details)

    def _add_warning(self, function: str, warning: warnings.WarningMessage) -> None:
        text = f"{warning.category.__name__}: {warning.message}"
        key = f"{function} {text}"
        if key in self._warned or len(self._warned) > 20:
            return
        self._warned.add(key)
        place = f"{Path(warning.filename).name}, line {warning.lineno}"
        self.add(
            "information",
            "contract",
            f"{function} made NumPy or Python warn: {text} ({place})",
            "Harmless where the value is not used, as a logarithm of 0 that means impossible.",
            CONTRACT,
        )


def _to_blame(words: str, details: str) -> str | None:
    """Return the function that an error is about: the innermost of the user's, or the named one."""
    frames = re.findall(r'^  File "(.+)", line \d+, in (.+)$', details, re.MULTILINE)
    if frames:
        return " ".join(frames[-1])
    named = re.match(r"(\w+) of ", words)
    return named[1] if named else None


def spread_out(count: int, total: int) -> IntArray:
    """Return at most ``count`` indices, evenly over ``range(total)``."""
    return np.unique(np.linspace(0, max(total - 1, 0), min(count, total)).astype(np.int64))
