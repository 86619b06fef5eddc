"""Whether the functions of a problem keep their contract: shapes, purity and streams.

Each function is called with states of several leading shapes, again with the same arguments in
another order, and with other streams. What may not differ is compared: rows of a batch with single
states, a call with its repetition, the spread within a call with the spread between calls.
"""

from __future__ import annotations

import contextlib
import random as python_random
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from holdfast.errors import ProblemError
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.floating_mode import as_caller
from holdfast.numerics.randomness import NoiseFreeStream, Purpose, Stream, stream
from holdfast.problems import checked
from holdfast.problems.attributes import (
    has_general_observations,
    has_own,
    name_of,
    sensing_labels,
)
from holdfast.tuning.findings import CheckEndedError, Inspection

__all__ = [
    "acted",
    "check_contract",
    "check_streams",
    "draw_observation",
    "kolmogorov_p",
    "truths",
    "two_sample_p",
]

_SHAPES = ((1,), (3, 4))
"""Leading shapes beside () and (n,)."""

_SAME = 1e-9
"""Relative difference up to which a batch and its rows differ by rounding alone."""

_DRAWS, _FEWEST = 200, 10
"""Of each of two samples that are compared; the second if the time is over."""

_MANY_ACTIONS = 32
"""Bound on the sensing actions of which single states are tried."""

_INITIAL, _MOVE = 1, 2
"""Trial numbers of the streams here."""


def truths(problem: Any, function: str, states: FloatArray) -> BoolArray:
    """Return which states are goals, or failures (``is_failure``, which a problem need not have).

    Raises
    ------
    ProblemError
        If the function returns anything else than a truth value for each state.
    """
    leading = states.shape[:-1]
    if getattr(problem, function, None) is None:
        return np.zeros(leading, dtype=bool)
    found = as_caller(getattr(problem, function), states)
    if np.shape(found) != leading or np.asarray(found).dtype != np.bool_:
        raise ProblemError(
            f"{function} of {name_of(problem)} returned {found!r:.80} for states of shape "
            f"{states.shape}: need truth values of shape {leading}"
        )
    return np.array(found)


def draw_observation(problem: Any, state: FloatArray, action: int, random: Stream) -> FloatArray:
    """Draw an observation in one state, as the simulated world does."""
    if hasattr(problem, "sample_observation"):
        return checked.sample_observation(problem, state, action, random)
    mean, variance = _usable(problem, state, action)
    shown: FloatArray = mean + np.sqrt(variance) * random.normal(mean.shape)
    return shown


def acted(problem: Any, states: FloatArray, stages: Any) -> FloatArray:
    """Return the executed actions in some states, read-only, as what a function is given."""
    commanded = checked.policy(problem, states, stages)
    commanded.setflags(write=False)
    actions = checked.executed_action(problem, commanded)
    actions.setflags(write=False)
    return actions


def _usable(problem: Any, states: FloatArray, action: int) -> tuple[FloatArray, FloatArray]:
    mean, variance = checked.prediction(problem, states, action)
    checked.require_usable(problem, action, mean, variance)
    return mean, np.broadcast_to(variance, mean.shape)


class _Call(NamedTuple):
    """A call with states and stages; ``by_rows`` if each row depends on its state alone."""

    function: str
    make: Callable[[FloatArray, Any], Any]
    by_rows: bool = False
    which: str = ""


def _calls(problem: Any) -> Iterator[_Call]:
    """Yield calls of each function that the problem has."""
    own, still = stream(0, 0, 0, Purpose.WORLD_MOTION), NoiseFreeStream(1000)
    function = "expected_move" if has_own(problem, "expected_move", ("move",)) else "move"

    def stage_after(states: FloatArray, stages: Any) -> Any:
        ask = checked.next_stages if states.ndim > 1 else checked.next_stage
        return ask(problem, states, stages)

    def reward(states: FloatArray, stages: Any) -> Any:
        ask = checked.rewards if states.ndim > 1 else checked.reward
        return ask(problem, states, acted(problem, states, stages))

    def measured(s: FloatArray, _: Any) -> FloatArray:
        return checked.measured_motion(problem, s[0], s[1], own)

    def felt(s: FloatArray, k: Any) -> FloatArray:
        return checked.move_observation(problem, s[0], acted(problem, s, k)[0], own)

    yield _Call("initial_states", lambda s, _: checked.initial_states(problem, own, len(s)))
    yield _Call("policy", lambda s, k: checked.policy(problem, s, k), True)
    yield _Call("policy", lambda s, k: checked.policy(problem, s, int(k[0])))
    yield _Call("execute", lambda s, k: acted(problem, s, k), True)
    yield _Call("move", lambda s, k: checked.move(problem, s, acted(problem, s, k), own))
    yield _Call("move", lambda s, k: checked.move(problem, s, acted(problem, s, k)[0], own))
    yield _Call("is_goal", lambda s, _: truths(problem, "is_goal", s), True)
    yield _Call("is_failure", lambda s, _: truths(problem, "is_failure", s), True)
    yield _Call("reward", reward, True)
    yield _Call("next_stage", stage_after, True)
    yield _Call(
        function, lambda s, k: checked.expected_move(problem, s, acted(problem, s, k), still)
    )
    for action in range(len(sensing_labels(problem))):
        yield from _sensing_calls(problem, action)
    optional = (
        _Call("known_state_return", lambda s, k: checked.known_state_return(problem, s, k)),
        _Call("reinitial_states", lambda s, _: checked.reinitial_states(problem, s, own)),
        _Call("measure_motion", measured),
        _Call(
            "move_by_measurement",
            lambda s, k: checked.moved_by_measurement(problem, s, measured(s, k), own),
        ),
        _Call("sample_move_observation", felt),
        _Call(
            "move_log_likelihood",
            lambda s, k: checked.move_log_likelihood(
                problem, s, acted(problem, s, k)[0], felt(s, k)
            ),
        ),
        _Call("scene", lambda *_: checked.scene(problem) is None),
    )
    for call in optional:
        if getattr(problem, call.function, None) is not None:
            yield call


