"""Simulated runs on request: takes lines ``FIRST LAST``, prints these seeds' processor seconds.

Says first which kind of state machines it runs, once it has run some.
"""

from __future__ import annotations

import sys
import time

from holdfast.config.source_digest import machines
from holdfast_lab.simulation.schedule_draws import draw_schedule
from holdfast_lab.simulation.world import Simulator

# What is computed once stays in memory after these.
_WARMING_SEEDS = range(1_000_000, 1_000_150)


def main() -> None:
    """Run seeds until standard input ends."""
    simulator = Simulator()
    for seed in _WARMING_SEEDS:
        simulator.run(draw_schedule(seed))
    print(machines(), flush=True)
    for line in sys.stdin:
        first, last = map(int, line.split())
        start = time.process_time()
        for seed in range(first, last):
            if simulator.run(draw_schedule(seed)).violation is not None:
                sys.exit(f"seed {seed} shows a violation")
        print(time.process_time() - start, flush=True)


if __name__ == "__main__":
    main()
