"""Random numbers by name, not by position.

A generator that lives long breaks as soon as two machines have drawn a different number of times.
Here a draw is a function of where it belongs: (seed, trial, step, purpose) name a stream, and each
call of a problem's function gets one that begins anew. A step that is computed again, elsewhere,
after a crash, draws what it drew before.

The generator is Philox 4x32-10 (Salmon et al., SC 2011): the seed is its key; trial, step and
purpose are words of its counter, so that no two streams of one seed share a block.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from holdfast import _kernel
from holdfast.errors import InvalidValueError, ProblemError
from holdfast.numerics import arrays
from holdfast.printable import brief

Words: TypeAlias = tuple[int, int, int, int, int]

Size: TypeAlias = int | Sequence[int]

_WORD = 2**32

# Like the kernel's marker of substreams (2**31), above every purpose, in the same word of the name.
_FURTHER_DRAWS = 2**30
_FURTHER_MOTIONS = 2**29

_UNIFORMS = 2**53
"""How many different numbers a uniform draw has."""

_LARGEST_DRAW = 2**33
"""Numbers: two from each block, which a word counts."""


class Purpose(enum.IntEnum):
    """What a stream is for. The numbers are part of the format: they never change."""

    INITIAL_BELIEF = 1
    PREDICTION = 2
    RESAMPLING = 3
    HYPOTHESES = 4
    SELECTION = 5
    MOVE_RESAMPLING = 6
    REINITIALISATION = 7
    RANK_TEST = 8
    WORLD_INITIAL_STATE = 16
    WORLD_MOTION = 17
    WORLD_OBSERVATION = 18
    WORLD_MEASURED_MOTION = 19
    WORLD_MOVE_OBSERVATION = 20


class _Call:
    """The call of a problem's function that a stream, and all that comes from it, is for."""

    __slots__ = ("has_ended",)

    def __init__(self) -> None:
        self.has_ended = False

    def __deepcopy__(self, memo: object) -> _Call:
        return self


