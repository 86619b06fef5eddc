"""Whether the functions of a problem keep their contract: shapes, purity and streams.

Each function is called with states of several leading shapes, again with the same arguments in
another order, and with other streams. What may not differ is compared: rows of a batch with single
states, a call with its repetition, the spread within a call with the spread between calls.
"""

from __future__ import annotations

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
from holdfast.tuning.findings import CONTRACT, CheckEndedError, Finding, Inspection

__all__ = [
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

# Trial numbers of an inspection's streams.
_INITIAL, _MOVE, _SHOWN = 1, 2, 3


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
    mean, variance = checked.prediction(problem, state, action)
    checked.require_usable(problem, action, mean, variance)
    shown: FloatArray = mean + np.sqrt(variance) * random.normal(mean.shape)
    return shown


class _Call(NamedTuple):
    """A call that is made twice."""

    function: str
    make: Callable[[], Any]


def check_contract(inspection: Inspection, states: FloatArray, stages: IntArray) -> None:
    """Check shapes over batches, and purity, at some states, shapes (n, state_size) and (n,)."""
    problem = inspection.problem
    late = inspection.deadline(0.15)
    broken: set[str] = set()
    tried: set[str] = set()
    first: list[tuple[_Call, bytes]] = []
    calls = list(_calls(problem, states, stages))
    for call in calls:
        if call.function not in broken and not (late() and call.function in tried):
            tried.add(call.function)
            try:
                first.append((call, _asked(inspection, call)))
            except CheckEndedError:
                broken.add(call.function)
    # In another order, so that what a call leaves behind shows.
    for call, before in reversed(first):
        with inspection.part():
            if call.function in broken or late():
                continue
            if _asked(inspection, call) != before:
                broken.add(call.function)
                inspection.add(
                    "error",
                    "purity",
                    f"{call.function} returned something else when it was called again with the "
                    "same arguments and the same stream",
                    "Draw from the given stream alone, not from np.random or a generator of the "
                    "object's own, and keep nothing that changes a later result.",
                    "docs/problems.md#your-own",
                )
    for function in dict.fromkeys(call.function for call in calls):
        with inspection.part():
            if function not in broken and not late():
                _check_rows(inspection, function, states, stages)


def _asked(inspection: Inspection, call: _Call) -> bytes:
    """Make a call and return what it gave as bytes; find out whether it drew from elsewhere."""
    before = _global_generators()
    found = inspection.ask(call.function, call.make)
    if _global_generators() != before:
        inspection.add(
            "error",
            "purity",
            f"{call.function} draws from the global generator of NumPy or of Python's random",
            "Draw from the stream that the function is given: stream.normal(states.shape). Two "
            "runs differ otherwise.",
            CONTRACT,
        )
    parts = found if isinstance(found, tuple) else (found,)
    return b"".join(np.ascontiguousarray(part).tobytes() for part in parts)


def _global_generators() -> tuple[object, ...]:
    kind, keys, position, has_gauss, _ = np.random.get_state()  # noqa: NPY002
    return kind, np.asarray(keys).tobytes(), position, has_gauss, python_random.getstate()


def _calls(problem: Any, states: FloatArray, stages: IntArray) -> Iterator[_Call]:
    """Yield calls with a belief, each function at least once."""
    states = np.array(states)
    states.setflags(write=False)
    stage = int(stages[0])

    def commanded() -> FloatArray:
        return checked.policy(problem, states, stage)

    def executed() -> FloatArray:
        return _executed(problem, states, stage)

    own = stream(0, 0, 0, Purpose.WORLD_MOTION)
    yield _Call("initial_states", lambda: checked.initial_states(problem, own, len(states)))
    yield _Call("policy", commanded)
    yield _Call("policy", lambda: checked.policy(problem, states, stages))
    yield _Call("execute", executed)
    yield _Call("move", lambda: checked.move(problem, states, executed(), own))
    yield _Call("move", lambda: checked.move(problem, states, executed()[0], own))
    yield _Call("is_goal", lambda: truths(problem, "is_goal", states))
    yield _Call("reward", lambda: checked.rewards(problem, states, executed()))
    yield _Call("next_stage", lambda: checked.next_stages(problem, states, stages))
    if hasattr(problem, "is_failure"):
        yield _Call("is_failure", lambda: truths(problem, "is_failure", states))
    noise_free = NoiseFreeStream(1000)
    function = "expected_move" if has_own(problem, "expected_move", ("move",)) else "move"
    yield _Call(function, lambda: checked.expected_move(problem, states, executed(), noise_free))
    for action in range(len(sensing_labels(problem))):
        yield from _sensing_calls(problem, states, action)
    if getattr(problem, "known_state_return", None) is not None:
        yield _Call(
            "known_state_return",
            lambda: np.asarray(checked.known_state_return(problem, states, stages)),
        )
    if getattr(problem, "reinitial_states", None) is not None:
        yield _Call("reinitial_states", lambda: checked.reinitial_states(problem, states, own))
    if hasattr(problem, "measure_motion"):
        yield _Call(
            "measure_motion", lambda: checked.measured_motion(problem, states[0], states[1], own)
        )
        if hasattr(problem, "move_by_measurement"):
            yield _Call(
                "move_by_measurement",
                lambda: checked.moved_by_measurement(
                    problem,
                    states,
                    checked.measured_motion(problem, states[0], states[1], own),
                    own,
                ),
            )
    if hasattr(problem, "sample_move_observation") and hasattr(problem, "move_log_likelihood"):
        yield _Call(
            "sample_move_observation",
            lambda: checked.move_observation(problem, states[0], executed()[0], own),
        )
        yield _Call(
            "move_log_likelihood",
            lambda: checked.move_log_likelihood(
                problem,
                states,
                executed()[0],
                checked.move_observation(problem, states[0], executed()[0], own),
            ),
        )
    if hasattr(problem, "scene"):
        yield _Call("scene", lambda: np.array(checked.scene(problem) is None))


def _sensing_calls(problem: Any, states: FloatArray, action: int) -> Iterator[_Call]:
    own = stream(0, 0, action, Purpose.WORLD_OBSERVATION)
    if not has_general_observations(problem):
        yield _Call("observation_mean", lambda: checked.prediction(problem, states, action))
        yield _Call("observation_variance", lambda: _usable(problem, states, action))
        return

    def shown() -> FloatArray:
        return checked.sample_observation(problem, states[0], action, own)

    yield _Call("sample_observation", shown)
    yield _Call("log_likelihood", lambda: checked.log_likelihood(problem, states, action, shown()))


def _usable(problem: Any, states: FloatArray, action: int) -> tuple[FloatArray, FloatArray]:
    mean, variance = checked.prediction(problem, states, action)
    checked.require_usable(problem, action, mean, variance)
    return mean, variance


def _check_rows(
    inspection: Inspection, function: str, states: FloatArray, stages: IntArray
) -> None:
    """Compare a function of a batch, of other leading shapes and of single states."""
    problem = inspection.problem
    for which, call in _by_rows(problem, function):
        whole = inspection.ask(function, lambda call=call: call(states, stages))  # type: ignore[misc]
        count = len(states)
        for leading in _SHAPES:
            size = int(np.prod(leading))
            some = states[:size].reshape(*leading, -1)
            own = stages[:size].reshape(leading)
            part = inspection.ask(function, lambda call=call, a=some, b=own: call(a, b))  # type: ignore[misc]
            _compare(
                inspection, function, which, whole[:size], part.reshape(size, *whole.shape[1:])
            )
        singles = [
            inspection.ask(function, lambda call=call, n=n: call(states[n], int(stages[n])))  # type: ignore[misc]
            for n in range(min(count, 12))
        ]
        _compare(inspection, function, which, whole[: len(singles)], np.array(singles))


def _by_rows(problem: Any, function: str) -> Iterator[tuple[str, Callable[[FloatArray, Any], Any]]]:
    """Yield the calls of a deterministic function whose rows are independent of each other."""
    if function == "policy":
        yield "", lambda states, stage: checked.policy(problem, states, stage)
    elif function == "execute":
        yield "", lambda states, stage: _executed(problem, states, stage)
    elif function in ("is_goal", "is_failure"):
        yield "", lambda states, _: truths(problem, function, states)
    elif function == "next_stage":
        yield (
            "",
            lambda states, stage: (
                checked.next_stages(problem, states, stage)
                if states.ndim > 1
                else checked.next_stage(problem, states, stage)
            ),
        )
    elif function == "reward":

        def rewards(states: FloatArray, stage: Any) -> Any:
            actions = _executed(problem, states, stage)
            if states.ndim > 1:
                return checked.rewards(problem, states, actions)
            return checked.reward(problem, states, actions)

        yield "", rewards
    elif function in ("observation_mean", "observation_variance"):
        which = 0 if function == "observation_mean" else 1
        for action in range(min(len(sensing_labels(problem)), _MANY_ACTIONS)):

            def predicted(states: FloatArray, _: Any, action: int = action) -> Any:
                mean, variance = _usable(problem, states, action)
                return np.broadcast_to((mean, variance)[which], mean.shape)

            yield f" of sensing action {action}", predicted


def _compare(
    inspection: Inspection, function: str, which: str, whole: FloatArray, rows: FloatArray
) -> None:
    """Add a finding if the rows of a batch are not what the states give by themselves."""
    whole, rows = np.asarray(whole, dtype=np.float64), np.asarray(rows, dtype=np.float64)
    if whole.shape != rows.shape:
        inspection.add(
            "error",
            "contract",
            f"{function}{which} has the shape {whole.shape} for a belief and {rows.shape} for its "
            "states one by one",
            "Return the leading shape of the states that are given.",
            CONTRACT,
        )
        raise CheckEndedError
    differs = np.abs(whole - rows)
    if differs.size == 0 or differs.max() == 0.0:
        return
    worst = np.unravel_index(int(differs.argmax()), differs.shape)
    if differs.max() > _SAME * max(1.0, float(np.abs(whole).max())):
        inspection.add(
            "error",
            "contract",
            f"{function}{which} of a belief is {whole[worst]:g} for its state {int(worst[0])}, and "
            f"{rows[worst]:g} when it is asked of that state in another leading shape",
            "Compute each state by itself: index coordinates as states[..., 0] and take no mean, "
            "maximum or sum over states.",
            CONTRACT,
        )
        raise CheckEndedError
    inspection.add(
        "information",
        "contract",
        f"{function}{which} of a belief and of its single states differ in the last bits, by "
        f"{differs.max():.1g}: another machine may compute other bits",
        "Take exp, log, sin, cos, arctan2 and sums from holdfast.numerics if services are to "
        "check the robot's state bit for bit.",
        CONTRACT,
    )


def check_streams(inspection: Inspection) -> None:
    """Check where draws come from: the stream, one for each state, alike alone and together."""
    problem = inspection.problem
    ask = inspection.ask

    def initial(number: int, count: int) -> FloatArray:
        own = inspection.random(_INITIAL, number)
        return ask("initial_states", lambda: checked.initial_states(problem, own, count))

    late = inspection.deadline(0.15)
    with inspection.part():
        alone = _drawn(lambda number: initial(number, 1)[0], late)
        _check_draws(inspection, "initial_states", initial(_DRAWS, _DRAWS), alone)
    states = initial(_DRAWS + 1, 8)
    action = ask("execute", lambda: _executed(problem, states[0], 0))

    def moved(number: int, which: int, shape: tuple[int, ...]) -> FloatArray:
        own = inspection.random(_MOVE + which, number)
        start = np.array(np.broadcast_to(states[which], (*shape, states.shape[1])))
        start.setflags(write=False)
        return ask("move", lambda: checked.move(problem, start, action, own))

    for which in range(2):
        alone = _drawn(lambda number, which=which: moved(number, which, ()), late)  # type: ignore[misc]
        together = moved(_DRAWS, which, (_DRAWS,))
        _check_draws(inspection, "move", together, alone)
        if not np.ptp(alone, axis=0).any() and np.any(np.asarray(problem.motion_variance) > 0.0):
            inspection.add(
                "warning",
                "streams",
                f"move leads to one state whatever the stream is, but motion_variance is "
                f"{np.asarray(problem.motion_variance).tolist()}",
                "Draw the noise of a step from the stream in move, or declare a motion_variance "
                "of 0.",
                CONTRACT,
            )
            break


def _drawn(draw: Callable[[int], FloatArray], late: Callable[[], bool]) -> FloatArray:
    """Return draws from different streams, fewer if the time is over."""
    drawn: list[FloatArray] = []
    for number in range(_DRAWS):
        if late() and number >= _FEWEST:
            break
        drawn.append(draw(number))
    return np.stack(drawn)


def _executed(problem: Any, states: FloatArray, stage: Any) -> FloatArray:
    """Return the executed actions in some states, read-only, as what a function is given."""
    commanded = checked.policy(problem, states, stage)
    commanded.setflags(write=False)
    actions = checked.executed_action(problem, commanded)
    actions.setflags(write=False)
    return actions


def _check_draws(
    inspection: Inspection, function: str, together: FloatArray, alone: FloatArray
) -> None:
    """Compare the spread within one call with the spread between calls of other streams."""
    within, between = np.ptp(together, axis=0) > 0.0, np.ptp(alone, axis=0) > 0.0
    if (shared := between & ~within).any():
        names = ", ".join(inspection.coordinate(int(each)) for each in np.flatnonzero(shared))
        inspection.add(
            "error",
            "streams",
            f"{function} gives all states of one call the same draw of {names}: the particles of a "
            "belief would never spread",
            "Draw with the shape of the states: stream.normal(states.shape), or "
            "stream.normal((count, 2)).",
            CONTRACT,
        )
        return
    if (fixed := within & ~between).any():
        names = ", ".join(inspection.coordinate(int(each)) for each in np.flatnonzero(fixed))
        inspection.add(
            "error",
            "streams",
            f"{function} draws {names} of a belief at random, but for a single state it gives the "
            f"same with each of {len(alone)} streams",
            "Draw from the stream that the function is given, for one state as for many: the "
            "simulated world is one state.",
            CONTRACT,
        )
        return
    for number in range(together.shape[1]):
        p = two_sample_p(together[:, number], alone[:, number])
        inspection.test(
            p,
            Finding(
                "error",
                "streams",
                f"{function}: {inspection.coordinate(number)} has another distribution in a belief "
                f"(mean {together[:, number].mean():.3g}, deviation {together[:, number].std():.2g}"
                f") than in single states ({alone[:, number].mean():.3g}, "
                f"{alone[:, number].std():.2g})",
                "The belief draws many states in a call and the simulated world one: both must "
                "draw each state from the same distribution.",
                CONTRACT,
            ),
        )


def two_sample_p(first: FloatArray, second: FloatArray) -> float:
    """Return the p-value of Kolmogorov and Smirnov's test that two samples are of one distribution.

    With ties it is too large, which only finds less. The approximation is that of Stephens (1970),
    Journal of the Royal Statistical Society B 32.
    """
    first, second = np.sort(first), np.sort(second)
    points = np.concatenate([first, second])
    below = [np.searchsorted(each, points, side="right") / len(each) for each in (first, second)]
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
