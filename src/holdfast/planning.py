"""Planning as a deterministic state machine: a state, and pure functions of it.

:class:`PlanningState` is everything that the next decision depends on besides the problem and the
settings. Nothing here reads a clock, a socket or a generator with a state; every random number is
named by (seed, trial, step, purpose). So whoever holds the state, a cloud service, the robot
itself, a process started after a crash, makes the same next decision, and a checkpoint is simply
the state, encoded.

One step of the loop::

    if needs_sensing(settings, state):
        sensing_action, info = choose_sensing_action(problem, settings, state)
        observation = environment.perform_sensing(sensing_action)
        state, info = observe(problem, settings, state, sensing_action, observation)
    task_action, info = choose_task_action(problem, settings, state)
    environment.perform(task_action)
    state = advance(problem, settings, state, task_action)
"""

from __future__ import annotations

import hashlib
import struct
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from holdfast import contract, numerics, sensing
from holdfast.belief import Belief, estimate, resample, uniform_weights, update
from holdfast.errors import CheckpointError, InvalidValueError, ProblemError
from holdfast.problems.problem import Problem
from holdfast.randomness import Purpose, stream
from holdfast.sensing import SensingInfo
from holdfast.settings import MAX_PARTICLES, PlanningSettings, check_settings

__all__ = [
    "Decision",
    "ObservationInfo",
    "Planner",
    "PlanningState",
    "SensingInfo",
    "TaskInfo",
    "advance",
    "check_state",
    "choose_sensing_action",
    "choose_task_action",
    "decode_checkpoint",
    "digest",
    "encode_checkpoint",
    "initial_state",
    "needs_sensing",
    "observe",
    "plan_until_sensing",
]

FloatArray = npt.NDArray[np.float64]

CHECKPOINT_VERSION = 1


class PlanningState(NamedTuple):
    """Everything that the next decision depends on, besides the problem and the settings.

    Attributes
    ----------
    seed, trial, step : int
        Name the random streams; ``step`` counts task actions.
    stage : int
        Stage of the task (which hole or via point is next).
    sensed : bool
        Whether this step's observation is already part of the belief.
    belief : Belief
    """

    seed: int
    trial: int
    step: int
    stage: int
    sensed: bool
    belief: Belief


class ObservationInfo(NamedTuple):
    """What folding in an observation found.

    Attributes
    ----------
    effective_sample_size : float
        After the update and before resampling; from 1 to the number of particles.
    explained : bool
        False if no particle explains the observation: the belief is valid but not to be trusted.
    resampled : bool
    mahalanobis_distance : float or None
        How far, in standard deviations, the observation is from what the nearest particle expects;
        None for a general likelihood.
    """

    effective_sample_size: float
    explained: bool
    resampled: bool
    mahalanobis_distance: float | None = None


class TaskInfo(NamedTuple):
    """Why a task action was chosen.

    Attributes
    ----------
    estimate : array of shape (state_size,)
        The state that the policy was asked for: the mean of the belief, or its most likely
        particle.
    commanded : array of shape (action_size,)
        What the policy said; the action itself is what the limits leave of it.
    stage : int
        The stage that the action belongs to.
    """

    estimate: FloatArray
    commanded: FloatArray
    stage: int


class Decision(NamedTuple):
    """All that can be decided in a state before something is sensed again.

    Attributes
    ----------
    actions : tuple of arrays of shape (action_size,)
        Task actions up to the next sensing step; none if the state has to sense first.
    sensing_action : int or None
        Of that sensing step; None if it is too far away.
    ahead : PlanningState
        The state in which it was chosen.
    """

    actions: tuple[FloatArray, ...]
    sensing_action: int | None
    ahead: PlanningState


def initial_state(
    problem: Problem, settings: PlanningSettings, seed: int, trial: int
) -> PlanningState:
    """Return the state before the first step of a trial.

    Parameters
    ----------
    problem : Problem
    settings : PlanningSettings
    seed : int
        From 0 to 2**63 - 1.
    trial : int
        From 0 to 2**32 - 1.

    Raises
    ------
    InvalidValueError
        If seed, trial or the number of particles is out of bounds.
    ProblemError
        If the problem's initial states have the wrong shape or are not finite.
    """
    count = settings.particle_filter.num_particles
    if not 1 <= count <= MAX_PARTICLES:
        raise InvalidValueError(
            f"particle_filter.num_particles {count}: allowed are 1 to {MAX_PARTICLES}"
        )
    contract.check_problem(problem)
    check_settings(settings)
    drawn = problem.initial_states(stream(seed, trial, 0, Purpose.INITIAL_BELIEF), count)
    states = contract.states_of(problem, "initial_states", drawn, (count, problem.state_size))
    return PlanningState(seed, trial, 0, 0, False, Belief(states, uniform_weights(count)))


