"""A trial as one chart, in which a step is clicked: what was believed then, and why it was sensed.

Vega-Lite links the parts: a step that is chosen in one filters the data of the others. What is kept
of a trial is bounded: of a long one not every step, and of a belief not every particle.
"""

from __future__ import annotations

import math
from textwrap import wrap
from typing import Any

import numpy as np

from holdfast.config.loader import Configuration
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.planning.belief import Belief, standard_deviation
from holdfast.planning.outcome import TrialResult
from holdfast.printable import one_line
from holdfast.problems import checked
from holdfast.problems.attributes import choice_labels, circular_states
from holdfast.problems.problem import Scene
from holdfast.protocol.robot_events import Timing
from holdfast.reports.csv_export import state_labels
from holdfast.reports.facts import (
    SCORES,
    EventFact,
    LateFact,
    SensingFact,
    TaskFact,
    TrialBeginFact,
    TrialEndFact,
)
from holdfast.reports.html_page import Chart, chart_part
from holdfast.reports.scene_drawing import body_corners, obstacles_within, shown_part, walls_at

MAX_PARTICLES = 80
"""Particles that are kept of a belief: evenly spread ones, if it has more."""

_MAX_COORDINATES = 8
_CAPTION_WIDTH = 34
_MAX_TEXT = 60

_TRUE, _BELIEF, _TARGET = "#111111", "#2F6DB3", "#C2571A"
_COLORS = ["#1D3C78", "#E8A317", "#B5342B", "#54B5A6", "#7D3C98", "#9AA05A"]


