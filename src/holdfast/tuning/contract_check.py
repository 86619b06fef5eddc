"""Whether the functions of a problem keep their contract: shapes, purity and streams.

Each function is called with states of several leading shapes, again with the same arguments in
another order, and with other streams. What may not differ is compared: rows of a batch with single
states, a call with its repetition, the spread within a call with the spread between calls.
"""

from __future__ import annotations

import functools
import random as python_random
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from holdfast.errors import ProblemError
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import NoiseFreeStream, Purpose, Stream, stream
from holdfast.problems import checked
from holdfast.problems.attributes import has_general_observations, sensing_labels
from holdfast.tuning.findings import CheckEndedError, Inspection

_SHAPES = ((1,), (3, 4))  # leading shapes beside () and (n,)
_SAME = 1e-9  # relative difference up to which a batch and its rows differ by rounding alone
_DRAWS = 200  # of each of two samples that are compared
_MANY_ACTIONS = 32  # bound on the sensing actions of which single states are tried
_GIVEN_BY = dict.fromkeys(("limit_action", "move", "expected_move", "reward"), "policy")
_GIVEN_BY["log_likelihood"] = "sample_observation"  # makes the arguments of the first
_INITIAL, _MOVE = 1, 2  # trial numbers of the streams here


def draw_observation(problem: Any, state: FloatArray, action: int, random: Stream) -> FloatArray:
    """Draw an observation in one state, as the simulated world does."""
    if hasattr(problem, "sample_observation"):
        return checked.sample_observation(problem, state, action, random)
    mean, variance = _usable(problem, state, action)
    return np.asarray(mean + np.sqrt(variance) * random.normal(mean.shape))


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


def _calls(p: Any) -> Iterator[_Call]:
    """Yield calls of each function that a problem has."""
    c, own, still = checked, stream(0, 0, 0, Purpose.WORLD_MOTION), NoiseFreeStream(1000)
    do = functools.partial(acted, p)

    def staged(s: FloatArray, k: Any) -> Any:
        return (c.next_stages if s.ndim > 1 else c.next_stage)(p, s, k)

    def rewarded(s: FloatArray, k: Any) -> Any:
        return (c.rewards if s.ndim > 1 else c.reward)(p, s, do(s, k))

    calls = [
        _Call("initial_states", lambda s, _: c.initial_states(p, own, len(s))),
        _Call("policy", lambda s, k: c.policy(p, s, k), True),
        _Call("policy", lambda s, k: c.policy(p, s, int(k[0]))),
        _Call("limit_action", do, True),
        _Call("move", lambda s, k: c.move(p, s, do(s, k), own)),
        _Call("move", lambda s, k: c.move(p, s, do(s, k)[0], own)),
        _Call("expected_move", lambda s, k: c.expected_move(p, s, do(s, k), still)),
        _Call("is_goal", lambda s, _: c.truths(p, "is_goal", s), True),
        _Call("is_failure", lambda s, _: c.truths(p, "is_failure", s), True),
        _Call("reward", rewarded, True),
        _Call("next_stage", staged, True),
        _Call("known_state_return", lambda s, k: c.known_state_return(p, s, k)),
        _Call("reinitial_states", lambda s, _: c.reinitial_states(p, s, own)),
        _Call("scene", lambda *_: c.scene(p) is None),
    ]
    for action in range(len(sensing_labels(p))):
        calls += _sensing_calls(p, action)
    yield from (call for call in calls if getattr(p, call.function, None) is not None)


def _sensing_calls(p: Any, action: int) -> list[_Call]:
    own = stream(0, 0, action, Purpose.WORLD_OBSERVATION)
    which, rows = f" of sensing action {action}", action < _MANY_ACTIONS

    def shown(s: FloatArray, _: Any) -> FloatArray:
        return checked.sample_observation(p, s[0], action, own)

    if has_general_observations(p):
        weigh = checked.log_likelihood
        return [
            _Call("sample_observation", shown),
            _Call("log_likelihood", lambda s, k: weigh(p, s, action, shown(s, k))),
        ]
    mean = checked.prediction
    return [
        _Call("observation_mean", lambda s, _: mean(p, s, action)[0], rows, which),
        _Call("observation_variance", lambda s, _: _usable(p, s, action)[1], rows, which),
    ]


def check_contract(inspection: Inspection, states: FloatArray, stages: IntArray) -> None:
    """Check shapes over batches, and purity, at some states, shapes (n, state_size) and (n,)."""
    late = inspection.deadline(0.15, "contract")
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
    first.reverse()  # so that what a call leaves behind shows
    for call, before in sorted(first, key=lambda each: each[0].function in _GIVEN_BY):
        if _GIVEN_BY.get(call.function) not in broken:
            ask("purity", call, _again, before)
    for call in calls:
        if call.by_rows:
            ask("contract", call, _by_rows)


