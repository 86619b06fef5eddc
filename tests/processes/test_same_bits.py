"""The same decisions, to the last bit, however the machine is set to compute them.

Each case runs the same trials in a process of its own: with other numbers of threads and of worker
processes, with the kernel compiled for other instruction sets, and with NumPy's and OpenBLAS's own
choices by processor taken away, which stands in for another machine. What is compared is the digest
of each trial: a hash of every decision, every action and every belief that an observation led to.
"""

import csv
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.programs import completed

EXAMPLES = Path(__file__).parents[2] / "examples"

# name: the example, trials, and what is changed in it.
RUNS: dict[str, tuple[str, int, dict[str, dict[str, object]]]] = {
    "peg": ("peg_in_hole_2d", 6, {}),
    "more particles": (
        "peg_in_hole_2d",
        4,
        {"particle_filter": {"num_particles": 700}, "simulator": {"max_steps": 60}},
    ),
    # From 4,096 particles on, motion runs on several threads, too.
    "many particles": (
        "peg_in_hole_2d",
        2,
        {"particle_filter": {"num_particles": 5000}, "simulator": {"max_steps": 20}},
    ),
    "few resamplings": (
        "peg_in_hole_2d",
        2,
        {
            "particle_filter": {"num_particles": 100, "resampling_threshold": 0.3},
            "selector": {
                "method": "action_entropy",
                "estimator": "gaussian_mixture_upper",
                "actions": "executed",
            },
            "active_sensing": {"horizon": 2, "discount": 0.5},
            "simulator": {"max_steps": 60},
        },
    ),
    "capsule": ("capsule_robot", 2, {}),
    "multitier": ("multitier_peg_in_hole_2d", 2, {}),
    "peg in space": ("peg_in_hole_3d", 2, {"simulator": {"max_steps": 60}}),
}

SCRIPT = """
import json
import sys
from pathlib import Path

import numpy as np

from holdfast import _kernel
from holdfast.config.loader import load
from holdfast.robot import trial_pool, trials

# As if workers cost nothing to start: they take all trials but the first.
trial_pool._WORKER_START_S = 0.0
# As if threads cost nothing to wake: they share all work that has more than one part.
_kernel.use_threads_from(0.0)

if __name__ == "__main__":
    jobs = int(sys.argv[1])
    digests = {}
    for path in sys.argv[2:]:
        results = []
        trials.run_trials(load(Path(path)), jobs, (), results.append)
        results.sort(key=lambda result: result.trial)
        digests[Path(path).stem] = [result.digest for result in results]
    features = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    print(json.dumps({"digests": digests, "simd": _kernel.simd(), "numpy": features,
                      "threads": _kernel.threads_started()}))
"""

SETTINGS = (
    *("HOLDFAST_SIMD", "NPY_DISABLE_CPU_FEATURES", "OPENBLAS_CORETYPE"),
    "OPENBLAS_NUM_THREADS",  # which the other tests have
)

Report = dict[str, object]
Run = Callable[..., subprocess.CompletedProcess[str]]


def numpy_features() -> list[str]:
    """Return the instruction sets that this NumPy would use here beyond its baseline."""
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    return list(found)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return a function that runs all trials in a fresh process."""
    directory = tmp_path_factory.mktemp("same-bits")
    (directory / "script.py").write_text(SCRIPT)

    def run_them(
        cores: int = 1, jobs: int = 1, names: tuple[str, ...] = tuple(RUNS), **settings: str
    ) -> subprocess.CompletedProcess[str]:
        paths = []
        for name in names:
            example, num_trials, changes = RUNS[name]
            content = yaml.safe_load((EXAMPLES / f"{example}.yaml").read_text())
            content["simulator"]["num_trials"] = num_trials
            for section, keys in changes.items():
                content.setdefault(section, {}).update(keys)
            content["active_sensing"]["num_cores"] = cores
            path = directory / f"cores-{cores}" / f"{name}.yaml"
            path.parent.mkdir(exist_ok=True)
            path.write_text(yaml.safe_dump(content))
            paths.append(str(path))
        environment = {key: value for key, value in os.environ.items() if key not in SETTINGS}
        # The kernel takes it for the number of processors: threads even where there is only one.
        environment["OMP_NUM_THREADS"] = str(cores or 4)
        return completed(
            [sys.executable, str(directory / "script.py"), str(jobs), *paths],
            env=environment | settings,
            timeout=300,
        )

    return run_them


def report_of(finished: subprocess.CompletedProcess[str]) -> Report:
    assert finished.returncode == 0, finished.stderr
    report = json.loads(finished.stdout)
    assert isinstance(report, dict)
    return report


@pytest.fixture(scope="module")
def usual(run: Run) -> Report:
    """Return what comes out with one thread, one process and this machine's own choices."""
    report = report_of(run())
    digests = report["digests"]
    assert isinstance(digests, dict)
    assert {name: len(found) for name, found in digests.items()} == {
        name: num_trials for name, (_, num_trials, _) in RUNS.items()
    }
    # Trials differ, so a digest of nothing would be found.
    every = [digest for found in digests.values() for digest in found]
    assert len(set(every)) == len(every)
    assert report["threads"] == 0
    return report


