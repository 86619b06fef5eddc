"""Which code made a run: only trials that are decided alike can be compared.

holdfast is identified by its version and the digest of its deciding modules, a problem by the
digests of its sources (:mod:`holdfast.config.source_digest`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import NamedTuple

from holdfast import __version__
from holdfast.config.loader import Configuration
from holdfast.config.registry import problem_module
from holdfast.config.source_digest import core_version, problem_sources

__all__ = ["Difference", "difference", "fingerprint"]

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
    """How the code of an earlier run differs from that of this one.

    Attributes
    ----------
    words : str
        For a person.
    made_by : str
        The version that made the earlier run, with the digest of its core if that is known.
    is_the_problems : bool
        Whether the problem's own source differs, else only holdfast's.
    """

    words: str
    made_by: str
    is_the_problems: bool


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
