"""What a robot reports about its observations: what no particle explains, lost, a suspect sensor.

The trial counts (:mod:`holdfast.planning.tracking`); here is what becomes an event, with words and
bounds.
"""

from __future__ import annotations

from collections import Counter

from holdfast.errors import HeldError
from holdfast.planning.belief import VALIDATION_GATE_SQUARED
from holdfast.planning.lost import MOVE, Verdict
from holdfast.planning.settings import LostSettings, OnLost
from holdfast.planning.tracking import Trial
from holdfast.problems.attributes import sensing_labels
from holdfast.protocol.effects import Effects
from holdfast.protocol.robot_events import RobotEffect

_MAX_REPORTS = 10
"""Bound on reports of each kind per trial; all are counted."""

_COUNTED_ONLY = "; further ones of this trial are counted only"

_FAR = f"more than {VALIDATION_GATE_SQUARED**0.5:g} standard deviations from every particle"

_WHY = {
    "lost": "the belief does not know where the robot is",
    "sensor_suspect": "other observations are explained: the sensor is dead, or its model wrong",
}
_OR_ITS_SENSOR = ", or this sensor is dead: nothing else was sensed meanwhile"


class ObservationWarnings:
    """Reports to ``effects`` what is observed in trials."""

    def __init__(self, effects: Effects[RobotEffect], lost: LostSettings) -> None:
        self._effects = effects
        self._lost = lost
        self.counts = effects.counts
        self._trial: int | None = None
        self._reported: Counter[str] = Counter()  # in that trial

    def observed(self, trial: Trial, step: int, **of_what: object) -> OnLost | None:
        """Report what the last input, of a step, has shown; return what to do if the robot is lost.

        ``of_what`` says in the report which observation it was.
        """
        info = trial.found
        if info is None:
            return None
        self.counts["unexplained"] += not info.explained
        if not info.explained and trial.num_unexplained <= _MAX_REPORTS:
            distance = info.mahalanobis_distance
            more = trial.num_unexplained == _MAX_REPORTS
            self._effects.report(
                "unexplained",
                trial=trial.state.trial,
                step=step,
                **of_what,
                **({} if distance is None else {"deviations": distance}),
                reason=("no particle can have made it" if distance is None else _FAR)
                + (_COUNTED_ONLY if more else ""),
            )
        alarm = trial.alarm
        if alarm is None:
            return None
        self.counts[alarm.kind] += 1
        self._raised(trial, step, alarm)
        return self._lost.on_lost if alarm.kind == "lost" else None

    def late_unused(self, trial: Trial, taken: int) -> None:
        """Report that an observation of an earlier step came and none of that step is awaited."""
        self._bounded(
            trial,
            "late_unused",
            "no observation of that step is awaited: it has come before, was given up, or nothing "
            "was sensed there",
            taken=taken,
        )

    def no_reading(self, trial: Trial, **of_what: object) -> None:
        """Report that sensing in a step, this one unless ``taken`` says, gave no reading."""
        self._bounded(trial, "no_reading", "the belief stays as it is", **of_what)

    def reinitialised(self, trial: Trial) -> None:
        """Report that the belief of a lost robot has begun anew."""
        self.counts["reinitialised"] += 1
        self._effects.report("reinitialised", trial=trial.state.trial, step=trial.state.step)

    def _bounded(self, trial: Trial, name: str, reason: str, **fields: object) -> None:
        """Count an event, and report it unless there were many of its kind in this trial."""
        number = trial.state.trial
        if number != self._trial:
            self._trial = number
            self._reported.clear()
        self.counts[name] += 1
        self._reported[name] += 1
        if self._reported[name] <= _MAX_REPORTS:
            if self._reported[name] == _MAX_REPORTS:
                reason += _COUNTED_ONLY
            self._effects.report(name, trial=number, step=trial.state.step, **fields, reason=reason)

    def _raised(self, trial: Trial, step: int, alarm: Verdict) -> None:
        is_lost = alarm.kind == "lost"
        count = trial.lost_test.num_lost if is_lost else trial.lost_test.num_suspect
        if count > _MAX_REPORTS:
            return
        action = alarm.sensing_action
        fields: dict[str, object] = {}
        if action is not None:
            labels = sensing_labels(trial.planner.problem)
            fields["sensing_action"] = "move" if action == MOVE else f"{action} ({labels[action]})"
        self._effects.report(
            alarm.kind,
            trial=trial.state.trial,
            step=step,
            **fields,
            outside=alarm.outside,
            observations=alarm.observations,
            false_alarm_rate=self._lost.false_alarm_rate,
            reason=_WHY[alarm.kind] + (_OR_ITS_SENSOR if is_lost and fields else ""),
        )


def held_error(trial: Trial, step: int) -> HeldError:
    """Return why a lost robot holds still, and what to do."""
    return HeldError(
        f"the robot is lost in trial {trial.state.trial}, step {step}, and holds still, as "
        "lost.on_lost says. Bring it to where it believes to be and resume the run; or resume it "
        "with lost.on_lost=reinitialise, and its belief begins anew"
    )
