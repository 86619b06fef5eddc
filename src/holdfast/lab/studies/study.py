"""What a study is: a question, the tasks that answer it, and the report on their results.

What seems best among many seems better than it is, on the trials that made it seem so. A study that
chooses something therefore chooses by the trials of one seed and judges by those of another.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol, runtime_checkable

import msgspec
import pandas as pd

from holdfast.lab.studies.statistics import Interval
from holdfast.lab.studies.tasks import Task

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "CHOICE",
    "CLAIM",
    "Number",
    "Report",
    "Results",
    "Scale",
    "Study",
    "TrialStudy",
]

CHOICE = "choice"
CLAIM = "claim"
"""What trials are for."""


class Scale(msgspec.Struct, frozen=True, kw_only=True):
    """How much of a study is run.

    Attributes
    ----------
    quick : bool
        Few trials, to see that everything works; the results are no evidence.
    seed : int
        Of all trials, or of those by which something is chosen.
    """

    quick: bool = False
    seed: int = 0

    @property
    def claim_seed(self) -> int:
        """Seed of the trials that judge what those of ``seed`` chose."""
        return (self.seed + 1) % 2**63

    def seed_of(self, purpose: str) -> int:
        """Return the seed of the trials for a purpose, :data:`CHOICE` or :data:`CLAIM`."""
        return self.claim_seed if purpose == CLAIM else self.seed


class Results:
    """The tables that tasks returned, by the tasks' keys."""

    def __init__(self, tables: Mapping[str, pd.DataFrame], key_of: Callable[[Task], str]) -> None:
        self._tables = tables
        self._key_of = key_of

    def of(self, tasks: Sequence[Task]) -> pd.DataFrame:
        """Return the rows of some tasks, one after another."""
        return pd.concat([self._tables[self._key_of(task)] for task in tasks], ignore_index=True)


class Number(NamedTuple):
    """A result in one line."""

    name: str
    interval: Interval
    unit: str = ""
    n: int | None = None

    def __str__(self) -> str:
        value, low, high = (f"{end:,.4g}" for end in self.interval)
        interval = "" if low == high == value else f" [{low}, {high}]"
        count = "" if self.n is None else f" (n = {int(self.n):,})"
        return f"{self.name}: {value}{interval} {self.unit}".rstrip() + count


class Report(msgspec.Struct, kw_only=True):
    """The result of a study.

    Attributes
    ----------
    summary : dict of str to DataFrame
        Small tables by name, to be committed and shown.
    raw : dict of str to DataFrame
        Every trial, by name; not to be committed.
    trials : DataFrame, optional
        Every trial, from which all else can be made again; small enough to be committed.
    figures : dict of str to callable
        Draw them; called only where matplotlib is installed.
    numbers : list of Number
        The main results, as the command prints them.
    """

    summary: dict[str, pd.DataFrame] = msgspec.field(default_factory=dict)
    raw: dict[str, pd.DataFrame] = msgspec.field(default_factory=dict)
    trials: pd.DataFrame | None = None
    figures: Mapping[str, Callable[[], Figure]] = msgspec.field(default_factory=dict)
    numbers: list[Number] = msgspec.field(default_factory=list)

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """The summary, and the numbers as a table."""
        if not self.numbers:
            return self.summary
        rows = [(each.name, *each.interval, each.unit, each.n) for each in self.numbers]
        names = ["name", "value", "value_low", "value_high", "unit", "n"]
        numbers = pd.DataFrame(rows, columns=names).astype({"n": "Int64"})
        return {**self.summary, "numbers": numbers}


class Study(Protocol):
    """A question to be answered by running something."""

    @property
    def name(self) -> str:
        """Its name on the command line."""
        ...

    @property
    def title(self) -> str:
        """Its subject, in one line."""
        ...

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all tasks, in the order in which to begin."""
        ...

    def report(self, scale: Scale, results: Results) -> Report:
        """Return the report on the results of all tasks."""
        ...


@runtime_checkable
class TrialStudy(Study, Protocol):
    """A study whose report follows from a table of its trials, which is kept."""

    def report_of(self, trials: pd.DataFrame) -> Report:
        """Return the report on all trials; InvalidValueError if they are not of this study."""
        ...
