"""Types of the fields that the problems' settings share, with their bounds.

Every number has finite bounds, far outside anything sensible: they keep infinities and NaN out.
"""

from __future__ import annotations

from typing import Annotated, TypeVar

import msgspec

from holdfast.errors import InvalidValueError

__all__ = [
    "Coordinate",
    "CoordinatePair",
    "Gain",
    "Length",
    "PositiveVariance",
    "Seed",
    "Step",
    "Tolerance",
    "Variance",
    "validated",
]

Coordinate = Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]
CoordinatePair = tuple[Coordinate, Coordinate]
Length = Annotated[float, msgspec.Meta(gt=0.0, le=1e5)]
Step = Annotated[float, msgspec.Meta(gt=0.0, le=1e5)]
Gain = Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]
Variance = Annotated[float, msgspec.Meta(ge=0.0, le=1e10)]
PositiveVariance = Annotated[float, msgspec.Meta(gt=0.0, le=1e10)]
Tolerance = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]
Seed = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]

StructT = TypeVar("StructT", bound=msgspec.Struct)


def validated(section: str, settings: StructT) -> StructT:
    """Return settings whose fields have the declared types and bounds.

    msgspec checks what it decodes, not what a constructor is given.

    Parameters
    ----------
    section : str
        Name of the section in the configuration, for the message.

    Raises
    ------
    InvalidValueError
        If a field has the wrong type or is out of bounds.
    """
    try:
        return msgspec.convert(msgspec.to_builtins(settings), type(settings))
    except msgspec.ValidationError as error:
        raise InvalidValueError(f"{section}: {error}") from error