class TrialChart:
    """A sink for the facts of one trial, of ``result.steps`` steps; then :meth:`chart`.

    At most twice ``most`` steps are shown: evenly spread ones, and those of evenly spread sensing
    actions.
    """

    def __init__(self, configuration: Configuration, result: TrialResult, most: int) -> None:
        self._problem = configuration.problem
        self._score = SCORES.get(configuration.planning.selector.method, "").split("\n")
        scene: Scene | None = checked.scene(self._problem)
        self._scene = scene
        size = self._problem.state_size
        self._names = [_short(each) for each in state_labels(self._problem)]
        self._choices = [_short(each) for each in choice_labels(self._problem)]
        self._circular = circular_states(self._problem)
        plane = (0, min(1, size - 1)) if scene is None else scene.axes
        self._planes = [plane, *([] if scene is None else scene.targets)]
        self._every = -(-max(result.steps, 1) // most)
        self._every_sensing = -(-max(len(result.sensing_ms), 1) // most)
        self.left_out = self._every > 1
        self._rows: list[dict[str, Any]] = []
        self._beliefs: list[dict[str, Any]] = []
        self._entropies: list[dict[str, Any]] = []
        self._places: list[FloatArray] = []
        self._sensed = 0
        self._has_truth = False
        self._pending: SensingFact | None = None
        self._notes: list[str] = []

    def trial_begins(self, fact: TrialBeginFact) -> None:
        """Do nothing: a chart has one trial."""

    def happened(self, fact: EventFact) -> None:
        """Leave out the events, which the time line of the run has."""

    @in_own_mode
    def sensed(self, fact: SensingFact) -> None:
        """Keep a sensing action for the row of its step."""
        self._pending = fact

    @in_own_mode
    def acted(self, fact: TaskFact) -> None:
        """Add a row for a step."""
        state, info = fact.step.state, fact.step.task_info
        self._add(state.step, state.belief, info.estimate, fact.true_state, fact.decider)

    def observed_late(self, fact: LateFact) -> None:
        """Note a late observation; it is folded in before the next step."""
        self._notes.append(f"the observation of step {fact.step.late.taken} came late")

    @in_own_mode
    def trial_ends(self, fact: TrialEndFact) -> None:
        """Add the last belief."""
        if fact.belief is not None and fact.estimate is not None:
            self._notes.append("the trial has ended")
            self._add(fact.steps, fact.belief, fact.estimate, fact.true_state, None, last=True)

    def _add(
        self,
        step: int,
        belief: Belief,
        estimate: FloatArray,
        truth: FloatArray | None,
        decider: Timing | None,
        *,
        last: bool = False,
    ) -> None:
        sensing, self._pending = self._pending, None
        self._sensed += sensing is not None
        wanted = sensing is not None and (self._sensed - 1) % self._every_sensing == 0
        if not (wanted or last or step % self._every == 0):
            return
        shown = len(self._rows)
        spread = standard_deviation(belief, self._circular)
        row: dict[str, Any] = {"k": shown, "s": step, "sensed": None, "by": None}
        for index, (mean, deviation) in enumerate(zip(estimate, spread, strict=True)):
            row |= {f"m{index}": _rounded(mean), f"l{index}": _rounded(mean - 2.0 * deviation)}
            row[f"h{index}"] = _rounded(mean + 2.0 * deviation)
            if truth is not None:
                row[f"t{index}"] = _rounded(truth[index])
        if self._scene is not None:
            place = estimate if truth is None else truth
            x, y = self._scene.axes
            angle = 0.0 if self._scene.angle is None else place[self._scene.angle]
            row |= {"px": _rounded(place[x]), "py": _rounded(place[y]), "pa": _rounded(angle)}
            for index, wall in enumerate(walls_at(self._scene, place)):
                ends = (f"w{index}{end}" for end in "abcd")
                row |= dict(zip(ends, map(_rounded, wall), strict=True))
        self._has_truth = truth is not None
        known = (estimate,) if truth is None else (estimate, truth)
        self._places += [each[list(plane)] for each in known for plane in self._planes]
        lines = [f"Step {step}", *self._notes]
        self._notes = []
        if sensing is not None:
            name = self._choices[sensing.step.sensing_action]
            row["sensed"] = name
            info = sensing.step.observation_info
            lines.append(f"sensed: {name}{_by(sensing.decider)}")
            if sensing.decider is not None:
                row["by"] = _short(sensing.decider.service)
            if sensing.step.observation is not None and not info.explained:
                lines.append("no particle explains the observation")
            self._keep_entropies(shown, sensing)
            self._keep_belief(shown, "before sensing", sensing.step.before.belief)
        if not last:
            lines.append(f"moved{_by(decider)}")
            row["by"] = row["by"] or (None if decider is None else _short(decider.service))
        row["note"] = [each for line in lines for each in wrap(line, _CAPTION_WIDTH)]
        self._keep_belief(shown, "belief", belief)
        self._rows.append(row)

    def _keep_entropies(self, shown: int, sensing: SensingFact) -> None:
        entropies = sensing.step.sensing_info.entropies
        if entropies is None:
            return
        action = sensing.step.sensing_action
        values = [_rounded(each) for each in entropies]
        looks = ["chosen" if each == action else "not chosen" for each in range(len(values))]
        names = self._choices[: len(values)]
        self._entropies.append({"k": shown, "e": values, "c": looks, "a": names})

    def _keep_belief(self, shown: int, when: str, belief: Belief) -> None:
        every = -(-len(belief.states) // MAX_PARTICLES)
        states, weights = belief.states[::every], belief.weights[::every]
        most = float(weights.max())
        row: dict[str, Any] = {"k": shown, "of": when}
        row["w"] = [round(9.0 * each / most) if most > 0.0 else 5 for each in weights.tolist()]
        for index, axes in enumerate(self._planes):
            for name, axis in zip("xy", axes, strict=True):
                row[f"{name}{index}"] = [_rounded(each) for each in states[:, axis]]
        self._beliefs.append(row)

    def chart(self) -> Chart:
        """Return the specification; click a step in it, or move its slider."""
        first = next((row["k"] for row in self._rows if row["sensed"]), 0)
        chart = chart_part("whole", first=first, last=len(self._rows) - 1)
        longest = max(len(each) for row in self._rows for each in (row["by"] or "", *self._choices))
        chart["usermeta"] = {"letters": longest}
        panels = self._panels()
        chart["params"][0]["views"] = [
            layer["name"] for panel in panels for layer in panel["layer"] if "name" in layer
        ]
        chart["datasets"] = {
            "steps": self._rows,
            "beliefs": self._beliefs,
            "entropies": self._entropies,
        }
        lines = max(len(row["note"]) for row in self._rows)
        left = [self._plane(), chart_part("caption", height=14 * lines + 6), *self._scores()]
        apart = {"resolve": {"scale": {"color": "independent"}}}
        chart["concat"] = [
            {"vconcat": left, "spacing": 12, **apart},
            {"vconcat": panels, "spacing": 8, **apart},
        ]
        return chart

    def _plane(self) -> Chart:
        places = np.array(self._places).reshape(-1, 2)
        low, high = places.min(axis=0), places.max(axis=0)
        reach = max(float((high - low).max()), 1e-6)
        scene = self._scene or Scene(
            self._planes[0], (*(low - 0.5 * reach).tolist(), *(high + 0.5 * reach).tolist())
        )
        part = shown_part(scene, [places])
        layers = [chart_part("still", values=_rectangles(obstacles_within(scene)))]
        for name, points in (("landmark", scene.points), ("goal", scene.goal)):
            if points is not None:
                values = [{"x": x, "y": y} for x, y in points.reshape(-1, 2).tolist()]
                layers.append(chart_part(name, values=values))
        clouds = [(_BELIEF, "particles"), *[(_TARGET, "of a target")] * len(scene.targets)]
        layers += [
            chart_part("cloud", i=index, color=color, title=title)
            for index, (color, title) in reversed([*enumerate(clouds)])
        ]
        for index, plane in enumerate(self._planes):
            for kind in "mt" if self._has_truth else "m":
                color = _TARGET if index else _TRUE if kind == "t" else _BELIEF
                x, y = (f"{kind}{axis}" for axis in plane)
                shape, filled = "square" if index else "circle", kind == "t"
                dash = [] if kind == "t" else [5, 3]
                layers.append(chart_part("path", x=x, y=y, color=color, dash=dash))
                layers.append(
                    chart_part("place", x=x, y=y, color=color, shape=shape, filled=filled)
                )
        corners = body_corners(scene)
        if len(corners):
            x, y = np.vstack([corners, corners[:1]]).round(6).T.tolist()
            layers.append(chart_part("body", body_x=str(x), body_y=str(y)))
        layers += [chart_part("wall", i=index) for index in range(len(scene.walls))]
        for layer in layers:
            for at, name in enumerate("xy"):
                label = self._names[self._planes[0][at]]
                scale = {"domain": part[[at, at + 2]].tolist(), "nice": False, "zero": False}
                axis = {"type": "quantitative", "title": label, "scale": scale}
                layer["encoding"][name] |= axis
        aspect = float((part[3] - part[1]) / (part[2] - part[0]))
        apart = {"scale": {"color": "independent"}}
        return {"layer": layers, "usermeta": {"aspect": aspect}, "resolve": apart}

    def _scores(self) -> list[Chart]:
        used = max((len(row["a"]) for row in self._entropies), default=0)
        if not used:
            return []
        part = chart_part("scores", height=max(60, 20 * used))
        part["encoding"]["x"]["title"] = self._score
        part["encoding"]["y"]["scale"] = {"domain": self._choices[:used]}
        return [part]

    def _panels(self) -> list[Chart]:
        panels = []
        names = self._names[:_MAX_COORDINATES]
        height = 104 if len(names) < 4 else 74
        for index, name in enumerate(names):
            panel = chart_part("coordinate", i=index, height=height)
            if not self._has_truth:
                del panel["layer"][2]
            for layer in panel["layer"]:
                look = {"type": "quantitative", "title": name, "scale": {"zero": False}}
                layer["encoding"]["y"] |= look
            panels.append(panel)
        could = {row["sensed"] for row in self._rows}.union(
            self._choices[: len(self._problem.sensing_actions)]
        )
        for field, title, known in (
            ("sensed", "sensed", [each for each in self._choices if each in could]),
            ("by", "decided by", sorted({row["by"] for row in self._rows if row["by"]})),
        ):
            if not any(row[field] for row in self._rows):
                continue
            panel = chart_part("row", field=field, height=max(40, 17 * len(known)))
            encoding = panel["layer"][0]["encoding"]
            encoding["y"] |= {"title": title, "scale": {"domain": known}}
            encoding["color"]["scale"] = {"domain": known, "range": _COLORS}
            panels.append(panel)
        last = self._rows[-1]["s"]
        for panel in panels:
            panel["layer"].append(chart_part("chosen"))
            for layer in panel["layer"]:
                below = "step (click one)" if panel is panels[-1] else None
                axis = {"title": below, "tickMinStep": 1, "format": "d"}
                over = {"field": "s", "type": "quantitative", "axis": axis}
                layer["encoding"]["x"] = {**over, "scale": {"nice": False, "domain": [0, last]}}
                layer["data"] = {"name": "steps"}
        return panels


def _rectangles(rows: FloatArray) -> list[dict[str, float | None]]:
    return [dict(zip("abcd", map(_rounded, row), strict=True)) for row in rows]


def _rounded(value: Any) -> float | None:
    number = float(value)
    return float(f"{number:.5g}") if math.isfinite(number) else None


def _short(text: object) -> str:
    line = one_line(str(text))
    return line if len(line) <= _MAX_TEXT else f"{line[: _MAX_TEXT - 1]}…"


def _by(decider: Timing | None) -> str:
    if decider is None:
        return ""
    waited = f", waited {decider.waited_ms:.3g} ms" if decider.waited_ms > 0.0 else ""
    return f", decided by {_short(decider.service)} ({_short(decider.status)}{waited})"
