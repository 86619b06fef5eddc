"""A sequential test with a stated false-alarm rate: the robot is lost, or a sensor is dead.

One observation outside the validation gate is an outlier. Many in a short time say that the belief
does not know where the robot is; many of one sensing action, while the others are explained, say
that this sensor does not measure what the model says.

Evidence is added up as Page's cumulative sum (1954, "Continuous inspection schemes", Biometrika
41). Each observation multiplies a likelihood ratio: of a lost robot, half of whose observations are
outside the gate, to a sound belief, of whose observations at most one in twenty is. So one outside
counts times 10, one inside times 10/19, and below 1 the sum begins anew. There is one sum over all
sensing actions and one for each of them. What comes with moves has a sum of its own alone: it comes
at each step, and has no gate but that of being possible, so it would drown the others. The first
that reaches the limit names the cause;
where both do, the greater one: an explained observation of another sensing action makes that of the
sensor the greater one. Equal ones say *lost*: nothing else was sensed that could tell.

**The false-alarm rate.** As long as, whatever was observed before, an observation is outside the
gate with probability at most :data:`MAX_OUTSIDE`, the probability of a false alarm of either kind
within n observations is at most ``n * false_alarm_rate``. For then each ratio has an expectation of
at most 1, and a sum is at most the Shiryaev-Roberts statistic ``R = (R + 1) * ratio``. That less
the number of its observations is a supermartingale, so with the limit c it reaches c within n
observations with probability at most n / c. The limit is 2 / false_alarm_rate: half of the rate is
for the sum over all observations, half for the others, each of which has its own sensing action's
observations alone. The gate's own probability is 0.01; the rest allows for outliers and for a
finite number of particles.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

MAX_OUTSIDE = 0.05
"""Share of a sound belief's observations that may be outside the gate."""

_OUTSIDE_IF_LOST = 0.5
_IF_OUTSIDE = _OUTSIDE_IF_LOST / MAX_OUTSIDE
_IF_INSIDE = (1.0 - _OUTSIDE_IF_LOST) / (1.0 - MAX_OUTSIDE)

MOVE = -1
"""Stands for the sensing action of what came with a move."""


class Verdict(NamedTuple):
    """An alarm."""

    kind: Literal["lost", "sensor_suspect"]

    sensing_action: int | None
    """The suspect one; of a lost robot, the only one of the run if there is but one (then that
    sensor may be dead instead), else None. :data:`MOVE` is what moves show."""

    outside: int  # observations outside the gate, since the evidence began
    observations: int  # all since then


class _Evidence:
    """A cumulative sum, and what it is made of."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        self.ratio = 1.0
        self.outside = 0
        self.observations = 0
        self.actions: set[int] = set()

    def add(self, sensing_action: int, within_gate: bool) -> None:
        self.ratio *= _IF_INSIDE if within_gate else _IF_OUTSIDE
        if self.ratio < 1.0:
            self.restart()
            return
        self.outside += not within_gate
        self.observations += 1
        self.actions.add(sensing_action)


class LostTest:
    """The test, from the beginning of a belief on, with its alarms of each kind so far.

    ``false_alarm_rate`` is above 0 and at most 1.
    """

    def __init__(self, false_alarm_rate: float) -> None:
        self._limit = 2.0 / false_alarm_rate
        self.num_lost = 0
        self.num_suspect = 0
        self.restart()

    def restart(self) -> None:
        """Forget all evidence: the belief has begun anew."""
        self._all = _Evidence()
        self._each: dict[int, _Evidence] = {}
        self._suspects: set[int] = set()

    def observed(self, sensing_action: int, within_gate: bool) -> Verdict | None:
        """Add an observation; return the alarm that it raises, if any.

        After an alarm the evidence is collected anew. A suspect sensing action does not count
        any more, until the robot is found lost or the test restarts.
        """
        if sensing_action in self._suspects:
            return None
        one = self._each.get(sensing_action)
        if one is None:
            one = self._each[sensing_action] = _Evidence()
        if sensing_action != MOVE:
            self._all.add(sensing_action, within_gate)
        one.add(sensing_action, within_gate)
        if within_gate:
            return None
        action, one = max(self._each.items(), key=lambda each: each[1].ratio)
        everything = self._all
        if max(one.ratio, everything.ratio) < self._limit:
            return None
        if one.ratio > everything.ratio:
            self.num_suspect += 1
            self._suspects.add(action)
            del self._each[action]
            self._all = _Evidence()
            return Verdict("sensor_suspect", action, one.outside, one.observations)
        self.num_lost += 1
        self.restart()
        only = next(iter(everything.actions)) if len(everything.actions) == 1 else None
        return Verdict("lost", only, everything.outside, everything.observations)