def check_state(problem: Problem, settings: PlanningSettings, state: PlanningState) -> None:
    """Check that a state belongs to a problem and settings: for states that come from outside.

    Raises
    ------
    InvalidValueError
        If the number of particles, their size or the stage is another than theirs.
    """
    contract.check_problem(problem)
    check_settings(settings)
    count, size = state.belief.states.shape
    if size != problem.state_size:
        raise InvalidValueError(
            f"state of {size} coordinates: {problem.name} has {problem.state_size}"
        )
    if count != settings.particle_filter.num_particles:
        raise InvalidValueError(
            f"state of {count} particles: particle_filter.num_particles is "
            f"{settings.particle_filter.num_particles}"
        )
    if not 0 <= state.stage < problem.num_stages:
        raise InvalidValueError(
            f"stage {state.stage}: {problem.name} has 0 to {problem.num_stages - 1}"
        )


def needs_sensing(settings: PlanningSettings, state: PlanningState) -> bool:
    """Tell whether the next decision is a sensing action (else it is a task action)."""
    return not state.sensed and state.step % (settings.sensing_interval + 1) == 0


def choose_sensing_action(
    problem: Problem, settings: PlanningSettings, state: PlanningState
) -> tuple[int, SensingInfo]:
    """Choose the next sensing action.

    Returns
    -------
    index : int
        Index into ``problem.sensing_actions``.
    info : SensingInfo
        The expected entropies behind the choice.

    Raises
    ------
    InvalidValueError, ProblemError
        As :func:`holdfast.sensing.choose_sensing_action`.
    """
    return sensing.choose_sensing_action(
        problem,
        settings,
        state.belief,
        state.stage,
        stream(state.seed, state.trial, state.step, Purpose.HYPOTHESES),
        stream(state.seed, state.trial, state.step, Purpose.SELECTION),
    )


def observe(
    problem: Problem,
    settings: PlanningSettings,
    state: PlanningState,
    sensing_action: int,
    observation: npt.ArrayLike,
) -> tuple[PlanningState, ObservationInfo]:
    """Fold an observation into the belief.

    Parameters
    ----------
    problem : Problem
    settings : PlanningSettings
    state : PlanningState
    sensing_action : int
        What was sensed.
    observation : array of shape (observation_size,)
        What it showed.

    Returns
    -------
    state : PlanningState
        With ``sensed`` set.
    info : ObservationInfo

    Raises
    ------
    InvalidValueError
        If the sensing action does not exist, or the observation is not finite or of the wrong
        size. The state that was passed in is still good.
    """
    if not 0 <= sensing_action < len(problem.sensing_actions):
        raise InvalidValueError(
            f"sensing action {sensing_action}: {problem.name} has 0 to "
            f"{len(problem.sensing_actions) - 1}"
        )
    belief, found = update(problem, state.belief, sensing_action, observation)
    count = belief.weights.shape[0]
    threshold = settings.particle_filter.resampling_threshold * count
    # Rounding may leave the size of equal weights a little above their number.
    resampled = threshold == count or found.effective_sample_size <= threshold
    if resampled:
        belief = resample(belief, stream(state.seed, state.trial, state.step, Purpose.RESAMPLING))
    after = state._replace(sensed=True, belief=belief)
    return after, ObservationInfo(
        found.effective_sample_size, found.explained, resampled, found.mahalanobis_distance
    )


def choose_task_action(
    problem: Problem, settings: PlanningSettings, state: PlanningState
) -> tuple[FloatArray, TaskInfo]:
    """Choose the next task action: the policy's for the estimate of the state, within its limits.

    Returns
    -------
    action : array of shape (action_size,)
        The executed action.
    info : TaskInfo

    Raises
    ------
    ProblemError
        If the policy's action is not finite.
    """
    estimated = estimate(state.belief, settings.particle_filter.estimate)
    stage = contract.next_stage(problem, estimated, state.stage)
    commanded = contract.policy(problem, estimated, stage)
    action = contract.executed_action(problem, commanded)
    if not numerics.all_finite(action):
        raise ProblemError(
            f"policy of {problem.name} gives {contract.in_brief(action)} in state "
            f"{contract.in_brief(estimated)}"
        )
    return action, TaskInfo(estimated, commanded, stage)