def _once(call: _Call, states: FloatArray, stages: IntArray) -> bytes:
    return np.ascontiguousarray(call.make(states, stages)).tobytes()


def _again(call: _Call, states: FloatArray, stages: IntArray, before: bytes) -> None:
    """Raise ProblemError if a call gives something else, or draws from what the program shares."""
    generators = _global_generators()
    same = _once(call, states, stages) == before
    if _global_generators() != generators:
        raise ProblemError(
            f"{call.function} draws from the global generator of NumPy or of Python's random"
        )
    if not same:
        raise ProblemError(
            f"{call.function} returned something else when it was called again with the same "
            "arguments and the same stream"
        )


def _global_generators() -> tuple[object, ...]:
    kind, keys, position, has_gauss, _ = np.random.get_state()  # noqa: NPY002
    return kind, np.asarray(keys).tobytes(), position, has_gauss, python_random.getstate()


def _by_rows(call: _Call, states: FloatArray, stages: IntArray) -> None:
    """Raise ProblemError if a batch differs from other leading shapes by more than rounding."""
    whole = np.asarray(call.make(states, stages), dtype=np.float64)
    parts: list[Any] = [[call.make(states[n], int(stages[n])) for n in range(min(len(states), 12))]]
    for leading in _SHAPES:
        size = int(np.prod(leading))
        part = call.make(states[:size].reshape(*leading, -1), stages[:size].reshape(leading))
        parts.append(np.reshape(part, (size, *whole.shape[1:])))
    for part in parts:
        rows = np.array(part, dtype=np.float64)
        differs = np.abs(whole[: len(rows)] - rows)
        worst = np.unravel_index(int(differs.argmax()), differs.shape)
        if differs[worst] > _SAME * max(1.0, float(np.abs(whole).max())):
            raise ProblemError(
                f"{call.function}{call.which} of a belief is {whole[worst]:g} for its state "
                f"{int(worst[0])}, and {rows[worst]:g} when it is asked of that state in another "
                "leading shape"
            )


def check_streams(inspection: Inspection) -> None:
    """Check where draws come from: the stream, one for each state, alike alone and together."""
    problem, ask = inspection.problem, inspection.ask

    def initial(number: int, count: int = 1) -> FloatArray:
        own = inspection.random(_INITIAL, number)
        return ask("initial_states", checked.initial_states, problem, own, count)

    _compare_draws(
        inspection, "initial_states", lambda number: initial(number)[0], initial(_DRAWS + 1, _DRAWS)
    )
    start = initial(_DRAWS)[0]
    start.setflags(write=False)
    many = np.tile(start, (_DRAWS, 1))
    many.setflags(write=False)
    action = ask("limit_action", acted, problem, start, 0)

    def moved(number: int, states: FloatArray = start) -> FloatArray:
        return ask("move", checked.move, problem, states, action, inspection.random(_MOVE, number))

    _compare_draws(inspection, "move", moved, moved(_DRAWS, many))


def _compare_draws(
    inspection: Inspection, function: str, draw: Callable[[int], FloatArray], together: FloatArray
) -> None:
    """Find what differs between the states of one call alone, or between single states alone."""
    late = inspection.deadline(0.1, "streams")
    alone = np.stack([draw(number) for number in range(_DRAWS) if not late()] or [together[0]])
    if len(alone) < _DRAWS:
        return
    within, between = _varied(together), _varied(alone)
    shared = between & (np.ptp(together, axis=0) == 0.0)
    fixed = within & (np.ptp(alone, axis=0) == 0.0)
    if not (shared | fixed).any():
        return
    at = np.flatnonzero(shared if shared.any() else fixed).tolist()
    names = ", ".join(map(inspection.coordinate, at))
    seen = f"{function} draws {names} of a belief at random, but for a single state it gives the "
    seen += f"same with each of {_DRAWS} streams"
    if shared.any():
        seen = f"{function} gives all states of one call the same draw of {names}: the particles "
        seen += "of a belief would never spread"
    advice = "Draw from the given stream with the shape of the states, of one as of many: "
    advice += "stream.normal(states.shape), or stream.normal((count, 2))."
    inspection.add("error", "streams", seen, advice)


def _varied(drawn: FloatArray) -> BoolArray:
    """Return which coordinates have no value nine times of ten, so that chance repeats none."""
    most = [np.unique(column, return_counts=True)[1].max() for column in drawn.T]
    return np.array(most) <= 0.9 * len(drawn)
