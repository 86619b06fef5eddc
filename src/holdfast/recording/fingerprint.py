"""Which code made a run: a trial can only stand beside others that the same code decided.

The version of holdfast tells its own code. A problem of somebody else's has no version that we
could trust while it is being written, so the source of its class, and of the classes that it is
derived from, is hashed.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping
from pathlib import Path

from holdfast import __version__
from holdfast.configuration import Configuration

__all__ = ["difference", "fingerprint"]

_VERSION = "holdfast_version"
_SOURCES = "problem_sources"


def fingerprint(configuration: Configuration) -> dict[str, str]:
    """Return what tells the code of a run, for its journal.

    Parameters
    ----------
    configuration : Configuration
        Of the run; its problem is looked at.

    Returns
    -------
    dict of str
        holdfast's version, and the hash of each source file of a problem that is not holdfast's,
        as JSON.
    """
    hashes: dict[str, str] = {}
    for derived in type(configuration.problem).__mro__:
        module = derived.__module__
        package = module.partition(".")[0]
        if package == "holdfast" or package in sys.stdlib_module_names:
            continue
        file = getattr(sys.modules.get(module), "__file__", None)
        if file is not None and module not in hashes:
            hashes[module] = hashlib.blake2b(Path(file).read_bytes(), digest_size=32).hexdigest()
    return {_VERSION: __version__, _SOURCES: json.dumps(hashes, sort_keys=True)}


def difference(there: Mapping[str, str], here: Mapping[str, str]) -> str | None:
    """Return in words how the code of two runs differs, None if it does not.

    Parameters
    ----------
    there, here : mapping of str
        What :func:`fingerprint` returned for the earlier run and for this one.
    """
    if there.get(_VERSION) != here[_VERSION]:
        return (
            f"it was made by holdfast {there.get(_VERSION, 'of an unknown version')}, "
            f"this is {here[_VERSION]}"
        )
    old: dict[str, str] = json.loads(there.get(_SOURCES, "{}"))
    new: dict[str, str] = json.loads(here[_SOURCES])
    changed = sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))
    if not changed:
        return None
    return f"the problem's source has changed since (module {', '.join(changed)})"
