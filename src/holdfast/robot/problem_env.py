"""A problem as a gymnasium environment: learn what to sense.

An episode is a trial. The planner has the belief, and its policy moves the robot; the agent chooses
what is sensed. So one step of the episode goes from one sensing step to the next: the agent's
choice is sensed and folded into the belief, then the robot performs task actions until it senses
again. What the agent sees is the belief, never the true state.

With the same choices an episode is, bit for bit, the trial that
:func:`holdfast.robot.trial.run_trial` runs with the same seed: what an agent has learned is
compared with holdfast's own methods on the same worlds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, SupportsIndex

import gymnasium
import msgspec
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from holdfast.config.registry import make_problem
from holdfast.errors import InvalidValueError
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import FloatArray, integer, whole
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.numerics.randomness import Purpose, seed_and_trial, stream
from holdfast.planning.belief import Belief, standard_deviation
from holdfast.planning.inputs import Moved, Sensed, encode_floats
from holdfast.planning.outcome import Ending, MoveResult, ending_of
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.settings import Method, PlanningSettings, SimulatorSettings
from holdfast.planning.tracking import Trial
from holdfast.printable import brief
from holdfast.problems import attributes, checked
from holdfast.problems.problem import Problem
from holdfast.robot.environment import SimulatedEnvironment

_SCOUTS = 64
"""Simulated robots whose ways give the range of each coordinate."""

_SCOUTS_TRIAL = 2**32 - 1
"""Names their random streams; no episode has this number."""

_MARGIN = 0.25
"""By this part of itself a range is wider, on either side, than the scouts' ways."""

_DECADES = 4.0
"""Spreads are told on a logarithmic scale, down to so many powers of ten below half the range."""