def _sensing_calls(problem: Any, action: int) -> Iterator[_Call]:
    own = stream(0, 0, action, Purpose.WORLD_OBSERVATION)
    if not has_general_observations(problem):
        which = f" of sensing action {action}"
        rows = action < _MANY_ACTIONS
        yield _Call(
            "observation_mean", lambda s, _: checked.prediction(problem, s, action)[0], rows, which
        )
        yield _Call(
            "observation_variance", lambda s, _: _usable(problem, s, action)[1], rows, which
        )
        return

    def shown(s: FloatArray, _: Any) -> FloatArray:
        return checked.sample_observation(problem, s[0], action, own)

    yield _Call("sample_observation", shown)
    yield _Call(
        "log_likelihood", lambda s, k: checked.log_likelihood(problem, s, action, shown(s, k))
    )


def check_contract(inspection: Inspection, states: FloatArray, stages: IntArray) -> None:
    """Check shapes over batches, and purity, at some states, shapes (n, state_size) and (n,)."""
    late = inspection.deadline(0.15)
    states = np.array(states)
    states.setflags(write=False)
    tried: set[str] = set()
    broken: set[str] = set()

    def ask(check: str, call: _Call, do: Callable[..., Any], *arguments: Any) -> Any:
        if call.function in broken or (late() and call.function in tried):
            return None
        tried.add(call.function)
        try:
            return inspection.ask(call.function, do, call, states, stages, *arguments, check=check)
        except CheckEndedError:
            broken.add(call.function)
            return None

    calls = list(_calls(inspection.problem))
    first = [(call, ask("contract", call, _once)) for call in calls]
    for call in calls:
        ask("purity", call, _drawn_elsewhere)
    # In another order, so that what a call leaves behind shows.
    for call, before in reversed(first):
        ask("purity", call, _again, before)
    for call in calls:
        rounded = ask("contract", call, _by_rows) if call.by_rows else None
        if rounded:
            seen = (
                f"{call.function}{call.which} of a belief and of its single states differ in the "
                f"last bits, by {rounded:.1g}: another machine may compute other bits"
            )
            advice = (
                "Take exp, log, sin, cos, arctan2 and sums from holdfast.numerics if services are "
                "to check the robot's state bit for bit."
            )
            inspection.add("information", "contract", seen, advice)


def _once(call: _Call, states: FloatArray, stages: IntArray) -> bytes:
    return np.ascontiguousarray(call.make(states, stages)).tobytes()


def _drawn_elsewhere(call: _Call, states: FloatArray, stages: IntArray) -> None:
    """Raise ProblemError if a call draws from a generator that all of the program shares."""
    before = _global_generators()
    call.make(states, stages)
    if _global_generators() != before:
        raise ProblemError(
            f"{call.function} draws from the global generator of NumPy or of Python's random: two "
            "runs differ"
        )


def _global_generators() -> tuple[object, ...]:
    kind, keys, position, has_gauss, _ = np.random.get_state()  # noqa: NPY002
    return kind, np.asarray(keys).tobytes(), position, has_gauss, python_random.getstate()


def _again(call: _Call, states: FloatArray, stages: IntArray, before: bytes) -> None:
    if _once(call, states, stages) != before:
        raise ProblemError(
            f"{call.function} returned something else when it was called again with the same "
            "arguments and the same stream"
        )