@pytest.mark.parametrize("cores", [3, pytest.param(0, marks=pytest.mark.slow)])
def test_threads(run: Run, usual: Report, cores: int) -> None:
    """With helpers that take their part of all work, however small."""
    report = report_of(run(cores=cores))
    assert report["threads"] == (cores or 4) - 1
    assert report["digests"] == usual["digests"]


@pytest.mark.parametrize("cores", [2, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["more particles", "many particles"])
def test_helpers_take_part(run: Run, usual: Report, name: str, cores: int) -> None:
    """In these very trials: the others have not woken the helpers before."""
    report = report_of(run(cores=cores, names=(name,)))
    assert report["threads"] == cores - 1
    digests = usual["digests"]
    assert isinstance(digests, dict)
    assert report["digests"] == {name: digests[name]}


def test_worker_processes(run: Run, usual: Report) -> None:
    names = ("peg", "capsule")
    digests = usual["digests"]
    assert isinstance(digests, dict)
    found = report_of(run(jobs=2, names=names))["digests"]
    assert found == {name: digests[name] for name in names}


@pytest.mark.parametrize(
    "simd",
    [
        pytest.param("baseline", marks=pytest.mark.slow),  # test_all_at_once has it, too
        "avx2",
        "avx512",
    ],
)
def test_instruction_sets(run: Run, usual: Report, simd: str) -> None:
    report = usual
    if report["simd"] != simd:
        finished = run(HOLDFAST_SIMD=simd)
        if simd != "baseline" and "allowed here are baseline" in finished.stderr:
            pytest.skip(f"this processor has no {simd}")
        report = report_of(finished)
    assert report["simd"] == simd
    assert report["digests"] == usual["digests"]


@pytest.mark.skipif(not numpy_features(), reason="NumPy makes no choices by processor here")
def test_all_at_once(run: Run, usual: Report) -> None:
    """As far from the usual as one machine allows."""
    report = report_of(
        run(
            cores=2,
            HOLDFAST_SIMD="baseline",
            NPY_DISABLE_CPU_FEATURES=" ".join(numpy_features()),
            OPENBLAS_CORETYPE="Prescott",
        )
    )
    assert usual["numpy"] == numpy_features()
    assert (report["simd"], report["numpy"]) == ("baseline", [])
    assert report["digests"] == usual["digests"]


@pytest.mark.parametrize("jobs", ["2", pytest.param("1", marks=pytest.mark.slow)])
def test_the_command(tmp_path: Path, usual: Report, jobs: str) -> None:
    """``holdfast run`` on the example itself, which leaves the number of threads open."""
    without_figures = "import sys; sys.modules['matplotlib'] = None; from holdfast.cli import main"
    command = [sys.executable, "-c", f"{without_figures}; main()", "run"]
    arguments = ["--trials", "6", "--jobs", jobs, "--out", str(tmp_path / "out")]
    subprocess.run(
        [*command, str(EXAMPLES / "peg_in_hole_2d.yaml"), *arguments],
        env={key: value for key, value in os.environ.items() if key not in SETTINGS},
        capture_output=True,
        timeout=300,
        check=True,
    )
    with (tmp_path / "out" / "trials.csv").open() as file:
        found = [row["digest"] for row in csv.DictReader(file)]
    digests = usual["digests"]
    assert isinstance(digests, dict)
    assert found == digests["peg"]