class Stream:
    """A named, endless sequence of random numbers, with the methods of a NumPy ``Generator``.

    A stream goes on: each draw gives other numbers than the one before. Its first draw, and so each
    later one, is a function of its name. Every call of a problem's function gets a stream that
    begins anew, and that ends with the call: one that is kept and asked later raises ProblemError,
    since what it gave would depend on what else had been computed. So do its substreams and copies.

    Draws are exact to the last bit on every machine. ``size`` is None for one number, or a shape.

    Parameters
    ----------
    words : tuple of int
        Two key words and three counter words of 32 bits each: the name.
    call : _Call, optional
        Ends the stream; that of the one from which this one comes.
    """

    # Further draws have names of their own, as substreams do. So one draw has 2**33 numbers, none
    # shares a block with another, and normal deviates none with uniform ones.
    __slots__ = ("_call", "_draws", "_motions", "words")

    words: Words

    def __init__(self, words: Words, call: _Call | None = None) -> None:
        self.words = words
        self._call = _Call() if call is None else call
        self._draws = self._motions = 0

    def standard_normal(self, size: Size | None = None) -> arrays.FloatArray:
        """Return standard normal deviates."""
        return _shaped(self._normals, size)

    def random(self, size: Size | None = None) -> arrays.FloatArray:
        """Return numbers that are uniform on [0, 1)."""
        return _shaped(self._uniforms, size)

    def normal(
        self,
        *positional: npt.ArrayLike,
        loc: npt.ArrayLike | None = None,
        scale: npt.ArrayLike | None = None,
        size: Size | None = None,
        shape: Size | None = None,
    ) -> arrays.FloatArray:
        """Return normal deviates: ``normal(loc=0.0, scale=1.0, size=None)``, as NumPy's.

        One argument alone is a shape, an integer or a tuple of them: ``normal((n, 3))``. NumPy
        takes it for ``loc``. Whatever else may be meant either way raises InvalidValueError:
        ``normal(4.0)``, ``normal(4, scale=0.1)``. ``shape`` is another name of ``size``.
        """
        mean, deviation, size = _parameters(
            "normal", ("loc", "scale"), positional, (loc, scale, size if shape is None else shape)
        )
        if mean is None and deviation is None:
            return self.standard_normal(size)
        mean, deviation = _number("loc", mean, 0.0), _number("scale", deviation, 1.0)
        # A comparison with NaN is false.
        if not (deviation >= 0.0).all():
            raise InvalidValueError(f"normal: scale is {arrays.in_brief(deviation)}, must be >= 0")
        return _spread(self._normals, "loc and scale", mean, deviation, size)

    def uniform(
        self,
        *positional: npt.ArrayLike,
        low: npt.ArrayLike | None = None,
        high: npt.ArrayLike | None = None,
        size: Size | None = None,
        shape: Size | None = None,
    ) -> arrays.FloatArray:
        """Return numbers uniform on [low, high): ``uniform(low=0.0, high=1.0, size=None)``.

        One argument alone is a shape, as for :meth:`normal`.
        """
        least, greatest, size = _parameters(
            "uniform", ("low", "high"), positional, (low, high, size if shape is None else shape)
        )
        if least is None and greatest is None:
            return self.random(size)
        least = _number("low", least, 0.0)
        width = _number("high", greatest, 1.0) - least
        # Comparisons with NaN are false.
        if not ((width >= 0.0) & (width < math.inf)).all():
            raise InvalidValueError(
                f"uniform: high less low is {arrays.in_brief(width)}, must be >= 0 and finite"
            )
        return _spread(self._uniforms, "low and high", least, width, size)

    def integers(
        self,
        low: npt.ArrayLike,
        high: npt.ArrayLike | None = None,
        size: Size | None = None,
        *,
        endpoint: bool = False,
    ) -> arrays.IntArray:
        """Return integers from ``low`` to below ``high``, all alike; with ``endpoint``, to it.

        Without ``high`` they are from 0 to below ``low``. A range has at most 2**53 integers. None
        is favoured: of 2**53 equally likely numbers, those that are too many to be shared out
        evenly are drawn again.
        """
        if high is None:
            low, high = 0, low
        first = _whole("low", low)
        counts = np.asarray(_whole("high", high) - first + bool(endpoint))
        shape = _shape(size) if size is not None else counts.shape
        if counts.size and 0 not in shape and not 1 <= counts.min() <= counts.max() <= _UNIFORMS:
            raise InvalidValueError(
                f"integers from {brief(low)} to {brief(high)}: a range must have 1 to 2**53 of them"
            )
        least, many = (_fitted("low and high", each, shape).reshape(-1) for each in (first, counts))
        found = (least + self._below(many)).reshape(shape)
        return cast(arrays.IntArray, _unwrapped(found, size))

    def choice(
        self,
        a: npt.ArrayLike,
        size: Size | None = None,
        replace: bool = True,
        p: npt.ArrayLike | None = None,
    ) -> Any:
        """Return entries of ``a``, or of ``range(a)`` if it is an integer, drawn along axis 0.

        ``p`` are their probabilities; without it all are alike. Without ``replace`` an entry is
        drawn at most once; it does not go with ``p``.
        """
        if arrays.is_masked(a):
            raise InvalidValueError(f"a {arrays.in_brief(a)}: must have no masked entry")
        entries = np.asarray(a)
        if entries.ndim == 0:
            entries = np.arange(int(_whole("a", a)))
        count, shape = len(entries), _shape(size)
        if p is not None:
            if not replace:
                raise InvalidValueError("choice: p does not go with replace=False")
            found = np.searchsorted(_cumulated(p, count), self.random(shape), side="right")
        elif replace:
            found = self.integers(count, size=shape)
        else:
            drawn = _size(shape)
            if drawn > count:
                raise InvalidValueError(f"choice: {drawn} of {count} without replacement")
            # Fisher and Yates: the i-th place is exchanged with one from there on.
            order = np.arange(count)
            others = self.integers(np.arange(drawn), count, size=drawn)
            for place, other in enumerate(others.tolist()):
                order[[place, other]] = order[[other, place]]
            found = order[:drawn].reshape(shape)
        return entries[_unwrapped(found, size)]

    def substream(self, index: int) -> Stream:
        """Return an independent stream from its beginning; the index is from 0 to 2**32 - 1.

        The same index names the same numbers, whatever was drawn before. A world
        (:mod:`holdfast.numerics.geometry`) draws from substreams 0 to 999 of the stream that it is
        given: if you use substreams too, give it one of them.
        """
        index = arrays.whole("substream index", index, 0, _WORD - 1)
        self._require_open()
        return Stream(_kernel.substream(self.words, index), self._call)

    def anew(self) -> Stream:
        """Return the stream from its beginning: who keeps one draws the same from it each time."""
        return Stream(self.words, self._call)

    def lent(self) -> Stream:
        """Return the stream from its beginning, for one call of a problem's function."""
        return Stream(self.words)

    def for_motion(self) -> Words:
        """Return the name of the noise of one motion in a world: another one at each call."""
        self._require_open()
        number, self._motions = self._motions, self._motions + 1
        return self._continued(_FURTHER_MOTIONS, number)

    def end(self) -> None:
        """Refuse all further draws, of what came from it too: the call that it is for is over."""
        self._call.has_ended = True

    def _normals(self, count: int) -> arrays.FloatArray:
        return _kernel.normals(self._for_draw(), count)

    def _uniforms(self, count: int) -> arrays.FloatArray:
        return _kernel.uniforms(self._for_draw(), count)

    def _below(self, counts: arrays.IntArray) -> arrays.IntArray:
        """Return integers from 0 to below each of ``counts``, shape (n,)."""
        found = np.empty(counts.shape, dtype=np.int64)
        open_ones = np.arange(counts.size)
        while open_ones.size:
            limits = counts[open_ones]
            drawn = (self._uniforms(open_ones.size) * _UNIFORMS).astype(np.int64)
            even = drawn < _UNIFORMS - _UNIFORMS % limits
            found[open_ones[even]] = (drawn % limits)[even]
            open_ones = open_ones[~even]
        return found

    def _for_draw(self) -> Words:
        self._require_open()
        number, self._draws = self._draws, self._draws + 1
        return self._continued(_FURTHER_DRAWS, number)

    def _continued(self, marker: int, number: int) -> Words:
        if number == 0:
            return self.words
        if number >= _WORD:
            raise InvalidValueError(f"a stream has {_WORD} draws, and all have been made")
        key0, key1, purpose, step, trial = self.words
        return _kernel.substream((key0, key1, purpose | marker, step, trial), number)

    def _require_open(self) -> None:
        if self._call.has_ended:
            raise ProblemError(
                "a stream is for the one call of a problem's function that it was given to: one "
                "that was kept from an earlier call cannot be drawn from"
            )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Stream) and self.words == other.words

    def __hash__(self) -> int:
        return hash(self.words)

    def __repr__(self) -> str:
        return f"Stream({self.words})"


