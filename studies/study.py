"""What a study is: a question, the tasks that answer it, and the report on their results.

What seems best among many seems better than it is, on the trials that made it seem so. A study that
chooses something therefore chooses by the trials of one seed and judges by those of another.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import msgspec
import pandas as pd

from studies.statistics import Interval
from studies.tables import Cell
from studies.tasks import Task

if TYPE_CHECKING:
    from matplotlib.figure import Figure


CHOICE = "choice"
CLAIM = "claim"
"""What trials are for."""

TRIALS = "trials"


class Scale(msgspec.Struct, frozen=True, kw_only=True):
    """How much of a study is run."""

    quick: bool = False
    """Few trials, to see that everything works; the results are no evidence."""
    seed: int = 0
    """Seed of all trials, or of those by which something is chosen."""

    @property
    def claim_seed(self) -> int:
        """Seed of the trials that judge what those of ``seed`` chose."""
        return (self.seed + 1) % 2**63

    def seed_of(self, purpose: str) -> int:
        """Return the seed of the trials for a purpose, :data:`CHOICE` or :data:`CLAIM`."""
        return self.claim_seed if purpose == CLAIM else self.seed


class Part(NamedTuple):
    """Tasks whose rows belong together in a table, and the columns that tell them from others."""

    names: Mapping[str, Cell]
    tasks: Iterable[Task]
    table: str = TRIALS


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
    """The result of a study."""

    summary: dict[str, pd.DataFrame] = msgspec.field(default_factory=dict)
    """Small tables by name, to be committed and shown."""
    raw: dict[str, pd.DataFrame] = msgspec.field(default_factory=dict)
    """Every row that was computed, by table; not to be committed."""
    trials: pd.DataFrame | None = None
    """Every trial, from which all else can be made again; small enough to be committed."""
    figures: Mapping[str, Callable[[], Figure]] = msgspec.field(default_factory=dict)
    """Draw them."""
    numbers: list[Number] = msgspec.field(default_factory=list)
    """The main results, as the command prints them."""

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """The summary, and the numbers as a table."""
        if not self.numbers:
            return self.summary
        rows = [(each.name, *each.interval, each.unit, each.n) for each in self.numbers]
        names = ["name", "value", "value_low", "value_high", "unit", "n"]
        numbers = pd.DataFrame(rows, columns=names).astype({"n": "Int64"})
        return {**self.summary, "numbers": numbers}


def drawn(place: str, *of: Any) -> Callable[[], Figure]:
    """Return what draws a figure: a function of a module here that is imported only then.

    Such modules import matplotlib. ``place`` is ``module:function``.
    """
    module, _, function = place.partition(":")

    def draw() -> Figure:
        imported = importlib.import_module(f"studies.{module}")
        figure: Figure = getattr(imported, function)(*of)
        return figure

    return draw


class Study(ABC):
    """A question to be answered by running something."""

    name: ClassVar[str]
    """On the command line."""
    title: ClassVar[str]
    """Its subject, in one line."""

    @abstractmethod
    def parts(self, scale: Scale) -> Iterable[Part]:
        """Return all that is computed, in the order in which to begin."""

    @abstractmethod
    def report_of(self, tables: Mapping[str, pd.DataFrame]) -> Report:
        """Return the report on the rows of all parts, by table."""

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all tasks, in the order in which to begin."""
        return [task for part in self.parts(scale) for task in part.tasks]

    def report(self, scale: Scale, result_of: Callable[[Task], pd.DataFrame]) -> Report:
        """Return the report on the results of all tasks."""
        tables = self._tables(scale, result_of)
        return msgspec.structs.replace(self.report_of(tables), raw=tables)

    def _tables(
        self, scale: Scale, result_of: Callable[[Task], pd.DataFrame]
    ) -> dict[str, pd.DataFrame]:
        found: dict[str, list[pd.DataFrame]] = {}
        for part in self.parts(scale):
            rows = pd.concat([result_of(task) for task in part.tasks], ignore_index=True)
            found.setdefault(part.table, []).append(rows.assign(**part.names))
        return {table: pd.concat(rows, ignore_index=True) for table, rows in found.items()}


class TrialStudy(Study):
    """A study whose report follows from one table of trials, which is kept."""

    @abstractmethod
    def kept(self, trials: pd.DataFrame) -> pd.DataFrame:
        """Return of all trials what is kept, as a file has it."""

    def report(self, scale: Scale, result_of: Callable[[Task], pd.DataFrame]) -> Report:
        """Return the report on the results of all tasks."""
        trials = self.kept(self._tables(scale, result_of)[TRIALS])
        return msgspec.structs.replace(self.report_of({TRIALS: trials}), trials=trials)
