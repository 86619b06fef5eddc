"""The settings of a run, as validated, immutable data.

Each class is one section of the configuration file and has the key names of the thesis's YAML, so
that its files load unchanged; the fields that the thesis does not have come after its own and have
defaults. Bounds stand beside the fields, once, and docs/settings.md says of each key what it does.
:func:`holdfast.config.loader.load` reports a breach of them with file, line, key and value; for
settings that are made in Python :func:`check_settings` does, without the file.
"""

from __future__ import annotations

import itertools
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from holdfast.conversion import convert
from holdfast.errors import InvalidValueError

MAX_PARTICLES = 10_000_000
"""Bound on ``num_particles``: states of six coordinates then fill 480 MB."""

MAX_SERVICES = 16
"""Bound on ``offload.services``: each has its links."""

FEW_PARTICLES = 500
"""Up to so many ``prior_neighbors`` has the less bias and takes little longer; its time grows with
their square."""

MAX_PRIOR_NEIGHBORS_POINTS = 4096
"""Bound on the particles of ``prior_neighbors``, whose time grows with their square."""

MAX_PATH_STEPS = 10_000
"""Bound on the entries of ``selector.path_offsets``, and on the steps that they come to."""

MAX_PATH_OFFSETS = 64
"""Bound on the number of entries of ``selector.path_offsets``."""


class _Keys(msgspec.StructMeta):
    """Names the key that was meant where one is given, in Python, that a section does not have."""

    def __call__(self, *values: Any, **keys: Any) -> Any:
        for key in keys:
            if key not in self.__struct_fields__:
                from holdfast.validation import close_match

                allowed = self.__struct_fields__
                raise InvalidValueError(
                    f"{self.__name__} has no {key}{close_match(key, allowed)}; allowed: "
                    f"{', '.join(allowed)}"
                )
        return super().__call__(*values, **keys)


class _Section(msgspec.Struct, metaclass=_Keys, frozen=True):
    """A section of the settings."""


SectionT = TypeVar("SectionT", bound=_Section)

