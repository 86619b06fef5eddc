"""Findings about a problem, and the inspection that collects them.

A problem is a user's own code. So an inspection calls it through :meth:`Inspection.ask`: whatever
it raises becomes a finding with the user's own lines, that check ends, and the next one begins.

A statistical test is wrong now and then. All tests share one false-alarm rate: they are collected,
and when their number is known, each is compared with its share (Bonferroni's correction).
"""

from __future__ import annotations

import re
import textwrap
import warnings
from collections.abc import Callable
from time import perf_counter
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np

from holdfast.config.user_code import COPY, account_of_user_error, in_words
from holdfast.errors import HoldfastError
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning.planner import PlanningState
from holdfast.planning.settings import PlanningSettings
from holdfast.printable import one_line
from holdfast.problems.attributes import coordinate_name, sensing_labels

FALSE_ALARM_RATE = 0.001  # probability that all tests of a right problem together find an error
OVER = "not looked at, or not at all of it: the time was over"  # of what the budget has cut short

Severity = Literal["error", "warning", "information"]

CONTRACT = "docs/problems.md#your-own"
WHERE = {
    "likelihood": "docs/problems.md#check-it",
    "method": "docs/tuning.md",
    "prices": "docs/problems.md#when-to-sense",
    "resolution": "docs/problems.md#a-sharp-sensor-beside-a-weak-one",
    "sensors": "docs/problems.md#when-to-sense",
    "time": "docs/settings.md",
}
"""What of the documentation says more, by check; of all others it is the contract."""

_REMEDIES = (
    ("read-only", COPY),
    ("TimeoutError", "Look for a loop that need not end, such as one that draws until it fits."),
    (
        r"array of shape \(n,\)",
        "It is asked for one state: return an array with one axis, np.array([value]) of a number.",
    ),
    ("a stream is for", "Draw from the stream of this call alone, and do not keep it."),
    (
        "something else|global generator",
        "Draw from the stream that the function is given, stream.normal(states.shape), not from "
        "np.random, random or a generator of your own, and keep nothing that changes a result.",
    ),
    (
        "another leading shape",
        "Compute each state by itself: index coordinates as states[..., 0] and take no mean, "
        "maximum or sum over states.",
    ),
    (
        "ValueError|IndexError|TypeError|need ",
        "Make it take states of any leading shape, (), (n,) or (t, n), with the coordinates last "
        "(states[..., 0]), and return what the table there says, as float64.",
    ),
    ("raised", "These are the lines of your own code."),
    ("^the problem: ", "Change this attribute of the class."),
)
"""Patterns of what is raised, and what to do; the first that fits counts."""

ResultT = TypeVar("ResultT")


class Finding(NamedTuple):
    """One thing that a check has found: what was seen, and what to do.

    An error makes decisions wrong, a warning makes them worse, information is to be read.
    """

    severity: Severity
    check: str  # contract, purity, streams, goals, likelihood, ...
    seen: str
    advice: str = ""  # of most information there is none
    where: str = CONTRACT  # the part of the documentation that says more
    details: str = ""  # the lines of the user's code that raised, if any did

    def __str__(self) -> str:
        lines = [f"{self.severity:<11} {self.check}: {self.seen}"]
        lines += [textwrap.indent(self.details, "    ")] if self.details else []
        where = "" if self.severity == "information" else f" ({self.where})"
        lines += [f"    -> {self.advice}{where}"] if self.advice else []
        return "\n".join(lines)


class CheckEndedError(Exception):
    """A check cannot go on, and why is among the findings."""


class OutOfTimeError(BaseException):
    """The budget is over; raised in the problem's code, which may catch any Exception."""


class Walk(NamedTuple):
    """Trials with the state known: m states and stages of theirs, and when each was at the goal."""

    states: FloatArray
    stages: IntArray
    reached: IntArray


