"""Which code made a run: only trials that the same code decided can be compared.

holdfast is identified by its version and the digest of its deciding modules, a problem by the
digests of its sources (:mod:`holdfast.config.source_digest`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from holdfast import __version__
from holdfast.config.loader import Configuration
from holdfast.config.registry import problem_module
from holdfast.config.source_digest import core_version, problem_sources

__all__ = ["difference", "fingerprint"]

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


def difference(there: Mapping[str, str], here: Mapping[str, str]) -> str | None:
    """Return in words how the code of an earlier run differs from that of this one, or None."""
    if there.get(_VERSION) != here[_VERSION]:
        return (
            f"it was made by holdfast {there.get(_VERSION, 'of an unknown version')}, "
            f"this is {here[_VERSION]}"
        )
    core = there.get(_CORE)
    if core is not None and core != here[_CORE]:
        return f"it was made by holdfast {core}, this is {here[_CORE]}: other code"
    old: dict[str, str] = json.loads(there.get(_SOURCES, "{}"))
    new: dict[str, str] = json.loads(here[_SOURCES])
    # Journals that say nothing of the core name fewer modules.
    names = old.keys() & new.keys() if core is None else old.keys() | new.keys()
    changed = sorted(name for name in names if old.get(name) != new.get(name))
    if not changed:
        return None
    return f"the problem's source has changed since (module {', '.join(changed)})"
