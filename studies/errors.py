"""What can go wrong in a study, as types."""

from __future__ import annotations

from holdfast.errors import HoldfastError


class TaskCrashError(RuntimeError):
    """An unexpected error in another process; the message holds its traceback."""


class TaskError(HoldfastError):
    """A task cannot be computed."""


class TrialFileError(HoldfastError):
    """A file of trials cannot be read, or is of something else."""
