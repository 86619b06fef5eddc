"""Studies: a question, the tasks that answer it, and what is made of their results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import msgspec

from holdfast.experiments.tables import Table
from holdfast.experiments.tasks import Task

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["CHOICE", "CLAIM", "Report", "Results", "Scale", "Study", "TrialStudy"]

CHOICE = "choice"
CLAIM = "claim"
"""What trials are for: something is chosen by those of one seed and judged by those of another.
What seems best among many seems better than it is, on the trials that made it seem so."""


class Scale(msgspec.Struct, frozen=True, kw_only=True):
    """How much of a study is run.

    Attributes
    ----------
    quick : bool
        Few trials, to see that everything works; what comes of it is no evidence.
    seed : int
        Of all its trials; a study that chooses something chooses by these.
    """

    quick: bool = False
    seed: int = 0

    @property
    def claim_seed(self) -> int:
        """Of the trials by which a study judges what it chose by those of ``seed``."""
        return (self.seed + 1) % 2**63


class Results:
    """What tasks came to.

    Parameters
    ----------
    tables : mapping of Task to Table
        By their keys.
    """

    def __init__(self, tables: Mapping[str, Table], key_of: Callable[[Task], str]) -> None:
        self._tables = tables
        self._key_of = key_of

    def of(self, tasks: Sequence[Task]) -> Table:
        """Return the rows of some tasks, one after another."""
        table = Table({})
        for task in tasks:
            table.extend(self._tables[self._key_of(task)])
        return table


class Report(msgspec.Struct, kw_only=True):
    """What a study comes to.

    Attributes
    ----------
    summary : dict of str to Table
        Small tables by name, to be committed and shown.
    raw : dict of str to Table
        Every trial, by name; not to be committed.
    trials : Table, optional
        Every trial, by which all else can be made anew; kept small, to be committed.
    figures : dict of str to callable
        By name; each draws one. Called only where matplotlib is there.
    findings : list of str
        Sentences, each with the interval or test that it rests on.
    """

    summary: dict[str, Table] = msgspec.field(default_factory=dict)
    raw: dict[str, Table] = msgspec.field(default_factory=dict)
    trials: Table | None = None
    figures: dict[str, Callable[[], Figure]] = msgspec.field(default_factory=dict)
    findings: list[str] = msgspec.field(default_factory=list)


class Study(Protocol):
    """A question to be answered by running something."""

    @property
    def name(self) -> str:
        """By which it is chosen on the command line."""
        ...

    @property
    def title(self) -> str:
        """What it is about, in one line."""
        ...

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all that is to be computed, in the order in which to begin."""
        ...

    def report(self, scale: Scale, results: Results) -> Report:
        """Return what it comes to, from the results of all its tasks."""
        ...


@runtime_checkable
class TrialStudy(Study, Protocol):
    """A study whose report follows from a table of its trials, which is kept."""

    def report_of(self, trials: Table) -> Report:
        """Return what it comes to, from all its trials.

        Raises
        ------
        InvalidValueError
            If they are not those of this study.
        """
        ...