def advance(
    problem: Problem, settings: PlanningSettings, state: PlanningState, task_action: FloatArray
) -> PlanningState:
    """Predict the belief by a performed task action and go to the next step.

    Parameters
    ----------
    problem : Problem
    settings : PlanningSettings
    state : PlanningState
    task_action : array of shape (action_size,)
        The executed action.

    Raises
    ------
    InvalidValueError
        If the action is not finite or of the wrong size.
    ProblemError
        If the problem moves a particle to a state that is not finite.
    """
    action = np.asarray(task_action, dtype=np.float64)
    if action.shape != (problem.action_size,) or not numerics.all_finite(action):
        raise InvalidValueError(
            f"task action {contract.in_brief(action)}: {problem.name} needs "
            f"{problem.action_size} finite coordinates"
        )
    belief = state.belief
    # Computed again, not taken from whoever calls: the action may come from another machine.
    estimated = estimate(belief, settings.particle_filter.estimate)
    stage = contract.next_stage(problem, estimated, state.stage)
    motion = stream(state.seed, state.trial, state.step, Purpose.PREDICTION)
    moved = problem.move(belief.states, action, motion)
    states = contract.states_of(problem, "move", moved, belief.states.shape)
    return PlanningState(
        state.seed, state.trial, state.step + 1, stage, False, Belief(states, belief.weights)
    )


def plan_until_sensing(
    problem: Problem, settings: PlanningSettings, state: PlanningState, max_actions: int
) -> tuple[list[FloatArray], PlanningState]:
    """Choose the task actions up to the next sensing step: no observation comes between them.

    Parameters
    ----------
    problem : Problem
    settings : PlanningSettings
    state : PlanningState
    max_actions : int
        Stop after so many.

    Returns
    -------
    actions : list of arrays of shape (action_size,)
        Executed actions; empty if the state has to sense first.
    ahead : PlanningState
        The state that they lead to.

    Raises
    ------
    ProblemError
        If a function of the problem breaks its contract.
    """
    return Planner(problem, settings).plan_until_sensing(state, max_actions)


class Planner:
    """The functions that change a state, for one problem and its settings.

    Whoever only follows a robot's belief needs no more of this module; and because they are pure,
    another object in the place of this one may remember what they came to.

    Parameters
    ----------
    problem : Problem
    settings : PlanningSettings
    """

    def __init__(self, problem: Problem, settings: PlanningSettings) -> None:
        self.problem = problem
        self.settings = settings

    def initial_state(self, seed: int, trial: int) -> PlanningState:
        """Return the state before the first step; see :func:`initial_state`."""
        return initial_state(self.problem, self.settings, seed, trial)

    def needs_sensing(self, state: PlanningState) -> bool:
        """Tell whether the next decision is a sensing action; see :func:`needs_sensing`."""
        return needs_sensing(self.settings, state)

    def observe(
        self, state: PlanningState, sensing_action: int, observation: npt.ArrayLike
    ) -> tuple[PlanningState, ObservationInfo]:
        """Fold an observation into the belief; see :func:`observe`."""
        return observe(self.problem, self.settings, state, sensing_action, observation)

    def advance(self, state: PlanningState, task_action: FloatArray) -> PlanningState:
        """Predict the belief and go to the next step; see :func:`advance`."""
        return advance(self.problem, self.settings, state, task_action)

    def choose_task_action(self, state: PlanningState) -> FloatArray:
        """Choose the next task action."""
        return choose_task_action(self.problem, self.settings, state)[0]

    def plan_until_sensing(
        self, state: PlanningState, max_actions: int
    ) -> tuple[list[FloatArray], PlanningState]:
        """Choose the task actions up to the next sensing step; see :func:`plan_until_sensing`."""
        actions: list[FloatArray] = []
        while len(actions) < max_actions and not self.needs_sensing(state):
            action = self.choose_task_action(state)
            state = self.advance(state, action)
            actions.append(action)
        return actions, state

    def decide(self, state: PlanningState, max_actions: int) -> Decision:
        """Decide all that can be decided before something is sensed again."""
        actions, ahead = self.plan_until_sensing(state, max_actions)
        if not needs_sensing(self.settings, ahead):
            return Decision(tuple(actions), None, ahead)
        return Decision(
            tuple(actions), choose_sensing_action(self.problem, self.settings, ahead)[0], ahead
        )

    def digest(self, state: PlanningState) -> bytes:
        """Return 32 bytes that are equal for equal states only; see :func:`digest`."""
        return digest(state)


