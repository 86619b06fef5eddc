"""Draw docs/images/frames.svg: the frames, signs and lengths of the built-in problems.

Run it from the repository: ``python docs/images/draw_frames.py``. Bodies, obstacles and goals are
those of the problems' own scenes. The figure is 900 pixels wide; its text is 11 to 13
pixels high.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.patches import Circle, Polygon, Rectangle

import holdfast as hf

INK, GROUND, BODY, MARK = "#222222", "#c9ccd1", "#f3d9a4", "#b03a2e"
PIXELS_PER_INCH = 100
TEXT, TITLE = 8.4, 9.4


def arrow(axes: Any, start: Any, end: Any, color: str = INK, style: str = "-|>") -> None:
    """Draw an arrow between two points."""
    shape = {"arrowstyle": style, "color": color, "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=end, xytext=start, arrowprops=shape)


def label(axes: Any, place: Any, text: str, color: str = INK, **options: Any) -> None:
    """Write a text."""
    options = {"ha": "center", "va": "center", "fontsize": TEXT, "color": color} | options
    axes.text(*place, text, **options)


def frame_of_plane(axes: Any, origin: tuple[float, float], length: float) -> None:
    """Draw the axes x and y."""
    x, y = origin
    arrow(axes, origin, (x + length, y))
    arrow(axes, origin, (x, y + length))
    label(axes, (x + 1.2 * length, y), "x")
    label(axes, (x, y + 1.2 * length), "y")


def obstacles(axes: Any, scene: Any) -> None:
    """Draw what a body stops at."""
    for x0, y0, x1, y1 in np.clip(scene.obstacles, -100.0, 100.0):
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, color=GROUND, lw=0))


def peg(axes: Any, scene: Any, x: float, y: float, angle: float) -> None:
    """Draw a peg, its own axis and the angle to the vertical."""
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    corners = np.asarray(scene.body) @ turn.T + (x, y)
    axes.add_patch(Polygon(corners, facecolor=BODY, edgecolor=INK, lw=1.0))
    axes.plot([x, x], [y, y + 2.0], color=INK, lw=0.8, ls=":")
    axes.plot([x, x - 2.0 * sine], [y, y + 2.0 * cosine], color=MARK, lw=0.8, ls="--")
    arc = np.linspace(0.0, angle, 30)
    axes.plot(x - 1.7 * np.sin(arc), y + 1.7 * np.cos(arc), color=MARK, lw=1.2)
    arrow(
        axes,
        (x - 1.7 * math.sin(0.9 * angle), y + 1.7 * math.cos(0.9 * angle)),
        (x - 1.7 * sine, y + 1.7 * cosine),
        MARK,
    )
    label(axes, (x - 2.2 * math.sin(angle / 2), y + 2.2 * math.cos(angle / 2)), "θ > 0", MARK)
    axes.plot(x, y, ".", color=INK)


def panel(axes: Any, title: str, limits: tuple[float, float, float, float]) -> None:
    """Prepare the axes of one drawing."""
    axes.set_title(title, fontsize=TITLE, loc="left", family="monospace")
    axes.set_xlim(limits[0], limits[2])
    axes.set_ylim(limits[1], limits[3])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])


def draw_peg_in_hole(axes: Any) -> None:
    """Draw a peg, the hole and their lengths."""
    scene: Any = hf.make_problem("peg_in_hole_2d", hole_tolerance=0.25).scene()
    panel(axes, "peg_in_hole_2d", (-3.6, -1.9, 6.4, 4.6))
    obstacles(axes, scene)
    peg(axes, scene, 3.4, 1.6, 0.5)
    label(axes, (2.3, 1.2), "(x, y)", ha="right")
    frame_of_plane(axes, (0.0, 0.0), 1.2)
    axes.plot(*scene.goal, "+", color=MARK, ms=10)
    label(axes, (-0.3, 0.3), "goal", MARK, ha="right")
    label(axes, (-2.2, -0.8), "ground, y < 0")
    arrow(axes, (0.5, -0.6), (0.75, -0.6), MARK, "<->")
    label(axes, (0.9, -0.6), "hole_tolerance", MARK, ha="left")
    arrow(axes, (-0.5, -1.55), (0.5, -1.55), INK, "<->")
    label(axes, (0.9, -1.55), "peg_width", ha="left")


def draw_multitier(axes: Any) -> None:
    """Draw the plates, in the order in which the peg passes them."""
    problem: Any = hf.make_problem("multitier_peg_in_hole_2d")
    scene = problem.scene()
    panel(axes, "multitier_peg_in_hole_2d", (-12.0, -9.0, 12.0, 12.0))
    obstacles(axes, scene)
    for stage, hole in enumerate(problem.model.holes):
        label(axes, hole.center, f"{stage}", MARK, weight="bold")
    peg(axes, scene, -3.5, 8.6, 0.6)
    frame_of_plane(axes, (0.0, 0.0), 2.4)
    label(axes, (0.0, -8.2), "plates; the number in a hole is the stage", INK)
    arrow(axes, (9.0, 5.5), (9.0, 6.5), MARK, "<->")
    label(axes, (8.5, 7.3), "holes[0].depth", MARK)


def draw_capsule(axes: Any) -> None:
    """Draw the maze and its via points, each with its axis."""
    problem: Any = hf.make_problem("capsule_robot")
    scene = problem.scene()
    panel(axes, "capsule_robot", (-0.9, -0.75, 5.6, 3.35))
    obstacles(axes, scene)
    planner = problem.state_space_planner
    start = np.array(problem.model.init_mean)
    for stage, target in enumerate((*planner.via_points, problem.model.goal)):
        center = np.array(target.center)
        axes.add_patch(Circle(center, target.radius, fill=False, color=MARK, lw=1.2))
        step = center - start
        margin = (0.45 if target.axis else 0.3) * step / np.linalg.norm(step)
        arrow(axes, start + margin, center - margin, "#8a8f98")
        name = f"{stage}, axis {target.axis}" if stage < len(planner.via_points) else "goal"
        label(axes, center - (0.0, 0.28), name, MARK)
        start = center
    axes.add_patch(Circle(problem.model.init_mean, problem.model.robot_radius, color=BODY, ec=INK))
    label(axes, (0.55, 2.27), "(x, y)")
    frame_of_plane(axes, (-0.6, -0.55), 0.6)
    label(axes, (2.9, -0.45), "axis 0: gain_0 acts on x, gain_1 on y; axis 1: reverse")


def draw_space(axes: Any) -> None:
    """Draw the frame of space and the signs of its three angles."""
    panel(axes, "peg_in_hole_3d", (-3.9, -2.5, 4.3, 2.9))
    to_x, to_y, to_z = np.array([-0.62, -0.42]), np.array([0.95, -0.16]), np.array([0.0, 1.0])

    def seen(x: Any, y: Any, z: Any) -> Any:
        return np.multiply.outer(x, to_x) + np.multiply.outer(y, to_y) + np.multiply.outer(z, to_z)

    width, depth, height = 0.5, 0.5, 1.0
    for face in (
        [(width, -depth, -height), (width, depth, -height), (width, depth, height),
         (width, -depth, height)],
        [(width, depth, -height), (-width, depth, -height), (-width, depth, height),
         (width, depth, height)],
        [(width, -depth, height), (width, depth, height), (-width, depth, height),
         (-width, -depth, height)],
    ):  # fmt: skip
        corners = [seen(*corner) for corner in face]
        axes.add_patch(Polygon(corners, facecolor=BODY, edgecolor=INK, lw=0.8))
    lengths = {"x": (2.6, 0.0, 0.0), "y": (0.0, 2.4, 0.0), "z": (0.0, 0.0, 2.2)}
    for name, end in lengths.items():
        arrow(axes, seen(0.0, 0.0, 0.0), seen(*end))
        label(axes, seen(*(1.12 * np.array(end))), name)
    around = np.linspace(-0.6, 4.2, 60)
    cosine, sine, along = 0.5 * np.cos(around), 0.5 * np.sin(around), np.zeros(60)
    for name, curve, place in (
        ("yaw > 0", seen(cosine, sine, along + 1.7), (1.25, 1.75)),
        ("pitch > 0", seen(sine, along + 1.8, cosine), (2.6, 0.55)),
        ("roll > 0", seen(along + 2.0, cosine, sine), (-2.55, -0.55)),
    ):
        axes.plot(*curve.T, color=MARK, lw=1.2)
        arrow(axes, curve[-4], curve[-1], MARK)
        label(axes, place, name, MARK)
    label(axes, (0.2, -1.75), "turned by Rz(yaw) Ry(pitch) Rx(roll);")
    label(axes, (0.2, -2.2), "the plate's top is z = 0, the hole is around z")


def main() -> None:
    """Draw all four; to the file that is named, or to the page's."""
    mpl.rcParams.update({"svg.hashsalt": "frames", "font.family": "DejaVu Sans"})
    figure, axes = plt.subplots(2, 2, figsize=(9.0, 6.6), dpi=PIXELS_PER_INCH)
    draw_peg_in_hole(axes[0, 0])
    draw_multitier(axes[0, 1])
    draw_capsule(axes[1, 0])
    draw_space(axes[1, 1])
    figure.tight_layout(pad=0.6)
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("frames.svg")
    figure.savefig(out, metadata={"Date": None} if out.suffix == ".svg" else None)


if __name__ == "__main__":
    main()
