"""All studies, by name."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Mapping, Sequence
from typing import cast

from holdfast.errors import InvalidValueError
from holdfast.experiments.study import Study

__all__ = ["ALL", "studies_of", "study_names"]

ALL = "all"

_STUDIES: Mapping[str, str] = {
    "thesis_chapter_6": "holdfast.experiments.thesis_chapter_6:ThesisChapter6",
    "cloud_worth": "holdfast.experiments.cloud_worth:CloudWorth",
    "published_2017": "holdfast.experiments.published_2017:Published2017",
    "published_worlds": "holdfast.experiments.published_worlds:PublishedWorlds",
    "selectors": "holdfast.experiments.selectors:Selectors",
    "parameters": "holdfast.experiments.parameters:Parameters",
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
    """
    for name in names:
        if name != ALL and name not in _STUDIES:
            close = difflib.get_close_matches(name, [ALL, *_STUDIES], n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            raise InvalidValueError(
                f"experiment {name!r}: there are {', '.join(_STUDIES)} and {ALL}{hint}"
            )
    wanted = [name for name in _STUDIES if ALL in names or name in names]
    return [_study(name) for name in wanted]


def _study(name: str) -> Study:
    module, _, attribute = _STUDIES[name].partition(":")
    return cast(Study, getattr(importlib.import_module(module), attribute)())
