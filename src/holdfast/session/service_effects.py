"""What a service's machine asks of the shell around it.

The order is part of the meaning: the replies to a call go out in the order of their effects, and
none follows the end of its call. A job is different: it is only handed out, and takes its time.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, TypeAlias

from holdfast.session.service_jobs import Job

__all__ = ["Answer", "Computed", "Effect", "End", "Noted", "Run"]


class Answer(NamedTuple):
    """Send a reply to a call."""

    call: int
    payload: bytes


class End(NamedTuple):
    """End a call: no reply to it follows."""

    call: int


class Run(NamedTuple):
    """Run a job, anywhere, and bring its outcome to the machine's ``finished``.

    Attributes
    ----------
    job : Job
    expected_s : float
        How long it may take, by what such jobs of the same robot took before; infinite if there
        was none, if the problem is still to be built or is not one of holdfast's own, or if the
        request is out of the ordinary.
    """

    job: Job
    expected_s: float


class Computed(NamedTuple):
    """Take note of the time that a part of an answer took; it changes nothing.

    Attributes
    ----------
    kind : {"task", "sensing"}
    computed_s : float
    waited_s : float
        Before it was begun.
    """

    kind: Literal["task", "sensing"]
    computed_s: float
    waited_s: float


class Noted(NamedTuple):
    """Tell people: one line of the log.

    Attributes
    ----------
    event : str
        ``session_opened``, ``session_taken_over``, ``restored``, ``state_diverged``,
        ``refused``, ``busy`` or ``evicted``.
    fields : dict
        Plain data.
    """

    event: str
    fields: dict[str, object]


Effect: TypeAlias = Answer | End | Run | Computed | Noted
