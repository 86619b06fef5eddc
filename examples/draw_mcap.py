"""Draw what an MCAP file of `holdfast export` holds, as RViz and Foxglove arrange it.

Everything is read back from the file, with rosbags and without ROS, so this is also an example of
how to evaluate such a file in Python. On the left is one moment in the frame `map`; on the right
are topics over time::

    pip install 'holdfast-sensing[mcap,figures]'
    holdfast export RUN --mcap run.mcap
    python examples/draw_mcap.py run.mcap --trial 0 --step 48 --out run.png
"""

from __future__ import annotations

import argparse
import itertools
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle
from rosbags.highlevel import AnyReader

BLUE, BLACK, GOLD, GREEN, GREY = "#2F6DB3", "#111111", "#C98A00", "#1E8A4C", "#C9CDD2"
ENTROPIES = ("#1D3C78", "#E8A317", "#B5342B", "#54B5A6", "#7D3C98", "#9AA05A")
MARKERS = "os^DvP"
CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
STATUSES = {"standard": "#9FC5E8", "local_recovery": "#F6B26B", "keep_alive": "#B6D7A8"}


def read(path: Path) -> dict[str, list[tuple[float, Any]]]:
    """Return the messages of each topic with their times in seconds."""
    topics: dict[str, list[tuple[float, Any]]] = defaultdict(list)
    with AnyReader([path]) as reader:
        for connection, time_ns, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            topics[connection.topic].append((time_ns / 1e9, message))
    return topics


def rotate(turn: Any, points: np.ndarray) -> np.ndarray:
    """Turn points by a geometry_msgs/Quaternion."""
    axis = np.array([turn.x, turn.y, turn.z])
    twice = 2.0 * np.cross(axis, points)
    return points + turn.w * twice + np.cross(axis, twice)


def xyz(point: Any) -> np.ndarray:
    """Return a geometry_msgs/Point or Vector3 as an array."""
    return np.array([point.x, point.y, point.z])


class Frames:
    """Frames at one moment, from /tf_static and /tf."""

    def __init__(self, topics: dict[str, list[tuple[float, Any]]], moment: float) -> None:
        self.transforms = {}
        for time, message in [*topics["/tf_static"], *topics["/tf"]]:
            if time <= moment:
                for each in message.transforms:
                    self.transforms[each.child_frame_id] = (each.header.frame_id, each.transform)

    def to_map(self, frame: str, points: np.ndarray) -> np.ndarray:
        while frame != "map":
            frame, transform = self.transforms[frame]
            points = rotate(transform.rotation, points) + xyz(transform.translation)
        return points


def last(messages: list[tuple[float, Any]], moment: float) -> Any:
    """Return the newest message at a moment: what a display shows."""
    return next((message for time, message in reversed(messages) if time <= moment), None)