class NoiseFreeStream(Stream):
    """A stream whose numbers are all at the middle: normal deviates 0, uniform ones 0.5.

    Normal numbers are so their mean, uniform ones the middle of their range, integers and choices
    the middle one, the lower of two; a choice with probabilities is the median. What a problem
    draws from it is what happens without noise, if its noise is made of these. Every substream is
    the stream itself. :data:`NOISE_FREE` is one.

    A problem that draws again until something holds would wait for ever here, where all draws are
    the same. So a stream made with a limit raises ProblemError when it is asked more often.
    """

    __slots__ = ("_left",)

    def __init__(self, limit: float = math.inf) -> None:
        super().__init__((0, 0, 0, 0, 0))
        self._left = limit

    def _count(self) -> None:
        self._left -= 1
        if self._left < 0:
            raise ProblemError(
                "a move without noise draws again and again, as if it waited for another number: "
                "give the problem an expected_move(states, actions), which path_entropy uses"
            )

    def _normals(self, count: int) -> arrays.FloatArray:
        self._count()
        return np.zeros(count)

    def _uniforms(self, count: int) -> arrays.FloatArray:
        self._count()
        return np.full(count, 0.5)

    def _below(self, counts: arrays.IntArray) -> arrays.IntArray:
        self._count()
        return np.asarray((counts - 1) // 2)

    def substream(self, index: int) -> Stream:
        """Return the stream itself."""
        del index
        return self

    def anew(self) -> Stream:
        """Return the stream itself."""
        return self

    def lent(self) -> Stream:
        """Return the stream itself."""
        return self

    def for_motion(self) -> Words:
        """Return the name, which a world does not draw from."""
        return self.words

    def end(self) -> None:
        """Do nothing: it gives the same numbers whenever it is asked."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, NoiseFreeStream)

    def __hash__(self) -> int:
        return hash(NoiseFreeStream)

    def __repr__(self) -> str:
        return "NOISE_FREE"


NOISE_FREE = NoiseFreeStream()


def seed_and_trial(seed: object, trial: object) -> tuple[int, int]:
    """Return what a user gave as whole numbers that :func:`stream` allows; else it raises."""
    return arrays.whole("seed", seed, 0, 2**63 - 1), arrays.whole("trial", trial, 0, _WORD - 1)


def stream(seed: int, trial: int, step: int, purpose: Purpose) -> Stream:
    """Return the stream of one purpose at one step of one trial.

    The seed is from 0 to 2**63 - 1, trial and step are from 0 to 2**32 - 1; others raise
    InvalidValueError.
    """
    if not 0 <= seed < 2**63:
        raise InvalidValueError(f"seed {seed}: allowed are 0 to {2**63 - 1}")
    if not (0 <= trial < _WORD and 0 <= step < _WORD):
        raise InvalidValueError(f"trial {trial}, step {step}: allowed are 0 to {_WORD - 1}")
    return Stream((seed % _WORD, seed >> 32, int(purpose), step, trial))


def _shape(size: object) -> tuple[int, ...]:
    """Return a size as a shape: () for None."""
    if size is None:
        return ()
    extents: Iterable[Any] = size if isinstance(size, Iterable) else (size,)
    found = [arrays.integer(extent) for extent in extents]
    shape = tuple(extent for extent in found if extent is not None)
    if len(shape) < len(found):
        raise InvalidValueError(f"size {brief(size)}: must be an integer or a tuple of integers")
    if any(extent < 0 for extent in shape):
        raise InvalidValueError(f"shape {size}: no extent may be negative")
    return shape


def _size(shape: tuple[int, ...]) -> int:
    size = math.prod(shape)
    if size > _LARGEST_DRAW:
        raise InvalidValueError(f"shape {shape}: one draw has at most 2**33 numbers")
    return size


def _unwrapped(drawn: Any, size: object) -> Any:
    """Return one number as a number."""
    return drawn[()] if size is None else drawn


def _shaped(draw: Callable[[int], arrays.FloatArray], size: Size | None) -> arrays.FloatArray:
    shape = _shape(size)
    drawn = draw(_size(shape)).reshape(shape)
    return cast(arrays.FloatArray, _unwrapped(drawn, size))


def _spread(
    draw: Callable[[int], arrays.FloatArray],
    what: str,
    base: arrays.FloatArray,
    width: arrays.FloatArray,
    size: Size | None,
) -> arrays.FloatArray:
    """Return ``base + width * drawn``, of the given size or as the two broadcast."""
    shape = np.broadcast_shapes(base.shape, width.shape) if size is None else _shape(size)
    base, width = (_fitted(what, each, shape) for each in (base, width))
    drawn: arrays.FloatArray = base + width * draw(_size(shape)).reshape(shape)
    return cast(arrays.FloatArray, _unwrapped(drawn, size))


def _fitted(what: str, values: Any, shape: tuple[int, ...]) -> Any:
    try:
        return np.broadcast_to(values, shape)
    except ValueError:
        raise InvalidValueError(
            f"size {shape} does not fit {what}, of which one has the shape {values.shape}"
        ) from None


def _number(name: str, value: npt.ArrayLike | None, default: float) -> arrays.FloatArray:
    return arrays.floats(name, default if value is None else value)


def _whole(name: str, value: npt.ArrayLike) -> arrays.IntArray:
    array = arrays.real_numbers(value)
    if array is None or (
        array.size > 0
        and (
            array.dtype.kind == "f" or not -(2**62) <= int(array.min()) <= int(array.max()) <= 2**62
        )
    ):
        raise InvalidValueError(
            f"{name} {arrays.in_brief(value)}: must be integers from -2**62 to 2**62"
        )
    return array.astype(np.int64)


def _cumulated(p: npt.ArrayLike, count: int) -> arrays.FloatArray:
    """Return the cumulated probabilities, of which the last is 1."""
    shares = _number("p", p, 0.0)
    # np.cumsum adds one by one, in order, unlike np.sum.
    sums = np.cumsum(shares)
    # Comparisons with NaN are false.
    if (
        not count
        or shares.shape != (count,)
        or not (shares >= 0.0).all()
        or not abs(sums[-1] - 1.0) < 1e-6
    ):
        raise InvalidValueError(
            f"p {arrays.in_brief(shares)}: must be {count} probabilities, not negative and of sum 1"
        )
    return np.asarray(sums / sums[-1])


def _parameters(
    what: str, names: tuple[str, str], positional: tuple[Any, ...], named: tuple[Any, Any, Any]
) -> tuple[Any, Any, Any]:
    """Return the two parameters of a distribution, None where not given, and the size."""
    if not positional:
        return named
    lone = positional[0]
    if len(positional) == 1 and named[2] is None:
        extents = lone if isinstance(lone, tuple) else (lone,)
        is_shape = all(
            isinstance(extent, int | np.integer) and not isinstance(extent, bool)
            for extent in extents
        )
        if is_shape and named == (None, None, None):
            return None, None, lone
        raise InvalidValueError(
            f"{what}({brief(lone)}): is this the shape, or {names[0]}? Name it: size=... or "
            f"{names[0]}=..."
        )
    if len(positional) > 3 or any(each is not None for each in named[: len(positional)]):
        raise InvalidValueError(f"{what} takes {names[0]}, {names[1]} and size, each of them once")
    return (*positional, *named[len(positional) :])
