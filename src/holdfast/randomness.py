"""Random numbers by name, not by position.

A generator with a state breaks as soon as two machines have drawn a different number of times.
Here a draw is a function of where it belongs: (seed, trial, step, purpose) name a stream, and the
same stream always gives the same numbers. A step that is computed again, elsewhere, after a crash,
draws what it drew before.

The generator is Philox 4x32-10 (Salmon et al., SC 2011): the seed is its key; trial, step and
purpose are words of its counter, so that no two streams of one seed share a block.
"""

from __future__ import annotations

import enum
import math
from typing import TypeAlias

import numpy as np

from holdfast import _kernel
from holdfast.arrays import FloatArray
from holdfast.errors import InvalidValueError, ProblemError

__all__ = ["NOISE_FREE", "NoiseFreeStream", "Purpose", "Stream", "stream"]

Words: TypeAlias = tuple[int, int, int, int, int]

_WORD = 2**32


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


class Stream:
    """An immutable name of an endless sequence of random numbers.

    Asking twice gives the same numbers twice; different numbers come from different streams, for
    instance from :meth:`substream`.

    Parameters
    ----------
    words : tuple of int
        Two key words and three counter words of 32 bits each.
    """

    __slots__ = ("words",)

    words: Words

    def __init__(self, words: Words) -> None:
        self.words = words

    def normal(self, shape: int | tuple[int, ...] = ()) -> FloatArray:
        """Return standard normal deviates, the first of the stream, in C order."""
        return _kernel.normals(self.words, _size(shape)).reshape(shape)

    def uniform(self, shape: int | tuple[int, ...] = ()) -> FloatArray:
        """Return deviates that are uniform on [0, 1), of the given shape; as :meth:`normal`."""
        return _kernel.uniforms(self.words, _size(shape)).reshape(shape)

    def substream(self, index: int) -> Stream:
        """Return an independent stream; the index is from 0 to 2**32 - 1."""
        if not 0 <= index < _WORD:
            raise InvalidValueError(f"substream index {index}: allowed are 0 to {_WORD - 1}")
        return Stream(_kernel.substream(self.words, index))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Stream) and self.words == other.words

    def __hash__(self) -> int:
        return hash(self.words)

    def __repr__(self) -> str:
        return f"Stream({self.words})"


class NoiseFreeStream(Stream):
    """A stream whose numbers are all at the middle: normal deviates 0, uniform ones 0.5.

    What a problem draws from it is what happens without noise, if its noise is made of these
    deviates. Every substream is the stream itself. :data:`NOISE_FREE` is one.

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

    def normal(self, shape: int | tuple[int, ...] = ()) -> FloatArray:
        """Return zeros of the given shape."""
        self._count()
        return np.zeros(shape)

    def uniform(self, shape: int | tuple[int, ...] = ()) -> FloatArray:
        """Return halves of the given shape."""
        self._count()
        return np.full(shape, 0.5)

    def substream(self, index: int) -> Stream:
        """Return the stream itself."""
        del index
        return self

    def __eq__(self, other: object) -> bool:
        return isinstance(other, NoiseFreeStream)

    def __hash__(self) -> int:
        return hash(NoiseFreeStream)

    def __repr__(self) -> str:
        return "NOISE_FREE"


NOISE_FREE = NoiseFreeStream()


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


def _size(shape: int | tuple[int, ...]) -> int:
    size = 1
    for extent in shape if isinstance(shape, tuple) else (shape,):
        if extent < 0:
            raise InvalidValueError(f"shape {shape}: no extent may be negative")
        size *= int(extent)
    return size
