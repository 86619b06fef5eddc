"""Problems of ``examples/``, by names that a study can give: here are the same files.

In those of ``two_ends.py`` coming to the wrong end is a failure, and what decides is not seen by
looking one step ahead: two cues that count only together (after Javdani and others, "Near-optimal
Bayesian active learning with noisy observations", 2010: decision regions), a cue that must be
sensed early (the T maze of Bakker, "Reinforcement learning with long short-term memory", 2001), and
a distractor that noise refreshes. The corridor has a belief with several modes, if the robot may be
anywhere in it; westward the heading is pi as much as -pi.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any


def _example(name: str) -> Any:
    path = Path(__file__).parents[1] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"{__name__}_{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


_module = _example("two_ends")
TwoCues, TMaze, Sorting = _module.TwoCues, _module.TMaze, _module.Sorting
Corridor = _example("corridor_doors").CorridorDoors
Westward = _example("wrapping_heading").WrappingHeading
