"""Planning as a deterministic state machine: a state, and pure functions of it.

:class:`PlanningState` is everything that the next decision depends on besides the problem and the
settings. :class:`Planner` holds these two, and its methods are pure: none reads a clock, a socket
or a generator with a state, and every random number is named by (seed, trial, step, purpose). So
every process that has the state makes the same next decision: a cloud service, the robot itself, a
process started after a crash. A checkpoint is the state, encoded.

One step of the loop::

    if planner.needs_sensing(state):
        sensing_action, info = planner.choose_sensing_action(state)
        observation = environment.perform_sensing(sensing_action)
        state, info = planner.observe(state, sensing_action, observation)
    task_action, info = planner.choose_task_action(state)
    environment.perform(task_action)
    state = planner.advance(state, task_action)

An observation may also come with a move (:meth:`Planner.observe_move`), or late
(:mod:`holdfast.planning.tracking`).
"""

from __future__ import annotations

import contextlib
import hashlib
import struct
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from holdfast.errors import CheckpointError, InvalidValueError, ProblemError
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import FloatArray, floats, in_brief, whole
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.numerics.randomness import Purpose, seed_and_trial, stream
from holdfast.planning import interruption, sensing
from holdfast.planning.belief import (
    Belief,
    ObservationInfo,
    belief_sizes,
    estimate,
    regularised,
    resample,
    uniform_weights,
    update,
    update_by_move,
)
from holdfast.planning.sensing import SensingInfo
from holdfast.planning.settings import MAX_PARTICLES, Method, PlanningSettings, check_settings
from holdfast.problems import checked
from holdfast.problems.attributes import (
    check_problem,
    check_sizes,
    circular_states,
    moves_give_observations,
    sensing_action_of,
    static_parameters,
)
from holdfast.problems.problem import Problem

CHECKPOINT_VERSION = 1

_LITTLE_ENDIAN = np.dtype("<f8")


class PlanningState(NamedTuple):
    """Everything that the next decision depends on, besides the problem and the settings.

    ``seed``, ``trial`` and ``step``, which counts task actions, name the random streams; ``stage``
    is that of the task (which hole or via point is next); ``sensed`` says whether this step's
    observation is already part of the belief.
    """

    seed: int
    trial: int
    step: int
    stage: int
    sensed: bool
    belief: Belief


class TaskInfo(NamedTuple):
    """The values behind the choice of a task action.

    Attributes
    ----------
    estimate : array of shape (state_size,)
        The state that the policy was given: the mean of the belief, or its most likely particle.
    commanded : array of shape (action_size,)
        The policy's action, before the limits of a step.
    stage : int
        The stage that the action belongs to.
    """

    estimate: FloatArray
    commanded: FloatArray
    stage: int


class Decision(NamedTuple):
    """All decisions of a state that no further observation can change.

    The task actions up to the next sensing step, none if the state has to sense first; the sensing
    action of that step, None if it is too far away; and the state ``ahead`` in which it was chosen.
    """

    actions: tuple[FloatArray, ...]
    sensing_action: int | None
    ahead: PlanningState


def needs_sensing(settings: PlanningSettings, state: PlanningState) -> bool:
    """Tell whether the next decision is a sensing action (else it is a task action)."""
    return not state.sensed and state.step % (settings.sensing_interval + 1) == 0