def digest(state: PlanningState) -> bytes:
    """Return 32 bytes that are equal exactly when two states are equal, bit for bit.

    BLAKE2b over all fields; the belief's arrays as little-endian float64 in C order.
    """
    states, weights = state.belief
    header = struct.pack(
        "<QQQQ?QQ",
        state.seed,
        state.trial,
        state.step,
        state.stage,
        state.sensed,
        states.shape[0],
        states.shape[1],
    )
    hashed = hashlib.blake2b(header, digest_size=32, person=b"holdfast-state")
    hashed.update(np.ascontiguousarray(states, dtype="<f8").data)
    hashed.update(np.ascontiguousarray(weights, dtype="<f8").data)
    return hashed.digest()


Word = Annotated[int, msgspec.Meta(ge=0, le=2**32 - 1)]


class _Checkpoint(msgspec.Struct, forbid_unknown_fields=True, array_like=True):
    version: int
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
    trial: Word
    step: Word
    stage: Word
    sensed: bool
    num_particles: Annotated[int, msgspec.Meta(ge=1, le=MAX_PARTICLES)]
    state_size: Annotated[int, msgspec.Meta(ge=1, le=4096)]
    # Not copied: that would hold up all other threads, 40 ms for 60 MB.
    states: memoryview
    weights: memoryview


_checkpoint_encoder = msgspec.msgpack.Encoder()
_checkpoint_decoder = msgspec.msgpack.Decoder(_Checkpoint)


def encode_checkpoint(state: PlanningState) -> bytes:
    """Encode a state: MessagePack, the arrays as little-endian float64."""
    states, weights = state.belief
    return _checkpoint_encoder.encode(
        _Checkpoint(
            CHECKPOINT_VERSION,
            state.seed,
            state.trial,
            state.step,
            state.stage,
            state.sensed,
            states.shape[0],
            states.shape[1],
            np.ascontiguousarray(states, dtype="<f8").data,
            np.ascontiguousarray(weights, dtype="<f8").data,
        )
    )


def decode_checkpoint(data: bytes | memoryview) -> PlanningState:
    """Decode a state and check it by itself; :func:`check_state` checks it against a problem.

    Raises
    ------
    CheckpointError
        If the bytes are no checkpoint, of another version, or describe no valid belief.
    """
    try:
        content = _checkpoint_decoder.decode(data)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise CheckpointError(f"{len(data)} bytes are no checkpoint: {error}") from error
    if content.version != CHECKPOINT_VERSION:
        raise CheckpointError(
            f"checkpoint version {content.version}: this holdfast reads {CHECKPOINT_VERSION}"
        )
    count, size = content.num_particles, content.state_size
    if len(content.states) != 8 * count * size or len(content.weights) != 8 * count:
        raise CheckpointError(
            f"checkpoint of {count} particles of {size} coordinates has {len(content.states)} and "
            f"{len(content.weights)} bytes: need {8 * count * size} and {8 * count}"
        )
    states = np.frombuffer(content.states, dtype="<f8").astype(np.float64).reshape(count, size)
    weights = np.frombuffer(content.weights, dtype="<f8").astype(np.float64)
    states.setflags(write=False)
    weights.setflags(write=False)
    if not numerics.all_finite(states):
        raise CheckpointError("checkpoint has a state that is not finite")
    # Numbers from anywhere may overflow; NumPy's warning would tell nothing that is not told here.
    with np.errstate(over="ignore", invalid="ignore"):
        total = float(weights.sum())
    if not (weights >= 0.0).all() or not abs(total - 1.0) < 1e-6:
        raise CheckpointError(f"checkpoint has weights that are negative or sum to {total}")
    return PlanningState(
        content.seed,
        content.trial,
        content.step,
        content.stage,
        content.sensed,
        Belief(states, weights),
    )