def draw_scene(panel: Any, topics: dict[str, list[tuple[float, Any]]], moment: float) -> None:
    """Draw the frame map: from the front (x and z), or a task in the ground's plane from above."""
    frames = Frames(topics, moment)
    cloud = last(topics["/holdfast/particle_cloud"], moment)
    frame = cloud.header.frame_id
    tails = np.array([xyz(pose.position) for pose in cloud.poses])
    middle = frames.to_map(frame, tails)
    seen = [0, 1] if np.ptp(middle[:, 2]) < 1e-9 else [0, 2]
    depth = 3 - sum(seen)

    def flat(frame: str, points: np.ndarray) -> np.ndarray:
        """Return points of a frame in the picture."""
        return frames.to_map(frame, np.atleast_2d(points))[:, seen]

    places = []

    for marker in last(topics["/holdfast/scene"], moment).markers:
        frame, color = marker.header.frame_id, marker.color
        center, scale = xyz(marker.pose.position), marker.scale
        if marker.ns == "obstacle":
            corners = frames.to_map(frame, center + 0.5 * CORNERS * xyz(scale))
            low, high = corners.min(axis=0), corners.max(axis=0)
            # Of obstacles in space, those that the plane of the belief's middle cuts.
            if low[depth] <= middle[:, depth].mean() <= high[depth]:
                panel.add_patch(Rectangle(low[seen], *(high - low)[seen], facecolor=GREY, zorder=1))
        elif marker.ns == "body":
            corners = flat(frame, center + 0.5 * CORNERS * xyz(scale))
            for one, other in itertools.combinations(range(8), 2):
                if (CORNERS[one] != CORNERS[other]).sum() == 1:
                    panel.plot(*corners[[one, other]].T, color=(color.r, color.g, color.b),
                               linewidth=1.2, zorder=5)  # fmt: skip
            places.append(corners)
        elif marker.ns == "goal":
            panel.plot(*flat(frame, center).T, "*", color=GREEN, markersize=13, label="goal",
                       linestyle="", zorder=6)  # fmt: skip
            places.append(flat(frame, center) - 1.0)
        elif marker.points:
            points = flat(frame, np.array([xyz(point) for point in marker.points]))
            panel.plot(*points.T, color=(color.r, color.g, color.b), linewidth=1.6, zorder=5)
            places.append(points)
    for topic, color, style, label in (
        ("/holdfast/true_path", BLACK, "-", "/holdfast/true_path, body in frame truth"),
        ("/holdfast/path", BLUE, (0, (4, 1.5)), "/holdfast/path, body in frame estimate"),
    ):
        path = last(topics[topic], moment)
        points = flat(
            path.header.frame_id, np.array([xyz(stamped.pose.position) for stamped in path.poses])
        )
        places.append(points)
        panel.plot(*points.T, color=color, linestyle=style,
                   linewidth=1.3, label=label, zorder=3)  # fmt: skip
    frame = cloud.header.frame_id
    heads = np.array([rotate(pose.orientation, np.array([[0.3, 0.0, 0.0]]))[0]
                      for pose in cloud.poses])  # fmt: skip
    starts, ends = flat(frame, tails), flat(frame, tails + heads)
    places += [starts, ends]
    panel.quiver(
        *starts.T,
        *(ends - starts).T,
        color=BLUE,
        alpha=0.55,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.0035,
        zorder=4,
        label="/holdfast/particle_cloud",
    )
    for marker in last(topics["/holdfast/sensing"], moment).markers:
        if marker.points:
            points = flat(marker.header.frame_id, np.array([xyz(each) for each in marker.points]))
            panel.plot(*points.T, color=GOLD, linewidth=3, zorder=7, label="/holdfast/sensing")
        elif marker.text:
            place = flat(marker.header.frame_id, xyz(marker.pose.position))[0]
            panel.text(*place, marker.text, color=GOLD, ha="center", weight="bold", zorder=8)
    panel.set_aspect("equal")
    panel.set_xlabel("map x (m)")
    panel.set_ylabel(f"map {'xyz'[seen[1]]} (m)")
    shown = np.concatenate(places)
    panel.set_xlim(shown[:, 0].min() - 0.5, shown[:, 0].max() + 0.5)
    panel.set_ylim(shown[:, 1].min() - 0.5, shown[:, 1].max() + 0.5)
    panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, frameon=False)