class Planner:
    """Makes all decisions for one problem, as pure functions of a state.

    A number of particles and a method of choosing sensing actions (``"random"``, say) take the
    place of the settings'; one that is out of bounds raises InvalidValueError.
    """

    def __init__(
        self,
        problem: Problem,
        settings: PlanningSettings | None = None,
        *,
        particles: int | None = None,
        method: Method | None = None,
    ) -> None:
        if isinstance(problem, str):
            raise InvalidValueError(f"problem is the name {problem!r}: holdfast.make builds it")
        check_sizes(problem)
        self.problem = problem
        settings = PlanningSettings() if settings is None else settings
        settings = _checked(settings)
        if particles is not None:
            settings = _replaced(settings, "particle_filter", "num_particles", particles)
        if method is not None:
            settings = _replaced(settings, "selector", "method", method)
        if particles is not None or method is not None:
            settings = check_settings(settings, PlanningSettings)
        self.settings = settings
        self._staged: tuple[PlanningState | None, int] = None, 0  # the stage that was found last

    @in_own_mode
    def init(self, seed: int, trial: int = 0) -> PlanningState:
        """Return the state before the first step of a trial.

        The seed is from 0 to 2**63 - 1, the trial from 0 to 2**32 - 1.

        Raises
        ------
        InvalidValueError
            If seed or trial is out of bounds.
        ProblemError
            If the problem breaks its contract: its initial states are not finite, say.
        """
        seed, trial = seed_and_trial(seed, trial)
        problem = self.problem
        check_problem(problem)
        count = self.settings.particle_filter.num_particles
        random = stream(seed, trial, 0, Purpose.INITIAL_BELIEF)
        states = checked.initial_states(problem, random, count)
        return PlanningState(seed, trial, 0, 0, False, Belief(states, uniform_weights(count)))

    @in_own_mode
    def check(self, state: PlanningState) -> None:
        """Check that a state from elsewhere belongs to this problem and these settings.

        InvalidValueError says if its number of particles, their size or its stage does not fit.
        """
        problem = self.problem
        check_problem(problem)
        self._require_size(state)
        count = state.belief.states.shape[0]
        if count != self.settings.particle_filter.num_particles:
            raise InvalidValueError(
                f"state of {count} particles: particle_filter.num_particles is "
                f"{self.settings.particle_filter.num_particles}"
            )
        if not 0 <= state.stage < problem.num_stages:
            raise InvalidValueError(
                f"stage {state.stage}: {problem.name} has 0 to {problem.num_stages - 1}"
            )

    def _require_size(self, state: PlanningState) -> None:
        size = state.belief.states.shape[1]
        if size != self.problem.state_size:
            raise InvalidValueError(
                f"state of {size} coordinates: {self.problem.name} has {self.problem.state_size}"
            )

    @property
    def no_sensing(self) -> int:
        """The choice not to sense: one more than the last sensing action."""
        return len(self.problem.sensing_actions)

    @property
    def num_choices(self) -> int:
        """Sensing actions, and one more if the robot may choose not to sense."""
        return self.no_sensing + self.settings.selector.sensing_is_optional

    @property
    def moves_give_observations(self) -> bool:
        """Whether a move may show something, so that the next decision has to wait for it."""
        return moves_give_observations(self.problem)

    def needs_sensing(self, state: PlanningState) -> bool:
        """Tell whether the next decision is a sensing action (else it is a task action)."""
        return needs_sensing(self.settings, state)

    @in_own_mode
    def choose_sensing_action(self, state: PlanningState) -> tuple[int, SensingInfo]:
        """Choose the next sensing action, an index into ``problem.sensing_actions``.

        It may be :attr:`no_sensing` if ``selector.sensing_is_optional`` is set.

        Raises
        ------
        InvalidValueError, ProblemError
            As :func:`holdfast.planning.sensing.choose_sensing_action`.
        """
        self._require_size(state)
        return sensing.choose_sensing_action(
            self.problem,
            self.settings,
            state.belief,
            state.stage,
            stream(state.seed, state.trial, state.step, Purpose.HYPOTHESES),
            stream(state.seed, state.trial, state.step, Purpose.SELECTION),
        )

    @in_own_mode
    def observe(
        self, state: PlanningState, sensing_action: int, observation: npt.ArrayLike | None
    ) -> tuple[PlanningState, ObservationInfo]:
        """Update the belief by an observation, shape ``(observation_size,)``, and set ``sensed``.

        Without one (None: it comes later, or the choice was :attr:`no_sensing`) the belief stays.

        Raises
        ------
        InvalidValueError
            If the sensing action does not exist, the observation is not finite or of the wrong
            size, or the state is another problem's.
        """
        interruption.check()
        problem = self.problem
        self._require_size(state)
        chosen = sensing_action_of(problem, sensing_action, optional=observation is None)
        if observation is None:
            size, distinct = belief_sizes(state.belief)
            info = ObservationInfo(size, True, False, distinct_particles=distinct)
            return state._replace(sensed=True), info
        ranks = None
        if getattr(problem, "rank_test", False):
            ranks = stream(state.seed, state.trial, state.step, Purpose.RANK_TEST)
        updated = update(problem, state.belief, chosen, observation, ranks)
        belief, info = self._resampled(state, *updated, Purpose.RESAMPLING)
        return PlanningState(*state[:4], True, belief), info

    @in_own_mode
    def observe_move(
        self, state: PlanningState, task_action: FloatArray, observation: npt.ArrayLike
    ) -> tuple[PlanningState, ObservationInfo]:
        """Update the belief by an observation that came with a move, shape ``(n,)``.

        The state is the one after the move, from :meth:`advance`. The likelihood is the problem's
        ``move_log_likelihood``.

        Raises
        ------
        InvalidValueError
            If the observation is not finite or the state is another problem's.
        ProblemError
            If the problem has no ``move_log_likelihood``, or it breaks its contract.
        """
        self._require_size(state)
        action = floats("task action", task_action)
        updated = update_by_move(self.problem, state.belief, action, observation)
        belief, info = self._resampled(state, *updated, Purpose.MOVE_RESAMPLING)
        return state._replace(belief=belief), info

    def _resampled(
        self, state: PlanningState, belief: Belief, found: ObservationInfo, purpose: Purpose
    ) -> tuple[Belief, ObservationInfo]:
        """Return an updated belief of a state, resampled if its effective size asks for it."""
        count = belief.weights.shape[0]
        threshold = self.settings.particle_filter.resampling_threshold * count
        # Rounding may leave the size of equal weights a little above their number.
        if threshold != count and found.effective_sample_size > threshold:
            return belief, found
        own = stream(state.seed, state.trial, state.step, purpose)
        drawn = resample(belief, own)
        if static := static_parameters(self.problem):
            drawn = regularised(drawn, belief, static, circular_states(self.problem), own)
        return drawn, found._replace(resampled=True)

    @in_own_mode
    def reinitialise(self, state: PlanningState) -> PlanningState:
        """Return the state with a new belief, for a robot that is lost.

        Its particles are the problem's ``reinitial_states(states, stream)``, else drawn from the
        initial belief. Weights are equal; step, stage and ``sensed`` stay.

        Raises
        ------
        ProblemError
            If the problem breaks its contract.
        """
        self._require_size(state)
        random = stream(state.seed, state.trial, state.step, Purpose.REINITIALISATION)
        states = checked.reinitial_states(self.problem, state.belief.states, random)
        return state._replace(belief=Belief(states, uniform_weights(states.shape[0])))

    @in_own_mode
    def choose_task_action(self, state: PlanningState) -> tuple[FloatArray, TaskInfo]:
        """Choose the next task action: the policy's for the estimate, within the limits of a step.

        The executed action has the shape ``(action_size,)``.

        Raises
        ------
        InvalidValueError
            If the state is another problem's.
        ProblemError
            If the policy's action is not finite.
        """
        problem = self.problem
        estimated, stage = self._estimate(state)
        commanded = checked.policy(problem, estimated, stage)
        action = checked.executed_action(problem, commanded)
        if not numerics.all_finite(action):
            raise ProblemError(
                f"policy of {problem.name} gives {in_brief(action)} in state {in_brief(estimated)}"
            )
        return action, TaskInfo(estimated, commanded, stage)

    @in_own_mode
    def advance(
        self, state: PlanningState, task_action: FloatArray, motion: npt.ArrayLike | None = None
    ) -> PlanningState:
        """Predict the belief by a performed task action and go to the next step.

        Parameters
        ----------
        motion : array of shape (n,), optional
            The measured motion. The problem's ``move_by_measurement`` then takes the place of its
            ``move``: it knows the noise of the measurement.

        Raises
        ------
        InvalidValueError
            If the action or the motion is not finite, or the action of the wrong size.
        ProblemError
            If the problem moves a particle to a state that is not finite, or has no
            ``move_by_measurement``.
        """
        interruption.check()
        problem = self.problem
        action = floats("task action", task_action)
        if action.shape != (problem.action_size,) or not numerics.all_finite(action):
            raise InvalidValueError(
                f"task action {in_brief(action)}: {problem.name} needs "
                f"{problem.action_size} finite coordinates"
            )
        # Not taken from the caller: the action may come from another machine.
        staged, stage = self._staged
        if staged is not state:
            _, stage = self._estimate(state)
        states, weights = state.belief
        random = stream(state.seed, state.trial, state.step, Purpose.PREDICTION)
        if motion is None:
            moved = checked.move(problem, states, action, random)
        else:
            moved = checked.moved_by_measurement(problem, states, motion, random)
        belief = Belief(moved, weights)
        return PlanningState(state.seed, state.trial, state.step + 1, stage, False, belief)

    def plan_until_sensing(
        self, state: PlanningState, max_actions: int
    ) -> tuple[list[FloatArray], PlanningState]:
        """Choose the task actions up to the next sensing step: no observation comes between them.

        Return at most ``max_actions`` executed actions, none if the state has to sense first, and
        the state that they lead to. Only one, if a move may show something.
        """
        actions: list[FloatArray] = []
        max_actions = whole("max_actions", max_actions, 0)
        if self.moves_give_observations:
            max_actions = min(max_actions, 1)
        while len(actions) < max_actions and not self.needs_sensing(state):
            interruption.check()
            action, _ = self.choose_task_action(state)
            state = self.advance(state, action)
            actions.append(action)
        return actions, state

    def decide(self, state: PlanningState, max_actions: int) -> Decision:
        """Make all decisions that no further observation can change."""
        actions, ahead = self.plan_until_sensing(state, max_actions)
        sensing_action = None
        if self.needs_sensing(ahead) and not (actions and self.moves_give_observations):
            sensing_action, _ = self.choose_sensing_action(ahead)
        return Decision(tuple(actions), sensing_action, ahead)

    def digest(self, state: PlanningState) -> bytes:
        """Return 32 bytes that are equal exactly when two states are equal, bit for bit."""
        return digest(state)

    def encode(self, state: PlanningState) -> bytes:
        """Return a checkpoint: the state as bytes."""
        return encode_checkpoint(state)

    def decode(self, data: bytes | memoryview) -> PlanningState:
        """Return the state of a checkpoint, checked.

        Raises
        ------
        CheckpointError
            If the bytes are no checkpoint.
        InvalidValueError
            If its state does not belong to this problem and these settings.
        """
        state = decode_checkpoint(data)
        self.check(state)
        return state

    @in_own_mode
    def estimate(self, state: PlanningState) -> FloatArray:
        """Return the state that stands for the belief, shape ``(state_size,)``."""
        return self._estimate(state)[0]

    def _estimate(self, state: PlanningState) -> tuple[FloatArray, int]:
        """Return the state that stands for the belief, and the stage that follows from it."""
        self._require_size(state)
        estimated = estimate(
            state.belief, self.settings.particle_filter.estimate, circular_states(self.problem)
        )
        stage = checked.next_stage(self.problem, estimated, state.stage)
        self._staged = state, stage
        return estimated, stage


