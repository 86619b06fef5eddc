"""A recorded run as arrays: ``holdfast.open_run``.

The journal holds decisions, not beliefs. Beliefs, estimates and entropies are a function of the
decisions' inputs, so a trial is planned again when it is read, and must come to the same decisions.
That takes as long as planning did.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from holdfast.config.loader import Configuration
from holdfast.errors import OutputError
from holdfast.journal.tables import trial_row
from holdfast.numerics.arrays import FloatArray, IntArray, whole
from holdfast.planning.belief import Belief
from holdfast.planning.outcome import TRIAL_COLUMNS, TrialResult
from holdfast.planning.planner import Planner
from holdfast.reports import facts
from holdfast.reports.replay import RecordedRun
from holdfast.robot.trial import SensingStep


@dataclass(frozen=True)
class TrialArrays:
    """One trial: T task actions, S of their steps with a sensing action before.

    Attributes
    ----------
    result : TrialResult or None
        None if the trial is not finished.
    task_actions : array of shape (T, action_size)
        Executed task actions.
    sensing_steps, sensing_actions : array of shape (S,)
        The steps with a sensing action, and which action it was.
    observations : tuple of S arrays
        Each of shape ``(observation_size,)``; of size 0 if the choice was not to sense, or if it
        never came. One that came late is here, too.
    entropies : array of shape (S, num_choices)
        What was minimised, expected after each choice: the sensing actions and, if it may be
        chosen, not to sense. NaN where nothing was.
    priors : tuple of S beliefs
        Before each observation.
    beliefs : tuple of T + 1 beliefs
        From which each task action was chosen, and the last. (A trial that is not finished may
        lack the last.)
    estimates : array of shape (T + 1, state_size)
        The states that stood for these beliefs.
    stages : array of shape (T,)
        Of each task action.
    rewards : array of shape (T,)
        NaN for a step without one.
    true_states : array of shape (T + 1, state_size) or None
        Of a simulated world; None for a robot's own.
    motions, move_observations : tuple of T arrays
        What each move has shown; of size 0 for nothing.
    """

    trial: int
    result: TrialResult | None
    task_actions: FloatArray
    sensing_steps: IntArray
    sensing_actions: IntArray
    observations: tuple[FloatArray, ...]
    entropies: FloatArray
    priors: tuple[Belief, ...]
    beliefs: tuple[Belief, ...]
    estimates: FloatArray
    stages: IntArray
    rewards: FloatArray
    true_states: FloatArray | None
    motions: tuple[FloatArray, ...]
    move_observations: tuple[FloatArray, ...]


@dataclass(frozen=True)
class RunArrays:
    """A recorded run.

    Attributes
    ----------
    path : Path
        Its directory, or its journal; absolute.
    trials : tuple of int
        Numbers of all its trials, the one that was begun and not finished included.
    results : dict of arrays
        The columns of ``trials.csv``, one entry for each finished trial. A number that
        there is not, such as a reward, is NaN.
    problem_directory : Path or None
        As :func:`open_run` was given it; absolute.
    """

    path: Path
    configuration: Configuration
    trials: tuple[int, ...]
    results: dict[str, npt.NDArray[Any]]
    problem_directory: Path | None = None

    def trial(self, number: int) -> TrialArrays:
        """Return one trial; :meth:`read` is faster for several."""
        return next(self.read([number]))

    def read(self, trials: Iterable[int] | None = None) -> Iterator[TrialArrays]:
        """Read trials one after the other, in ascending order. Default: all.

        Raises
        ------
        OutputError
            If there is no such trial, or the run is damaged.
        HoldfastError
            If a trial is decided otherwise now.
        """
        wanted = self.trials if trials is None else [whole("trial", each, 0) for each in trials]
        chosen = sorted(set(wanted))
        if lacking := set(chosen).difference(self.trials):
            raise OutputError(f"{self.path}: has no trial {min(lacking)}")
        with RecordedRun(self.path, "open", problem_directory=self.problem_directory) as run:
            planner = Planner(run.configuration.problem, run.configuration.planning)
            sink = _Collector(planner.num_choices)
            for trial in run.replay(chosen, [sink]):
                yield sink.collected(trial, run.configuration.problem.action_size)


def open_run(path: str | Path, *, problem_directory: str | Path | None = None) -> RunArrays:
    """Open a recorded run, by its directory or journal, to be read as arrays; it is not changed.

    Parameters
    ----------
    problem_directory : str or Path, optional
        Where the module of a run's own problem (``module:Class``) lies. Its code is run then, and
        no code that the record names is run without.

    Raises
    ------
    OutputError
        If it is no run, or damaged.
    UntrustedCodeError
        If its problem is ``module:Class``, and there is no ``problem_directory``.
    HoldfastError
        If its problem cannot be built any more.
    """
    run = Path(path).absolute()  # the problem's own code may change the current directory
    directory = None if problem_directory is None else Path(problem_directory).absolute()
    with RecordedRun(run, "open", problem_directory=directory) as recorded:
        configuration, trials = recorded.configuration, recorded.trials
        rows = [trial_row(each) for each in recorded.journal.results()]
    columns = zip(*rows, strict=True) if rows else ([] for _ in TRIAL_COLUMNS)
    results = {
        name: np.array([np.nan if value is None else value for value in column])
        for name, column in zip(TRIAL_COLUMNS, columns, strict=True)
    }
    return RunArrays(run, configuration, trials, results, directory)


class _Collector:
    """Collects the facts of one trial at a time."""

    def __init__(self, num_choices: int) -> None:
        self._no_entropies = np.full(num_choices, np.nan)
        self._sensing: list[SensingStep] = []
        self._late: dict[int, FloatArray] = {}
        self._tasks: list[facts.TaskFact] = []
        self._end: facts.TrialEndFact | None = None

    def trial_begins(self, fact: facts.TrialBeginFact) -> None:
        """Forget the trial before."""
        del fact
        self._sensing, self._tasks, self._end, self._late = [], [], None, {}

    def sensed(self, fact: facts.SensingFact) -> None:
        """Keep a sensing action."""
        self._sensing.append(fact.step)

    def acted(self, fact: facts.TaskFact) -> None:
        """Keep a task action."""
        self._tasks.append(fact)

    def observed_late(self, fact: facts.LateFact) -> None:
        """Keep a late observation."""
        self._late[fact.step.late.taken] = fact.step.late.numbers()

    def trial_ends(self, fact: facts.TrialEndFact) -> None:
        """Keep the end."""
        self._end = fact

    def happened(self, fact: facts.EventFact) -> None:
        """Leave events out."""

    def collected(self, trial: int, action_size: int) -> TrialArrays:
        """Return the trial that has just ended."""
        sensing, tasks, end = self._sensing, self._tasks, self._end
        assert end is not None
        acted = [task.step for task in tasks]
        moved = [step.moved.numbers() for step in acted]
        actions = np.array([step.executed for step in acted]).reshape(-1, action_size)
        steps = np.array([each.before.step for each in sensing], dtype=np.int64)
        chosen = np.array([each.sensing_action for each in sensing], dtype=np.int64)
        known = (each.sensing_info.entropies for each in sensing)
        entropies = [self._no_entropies if each is None else each for each in known]
        rewards = [np.nan if step.reward is None else step.reward for step in acted]
        beliefs = [*(step.state.belief for step in acted), end.belief]
        estimates = [*(step.task_info.estimate for step in acted), end.estimate]
        ends: list[facts.TaskFact | facts.TrialEndFact] = [*tasks, end]
        true_states = [each.true_state for each in ends if each.true_state is not None]
        return TrialArrays(
            trial,
            end.result,
            actions,
            steps,
            chosen,
            observations=tuple(
                _shown(self._late.get(each.before.step, each.observation)) for each in sensing
            ),
            entropies=np.array(entropies).reshape(-1, self._no_entropies.size),
            priors=tuple(each.before.belief for each in sensing),
            beliefs=tuple(each for each in beliefs if each is not None),
            estimates=np.array([each for each in estimates if each is not None]),
            stages=np.array([step.task_info.stage for step in acted], dtype=np.int64),
            rewards=np.array(rewards, dtype=np.float64),
            true_states=np.array(true_states) if true_states else None,
            motions=tuple(_shown(motion) for motion, _ in moved),
            move_observations=tuple(_shown(observation) for _, observation in moved),
        )


def _shown(values: FloatArray | None) -> FloatArray:
    return np.empty(0) if values is None else values
