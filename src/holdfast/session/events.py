"""What happens to a robot: on its wire to the services, and in the world that it acts on.

A call is one request and any number of replies; it always ends. A call that ends without the answer
says that whoever was asked is gone. What a robot asks of its world ends in one event, too, and that
may be a failure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from holdfast.errors import HoldfastError
from holdfast.outcome import Done
from holdfast.planning import PlanningState

__all__ = [
    "Acted",
    "Appeared",
    "Begun",
    "Decided",
    "Ended",
    "EnvironmentEvent",
    "EnvironmentFailed",
    "Planned",
    "Replied",
    "Sensed",
    "TransportEvent",
    "Vanished",
]

FloatArray = npt.NDArray[np.float64]


class Appeared(NamedTuple):
    """A service is there: it can be asked.

    Attributes
    ----------
    service : str
        The robot's name for it.
    boot : str
        Of the service's process; another one is another process, with another memory. It is the
        process's own word for itself, or the robot's, where the process is there before its word.
    """

    service: str
    boot: str


class Vanished(NamedTuple):
    """A service is gone: it closed, its process died, or the link to it did."""

    service: str
    boot: str


class Replied(NamedTuple):
    """A reply to a call."""

    call: int
    payload: bytes


class Ended(NamedTuple):
    """No more replies come to a call."""

    call: int


TransportEvent: TypeAlias = Appeared | Vanished | Replied | Ended


class Begun(NamedTuple):
    """The environment of a trial is there.

    Attributes
    ----------
    done : bool or "failed"
        Whether the task is done already, or has failed.
    steps_performed : int or None
        Task actions performed in this trial so far, as the environment itself has counted; None if
        it was not asked or does not count.
    """

    done: Done
    steps_performed: int | None


class Sensed(NamedTuple):
    """A sensing action has been performed.

    Attributes
    ----------
    step : int
    observation : array of shape (observation_size,)
        Finite, read-only.
    """

    step: int
    observation: FloatArray


class Acted(NamedTuple):
    """A task action has been performed.

    Attributes
    ----------
    step : int
    reward : float or None
        Finite; None where the environment gives none.
    done : bool or "failed"
        Whether the task is done, or has failed.
    """

    step: int
    reward: float | None
    done: Done


class EnvironmentFailed(NamedTuple):
    """The environment raised, returned what nobody can use, or did not return in time.

    Nothing more comes of this environment.

    Attributes
    ----------
    step : int
    what : str
        The method, or the name of the environment where it could not be made.
    text : str
        For a person: what happened, and where in the environment's own code.
    performance_unknown : bool
        True if the step's task action may have been performed: it was begun, and no
        :class:`Acted` came of it. Only the environment can say.
    performed : bool
        True if the step's task action was performed, and it is what came after that failed.
    reward : float or None
        Of that task action, as in :class:`Acted`.
    counts : bool
        Whether the environment counts its steps, so that it can be asked later what it has done.
    """

    step: int
    what: str
    text: str
    performance_unknown: bool
    performed: bool = False
    reward: float | None = None
    counts: bool = True


EnvironmentEvent: TypeAlias = Begun | Sensed | Acted | EnvironmentFailed


class Decided(NamedTuple):
    """The robot's own planner has answered a question, or failed at it.

    Attributes
    ----------
    number : int
        Of its :class:`~holdfast.session.effects.Decide`.
    actions : tuple of array
        Task actions up to the next sensing step.
    sensing_action : int or None
        Of that sensing step; None if it is too far away.
    ahead_digest : bytes
        Of the state in which it was chosen.
    computed_s : float
        How long the planner computed.
    failure : str or None
        For a person: why there is no answer; None if there is.
    """

    number: int
    actions: tuple[FloatArray, ...] = ()
    sensing_action: int | None = None
    ahead_digest: bytes = b""
    computed_s: float = 0.0
    failure: str | None = None


class Planned(NamedTuple):
    """The planner of a robot without services has computed a part of an answer.

    Attributes
    ----------
    number : int
        Of its :class:`~holdfast.session.effects.Plan`.
    ahead : PlanningState
        To which the task actions lead, or in which the sensing action was chosen.
    actions : sequence of array
        Task actions up to the next sensing step.
    ahead_digest : bytes
        Of the state in which the sensing action was chosen.
    sensing_action : int or None
        None for task actions.
    computed_s : float
        How long the planner computed.
    error : HoldfastError or None
        Why there is nothing of it.
    """

    number: int
    ahead: PlanningState
    actions: Sequence[FloatArray] = ()
    ahead_digest: bytes = b""
    sensing_action: int | None = None
    computed_s: float = 0.0
    error: HoldfastError | None = None
