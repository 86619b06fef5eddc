"""The problems of ``examples/two_ends.py``, by names that a study can give: here is the same file.

Coming to the wrong end is a failure, and what decides is not seen by looking one step ahead: two
cues that count only together (after Javdani and others, "Near-optimal Bayesian active learning with
noisy observations", 2010: decision regions), a cue that must be sensed early (the T maze of Bakker,
"Reinforcement learning with long short-term memory", 2001), and a distractor that noise refreshes.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

__all__ = ["Sorting", "TMaze", "TwoCues"]


def _example(name: str) -> Any:
    path = Path(__file__).parents[1] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"{__name__}_example", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


_module = _example("two_ends")
TwoCues, TMaze, Sorting = _module.TwoCues, _module.TMaze, _module.Sorting
