"""The facts of a run in Rerun's viewer: what the robot believes, why it senses what it senses.

Rerun shows what was logged under a path at a time. The scene and the styles are logged once,
without a time, and the blueprint says which view shows which paths, so that nothing is left to the
viewer's guesses. A plane is drawn in a 3-D view, from above: Rerun's 2-D view has y pointing down.

There are three timelines. ``time`` is when something happened. ``step`` counts task actions, on
over all trials that are shown, so that no trial lies over another one. ``trial`` is the number of
the trial.

This module imports Rerun (extra ``view``); import it only where something is to be viewed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import rerun as rr

from holdfast.config.loader import Configuration
from holdfast.errors import HoldfastError, ViewError
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import NoiseFreeStream
from holdfast.planning.belief import Belief, standard_deviation
from holdfast.problems import checked
from holdfast.problems.attributes import choice_labels, circular_states
from holdfast.protocol.robot_events import Timing
from holdfast.protocol.status import Status
from holdfast.reports.csv_export import state_labels
from holdfast.reports.facts import (
    EventFact,
    LateFact,
    SensingFact,
    TaskFact,
    TrialBeginFact,
    TrialEndFact,
)
from holdfast.reports.markers import GrowingPath, Marker, scene_markers, sensing_markers
from holdfast.reports.rerun_blueprint import blueprint, drawn_layout, is_flat
from holdfast.reports.rerun_streams import RerunStreams
from holdfast.reports.view_target import ViewTarget
from holdfast.runtime.events import severity
from holdfast.runtime.log_lines import fields_as_text

MAX_PARTICLES = 1000
"""Particles that are drawn of a belief: evenly spread ones, if it has more."""

_BINS = 60
"""Bins of a belief that is drawn as a histogram."""

_MAX_PATH = 2000
"""Places of a path that are kept; of a longer one every second, every fourth, ..."""

_TASK, _ESTIMATE, _TRUTH = "world", "world/estimate", "world/truth"

_OBSTACLE = (92, 99, 110)
_GOAL = (67, 190, 113)
_ESTIMATED = (92, 164, 255)
_TRUE = (240, 240, 240)
_SENSED = (245, 178, 52)
_ACTED = (255, 92, 92)
_FAINT, _STRONG = np.array([30.0, 60.0, 110.0]), np.array([130.0, 190.0, 255.0])
"""Colours of particles: without weight, and with the largest of the belief."""

_SERIES = (
    (92, 164, 255), (245, 178, 52), (235, 98, 86), (84, 181, 166), (190, 130, 220), (176, 186, 104),
)  # fmt: skip
_STATUSES = {
    Status.STANDARD.value: (67, 160, 100),
    Status.LOCAL_RECOVERY.value: (245, 178, 52),
    Status.KEEP_ALIVE.value: (92, 164, 255),
}
_OUTCOMES = {"succeeded": _GOAL, "failed": (235, 98, 86), "truncated": _SENSED}

_MAX_DRAWS = 10_000
"""Draws for a move without noise, as in :mod:`holdfast.planning.policy_path`."""


class RerunSink:
    """Logs the facts of a run; to be used in a ``with`` statement.

    Raises ViewError if the viewer cannot be started or reached, or the file not be written; later
    if the viewer of a recorded run is lost. ``has_times``: the times of the facts are those of a
    clock, in nanoseconds since 1970. ``live``: the viewer follows the last fact; then one that is
    lost is told by ``streams``.
    """

    def __init__(
        self, configuration: Configuration, target: ViewTarget, *, has_times: bool, live: bool
    ) -> None:
        problem = configuration.problem
        self._problem = problem
        self._has_times = has_times
        self._live = live
        self._layout = drawn_layout(problem)
        self._labels = state_labels(problem)
        self._choices = choice_labels(problem)
        self._offset = self._last = 0
        self._paths: dict[str, GrowingPath[FloatArray]] = {}
        self._states: dict[str, str] = {}
        self._move_error = False
        self._recording = RerunStreams(target)
        self._recording.open(blueprint(configuration, self._layout, live=live))
        # Before the run begins: what Rerun loads with the first of it takes a while.
        self._log_styles()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        # What nobody waits for any more is not sent: that may take long.
        if kind is None or issubclass(kind, HoldfastError):
            self._recording.close()

    @property
    def streams(self) -> RerunStreams:
        """Where it goes."""
        return self._recording

    # -- facts -------------------------------------------------------------------------------------

    def trial_begins(self, fact: TrialBeginFact) -> None:
        """Log that the trial begins."""
        self._offset = self._last
        self._paths = {}
        self._states.pop("status", None)
        self._at(fact.time_ns, fact.trial, 0)
        if self._layout is not None:
            for name in ("estimate_path", "truth_path", "sensing", "action"):
                self._recording.log(f"{_TASK}/{name}", rr.Clear(recursive=True))
        self._state("trial", f"trial {fact.trial}")
        self._text("INFO", f"trial {fact.trial} begins")

    def sensed(self, fact: SensingFact) -> None:
        """Log the choice and the alternatives, then the belief that the observation led to."""
        (before, sensed, why, after, info), decided_ns, observed_ns, decider = fact
        self._at(decided_ns, before.trial, before.step)
        self._belief(before.belief)
        action = sensed.sensing_action
        label = self._choices[action]
        self._state("sensing_action", label)
        self._decider(decider)
        if why.entropies is not None:
            self._recording.log("scores", rr.Scalars(_finite(why.entropies)))
            self._recording.log("scores/chosen", rr.Scalars(_finite(why.entropies[action])))
        if self._layout is not None and action < len(self._problem.sensing_actions):
            self._sensing(before.belief, action)
        self._at(observed_ns, before.trial, before.step)
        self._belief(after.belief)
        for name in ("effective_sample_size", "mahalanobis_distance"):
            value = getattr(info, name)
            if value is not None:
                self._recording.log(f"filter/{name}", rr.Scalars(_finite(value)))
        if not info.explained:
            distance = info.mahalanobis_distance
            self._recording.log(
                "filter/mahalanobis_distance/unexplained",
                rr.Scalars(_finite(0.0 if distance is None else distance)),
            )
            self._text("WARN", f"trial {before.trial}, step {before.step}: no particle explains "
                       f"the observation of {label}")  # fmt: skip

    def acted(self, fact: TaskFact) -> None:
        """Log the belief, its estimate, the true state if it is known, and the action."""
        step, state, estimate = fact.step, fact.step.state, fact.step.task_info.estimate
        self._at(fact.time_ns, state.trial, state.step)
        self._decider(fact.decider)
        self._place(state.belief, estimate, fact.true_state)
        self._action(estimate, step.executed)
        self._flush()

    def observed_late(self, fact: LateFact) -> None:
        """Log the belief that an earlier step's observation led to."""
        late, after, info = fact.step
        self._at(fact.time_ns, after.trial, after.step)
        self._belief(after.belief)
        text = f"trial {after.trial}, step {after.step}: the observation of step {late.taken} came"
        if info.explained:
            self._text("INFO", text)
        else:
            self._text("WARN", f"{text}, which no particle explains")

    def trial_ends(self, fact: TrialEndFact) -> None:
        """Log the last belief, and what the trial came to."""
        self._at(fact.time_ns, fact.trial, fact.steps)
        self._place(fact.belief, fact.estimate, fact.true_state, last=True)
        if self._layout is not None:
            self._recording.log(f"{_TASK}/action", rr.Clear(recursive=True))
        result = fact.result
        if result is None:
            self._text("INFO", f"trial {fact.trial}: {fact.steps} steps so far; not finished")
            return
        self._state("trial", result.outcome)
        text = f"trial {fact.trial} {result.in_words()}"
        self._text("INFO" if result.outcome == "succeeded" else "WARN", text)
        # The next trial's first step comes after this one's last belief.
        self._last += 1
        self._flush()

    def happened(self, fact: EventFact) -> None:
        """Log an event of the services."""
        if fact.name == "trial":
            return  # its beginning and its end are there
        fields = {key: value for key, value in fact.fields.items() if key != "component"}
        self._time(fact.time_ns)
        if fact.name == "status":
            self._state("status", str(fields.get("to", "")))
        words = fields_as_text(fields)
        name = fact.name.replace("_", " ")
        self._text(severity(fact.name, fact.fields), f"{name}: {words}" if words else name)

    def _flush(self) -> None:
        self._recording.flush()
        if self._recording.lost is not None and not self._live:
            raise ViewError(f"the viewer {self._recording.lost}")

    # -- what is logged ----------------------------------------------------------------------------

    def _at(self, time_ns: int, trial: int, step: int) -> None:
        self._time(time_ns)
        self._last = self._offset + step
        self._recording.set_time("step", sequence=self._last)
        self._recording.set_time("trial", sequence=trial)

    def _time(self, time_ns: int) -> None:
        if self._has_times:
            self._recording.set_time("time", timestamp=np.datetime64(time_ns, "ns"))
        else:
            self._recording.set_time("time", duration=np.timedelta64(time_ns, "ns"))

    def _belief(self, belief: Belief | None) -> None:
        if belief is None:
            return
        if self._layout is None:
            self._histograms(belief)
            return
        every = -(-len(belief.states) // MAX_PARTICLES)
        weights = belief.weights[::every]
        largest = weights.max()
        share = (weights / largest if largest > 0.0 else weights)[:, np.newaxis]
        self._recording.log(
            f"{_TASK}/belief",
            rr.Points3D(
                self._layout.poses(belief.states[::every])[:, :3],
                colors=(_FAINT + share * (_STRONG - _FAINT)).astype(np.uint8),
            ),
        )

    def _histograms(self, belief: Belief) -> None:
        """Log how the weight is spread over each coordinate, which is in no place in space."""
        for label, values in zip(self._labels, belief.states.T, strict=True):
            shares, edges = np.histogram(values, _BINS, weights=belief.weights)
            middles = 0.5 * (edges[:-1] + edges[1:])
            bars = rr.BarChart(shares, abscissa=middles, widths=np.diff(edges), color=_ESTIMATED)
            self._recording.log(["belief", label], bars)

    def _place(
        self,
        belief: Belief | None,
        estimate: FloatArray | None,
        true_state: FloatArray | None,
        *,
        last: bool = False,
    ) -> None:
        self._belief(belief)
        if belief is not None and estimate is not None:
            spread = standard_deviation(belief, circular_states(self._problem))
            for index, label in enumerate(self._labels):
                values = estimate[index] + np.array([0.0, -1.0, 1.0]) * spread[index]
                self._recording.log(["state", label], rr.Scalars(values))
        if true_state is not None:
            for label, value in zip(self._labels, true_state.tolist(), strict=True):
                self._recording.log(["state", label, "true"], rr.Scalars(value))
        if self._layout is None:
            return
        for entity, state in ((_ESTIMATE, estimate), (_TRUTH, true_state)):
            if state is not None:
                pose = self._layout.poses(state)
                self._recording.log(
                    entity,
                    rr.Transform3D(translation=pose[:3], quaternion=rr.Quaternion(xyzw=pose[3:])),
                )
                path = self._paths.setdefault(entity, GrowingPath(_MAX_PATH))
                if path.add(pose[:3], last=last):
                    self._recording.log(f"{entity}_path", rr.LineStrips3D([path.places]))

    def _action(self, estimate: FloatArray, action: FloatArray) -> None:
        """Log where the task action leads from the estimate, as far as the problem says so."""
        if self._layout is None or self._move_error:
            return
        try:
            after = checked.expected_move(
                self._problem, estimate[np.newaxis], action[np.newaxis], NoiseFreeStream(_MAX_DRAWS)
            )
        except HoldfastError:
            self._move_error = True  # a problem that has no move without noise has no arrows
            return
        begin, end = self._layout.poses(np.stack([estimate, after[0]]))[:, :3]
        self._recording.log(
            f"{_TASK}/action", rr.Arrows3D(origins=begin, vectors=end - begin, colors=_ACTED)
        )

    def _sensing(self, belief: Belief, sensing_action: int) -> None:
        assert self._layout is not None
        entity = f"{_TASK}/sensing"
        self._recording.log(entity, rr.Clear(recursive=True))
        for marker in sensing_markers(self._problem, self._layout, _TASK, belief, sensing_action):
            self._recording.log(f"{entity}/{marker.namespace}", _shape(marker, _SENSED))

    def _decider(self, decider: Timing | None) -> None:
        if decider is None:
            return
        self._state("decider", decider.service)
        if "status" not in self._states:
            # From then on there are events of it. An answer's own status may be an earlier one.
            self._state("status", decider.status)

    def _state(self, name: str, state: str) -> None:
        """Log a state of the timeline, if it has changed."""
        if self._states.get(name) != state:
            self._states[name] = state
            self._recording.log(f"decisions/{name}", rr.StateChange(state=state))

    def _text(self, level: str, text: str) -> None:
        self._recording.log("log", rr.TextLog(text, level=level))

    def _log_styles(self) -> None:
        def static(entity: str | list[object], *shapes: rr.AsComponents) -> None:
            self._recording.log(entity, *shapes, static=True)

        colors = [_SERIES[index % len(_SERIES)] for index in range(len(self._choices))]
        static("scores", rr.SeriesLines(names=self._choices, colors=colors))
        static("scores/chosen", rr.SeriesPoints(names="chosen", colors=_TRUE, marker_sizes=4))
        for label in self._labels:
            static(
                ["state", label],
                rr.SeriesLines(
                    names=["estimate", "- standard deviation", "+ standard deviation"],
                    colors=[_ESTIMATED, (45, 82, 128), (45, 82, 128)],
                    widths=[2.0, 1.0, 1.0],
                ),
            )
            static(["state", label, "true"], rr.SeriesLines(names="true", colors=_TRUE))
        for name, words, color in (
            ("effective_sample_size", "effective sample size", _ESTIMATED),
            ("mahalanobis_distance", "distance of the observation (standard deviations)", _SENSED),
        ):
            static(f"filter/{name}", rr.SeriesLines(names=words, colors=color))
        static(
            "filter/mahalanobis_distance/unexplained",
            rr.SeriesPoints(names="outside the validation gate", colors=_ACTED, marker_sizes=6,
                            markers="cross"),
        )  # fmt: skip
        looks: dict[str, Any] = {"status": _STATUSES, "trial": _OUTCOMES}
        looks["sensing_action"] = dict(zip(self._choices[:-1], colors, strict=False))
        for name, look in looks.items():
            states = rr.StateConfiguration(values=list(look), colors=list(look.values()))
            static(f"decisions/{name}", states)
        if self._layout is None:
            return
        thin, thick = rr.Radius.ui_points(1.0), rr.Radius.ui_points(2.0)
        static(f"{_TASK}/belief", rr.Points3D.from_fields(radii=thick))
        static(f"{_TASK}/action", rr.Arrows3D.from_fields(radii=thick))
        for entity, color in ((_ESTIMATE, _ESTIMATED), (_TRUTH, _TRUE)):
            static(f"{entity}_path", rr.LineStrips3D.from_fields(colors=color, radii=thin))
        self._log_scene()

    def _log_scene(self) -> None:
        assert self._layout is not None
        looks = {"obstacle": _OBSTACLE, "goal": _GOAL, "landmark": _GOAL}
        solid: list[Marker] = []
        markers = scene_markers(self._problem, self._layout, _TASK, _ESTIMATE, _TRUTH)
        for number, marker in enumerate(markers):
            if marker.namespace == "obstacle":
                solid.append(marker)
            else:
                body = _ESTIMATED if marker.frame == _ESTIMATE else _TRUE
                color = looks.get(marker.namespace, body)
                name = "body" if marker.frame != _TASK else f"{marker.namespace}/{number}"
                self._recording.log(f"{marker.frame}/{name}", _shape(marker, color), static=True)
        if solid:
            centers = np.array([marker.pose[:3] for marker in solid])
            if is_flat(self._layout):
                # What moves in the plane is seen in front of it.
                centers[:, 2] -= [marker.scale[2] for marker in solid]
            self._recording.log(
                f"{_TASK}/obstacles",
                rr.Boxes3D(
                    centers=centers,
                    sizes=[marker.scale for marker in solid],
                    colors=_OBSTACLE,
                    fill_mode="majorwireframe" if not is_flat(self._layout) else "solid",
                ),
                static=True,
            )


def _shape(marker: Marker, color: Sequence[int]) -> rr.AsComponents:
    """Return a marker as Rerun draws it; flat lines have the same width at any distance."""
    pose = marker.pose
    line = rr.Radius.ui_points(1.5)
    if marker.kind == "CUBE":
        return rr.Boxes3D(centers=[pose[:3]], quaternions=[pose[3:]], sizes=[marker.scale],
                          colors=color)  # fmt: skip
    if marker.kind == "LINE_STRIP":
        return rr.LineStrips3D([marker.points], colors=color, radii=line)
    if marker.kind == "ARROW":
        begin, end = map(np.asarray, marker.points)
        return rr.Arrows3D(origins=begin, vectors=end - begin, colors=color, radii=line)
    if marker.kind == "TEXT_VIEW_FACING":
        return rr.Points3D([pose[:3]], labels=[marker.text], show_labels=True, colors=color,
                           radii=rr.Radius.ui_points(0.0))  # fmt: skip
    return rr.Points3D([pose[:3]], colors=color, radii=0.5 * marker.scale[0])


def _finite(values: Any) -> Any:
    """Return values of which the infinite are missing: a plot would have no scale."""
    array = np.asarray(values, dtype=np.float64)
    return np.where(np.isfinite(array), array, math.nan)
