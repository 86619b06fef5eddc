"""The layout of Rerun's viewer: the belief in space, and beside it why what was sensed.

This module imports Rerun (extra ``view``); import it only where something is to be viewed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from holdfast.config.loader import Configuration
from holdfast.problems import checked
from holdfast.problems.attributes import circular_states
from holdfast.problems.problem import Problem, Scene
from holdfast.reports.csv_export import state_labels
from holdfast.reports.facts import SCORES
from holdfast.reports.poses import PoseLayout, pose_layout

_FRAMES_PER_S = 10.0
"""Steps a second, when a recorded run is played."""

_MAX_IN_A_COLUMN = 3
"""Coordinates of a state that are drawn below each other; more are drawn in a grid."""

_AWAY = 1.0
"""Distance of the eye from a plane, by the larger side of what is to be seen."""

_ASIDE = (0.36, -0.6, 0.32)
"""Where the eye is in space, by the same; it looks at a place a little above the middle."""

_ABOVE = 0.12


def drawn_layout(problem: Problem) -> PoseLayout | None:
    """Return which coordinates are drawn in space: of the pose, else of the problem's drawing."""
    layout = pose_layout(problem)
    if layout is None and (scene := _scene_of(problem)) is not None:
        across, upwards = scene.axes
        indices = (across, upwards, None, None, None, scene.angle)
        layout = PoseLayout(indices, (0.0, 0.0, 0.0, 1.0), tuple(circular_states(problem)))
    return layout


def is_flat(layout: PoseLayout | None) -> bool:
    """Return whether all that is drawn is in one plane."""
    return layout is not None and layout.indices[2] is None


def blueprint(
    configuration: Configuration, layout: PoseLayout | None, *, live: bool
) -> rrb.Blueprint:
    """Return which view shows what; a live one follows the last fact."""
    problem = configuration.problem
    method = configuration.planning.selector.method
    score = SCORES.get(method, method).replace("\n", " ")
    labels, hidden = state_labels(problem), rrb.PlotLegend(visible=False)
    coordinates, histograms = (
        [
            view(origin=rr.new_entity_path([part, label]), name=name + label, plot_legend=hidden)
            for label in labels
        ]
        for view, part, name in (
            (rrb.TimeSeriesView, "state", ""),
            (rrb.BarChartView, "belief", "belief, "),
        )
    )
    column = rrb.Vertical if len(coordinates) <= _MAX_IN_A_COLUMN else rrb.Grid
    plots = rrb.Vertical(
        rrb.TimeSeriesView(
            origin="scores",
            name=f"{score}, by what is sensed",
            plot_legend=rrb.PlotLegend(corner="RightTop"),
        ),
        rrb.Tabs(
            column(*coordinates, name="state: estimate, its spread, truth"),
            rrb.TimeSeriesView(origin="filter/effective_sample_size", name="effective sample size"),
            rrb.TimeSeriesView(origin="filter/mahalanobis_distance", name="observations: distance"),
        ),
        rrb.StateTimelineView(origin="decisions", name="decisions"),
        rrb.TextLogView(
            origin="log",
            name="log",
            columns=rrb.TextLogColumns(text_log_columns=["loglevel", "body"]),
        ),
        row_shares=[1.9, 2.9, 2.2, 1.2],
    )
    views: list[Any] = [plots]
    if layout is not None:
        views.insert(0, _spatial_view(configuration, layout))
    else:
        views.insert(0, rrb.Grid(*histograms, name="belief"))
    return rrb.Blueprint(
        rrb.Horizontal(*views),
        rrb.TimePanel(
            state="collapsed",
            timeline="step",
            play_state="following" if live else "playing",
            fps=_FRAMES_PER_S,
        ),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )


def _spatial_view(configuration: Configuration, layout: PoseLayout) -> rrb.Spatial3DView:
    scene = _scene_of(configuration.problem)
    eye = None
    if scene is not None:
        x_min, y_min, x_max, y_max = scene.limits
        size = max(x_max - x_min, y_max - y_min)
        if is_flat(layout):
            middle = np.array([0.5 * (x_min + x_max), 0.5 * (y_min + y_max), 0.0])
            away, up = np.array([0.0, 0.0, _AWAY * size]), (0.0, 1.0, 0.0)
        else:
            middle = np.array([0.0, 0.0, _ABOVE * size])
            away, up = np.array(_ASIDE) * size, (0.0, 0.0, 1.0)
        eye = rrb.EyeControls3D(position=middle + away, look_target=middle, eye_up=up)
    return rrb.Spatial3DView(
        origin="/world",
        name=f"{configuration.problem_name}: belief, estimate, truth",
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=eye,
    )


def _scene_of(problem: Problem) -> Scene | None:
    scene: Scene | None = checked.scene(problem)
    return scene
