"""What the values of options and arguments may be; a value that is none of them is one short error.

typer checks numbers, too, but what it says of them names neither the value nor always the limit,
and it takes an empty text for the current directory.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from holdfast.errors import HoldfastError

if TYPE_CHECKING:
    from holdfast.service.health import HttpAddress

__all__ = [
    "MAX_SEED",
    "MAX_TRIALS",
    "OptionError",
    "http_address",
    "location",
    "number",
    "whole_number",
]

MAX_SEED = 2**63 - 1
"""Largest seed, as in the configuration."""

MAX_TRIALS = 10_000_000
"""Largest number of trials, as in the configuration."""


class OptionError(HoldfastError):
    """A value of an option or argument is not allowed; the message names all three."""


def whole_number(option: str, least: int, most: int) -> Callable[[str], int]:
    """Return what reads a whole number.

    Parameters
    ----------
    option : str
        For messages.
    least, most : int
        The limits; both are allowed.
    """

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value <= most:
            raise OptionError(
                f"{option} is {text!r:.80}; allowed are whole numbers from {least} to {most}"
            )
        return value

    return read


def number(option: str, least: float, most: float, unit: str) -> Callable[[str], float]:
    """Return what reads a number.

    Parameters
    ----------
    option : str
        For messages.
    least, most : float
        The limits; both are allowed.
    unit : str
    """

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not least <= value <= most:
            raise OptionError(
                f"{option} is {text!r:.80}; allowed are numbers from {least:g} to {most:g} ({unit})"
            )
        return value

    return read


def location(option: str) -> Callable[[str | Path], Path]:
    """Return what reads the path of a file or directory.

    Parameters
    ----------
    option : str
        For messages.
    """

    def read(text: str | Path) -> Path:
        # Path("") is the current directory, and a variable of a script that is not set is "".
        if not str(text):
            raise OptionError(f"{option} is ''; expected a path (. is the current directory)")
        return Path(text)

    return read


def http_address(option: str) -> Callable[[str | HttpAddress], HttpAddress]:
    """Return what reads where HTTP is to be answered.

    Parameters
    ----------
    option : str
        For messages.
    """

    def read(text: str | HttpAddress) -> HttpAddress:
        from holdfast.service.health import HealthError, parse_http_address

        try:
            return parse_http_address(str(text))
        except HealthError as error:
            raise OptionError(f"{option}: {error}") from error

    return read