class ProblemEnv(gymnasium.Env[Any, Any]):
    """A problem, simulated, in which an agent chooses the sensing actions.

    **Action**: the index of a sensing action; with ``sensing_is_optional`` one more, the last,
    which is not to sense.

    **Observation**: numbers from -1 to 1 (``observation_labels`` names them), in this order.

    - The planner's estimate of each coordinate of the state; of an angle (``problem.circular``) its
      sine and cosine. -1 and 1 are the ends of a range that is 1.5 times as wide as the ways of 64
      robots that know their state; what lies outside is clipped.
    - The belief's standard deviation, for each coordinate, on a logarithmic scale: 1 is half the
      range, 0 a hundredth of that, -1 a ten-thousandth or less.
    - The policy's commanded action for the estimate, and its standard deviation over the belief, in
      the same way: how sure the robot is of what to do. This is what action entropy measures.
    - Where there are several stages, 1 for the present one and 0 for the others.
    - For each sensing action ``1 / (1 + n)``, n sensing steps after it was last chosen; 0 before.

    With ``observation="particles"`` it is a dictionary: ``summary`` as above, ``states`` of shape
    (num_particles, state_size) from -1 to 1 (an angle in half turns), and their ``weights``.

    **Reward**: the sum over the task actions of the step of the problem's rewards, or -1 each, less
    the problem's cost of the sensing action. Maximised without costs, -1 each means the fewest
    steps to the goal.

    **End**: ``terminated`` at the goal or in a failure (``is_failure``), ``truncated`` after
    ``max_steps`` task actions. With -1 for each task action a failure costs all that are left.

    **Seeds**: ``reset(seed=s)`` is trial 0 of the seed s, and each further ``reset()`` the next
    trial; ``options={"trial": n}`` takes trial n. ``info`` has ``seed``, ``trial``, ``steps`` (task
    actions so far), ``success``, ``true_state`` (for critics and figures), and at the end the
    ``digest`` of the decisions.

    Parameters
    ----------
    problem : str or Problem
        A name (:func:`holdfast.make`), ``module:Class``, the path of a configuration ending in
        ``.yaml``, which then gives the settings and ``max_steps`` too, or a problem.
    model : mapping, optional
        Settings of the problem, for a name.
    settings : PlanningSettings, optional
        How the planner plans. The selector in it is used by :meth:`choose` alone.
    particles, sensing_interval : int, optional
        In place of the settings'.
    sensing_is_optional : bool, optional
        Whether the agent may choose not to sense; else the settings say.
    max_steps : int, optional
        500 unless a configuration says otherwise.
    observation : {"summary", "particles"}
    reward : {"problem", "steps"}
        ``problem``: its rewards, if it has any; ``steps``: -1 for each task action anyway.

    Attributes
    ----------
    state : PlanningState
        What the planner knows.
    observation_labels : list of str
    state_low, state_high : array of shape (state_size,)
        The range of each coordinate.

    Raises
    ------
    HoldfastError
        If an argument, the problem or a setting is out of bounds.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as gymnasium declares it

    @in_own_mode
    def __init__(
        self,
        problem: str | Problem,
        *,
        model: Mapping[str, Any] | None = None,
        settings: PlanningSettings | None = None,
        particles: int | None = None,
        sensing_interval: int | None = None,
        sensing_is_optional: bool | None = None,
        max_steps: int | None = None,
        observation: Literal["summary", "particles"] = "summary",
        reward: Literal["problem", "steps"] = "problem",
        render_mode: None = None,
    ) -> None:
        del render_mode  # gymnasium passes it
        _require_one_of("observation", observation, ("summary", "particles"))
        _require_one_of("reward", reward, ("problem", "steps"))
        built, planning, steps = _built(problem, model, settings)
        planning = _changed(planning, sensing_interval, sensing_is_optional)
        self.planner = Planner(built, planning, particles=particles)
        attributes.check_problem(built)
        self.problem = built
        self.max_steps = whole("max_steps", steps if max_steps is None else max_steps, 1)
        self._costs = attributes.sensing_costs(built, optional=True)
        self._minus_steps = reward == "steps"
        self._with_particles = observation == "particles"
        self._planners: dict[Method, Planner] = {}
        self._seed, self._trial = -1, -1
        self._track: Trial | None = None
        self._world: SimulatedEnvironment | None = None
        self._ending: Ending | None = None
        self._over = True
        self._last_chosen: dict[int, int] = {}
        self._sensing_steps = 0

        self.state_low, self.state_high, self._action_size = _ranges(built, self.max_steps)
        self._circular = list(attributes.circular_states(built))
        self._circular_actions = attributes.circular_actions(built)
        self.observation_labels = self._labels()
        self.action_space = spaces.Discrete(self.planner.num_choices)
        summary = spaces.Box(-1.0, 1.0, (len(self.observation_labels),), np.float32)
        self.observation_space: spaces.Space[Any] = summary
        if self._with_particles:
            count = self.planner.settings.particle_filter.num_particles
            self.observation_space = spaces.Dict(
                {
                    "summary": summary,
                    "states": spaces.Box(-1.0, 1.0, (count, built.state_size), np.float32),
                    "weights": spaces.Box(0.0, 1.0, (count,), np.float32),
                }
            )

    @property
    def state(self) -> PlanningState:
        """What the planner knows; after ``reset``."""
        return self._running()[0].state

    @in_own_mode
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; see the class for seeds and ``options``."""
        following = self._trial + 1 if seed is None else 0
        own = max(self._seed, 0) if seed is None else seed
        own, trial = seed_and_trial(own, (options or {}).get("trial", following))
        if seed is None and self._seed < 0:
            own = int(self.np_random.integers(2**63))
        track = Trial(self.planner, own, trial)
        world = SimulatedEnvironment(self.problem, own, trial)
        ending = ending_of(world.is_done())
        super().reset(seed=None if seed is None else own)
        # Only now: a reset that is refused leaves the episode and its number as they were.
        self._seed, self._trial, self._track, self._world = own, trial, track, world
        self._ending = ending
        self._over = False
        self._last_chosen = {}
        self._sensing_steps = 0
        return self._observation(), self._info()

    @in_own_mode
    def step(self, action: SupportsIndex) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Sense what the agent has chosen, then move until the robot senses again."""
        track, world = self._running()
        if self._over:
            raise gymnasium.error.ResetNeeded("the episode has ended: reset() begins the next one")
        choice = integer(action)
        if choice is None or not 0 <= choice < self.planner.num_choices:
            raise InvalidValueError(
                f"action {brief(action)}: {self.problem.name} has 0 to "
                f"{self.planner.num_choices - 1} (the last is not to sense if sensing_is_optional)"
            )
        total = 0.0
        if self._ending is None:  # else the trial has begun at the goal
            total = self._sense(track, world, choice)
        while self._ending is None and track.state.step < self.max_steps:
            total += self._move(track, world)
            if self.planner.needs_sensing(track.state):
                break
        terminated = self._ending is not None and self._ending.outcome != "truncated"
        truncated = not terminated and track.state.step >= self.max_steps
        self._over = terminated or truncated
        info = self._info()
        if self._over:
            info["digest"] = track.result(self._ending).digest
        return self._observation(), total, terminated, truncated, info

    @in_own_mode
    def choose(self, method: Method | None = None) -> int:
        """Return what one of holdfast's own methods would choose now; None: the settings'.

        It has the belief alone, as the agent. Baselines and demonstrations are made with this.
        """
        planner = self.planner
        if method is not None:
            if method not in self._planners:
                self._planners[method] = Planner(self.problem, planner.settings, method=method)
            planner = self._planners[method]
        return planner.choose_sensing_action(self.state)[0]

    def _running(self) -> tuple[Trial, SimulatedEnvironment]:
        if self._track is None or self._world is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset() first")
        return self._track, self._world

    def _sense(self, track: Trial, world: SimulatedEnvironment, choice: int) -> float:
        shown = None if choice == self.planner.no_sensing else world.perform_sensing(choice)
        track.take(Sensed(track.state.step, choice, encode_floats(shown)))
        self._sensing_steps += 1
        self._last_chosen[choice] = self._sensing_steps
        return -float(self._costs[choice])

    def _move(self, track: Trial, world: SimulatedEnvironment) -> float:
        executed, _ = self.planner.choose_task_action(track.state)
        shown = world.perform(executed)
        result = shown if isinstance(shown, MoveResult) else MoveResult(shown)
        reward, motion, observation = result
        track.pending = executed
        shows = map(encode_floats, (motion, observation))
        track.take(Moved(track.state.step, reward, *shows))
        self._ending = ending_of(world.is_done())
        if reward is not None and not self._minus_steps:
            return float(reward)
        failed = self._ending is not None and self._ending.outcome == "failed"
        return -1.0 - failed * (self.max_steps - track.state.step)

    def _info(self) -> dict[str, Any]:
        track, world = self._running()
        return {
            "seed": self._seed,
            "trial": self._trial,
            "steps": track.state.step,
            "success": self._ending is not None and self._ending.outcome == "succeeded",
            "true_state": world.state.copy(),
        }

    def _labels(self) -> list[str]:
        problem = self.problem
        states = attributes.state_labels(problem) or range(problem.state_size)
        labels = []
        for index, name in enumerate(states):
            kinds = ("sine", "cosine") if index in self._circular else ("estimate",)
            labels += [f"{kind} of {name}" for kind in kinds]
        labels += [f"spread of {name}" for name in states]
        labels += [f"action {index}" for index in range(problem.action_size)]
        labels += [f"spread of action {index}" for index in range(problem.action_size)]
        if problem.num_stages > 1:
            labels += [f"stage {stage}" for stage in range(problem.num_stages)]
        return labels + [
            f"since {name}"
            for name in attributes.choice_labels(problem)[: self.planner.num_choices]
        ]

    def _observation(self) -> Any:
        summary = self._summary()
        if not self._with_particles:
            return summary
        states, weights = self.state.belief
        return {
            "summary": summary,
            "states": self._scaled(states).astype(np.float32),
            "weights": np.minimum(weights, 1.0).astype(np.float32),
        }

    def _summary(self) -> npt.NDArray[np.float32]:
        planner, problem, belief = self.planner, self.problem, self.state.belief
        _, task = planner.choose_task_action(self.state)
        circular = self._circular
        middle = self._scaled(task.estimate)
        values: list[float] = []
        for index, value in enumerate(middle):
            if index in circular:
                angle = task.estimate[index]
                values += [float(numerics.sin(angle)), float(numerics.cos(angle))]
            else:
                values.append(float(value))
        half = 0.5 * (self.state_high - self.state_low)
        values += _logarithmic(standard_deviation(belief, circular) / half)
        actions = checked.policy(problem, belief.states, task.stage)
        spread = standard_deviation(Belief(actions, belief.weights), self._circular_actions)
        values += np.clip(task.commanded / self._action_size, -1.0, 1.0).tolist()
        values += _logarithmic(spread / self._action_size)
        if problem.num_stages > 1:
            values += [float(stage == task.stage) for stage in range(problem.num_stages)]
        for choice in range(planner.num_choices):
            last = self._last_chosen.get(choice)
            values.append(0.0 if last is None else 1.0 / (1 + self._sensing_steps - last))
        return np.array(values, dtype=np.float32)

    def _scaled(self, states: FloatArray) -> FloatArray:
        scaled = 2.0 * (states - self.state_low) / (self.state_high - self.state_low) - 1.0
        if self._circular:
            angles = states[..., self._circular]
            scaled[..., self._circular] = numerics.wrapped(angles) / np.pi
        return np.clip(scaled, -1.0, 1.0)


def _built(
    problem: str | Problem, model: Mapping[str, Any] | None, settings: PlanningSettings | None
) -> tuple[Problem, PlanningSettings, int]:
    """Return the problem, the settings and the bound on steps."""
    steps = SimulatorSettings().max_steps
    is_path = isinstance(problem, str) and problem.endswith((".yaml", ".yml"))
    if model is not None and (is_path or not isinstance(problem, str)):
        raise InvalidValueError(
            f"model is {brief(dict(model))}; it goes with the name of a problem alone"
        )
    if isinstance(problem, str) and is_path:
        from holdfast.config.loader import load

        configuration = load(Path(problem))
        return (
            configuration.problem,
            settings or configuration.planning,
            configuration.simulator.max_steps,
        )
    built = make_problem(problem, **(model or {})) if isinstance(problem, str) else problem
    return built, settings or PlanningSettings(), steps


def _changed(
    settings: PlanningSettings, sensing_interval: int | None, optional: bool | None
) -> PlanningSettings:
    if sensing_interval is not None:
        settings = msgspec.structs.replace(settings, sensing_interval=sensing_interval)
    if optional is not None:
        selector = msgspec.structs.replace(settings.selector, sensing_is_optional=optional)
        settings = msgspec.structs.replace(settings, selector=selector)
    return settings


def _ranges(problem: Problem, max_steps: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the least and greatest coordinates of a state, and the largest size of an action's.

    Robots that know their state follow the policy, with the motion's noise. Ranges must be the same
    in each episode and on every machine, so they are a function of the problem alone.
    """
    states = checked.initial_states(problem, _scouts_stream(0, Purpose.INITIAL_BELIEF), _SCOUTS)
    stages = np.zeros(_SCOUTS, dtype=np.int64)
    low, high = states.min(axis=0), states.max(axis=0)
    largest = np.zeros(problem.action_size)
    for step in range(max_steps):
        stages = checked.next_stages(problem, states, stages)
        actions = checked.policy(problem, states, stages)
        largest = np.maximum(largest, np.abs(actions).max(axis=0))
        executed = checked.executed_action(problem, actions)
        noise = _scouts_stream(step, Purpose.PREDICTION)
        states = checked.move(problem, states, executed, noise)
        low, high = np.minimum(low, states.min(axis=0)), np.maximum(high, states.max(axis=0))
        if checked.ends(problem, states)[0].all():
            break
    room = np.where(high > low, _MARGIN * (high - low), 1.0)
    low, high = low - room, high + room
    angles = list(attributes.circular_states(problem))
    low[angles], high[angles] = -np.pi, np.pi
    return low, high, np.where(largest > 0.0, largest, 1.0)


def _scouts_stream(step: int, purpose: Purpose) -> Any:
    return stream(0, _SCOUTS_TRIAL, step, purpose)


def _logarithmic(ratios: FloatArray) -> list[float]:
    """Return ratios on a logarithmic scale: 1 is 1, and -1 is ``10**-_DECADES`` or less."""
    floor = 10.0**-_DECADES
    decades = numerics.log(np.clip(ratios, floor, 1.0)) / math.log(10.0)
    scaled: list[float] = np.clip(1.0 + 2.0 * decades / _DECADES, -1.0, 1.0).tolist()
    return scaled


def _require_one_of(key: str, value: object, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise InvalidValueError(f"{key} is {brief(value)}; allowed: {', '.join(allowed)}")