Count = Annotated[int, msgspec.Meta(ge=1)]
NonNegativeCount = Annotated[int, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Resolution = Annotated[float, msgspec.Meta(ge=1e-150, le=1e150)]
Resolutions = Annotated[tuple[Resolution, ...], msgspec.Meta(min_length=1, max_length=64)]
Milliseconds = Annotated[float, msgspec.Meta(gt=0.0, le=3_600_000.0)]
Seed = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Text = Annotated[str, msgspec.Meta(min_length=1, max_length=4096)]

Method = Literal[
    "action_entropy",
    "path_entropy",
    "state_entropy",
    "action_covariance",
    "expected_return",
    "random",
    "fixed",
]
"""How a sensing action is chosen; :mod:`holdfast.planning.sensing` has a branch for each."""

ENTROPY_METHODS: frozenset[Method] = frozenset({"action_entropy", "path_entropy", "state_entropy"})
"""Those that minimise an entropy and so need an estimator."""

UNINFORMED_METHODS: frozenset[Method] = frozenset({"random", "fixed"})
"""Those that use no belief."""

Estimator = Literal[
    "nearest_neighbor",
    "prior_neighbors",
    "prior_neighbors_undominated",
    "gaussian_mixture_upper",
    "gaussian_mixture_lower",
]
"""How an entropy is estimated: :mod:`holdfast.planning.estimators` has a class for each kind."""

PRIOR_ESTIMATORS: frozenset[Estimator] = frozenset(
    {"prior_neighbors", "prior_neighbors_undominated"}
)
"""Those that count nearest neighbours before the observation."""

NEIGHBOR_ESTIMATORS: frozenset[Estimator] = PRIOR_ESTIMATORS | {"nearest_neighbor"}
"""Those that count nearest neighbours."""


Estimate = Literal["mean", "most_likely", "heaviest_mode"]
"""Which state stands for a belief: ``holdfast.planning.belief.estimate`` has a branch each."""

OnLost = Literal["continue", "hold", "reinitialise"]
"""What a robot that is lost does."""


class ParticleFilterSettings(_Section, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``particle_filter``.

    Attributes
    ----------
    num_particles : int
        The more the fewer steps a task takes; no other change of the defaults was found to help
        over several problems (docs/results.md).
    resampling_threshold : float
        Resample when the effective sample size is at most this fraction of the particles.
    estimate : Estimate
        The state for which the policy is asked. ``heaviest_mode`` is for beliefs with several
        modes, between which the mean lies where the robot is not; with one mode it is the mean. Of
        equal weights, as all are after resampling, the first particle is the most likely: no more
        than a draw from the belief.
    """

    num_particles: Annotated[int, msgspec.Meta(ge=1, le=MAX_PARTICLES)] = 300
    resampling_threshold: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 1.0
    estimate: Estimate = "mean"


class ActiveSensingSettings(_Section, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``active_sensing``: Algorithm 2 and its entropy estimate.

    Attributes
    ----------
    horizon : int
        Number H of entropies added up: now, and after each of H - 1 predicted steps.
    discount : float
        Weight ``discount**h`` of the entropy, or for ``expected_return`` the reward, h steps ahead.
    num_observation_samples : int
        Number M of hypothetical observations of each sensing action.
    num_nearest_neighbors : int
        The k of the estimators that count neighbours.
    num_cores : int
        Threads of a decision; 0 means all cores (or what ``OMP_NUM_THREADS`` says). Changes time
        only, never a result. Moving 4,096 particles or more always uses all cores.
    """

    horizon: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 1
    discount: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 1.0
    num_observation_samples: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = 10
    num_nearest_neighbors: Count = 5
    num_cores: NonNegativeCount = 0


class SelectorSettings(_Section, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``selector``: how the sensing action is chosen.

    Attributes
    ----------
    method : Method
        ``path_entropy`` adds up the entropies of the actions at several steps of the way that the
        policy leads each particle without noise.
    sensing_action : int
        What ``fixed`` chooses.
    sensing_is_optional : bool
        Whether not to sense is a choice, too: the one whose number is that of the sensing actions.
    nats_per_cost : float
        What a unit of the problem's ``sensing_costs`` is worth in nats of entropy, for the methods
        that minimise one (for ``action_covariance`` in the unit of its trace). A problem without
        costs counts 1 for each sensing action. With 0 no cost counts.
    estimator : Estimator or None
        ``prior_neighbors`` has less bias where a sharp observation leaves few particles: 300 choose
        about as well as 1,000 with ``nearest_neighbor``. ``prior_neighbors_undominated`` is the
        same, and never takes a sensing action of which another one shows the same more sharply, and
        is no dearer. A mixture takes few particles for
        certainty: use it with so many that they lie closer than its noise (docs/results.md).
        None: see :func:`estimator_of`.
    actions : {"commanded", "executed"}
        The policy's actions before or after the limits of a step.
    resolution : float, tuple of float or None
        Distance below which two actions (or, for ``state_entropy``, states) do not differ in
        practice; for a mixture, the standard deviation of the noise that blurs them. One number for
        each coordinate makes the choice independent of units. None takes the problem's, and for a
        mixture its motion noise, unless that has none for a coordinate, there are more coordinates
        of a state than of an action, or the problem has a resolution of states.
    path_offsets : tuple of int
        Where on the path ``path_entropy`` takes the actions, in increasing order: 0 is the next.
    path_unit : {"sensing_intervals", "steps"}
        Of the offsets. An interval is ``simulator.sensing_intervals + 1`` steps.
    path_discount : float
        The entropy at offset h counts ``path_discount**h`` times, h in ``path_unit``: before an
        action h intervals away, the robot senses h more times.
    rollout_reward : {"problem", "steps"}
        Whose sum is the return: the problem's rewards, or -1 for each step up to the goal, as for
        any problem without rewards.
    rollout_steps : int
        Steps after which a rollout that has not reached the goal ends.
    rollout_sensing_steps : int
        In a rollout the state gets known at each of so many of the next sensing steps with equal
        chances, 1 over this number, and at the last one for sure.
    max_observation_samples : int
        ``expected_return`` begins with ``num_observation_samples`` and doubles them up to this for
        those sensing actions whose return differs from the best one's by less than two standard
        errors.
    """

    method: Method = "path_entropy"
    sensing_action: NonNegativeCount = 0
    sensing_is_optional: bool = False
    nats_per_cost: Annotated[float, msgspec.Meta(ge=0.0, le=1e150)] = 0.0
    estimator: Estimator | None = None
    actions: Literal["commanded", "executed"] = "commanded"
    resolution: Resolution | Resolutions | None = None
    path_offsets: Annotated[
        tuple[Annotated[int, msgspec.Meta(ge=0, le=MAX_PATH_STEPS)], ...],
        msgspec.Meta(min_length=1, max_length=MAX_PATH_OFFSETS),
    ] = (0, 1)
    path_unit: Literal["sensing_intervals", "steps"] = "sensing_intervals"
    path_discount: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.5
    rollout_reward: Literal["problem", "steps"] = "problem"
    rollout_steps: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 200
    rollout_sensing_steps: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 4
    max_observation_samples: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = 40


class SimulatorSettings(_Section, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``simulator``: trials, their length and how often the robot senses.

    Attributes
    ----------
    max_steps : int
        Steps after which a trial has failed.
    sensing_intervals : int
        Steps between two sensing steps: the robot senses at every step t with
        ``t % (sensing_intervals + 1) == 0``. (The thesis's spelling of the key.)
    verbosity : int
        Accepted because the thesis's files have it; without effect.
    """

    num_trials: Annotated[int, msgspec.Meta(ge=1, le=10_000_000)] = 10
    max_steps: Annotated[int, msgspec.Meta(ge=1, le=10_000_000)] = 500
    sensing_intervals: NonNegativeCount = 8
    verbosity: NonNegativeCount = 0
    seed: Seed = 0


class OffloadSettings(_Section, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``offload``: which services decide, and how soon one is considered lost.

    Nothing here changes a decision, only when and where it is made.

    Attributes
    ----------
    services : tuple of str
        Endpoints in order of preference. None: the planner runs in the robot's own process.
    what : {"sensing", "all"}
        Which decisions services make: sensing actions alone, so the robot takes its task actions
        itself, from its own belief, and waits for no service before it moves; or, as in the thesis,
        task actions too.
    detection_timeout_ms : float
        A service from which a decision is awaited and that shows no sign of progress for this long
        counts as dead. (A killed one is found sooner, by its broken link.)
    startup_timeout_ms : float
        How long a run waits at its start for a service that has never been seen yet.
    lease_ms : float
        How long this robot may be silent before services give up the link to it. It is silent while
        its own code computes, and a service has no hurry: of a robot that dies it hears by the end
        of the link. A service's own lease is ``holdfast serve --lease-ms``; for the local service,
        which the robot starts, it is this one.
    decision_deadline_ms : float or None
        A decision that is not there this long after it was needed is asked of the local service
        as well, if that is running; the first answer wins.
    max_hedged_share : float
        Bound on such decisions, as a share of all.
    decision_timeout_ms : float
        A decision that takes longer is given up even if its service shows progress.
    verify_share : float
        Share of the services' answers that this robot computes again with its own planner while it
        moves. A service whose answer differs is not asked again in the run. Answers that differ
        from each other or break the problem's limits are always computed again.
    tls : str or None
        Directory with this robot's credentials; in a file it may be relative to that file.
    name : str or None
        The robot's name in the logs of services; with a certificate it must be the one in it. None
        takes the certificate's or, without one, this machine's.
    """

    services: Annotated[tuple[Text, ...], msgspec.Meta(max_length=MAX_SERVICES)] = ()
    what: Literal["sensing", "all"] = "sensing"
    detection_timeout_ms: Milliseconds = 250.0
    startup_timeout_ms: Milliseconds = 1000.0
    lease_ms: Annotated[float, msgspec.Meta(ge=50.0, le=60_000.0)] = 30_000.0
    decision_deadline_ms: Milliseconds | None = None
    max_hedged_share: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.1
    decision_timeout_ms: Milliseconds = 60_000.0
    verify_share: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.05
    tls: Text | None = None
    name: Text | None = None


class RecoverySettings(_Section, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``recovery``: the local service that decides while no other can.

    Attributes
    ----------
    launch : {"on_failure", "at_start", "never"}
        When it is started: once the services named are found dead, with the run, or never; then
        the robot holds still until one of them answers.
    launch_timeout_ms : float
        A local service that has not been seen this long after its launch is launched again. Doubles
        with each such launch in a row, up to 8 times: a busy machine is only slow.
    relaunch_delay_ms : float
        Pause after a failed launch; doubles with each failure in a row, up to 32 times.
    journal_survives : {"process_crash", "power_cut"}
        What each journalled step outlives: the end of the process (microseconds), or of the whole
        machine (the time that a disk takes to write).
    """

    launch: Literal["on_failure", "at_start", "never"] = "on_failure"
    launch_timeout_ms: Milliseconds = 5000.0
    relaunch_delay_ms: Milliseconds = 100.0
    journal_survives: Literal["process_crash", "power_cut"] = "process_crash"


class LostSettings(_Section, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``lost``: when the robot counts as lost, and what it does then.

    The robot's own: services see only a recorded reinitialisation.

    Attributes
    ----------
    false_alarm_rate : float
        For each observation: within n of them a false alarm, of a lost robot or a dead sensor, has
        a probability of at most n times this (:mod:`holdfast.planning.lost` says for which
        beliefs).
    on_lost : {"continue", "hold", "reinitialise"}
        Report it only; hold still and end the run, which can be resumed; or begin the belief anew,
        from the problem's ``reinitial_states`` or else its initial belief.
    """

    false_alarm_rate: Annotated[float, msgspec.Meta(ge=1e-12, le=0.1)] = 1e-4
    on_lost: OnLost = "continue"


class EnvironmentSettings(_Section, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``environment``: the world that the robot acts on.

    Nothing here changes a decision, given what was sensed.

    Attributes
    ----------
    object : str or None
        ``module:Class``, or an entry point of the group ``holdfast.environments``. None: the world
        is simulated from the problem.
    directory : str or None
        Directory of the module; in a file it may be relative to that file. None: the file's own or
        the current one, else the module is installed.
    arguments : dict
        Plain data, passed to the class as keyword arguments.
    timeout_ms : float
        Any call of the environment that takes longer has failed.
    sense_in_background : bool
        Whether the robot goes on while it senses; ``perform_sensing`` and ``perform`` then run at
        the same time.
    max_missing_in_a_row : int
        How often in a row sensing may give no reading before the run stops.
    """

    object: Text | None = None
    directory: Text | None = None
    arguments: dict[str, Any] = msgspec.field(default_factory=dict)
    timeout_ms: Milliseconds = 60_000.0
    sense_in_background: bool = False
    max_missing_in_a_row: Annotated[int, msgspec.Meta(ge=0, le=1_000_000)] = 20


class PlanningSettings(_Section, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All that a decision depends on besides the problem and the state.

    Attributes
    ----------
    sensing_interval : int
        Steps between two sensing steps.
    """

    particle_filter: ParticleFilterSettings = msgspec.field(default_factory=ParticleFilterSettings)
    active_sensing: ActiveSensingSettings = msgspec.field(default_factory=ActiveSensingSettings)
    selector: SelectorSettings = msgspec.field(default_factory=SelectorSettings)
    sensing_interval: NonNegativeCount = 8


def estimator_of(selector: SelectorSettings, num_particles: int) -> Estimator:
    """Return how the entropies of so many particles are estimated."""
    if selector.estimator is not None:
        return selector.estimator
    few = num_particles <= FEW_PARTICLES
    return "prior_neighbors" if few and selector.method == "path_entropy" else "nearest_neighbor"


def path_steps(settings: PlanningSettings) -> tuple[int, ...]:
    """Return ``selector.path_offsets`` in steps."""
    selector = settings.selector
    if selector.path_unit == "steps":
        return selector.path_offsets
    interval = settings.sensing_interval + 1
    return tuple(offset * interval for offset in selector.path_offsets)


def unfit_for_the_method(settings: PlanningSettings) -> tuple[tuple[str, str], str] | None:
    """Return which key ``selector.method`` cannot use as it is, and why; None if all fit.

    For what the bounds of a single key do not say.
    """
    method, particles = settings.selector.method, settings.particle_filter.num_particles
    estimator = estimator_of(settings.selector, particles)
    if method in ENTROPY_METHODS and estimator in NEIGHBOR_ESTIMATORS:
        neighbors = settings.active_sensing.num_nearest_neighbors
        if neighbors >= particles:
            return ("active_sensing", "num_nearest_neighbors"), (
                f"is {neighbors}; the {estimator} estimator needs it below "
                f"particle_filter.num_particles, which is {particles}"
            )
        if estimator in PRIOR_ESTIMATORS and particles > MAX_PRIOR_NEIGHBORS_POINTS:
            return ("particle_filter", "num_particles"), (
                f"is {particles}; the {estimator} estimator allows {MAX_PRIOR_NEIGHBORS_POINTS}"
            )
    if method == "expected_return":
        first = settings.active_sensing.num_observation_samples
        most = settings.selector.max_observation_samples
        if most >= first:
            return None
        return ("selector", "max_observation_samples"), (
            f"is {most}; with selector.method expected_return it must be at least "
            f"active_sensing.num_observation_samples, which is {first}"
        )
    if method != "path_entropy":
        return None
    offsets = settings.selector.path_offsets
    key = ("selector", "path_offsets")
    if any(after <= before for before, after in itertools.pairwise(offsets)):
        return key, f"is {list(offsets)}; the offsets must increase strictly"
    steps = path_steps(settings)
    if not steps or len(steps) > MAX_PATH_OFFSETS or steps[0] < 0 or steps[-1] > MAX_PATH_STEPS:
        return key, (
            f"is {list(offsets)}, {list(steps)} steps with selector.path_unit "
            f"{settings.selector.path_unit}; allowed are 1 to {MAX_PATH_OFFSETS} offsets from 0 to "
            f"{MAX_PATH_STEPS} steps"
        )
    horizon = settings.active_sensing.horizon
    if horizon > 1:
        return ("active_sensing", "horizon"), (
            f"is {horizon}; with selector.method path_entropy it must be 1: the offsets of "
            "selector.path_offsets are how far that looks ahead"
        )
    return None


def _plain_or_text(value: Any) -> Any:
    from holdfast.numerics.arrays import plain

    return repr(value) if (found := plain(value)) is value else found


def check_settings(settings: object, schema: type[SectionT], what: str = "settings") -> SectionT:
    """Check settings that were made in Python; return them with Python's numbers for NumPy's.

    Raises
    ------
    InvalidValueError
        If a value is not what its section allows; the message names ``what``, section and key.
    """
    if not isinstance(settings, schema):
        raise InvalidValueError(f"{what} is {_mistaken(settings, schema)}")
    try:
        plain = msgspec.to_builtins(settings, enc_hook=_plain_or_text)
    except TypeError as error:
        raise InvalidValueError(f"{what}: {error}") from error
    try:
        checked = convert(plain, schema)
    except msgspec.ValidationError as error:
        from holdfast.validation import dotted, find_mismatch

        found = find_mismatch(plain, schema)
        if found is None or not found.path:
            raise InvalidValueError(f"{what}: {error}") from error
        raise InvalidValueError(f"{what}: {dotted(found.path)} {found.in_words()}") from error
    if not isinstance(checked, PlanningSettings):
        return checked
    for name in PlanningSettings.__struct_fields__:
        value, kind = getattr(settings, name), type(getattr(checked, name))
        if issubclass(kind, _Section) and not isinstance(value, kind):
            raise InvalidValueError(
                f"{what}: {name} is of type {type(value).__name__}; it must be a {kind.__name__}"
            )
    if (unfit := unfit_for_the_method(checked)) is not None:
        (section, key), reason = unfit
        raise InvalidValueError(f"{what}: {section}.{key} {reason}")
    return checked


def _mistaken(given: object, schema: type[_Section]) -> str:
    """Return in words what was given in the place of settings, and what they must be."""
    kind, name = type(given).__name__, schema.__name__
    came = f"the class {given.__name__}" if isinstance(given, type) else f"of type {kind}"
    hint = ""
    if isinstance(getattr(given, "planning", None), schema):
        hint = ", as its attribute planning is"
    elif isinstance(given, _Section):
        keys = [field.name for field in msgspec.structs.fields(schema) if field.type is type(given)]
        hint = "".join(f", as in {name}({key}={kind}(...))" for key in keys)
    return f"{came}; it must be a {name}{hint}"
