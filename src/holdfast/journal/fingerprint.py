"""Which code made a run: only trials that are decided alike can be compared.

holdfast is identified by its version and the digest of its deciding modules, a problem by the
digests of its sources (:mod:`holdfast.config.source_digest`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import msgspec

from holdfast import __version__
from holdfast.config.loader import Configuration
from holdfast.config.registry import problem_module
from holdfast.config.source_digest import core_version, problem_sources

_VERSION = "holdfast_version"
_CORE = "holdfast_core"
_SOURCES = "problem_sources"


def fingerprint(configuration: Configuration) -> dict[str, str]:
    """Return the identity of a run's code, for its journal.

    It has holdfast's version, without and with the digest of its core, and the digests of the
    problem's sources, as JSON.
    """
    module = problem_module(configuration.problem_name)
    sources = problem_sources(type(configuration.problem), module)
    return {
        _VERSION: __version__,
        _CORE: core_version(),
        _SOURCES: json.dumps(sources, sort_keys=True),
    }


class Difference(NamedTuple):
    """How the code of an earlier run differs from that of this one."""

    words: str  # for a person
    # The version that made the earlier run, with the digest of its core if that is known.
    made_by: str
    is_the_problems: bool  # whether the problem's own source differs, else only holdfast's


def difference(there: Mapping[str, str], here: Mapping[str, str]) -> Difference | None:
    """Return how the code of an earlier run differs from that of this one, or None."""
    core = there.get(_CORE)
    made_by = core or there.get(_VERSION) or "of an unknown version"
    old: dict[str, str] = json.loads(there.get(_SOURCES, "{}"))
    new: dict[str, str] = json.loads(here[_SOURCES])
    # Journals that say nothing of the core name fewer modules.
    names = old.keys() & new.keys() if core is None else old.keys() | new.keys()
    changed = sorted(name for name in names if old.get(name) != new.get(name))
    if changed:
        words = f"the problem's source has changed since (module {', '.join(changed)})"
        return Difference(words, made_by, is_the_problems=True)
    same = there.get(_VERSION) == here[_VERSION] if core is None else core == here[_CORE]
    if not same:
        words = f"it was made by holdfast {made_by}, this is {here[_CORE]}: other code"
        return Difference(words, made_by, is_the_problems=False)
    return None


class EarlierCode(msgspec.Struct, frozen=True, kw_only=True):
    """What another version of holdfast decided in a run, before this one went on with it."""

    holdfast: str  # the version, with the digest of what decides in it
    # Ranges of finished trials: the first and the last of each.
    finished: tuple[tuple[int, int], ...]
    # The trial that was begun, and how many of its decisions were there.
    unfinished: tuple[int, int] | None = None
    # Trials whose decisions the version that went on has computed, all with the same result.
    computed_again: tuple[int, ...]

    def decided(self) -> str:
        """Return what was decided, in words."""
        parts = [_trials(self.finished)] if self.finished else []
        if self.unfinished is not None:
            trial, count = self.unfinished
            parts.append(f"the first {count:,} decisions of trial {trial}")
        return f"holdfast {self.holdfast} decided {' and '.join(parts) or 'nothing yet'}"

    def in_words(self) -> str:
        """Return that, and why this version may go on."""
        if not self.computed_again:
            return self.decided()
        again = _trials(ranges_of(self.computed_again))
        return f"{self.decided()}; this version decides the same (computed again: {again})"


def _trials(ranges: Sequence[tuple[int, int]]) -> str:
    texts = [str(first) if first == last else f"{first} to {last}" for first, last in ranges]
    return f"trial{'' if ranges[0][0] == ranges[-1][1] else 's'} {', '.join(texts)}"


def ranges_of(numbers: Sequence[int]) -> tuple[tuple[int, int], ...]:
    """Return the first and the last of each row of numbers that follow each other."""
    ranges: list[tuple[int, int]] = []
    for number in numbers:
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1] = ranges[-1][0], number
        else:
            ranges.append((number, number))
    return tuple(ranges)


_EARLIER = msgspec.json.Decoder(tuple[EarlierCode, ...])


def read_earlier(text: str | None) -> tuple[EarlierCode, ...]:
    """Read the note of a journal about earlier code."""
    return _EARLIER.decode(text or "[]")
