"""What can go wrong, as types.

Every error that holdfast raises on purpose is a :class:`HoldfastError`. Its message names the
value, the limit that it broke and, where there is one, the key of the configuration, because the
person who reads it has the file open, not this code.
"""

from __future__ import annotations

__all__ = [
    "CheckpointError",
    "ConfigurationError",
    "EnvironmentFailedError",
    "HoldfastError",
    "InvalidValueError",
    "OtherCodeError",
    "ProblemError",
    "TransportError",
    "TrialError",
    "UnknownProblemError",
]


class HoldfastError(Exception):
    """Base of every error that holdfast raises on purpose."""


class InvalidValueError(HoldfastError, ValueError):
    """A value is outside its bounds: a negative variance, a NaN in an observation, k >= N."""


class ConfigurationError(HoldfastError):
    """A configuration file cannot be used; the message says which file, key and value."""


class UnknownProblemError(ConfigurationError):
    """No problem of that name is registered, nor can it be imported."""


class OtherCodeError(HoldfastError):
    """The robot's holdfast or problem is other code than the service's, which may decide otherwise.

    The message names the problem and the digests of both.
    """


class ProblemError(HoldfastError):
    """A problem's own function returned something that the contract does not allow."""


class EnvironmentFailedError(HoldfastError):
    """The robot's world raised, stalled, or returned something that the contract does not allow."""


class CheckpointError(HoldfastError):
    """A checkpoint does not decode to a valid planning state."""


class TransportError(HoldfastError):
    """An endpoint cannot be used: it is malformed, taken, or lacks its credentials."""


class TrialError(HoldfastError):
    """What holdfast refused, or the problem's own code raised, with the trial where it happened."""