def _by_rows(call: _Call, states: FloatArray, stages: IntArray) -> float:
    """Return by how much a batch differs from other leading shapes; raise if it is not rounding."""
    whole = np.asarray(call.make(states, stages), dtype=np.float64)
    parts: list[Any] = [[call.make(states[n], int(stages[n])) for n in range(min(len(states), 12))]]
    for leading in _SHAPES:
        size = int(np.prod(leading))
        part = call.make(states[:size].reshape(*leading, -1), stages[:size].reshape(leading))
        parts.append(np.reshape(part, (size, *whole.shape[1:])))
    largest = 0.0
    for part in parts:
        rows = np.array(part, dtype=np.float64)
        differs = np.abs(whole[: len(rows)] - rows)
        worst = np.unravel_index(int(differs.argmax()), differs.shape)
        largest = max(largest, float(differs[worst]))
        if differs[worst] > _SAME * max(1.0, float(np.abs(whole).max())):
            raise ProblemError(
                f"{call.function}{call.which} of a belief is {whole[worst]:g} for its state "
                f"{int(worst[0])}, and {rows[worst]:g} when it is asked of that state in another "
                "leading shape"
            )
    return largest


def check_streams(inspection: Inspection) -> None:
    """Check where draws come from: the stream, one for each state, alike alone and together."""
    problem, ask = inspection.problem, inspection.ask
    late = inspection.deadline(0.15)

    def initial(number: int, count: int) -> FloatArray:
        own = inspection.random(_INITIAL, number)
        return ask("initial_states", checked.initial_states, problem, own, count)

    def compare(function: str, draw: Callable[[int], FloatArray], together: FloatArray) -> None:
        alone = [draw(0)]
        while len(alone) < _DRAWS and not (late() and len(alone) >= _FEWEST):
            alone.append(draw(len(alone)))
        _compare_draws(inspection, function, together, np.stack(alone))

    with contextlib.suppress(CheckEndedError):
        compare("initial_states", lambda number: initial(number, 1)[0], initial(_DRAWS, _DRAWS))
    for which, state in enumerate(initial(_DRAWS + 1, 2)):
        state.setflags(write=False)
        many = np.tile(state, (_DRAWS, 1))
        many.setflags(write=False)
        action = ask("execute", acted, problem, state, 0)

        def moved(
            number: int, states: FloatArray, which: int = which, action: FloatArray = action
        ) -> FloatArray:
            own = inspection.random(_MOVE + which, number)
            return ask("move", checked.move, problem, states, action, own)

        compare("move", lambda number, s=state, m=moved: m(number, s), moved(_DRAWS, many))  # type: ignore[misc]


def _compare_draws(
    inspection: Inspection, function: str, together: FloatArray, alone: FloatArray
) -> None:
    """Compare the spread within one call with the spread between calls of other streams."""
    within, between = np.ptp(together, axis=0) > 0.0, np.ptp(alone, axis=0) > 0.0
    if (differs := within != between).any():
        names = ", ".join(inspection.coordinate(int(each)) for each in np.flatnonzero(differs))
        if (between & ~within).any():
            seen = (
                f"{function} gives all states of one call the same draw of {names}: the particles "
                "of a belief would never spread"
            )
        else:
            seen = (
                f"{function} draws {names} of a belief at random, but for a single state it gives "
                f"the same with each of {len(alone)} streams"
            )
        advice = (
            "Draw from the stream that the function is given, with the shape of the states, for "
            "one state as for many: stream.normal(states.shape), or stream.normal((count, 2))."
        )
        inspection.add("error", "streams", seen, advice)
        return
    for number, (own, other) in enumerate(zip(together.T, alone.T, strict=True)):
        seen = (
            f"{function}: {inspection.coordinate(number)} has another distribution in a belief "
            f"(mean {own.mean():.3g}, deviation {own.std():.2g}) than in single states "
            f"({other.mean():.3g}, {other.std():.2g})"
        )
        advice = (
            "The belief draws many states in a call and the simulated world one: both must draw "
            "each state from the same distribution."
        )
        inspection.test(two_sample_p(own, other), "streams", seen, advice)


def two_sample_p(first: FloatArray, second: FloatArray) -> float:
    """Return the p-value of Kolmogorov and Smirnov's test that two samples are of one distribution.

    With ties it is too large, which only finds less. The approximation is that of Stephens (1970),
    Journal of the Royal Statistical Society B 32.
    """
    points = np.concatenate([first, second])
    below = [
        np.searchsorted(np.sort(each), points, side="right") / len(each) for each in (first, second)
    ]
    size = len(first) * len(second) / (len(first) + len(second))
    return kolmogorov_p(float(np.abs(below[0] - below[1]).max()), size)


def kolmogorov_p(distance: float, size: float) -> float:
    """Return the probability of such a distance between a distribution and a sample of it."""
    root = np.sqrt(size)
    scaled = (root + 0.12 + 0.11 / root) * distance
    if scaled < 0.3:
        return 1.0
    terms = np.arange(1, 101)
    total = 2.0 * np.sum((-1.0) ** (terms - 1) * np.exp(-2.0 * terms**2 * scaled**2))
    return float(min(1.0, max(0.0, total)))
