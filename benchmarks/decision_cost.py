"""Compare the cost model of services with what decisions take.

    OMP_NUM_THREADS=1 python -m benchmarks.decision_cost --count 200 --seed 1

Settings are drawn; the choice of a sensing action, and steps and observations to reach a state, are
measured in the processor's time of one thread and compared with what
:mod:`holdfast.protocol.decision_cost` says. Below 1 the model says too much.
"""

from __future__ import annotations

import argparse
import math
import random
import resource
import statistics
import tracemalloc
from time import thread_time
from typing import get_args

from tests.fuzz.hostile_settings import made_fit, with_key

from holdfast.config import registry
from holdfast.config.registry import BUILT_IN
from holdfast.errors import HoldfastError
from holdfast.planning.planner import Planner
from holdfast.planning.settings import Estimator, Method, PlanningSettings
from holdfast.protocol.decision_cost import Pricing, describe_cost
from holdfast.protocol.service_sessions import with_cores
from holdfast.service.calibration import measure_problem, measure_slowness


def random_settings(chance: random.Random) -> PlanningSettings:
    """Return settings whose costly numbers are drawn by their logarithms; others stay."""
    settings = PlanningSettings()

    def drawn(least: int, greatest: int) -> int:
        return round(least * math.exp(math.log(greatest / least) * chance.random()))

    values: dict[str, object] = {
        "selector.method": chance.choice(get_args(Method)),
        "selector.estimator": chance.choice((None, *get_args(Estimator))),
        "selector.resolution": chance.choice((None, 10.0 ** chance.uniform(-4.0, 3.0))),
        "selector.sensing_is_optional": chance.random() < 0.3,
        "particle_filter.num_particles": drawn(30, 30_000),
        "particle_filter.estimate": chance.choice(("mean", "mean", "heaviest_mode")),
        "active_sensing.num_observation_samples": drawn(1, 200),
        "active_sensing.num_nearest_neighbors": drawn(1, 300) if chance.random() < 0.4 else 5,
        "active_sensing.horizon": drawn(1, 30),
        "selector.rollout_steps": drawn(1, 2000),
        "selector.rollout_sensing_steps": drawn(1, 100),
        "selector.max_observation_samples": drawn(1, 400),
        "selector.path_offsets": tuple(range(drawn(1, 16))),
        "sensing_interval": drawn(1, 60),
    }
    for key, value in values.items():
        settings = with_key(settings, key, value)
    return made_fit(settings)


def main() -> None:
    """Measure, and print a line for each decision and a summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--most-s", type=float, default=2.0)
    parser.add_argument("--least-s", type=float, default=0.0)
    parser.add_argument("--memory", action="store_true", help="Compare bytes, too (slow).")
    options = parser.parse_args()
    chance = random.Random(options.seed)
    slowness = measure_slowness()
    print(f"slowness {slowness:.2f}")
    ratios: dict[str, list[float]] = {}
    done = 0
    while done < options.count:
        name = chance.choice(tuple(BUILT_IN))
        problem = registry.problem_class(name).from_settings({}, {})
        settings = with_cores(random_settings(chance), 1)
        own = measure_problem(problem)
        price = Pricing(slowness).price_of(problem, settings, own)
        sensing = price.sensing
        if not options.least_s <= sensing.seconds <= options.most_s or sensing.num_bytes > 1 << 30:
            continue
        done += 1
        planner = Planner(problem, settings)
        method = settings.selector.method
        try:
            began = thread_time()
            state = planner.init(done)
            steps = chance.choice((0, 1, 5))
            inputs = chance.choice((0, 1, 2))
            for _ in range(steps):
                action, _ = planner.choose_task_action(state)
                state = planner.advance(state, action)
            shown = problem.observation_mean(state.belief.states[0], 0)
            for _ in range(inputs):
                state, _ = planner.observe(state, 0, shown)
            planner.digest(state)
            reached_s = thread_time() - began
            if options.memory:
                tracemalloc.start()
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            began = thread_time()
            planner.choose_sensing_action(state)
            took_s = thread_time() - began
            peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
            if options.memory:
                peak = max(peak, tracemalloc.get_traced_memory()[1])
                tracemalloc.stop()
        except HoldfastError as error:
            print(f"failed {error}")
            continue
        reach = price.reaching.cost(steps=steps, inputs=inputs, begins=True, num_bytes=0)
        kind: str = method
        if method in ("action_entropy", "path_entropy", "state_entropy"):
            kind += f" {settings.selector.estimator}"
        ratios.setdefault("reach", []).append(reached_s / reach.seconds)
        ratios.setdefault(kind, []).append(took_s / sensing.seconds)
        if options.memory:
            ratios.setdefault("memory", []).append(peak / sensing.num_bytes)
        estimated_ms, took_ms = 1e3 * sensing.seconds, 1e3 * took_s
        print(
            f"{took_s / sensing.seconds:6.2f} {took_ms:9.2f} ms of {estimated_ms:9.2f}"
            f" {peak / 2**20:6.1f} MB of {sensing.num_bytes / 2**20:6.1f} | reach"
            f" {reached_s / reach.seconds:5.2f} | {name} {describe_cost(problem, settings)}"
            f" estimator {settings.selector.estimator} {settings.particle_filter.estimate}"
            f" resolution {settings.selector.resolution}",
            flush=True,
        )
    print()
    for kind, found in sorted(ratios.items()):
        print(
            f"{kind:40s} {len(found):4d}  median {statistics.median(found):6.3f}  "
            f"max {max(found):6.2f}  min {min(found):6.3f}"
        )
    everything = [each for kind, found in ratios.items() if kind != "memory" for each in found]
    spread = statistics.pstdev(math.log(max(each, 1e-6)) for each in everything)
    print(f"{len(everything)} measured, spread {math.exp(spread):.1f}")


if __name__ == "__main__":
    main()