def draw_topics(
    panels: Any, topics: dict[str, list[tuple[float, Any]]], begin: float, moment: float
) -> None:
    """Draw what is sensed, how sure the belief is, and who decides, over time."""
    entropies, deviation, sensed, waits = panels
    labels = topics["/holdfast/entropies"][0][1].layout.dim[0].label.split("; ")
    times = [time - begin for time, _ in topics["/holdfast/entropies"]]
    values = np.array([message.data for _, message in topics["/holdfast/entropies"]])
    for index, label in enumerate(labels):
        style = {"color": ENTROPIES[index % 6], "marker": MARKERS[index % 6]}
        entropies.plot(times, values[:, index], markersize=3, linewidth=0.7, label=label, **style)
    entropies.set_title("/holdfast/entropies (nats)", loc="left")
    entropies.legend(loc="lower right", bbox_to_anchor=(1, 0.98), ncols=6, frameon=False,
                     columnspacing=0.8, handletextpad=0.3)  # fmt: skip

    estimates = topics["/holdfast/estimate"]
    for row, (label, color) in enumerate((("x", BLUE), ("y", GREEN))):
        spread = [np.sqrt(message.pose.covariance[7 * row]) for _, message in estimates]
        deviation.plot([time - begin for time, _ in estimates], spread, color=color,
                           linewidth=1, linestyle=("-", "--")[row], label=label)  # fmt: skip
    deviation.set_title("/holdfast/estimate: standard deviation (m)", loc="left")
    deviation.legend(loc="lower right", bbox_to_anchor=(1, 0.98), ncols=2, frameon=False)

    for index, label in enumerate(labels):
        chosen = [time - begin for time, message in topics["/holdfast/sensing_action_label"]
                  if message.data == label]  # fmt: skip
        sensed.plot(chosen, [index] * len(chosen), linestyle="", marker=MARKERS[index % 6],
                    color=ENTROPIES[index % 6], markersize=4)  # fmt: skip
    sensed.set_yticks(range(len(labels)), labels)
    sensed.set_ylim(len(labels) - 0.5, -0.5)
    sensed.set_title("/holdfast/sensing_action_label", loc="left")

    statuses = [(time - begin, message.status[0]) for time, message in topics["/diagnostics"]]
    values = [{entry.key: entry.value for entry in status.values} for _, status in statuses]
    asked = [(time, float(value["waited_ms"]))
             for (time, _), value in zip(statuses, values, strict=True)
             if "round_trip_ms" in value]  # fmt: skip
    shown = set()
    following = [*(time for time, _ in statuses[1:]), statuses[-1][0]]
    for (time, _), value, end in zip(statuses, values, following, strict=True):
        status = value.get("status")
        if status in STATUSES:
            waits.axvspan(time, end, color=STATUSES[status], linewidth=0,
                          label=None if status in shown else status)  # fmt: skip
            shown.add(status)
    if not shown:
        waits.text(0.5, 0.5, "no service decided", ha="center", transform=waits.transAxes)
    if asked:
        waits.plot(*zip(*asked, strict=True), ".", color=BLACK, markersize=4)
        waits.set_yscale("symlog", linthresh=1.0)
        waits.set_ylim(bottom=0.0)
    waits.set_title("/diagnostics: wait (ms), status", loc="left")
    if shown:
        waits.legend(loc="lower right", bbox_to_anchor=(1, 0.98), ncols=3, frameon=False)
    waits.set_xlabel("time since the first message (s)")
    for panel in panels:
        panel.axvline(moment - begin, color=GOLD, linewidth=1)
        panel.grid(color="#E6E8EB", linewidth=0.6)
        panel.set_axisbelow(True)


def main() -> None:
    """Read the file and draw it."""
    parser = argparse.ArgumentParser(description="Draw an MCAP file of holdfast export.")
    parser.add_argument("file", type=Path)
    parser.add_argument("--trial", type=int, default=0)
    parser.add_argument("--step", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("run.png"))
    given = parser.parse_args()
    topics = read(given.file)
    begin = topics["/rosout"][0][0]
    trials = {time: message.data for time, message in topics["/holdfast/trial"]}
    moment = next(
        (
            time
            for time, message in topics["/holdfast/step"]
            if (trials.get(time), message.data) == (given.trial, given.step)
        ),
        None,
    )
    if moment is None:
        parser.error(f"trial {given.trial} has no step {given.step} in {given.file}")
    plt.rcParams.update({"font.size": 9.5, "axes.titlesize": 9.5, "legend.fontsize": 8.5})
    figure = plt.figure(figsize=(12.0, 6.8), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.1))
    draw_scene(left.subplots(), topics, moment)
    draw_topics(right.subplots(4, 1, sharex=True), topics, begin, moment)
    figure.suptitle(
        f"Drawn from {given.file.name}: trial {given.trial}, step {given.step} in the frame map "
        "(left), topics over time (right)", x=0.01, ha="left", fontsize=11,
    )  # fmt: skip
    figure.savefig(given.out, dpi=130)


if __name__ == "__main__":
    main()
