"""What is decided, pinned: ``digests.csv`` has the digest of every kind of run.

All other tests of "the same bits" compare runs of one and the same code, so a change of what is
decided passes them. Here each row names a run, the command that makes it, and the digest that
``summary.json`` has after it: a hash of every decision of every trial. A digest changes only with
a reason, which stands in CHANGELOG.md. ::

    python -m tests.golden.table

writes the table anew and says which rows changed. With ``--check`` it compares instead, and needs
nothing but holdfast: so a wheel is tried on the machine and with the compiler that it is for.
"""

import csv
import platform
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

from holdfast.config import registry
from holdfast.config.loader import Configuration, load
from holdfast.journal.tables import SummaryBuilder
from holdfast.planning.outcome import TrialResult
from holdfast.planning.settings import SelectorSettings
from holdfast.robot.trials import run_trials
from studies.cases import CASES

ROOT = Path(__file__).parents[2]
TABLE = Path(__file__).with_name("digests.csv")
REWRITE = "python -m tests.golden.table"
COLUMNS = ("name", "command", "digest")
PLAIN = "tests/golden/plain.yaml"
SONAR = "tests/golden/sonar_room.yaml"


class Run(NamedTuple):
    """A batch run of a configuration file, with values instead of the file's."""

    name: str
    file: str
    trials: int
    changes: dict[str, Any]
    problem: str | None = None

    def command(self) -> str:
        """Return the command that makes this run, from the root of the repository."""
        problem = [] if self.problem is None else ["--problem", self.problem]
        changes = [
            f"--set {shlex.quote(f'{key}={_written(value)}')}"
            for key, value in self.changes.items()
        ]
        words = ["holdfast run", self.file, *problem, "--trials", str(self.trials), *changes]
        return " ".join(words)

    def configuration(self) -> Configuration:
        """Return what the command would run."""
        return load(
            ROOT / self.file, problem=self.problem, num_trials=self.trials, overrides=self.changes
        )

    def digest(self) -> str:
        """Run it and return the ``digest`` of its summary."""
        results: list[TrialResult] = []
        run_trials(self.configuration(), 1, (), results.append)
        summary = SummaryBuilder()
        for result in results:
            summary.add(result)
        return summary.build(
            problem="", seed=0, version="", trials=self.trials, wall_time_s=0.0
        ).digest


def _written(value: object) -> str:
    return "null" if value is None else str(value)


def runs() -> list[Run]:
    """Return every run that is pinned; what is new in the product appears here by itself."""
    return [*_examples(), *_problems(), *_selectors(), *_resolutions(), *_estimates()]


_FIRST_DEFAULTS: dict[str, Any] = {
    "selector.method": "action_entropy",
    "selector.estimator": "nearest_neighbor",
}
"""What runs choose by whose configuration says nothing else, until path entropy was the default."""


def _examples() -> Iterator[Run]:
    for path in sorted((ROOT / "examples").rglob("*.yaml")):
        if path.stem == "taskboard":
            continue  # without the arm nothing ends a trial
        file = path.relative_to(ROOT).as_posix()
        short: dict[str, Any] = {"simulator.max_steps": 300}
        if load(path).environment.object is not None:  # what is pinned is simulated
            short["environment.object"] = None
        if path.stem in ("priced_looks", "optional_looks"):
            yield Run(file, file, 3, short)
            continue
        yield Run(file, file, 3, {**short, **_FIRST_DEFAULTS, **_as_before(path.stem)})
        yield Run(f"{file}, as it is", file, 3, short)


def _problems() -> Iterator[Run]:
    """holdfast's own, and those that only its studies have."""
    for problem in dict.fromkeys((*registry.BUILT_IN, *(case.problem for case in CASES))):
        for count in (100, 300):
            changes = {"particle_filter.num_particles": count, "simulator.max_steps": 60}
            before = _as_before(problem)
            yield Run(f"{problem}, {count} particles", PLAIN, 3, {**changes, **before}, problem)
            if before:
                yield Run(f"{problem}, {count} particles, as now", PLAIN, 3, changes, problem)


def _as_before(problem: str) -> dict[str, Any]:
    """The peg in space had one resolution for metres and radians; so old runs can be had again."""
    return {"selector.resolution": 0.04728708045015877} if problem == "peg_in_hole_3d" else {}


def _selectors() -> Iterator[Run]:
    """Every way of choosing, and two steps ahead; long enough that no two of them decide alike."""
    short = {"particle_filter.num_particles": 100, "simulator.max_steps": 200}
    ahead = {"active_sensing.horizon": 2, "active_sensing.discount": 0.5}
    for method in _choices("method"):
        for estimator in _choices("estimator") if method.endswith("_entropy") else (None,):
            if estimator == "prior_neighbors_undominated":
                continue  # Nothing is dominated here, so it decides as prior_neighbors.
            acts = method.startswith(("action_", "path_"))
            for actions in _choices("actions") if acts else (None,):
                chosen = {"method": method, "estimator": estimator, "actions": actions}
                selector = {f"selector.{key}": value for key, value in chosen.items() if value}
                name = ", ".join(selector.values())
                if method == "expected_return":
                    yield from _returns()
                    continue
                yield Run(name, PLAIN, 4, {**selector, **short})
                if method not in {"random", "fixed", "path_entropy"}:
                    yield Run(f"{name}, horizon 2", PLAIN, 4, {**selector, **ahead, **short})


