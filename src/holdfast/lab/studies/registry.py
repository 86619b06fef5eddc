"""All studies, by name."""

from __future__ import annotations

import difflib
import importlib.util
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, cast

from holdfast.errors import HoldfastError, InvalidValueError

if TYPE_CHECKING:
    from holdfast.lab.studies.study import Study

__all__ = ["ALL", "studies_of", "study_names"]

ALL = "all"

_PACKAGES = ("scipy", "pandas", "statsmodels", "matplotlib", "pyarrow")

_STUDIES: Mapping[str, str] = {
    "thesis_chapter_6": "holdfast.lab.studies.thesis_chapter_6:ThesisChapter6",
    "offload_break_even": "holdfast.lab.studies.offload_break_even:OffloadBreakEven",
    "published_2017": "holdfast.lab.studies.published_2017:Published2017",
    "published_worlds": "holdfast.lab.studies.published_worlds:PublishedWorlds",
    "selectors": "holdfast.lab.studies.selectors:Selectors",
    "parameters": "holdfast.lab.studies.parameters:Parameters",
}
"""Where each is; imported when it is needed."""


def study_names() -> list[str]:
    """Return the names of all studies, in the order in which ``all`` runs them."""
    return list(_STUDIES)


def studies_of(names: Sequence[str]) -> list[Study]:
    """Return the studies of some names, each once, in the order of :func:`study_names`.

    Parameters
    ----------
    names : sequence of str
        ``all`` stands for all of them.

    Raises
    ------
    InvalidValueError
        If there is no study of a name.
    HoldfastError
        If a package is missing that studies need.
    """
    for name in names:
        if name != ALL and name not in _STUDIES:
            close = difflib.get_close_matches(name, [ALL, *_STUDIES], n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            raise InvalidValueError(
                f"experiment {name!r}: there are {', '.join(_STUDIES)} and {ALL}{hint}"
            )
    missing = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise HoldfastError(
            f"experiments need {', '.join(missing)}, not installed here: pip install "
            "'holdfast[lab]'"
        )
    wanted = [name for name in _STUDIES if ALL in names or name in names]
    return [_study(name) for name in wanted]


def _study(name: str) -> Study:
    module, _, attribute = _STUDIES[name].partition(":")
    return cast("Study", getattr(importlib.import_module(module), attribute)())