_checked_before: dict[int, tuple[PlanningSettings | None, PlanningSettings]] = {}
"""Settings that were checked, and as what, by their identity."""


def _checked(settings: PlanningSettings) -> PlanningSettings:
    """Check settings, but not again at each decision of a service."""
    given, found = _checked_before.get(id(settings), (None, settings))
    if given is not settings:
        found = check_settings(settings, PlanningSettings)
        if len(_checked_before) >= 512:
            _checked_before.clear()
        with contextlib.suppress(TypeError):
            hash(settings)  # else it has a list, say, which may change
            _checked_before[id(settings)] = settings, found
    return found


def _replaced(
    settings: PlanningSettings, section: str, key: str, value: object
) -> PlanningSettings:
    changed = msgspec.structs.replace(getattr(settings, section), **{key: value})
    return msgspec.structs.replace(settings, **{section: changed})


def digest(state: PlanningState) -> bytes:
    """Return 32 bytes that are equal exactly when two states are equal, bit for bit.

    BLAKE2b over all fields; the belief's arrays as little-endian float64 in C order.
    """
    states, weights = state.belief
    header = struct.pack("<QQQQ?QQ", *state[:5], *states.shape)
    hashed = hashlib.blake2b(header, digest_size=32, person=b"holdfast-state")
    for array in (states, weights):
        hashed.update(np.asarray(array, _LITTLE_ENDIAN, order="C").data)
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
            int(state.seed),
            int(state.trial),
            int(state.step),
            int(state.stage),
            bool(state.sensed),
            states.shape[0],
            states.shape[1],
            np.ascontiguousarray(states, dtype="<f8").data,
            np.ascontiguousarray(weights, dtype="<f8").data,
        )
    )


@in_own_mode
def decode_checkpoint(data: bytes | memoryview) -> PlanningState:
    """Decode a state and check it by itself; :meth:`Planner.check` checks it against a problem.

    Raises
    ------
    CheckpointError
        If the bytes are no checkpoint, of another version, or describe no valid belief.
    """
    try:
        content = _checkpoint_decoder.decode(data)
    except MemoryError:
        raise
    except Exception as error:  # decoding may raise anything
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
    # A sum of foreign numbers may overflow: the error below says so, NumPy need not warn.
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