def _resolutions() -> Iterator[Run]:
    """One for each coordinate, of actions and of states."""
    given = {"selector.resolution": [0.1, 0.1, 0.02]}
    short = {"particle_filter.num_particles": 100, "simulator.max_steps": 100}
    for method in ("action_entropy", "action_covariance"):
        yield Run(f"{method}, resolutions", PLAIN, 4, {"selector.method": method, **given, **short})
    mixture = {"selector.estimator": "gaussian_mixture_upper", **given, **short}
    yield Run("mixture, resolutions", PLAIN, 4, mixture)
    states = {"selector.method": "state_entropy", **short}
    yield Run(
        "state_entropy, resolutions of states", PLAIN, 4, states, "studies.passer_by:PasserBy"
    )


def _returns() -> Iterator[Run]:
    """Expected return of the rewards and of the steps, and with a general likelihood."""
    for file, rewards in ((PLAIN, "problem"), (PLAIN, "steps"), (SONAR, "steps")):
        changes = {
            "selector.method": "expected_return",
            "selector.rollout_reward": rewards,
            "selector.max_observation_samples": 20,
            "particle_filter.num_particles": 100,
            "simulator.max_steps": 200,
        }
        yield Run(f"expected_return, {rewards}, {Path(file).stem}", file, 2, changes)


def _estimates() -> Iterator[Run]:
    """Weights that last, the other estimate of the state, stages ahead, a general likelihood."""
    weighted = {"particle_filter.resampling_threshold": 0.4, "simulator.max_steps": 100}
    most_likely = {"particle_filter.estimate": "most_likely"}
    ahead = {"active_sensing.horizon": 2, "simulator.max_steps": 100}
    yield Run("few resamplings", PLAIN, 2, weighted)
    yield Run("most likely particle", PLAIN, 2, {**most_likely, **weighted})
    yield Run("stages ahead", PLAIN, 2, ahead, "capsule_robot")
    on_the_way = {"selector.method": "path_entropy", "simulator.max_steps": 100}
    yield Run("stages on the way", PLAIN, 2, on_the_way, "capsule_robot")
    counted: dict[str, Any] = {
        "selector.path_unit": "steps",
        "selector.path_offsets": [0, 9, 18, 36],
        "selector.path_discount": 1.0,
    }
    few = {"particle_filter.num_particles": 100}
    yield Run("offsets in steps", PLAIN, 4, {**on_the_way, **counted, **few})
    short = {"particle_filter.num_particles": 100, "simulator.max_steps": 100}
    yield Run("general likelihood", SONAR, 6, short)
    path = {"selector.method": "path_entropy"}
    yield Run("general likelihood, path entropy", SONAR, 6, {**path, **short})
    yield Run("general likelihood, horizon 2", SONAR, 6, {"active_sensing.horizon": 2, **short})
    yield Run("general likelihood, few resamplings", SONAR, 6, {**short, **weighted})


def _choices(key: str) -> tuple[str, ...]:
    """Return what a key of the section ``selector`` may be."""
    hint = get_type_hints(SelectorSettings)[key]
    # One that may be None, too, is a union.
    literals = [each for each in get_args(hint) if get_args(each)] or [hint]
    return tuple(choice for literal in literals for choice in get_args(literal))


def pinned() -> dict[str, tuple[str, str]]:
    """Return the table: command and digest by name."""
    with TABLE.open(encoding="utf-8", newline="") as file:
        return {row["name"]: (row["command"], row["digest"]) for row in csv.DictReader(file)}


def rewrite() -> None:
    """Run everything and write the table anew."""
    before = pinned() if TABLE.exists() else {}
    now = {run.name: (run.command(), run.digest()) for run in runs()}
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows((name, *row) for name, row in now.items())
    _print_differences(before, now)
    print(f"{TABLE}: {len(now)} rows; a changed digest needs its reason in CHANGELOG.md")


def check() -> bool:
    """Run everything, and tell whether all of it comes out as the table says."""
    now = {run.name: (run.command(), run.digest()) for run in runs()}
    different = _print_differences(pinned(), now)
    print(f"{len(now)} runs on {platform.machine()}, {different} of them differ from {TABLE.name}")
    return different == 0


def _print_differences(before: dict[str, tuple[str, str]], now: dict[str, tuple[str, str]]) -> int:
    names = [name for name in sorted(before | now) if before.get(name) != now.get(name)]
    for name in names:
        was, is_now = (rows.get(name, ("", "no row"))[1] for rows in (before, now))
        print(f"{name}: {was} -> {is_now}")
    return len(names)


if __name__ == "__main__":
    if sys.argv[1:] == ["--check"]:
        sys.exit(not check())
    rewrite()