class Inspection:
    """What the checks of one problem share: its settings, random streams, time and findings."""

    def __init__(
        self, problem: Any, settings: PlanningSettings, max_steps: int, seed: int, budget_s: float
    ) -> None:
        self.problem, self.settings, self.max_steps, self.seed = problem, settings, max_steps, seed
        self.trials = 0
        self.findings: list[Finding] = []
        self.walk: Walk | None = None
        self.beliefs: list[PlanningState] = []
        self.rewards: list[float] = []
        self.num_tests = 0
        self._tests: list[tuple[float, Finding]] = []
        self._budget_s, self._end = budget_s, perf_counter() + budget_s
        self._blamed: set[str] = set()

    def random(self, purpose: int, number: int = 0) -> Stream:
        """Return a stream, by the number of what it is for."""
        return stream(self.seed, purpose, number, Purpose.INITIAL_BELIEF)

    def label(self, sensing_action: int) -> str:
        """Return what messages call a sensing action."""
        return f"sensing action {sensing_action} ({sensing_labels(self.problem)[sensing_action]})"

    def coordinate(self, number: int) -> str:
        """Return what messages call a coordinate of a state."""
        return coordinate_name(self.problem, number)

    def deadline(self, share: float, check: str = "") -> Callable[[], bool]:
        """Return a function that tells whether a check, if named, is over its share of the time."""
        end = min(self._end, perf_counter() + share * self._budget_s)

        def late() -> bool:
            over = perf_counter() > end
            if over and check:
                self.add_over(check)
            return over

        return late

    def add_over(self, check: str) -> None:
        """Say that the time for a check was over."""
        self.add("information", check, OVER, "Give it more (--budget).")

    def add(
        self, severity: Severity, check: str, seen: str, advice: str = "", details: str = ""
    ) -> None:
        """Add a finding, unless it is there."""
        where = WHERE.get(check, CONTRACT)
        found = Finding(severity, check, one_line(seen), advice, where, details)
        if found not in self.findings:
            self.findings.append(found)

    def test(self, p: float, check: str, seen: str, advice: str) -> None:
        """Add an error if the p-value of a test is too small for chance, which shows later."""
        self.num_tests += 1
        self._tests.append((p, Finding("error", check, seen, advice)))

    def judge_tests(self) -> None:
        """Add what has a p-value below its share of the false alarms, one for each function."""
        if self.num_tests:
            seen = f"{self.num_tests} statistical tests were made; all together they find an error "
            seen += f"in a right problem with a probability of at most {FALSE_ALARM_RATE:g}"
            self.add("information", "likelihood", seen)
        judged = set()
        for p, found in sorted(self._tests, key=lambda test: test[0]):
            about = found.check, found.seen.partition(":")[0]
            if p * self.num_tests < FALSE_ALARM_RATE and about not in judged:
                judged.add(about)
                seen = f"{found.seen} (p = {p:.1g}, of {self.num_tests} tests)"
                self.add("error", found.check, seen, found.advice)

    def ask(
        self, function: str, call: Callable[..., ResultT], *arguments: Any, check: str = "contract"
    ) -> ResultT:
        """Return what a call of the problem's code returns; what it raises is a finding."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return call(*arguments)
        except (KeyboardInterrupt, CheckEndedError):
            raise
        except OutOfTimeError as over:
            self.add_over(check)
            raise CheckEndedError from over
        except BaseException as error:
            self._add_error(function, check, error)
            raise CheckEndedError from error

    def _add_error(self, function: str, check: str, error: BaseException) -> None:
        account, words = account_of_user_error(error, function), in_words(error)
        seen, details = f"{function} raised {words}", ""
        if account is not None:
            details = account.removeprefix(seen).removesuffix(COPY).strip("\n")
        else:
            seen = str(error) if isinstance(error, HoldfastError) else words
            seen = seen if function in seen else f"{function}: {seen}"
        # One finding for what is broken, whoever calls it and with whatever states.
        frames = re.findall(r'^  File "(.+)", line \d+, in (.+)$', details, re.MULTILINE)
        named = re.search(r"(?:^|: )(\w+) of ", seen)
        to_blame = " ".join(frames[-1]) if frames else named[1] if named else f"{function} {check}"
        if to_blame in self._blamed:
            return
        self._blamed.add(to_blame)
        fits = (remedy for pattern, remedy in _REMEDIES if re.search(pattern, seen))
        self.add("error", check, seen, next(fits, "Look at what it returns there."), details)


def spread_out(count: int, total: int) -> IntArray:
    """Return at most ``count`` indices, evenly over ``range(total)``."""
    return np.unique(np.linspace(0, max(total - 1, 0), min(count, total)).astype(np.int64))
