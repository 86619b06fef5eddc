"""Studies: a question, the tasks that answer it, and what is made of their results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import msgspec

from holdfast.experiments.tables import Table
from holdfast.experiments.tasks import Task

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Report", "Results", "Scale", "Study"]


class Scale(msgspec.Struct, frozen=True, kw_only=True):
    """How much of a study is run.

    Attributes
    ----------
    quick : bool
        Few trials, to see that everything works; what comes of it is no evidence.
    seed : int
        Of all its trials.
    """

    quick: bool = False
    seed: int = 0


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
        Every trial, by name.
    figures : dict of str to callable
        By name; each draws one. Called only where matplotlib is there.
    findings : list of str
        Sentences, each with the interval or test that it rests on.
    """

    summary: dict[str, Table] = msgspec.field(default_factory=dict)
    raw: dict[str, Table] = msgspec.field(default_factory=dict)
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
