"""What has to be measured in a process of its own: peak memory, instruction sets, busy cores.

Takes one JSON object (``kind`` names the function, the rest are its arguments) and prints one.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.beliefs import (
    SEED,
    concentrated_state,
    default_settings,
    recorded_trial,
    settings_for,
)
from benchmarks.common import decide, evenly_spread
from benchmarks.measure import alternate, peak_memory_bytes
from holdfast import _kernel
from holdfast.planning.planner import Planner
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.peg_in_hole_3d import PegInHole3D


def large(
    num_particles: int,
    deviation: float | None,
    threads: int,
    turns: int,
    in_space: bool = False,
    heavy_tails: bool = False,
    default: bool = False,
) -> dict[str, Any]:
    """Time a decision over many particles; a deviation of None means the initial belief."""
    problem = PegInHole3D() if in_space else PegInHole2D()
    settings = (default_settings if default else settings_for)(num_particles, threads)
    planner = Planner(problem, settings)
    if deviation is None:
        state = planner.init(SEED, 0)
    else:
        state = concentrated_state(
            num_particles, deviation, in_space=in_space, heavy_tails=heavy_tails
        )
    before = peak_memory_bytes()
    seconds = []
    for _ in range(turns):
        start = time.perf_counter()
        _, info = planner.choose_sensing_action(state)
        seconds.append(time.perf_counter() - start)
    return {
        "seconds": seconds,
        "peak_before_bytes": before,
        "peak_bytes": peak_memory_bytes(),
        "visits": info.visits,
    }


def decisions(sizes: list[int], threads: int, num_beliefs: int, turns: int) -> dict[str, Any]:
    """Time decisions on beliefs of a trial; the hash covers every entropy, bit for bit."""
    problem = PegInHole2D()
    hashed = hashlib.blake2b(digest_size=16)
    medians, percentiles = {}, {}
    for num_particles in sizes:
        settings = settings_for(num_particles, threads)
        states, _ = recorded_trial(problem, settings)
        times = []
        for state in evenly_spread(states, num_beliefs):
            _, info = Planner(problem, settings).choose_sensing_action(state)
            if info.samples is not None:
                hashed.update(np.ascontiguousarray(info.samples).tobytes())
            times.append(alternate({"": decide(problem, settings, state)}, turns)[""].ravel())
        medians[num_particles] = float(np.median([np.median(own) for own in times]))
        percentiles[num_particles] = float(np.percentile(np.concatenate(times), 99))
    return {
        "simd": _kernel.simd(),
        "medians": medians,
        "percentiles_99": percentiles,
        "hash": hashed.hexdigest(),
    }


def main() -> None:
    """Measure what the command line asks for."""
    request = json.loads(sys.argv[1])
    kind = request.pop("kind")
    print(json.dumps(large(**request) if kind == "large" else decisions(**request)))


if __name__ == "__main__":
    main()
