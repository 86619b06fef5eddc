"""Small results, configurations and recorded trials for the tests of recording."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from holdfast.config.loader import Configuration, load
from holdfast.journal.journal import Journal
from holdfast.journal.journal_file import START, Finished, decode_entry
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import Belief, ObservationInfo
from holdfast.planning.inputs import ActingRecord, Moved, Record, Sensed, encode_floats
from holdfast.planning.outcome import Decisions, TrialResult
from holdfast.planning.planner import Planner, PlanningState, TaskInfo
from holdfast.planning.sensing import SensingInfo
from holdfast.reports.recorder import Recorder
from holdfast.robot.trial import SensingStep, TaskStep, TrialObserver, run_trial


def result_of(
    trial: int, *, success: bool = True, reward: float = -1.0, sensing_ms: tuple[float, ...] = ()
) -> TrialResult:
    """Return a result with decisions of its own."""
    decisions = Decisions(1, trial.to_bytes(8, "little"))
    return TrialResult(
        trial=trial,
        seed=5,
        success=success,
        steps=10 + trial,
        reward=reward,
        sensing_decisions=len(sensing_ms),
        mean_sensing_ms=0.1 + 0.2,
        recoveries=0,
        unexplained_observations=1,
        digest=decisions.digest(),
        sensing_ms=sensing_ms,
        decisions=decisions,
    )


class Steps(TrialObserver):
    """Keeps what the loop of a trial shows."""

    def __init__(self) -> None:
        self.sensing: list[SensingStep] = []
        self.tasks: list[TaskStep] = []
        vars(self).update(sensed=self.sensing.append, acted=self.tasks.append)


def configuration_of(
    tmp_path: Path,
    *,
    seed: int = 5,
    tolerance: float = 0.1,
    num_particles: int = 30,
    max_steps: int = 30,
) -> Configuration:
    """Return a small configuration, written to peg.yaml."""
    path = tmp_path / "peg.yaml"
    path.write_text(
        "problem: peg_in_hole_2d\n"
        f"model: {{hole_tolerance: {tolerance}}}\n"
        f"particle_filter: {{num_particles: {num_particles}}}\n"
        "active_sensing: {num_observation_samples: 2, num_cores: 1}\n"
        f"simulator: {{num_trials: 3, max_steps: {max_steps}, seed: {seed}}}\n"
    )
    return load(path)


def robot_configuration(tmp_path: Path, *, num_trials: int) -> Configuration:
    """Return the configuration of a robot's short trials, written to robot.yaml."""
    path = tmp_path / "robot.yaml"
    path.write_text(
        "problem: peg_in_hole_2d\n"
        "particle_filter: {num_particles: 50}\n"
        f"simulator: {{num_trials: {num_trials}, max_steps: 60, sensing_intervals: 8, seed: 3}}\n"
    )
    return load(path)


def rewrite(path: Path, change: Callable[[Any], Any]) -> None:
    """Write a journal again, each of its entries changed; None leaves it out."""
    with Journal.read(path) as journal:
        payloads = [payload for payload, _ in journal._file.frames(START)]
    path.unlink()
    entries = [change(decode_entry(payload)) for payload in payloads]
    Journal.create_from(path, [entry for entry in entries if entry is not None]).close()


def forget_steps(entry: Any) -> Any:
    """Keep no steps of a finished trial, as runs of early versions."""
    kept = isinstance(entry, Finished)
    return msgspec.structs.replace(entry, keeps_steps=False) if kept else entry


def failed(result: TrialResult) -> TrialResult:
    """Return the same result as a failure."""
    return msgspec.structs.replace(result, success=False, failed=True)


def flipped(result: TrialResult, byte: int = 9) -> TrialResult:
    """Return the result with another decision; the byte is of the first sensing action."""
    assert result.decisions is not None
    log = bytearray(result.decisions.log)
    log[byte] ^= 1
    decisions = msgspec.structs.replace(result.decisions, log=bytes(log))
    return msgspec.structs.replace(result, decisions=decisions, digest=decisions.digest())


def without_decisions(result: TrialResult) -> TrialResult:
    """Return the result as the journal returns it."""
    return msgspec.structs.replace(result, decisions=None)


def decided(configuration: Configuration, trial: int = 1, **more: Any) -> TrialResult:
    """Return what a plain loop decides: without journal, wire and service."""
    planner = Planner(configuration.problem, configuration.planning)
    simulator = configuration.simulator
    return run_trial(planner, simulator.seed, trial, max_steps=simulator.max_steps, **more)


def record_trial(configuration: Configuration, trial: int = 1) -> Recorder:
    """Run a trial and record it."""
    recorder = Recorder(trial, Planner(configuration.problem, configuration.planning))
    decided(configuration, trial, observer=recorder)
    return recorder


def a_sensing_step(
    belief: Belief, sensing_action: int, *, trial: int = 0, step: int = 0, **values: Any
) -> SensingStep:
    """Return a step whose observation has left the belief as it was."""
    state = PlanningState(5, trial, step, 0, sensed=False, belief=belief)
    info = SensingInfo(values.pop("entropies", None), None, 0, 0)
    sensed = Sensed(step, sensing_action, encode_floats(values.pop("observation", None)))
    found = ObservationInfo(**{"effective_sample_size": 1.5, "explained": True,
                               "resampled": False, **values})  # fmt: skip
    return SensingStep(state, sensed, info, state, found)


def a_task_step(
    belief: Belief, action: FloatArray, estimate: FloatArray, *, trial: int = 0
) -> TaskStep:
    """Return the first step of a trial of a world that nothing asks."""
    state = PlanningState(5, trial, 0, 0, sensed=True, belief=belief)
    nobody: Any = None
    return TaskStep(nobody, state, TaskInfo(estimate, action, 0), action, Moved(0, None))


class Journalling(TrialObserver):
    """Writes down what a robot writes down."""

    def __init__(self) -> None:
        self.records: list[Record] = []

    def sensed(self, step: SensingStep) -> None:
        self.records.append(msgspec.structs.replace(step.sensed, sensing_ms=0.0))

    def acted(self, step: TaskStep) -> None:
        data = np.asarray(step.executed, dtype="<f8").tobytes()
        self.records.append(ActingRecord(step.state.step, data))
        self.records.append(step.moved)
