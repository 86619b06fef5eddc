"""A recorded run as one MCAP file of standard ROS 2 messages, without ROS.

MCAP is what rosbag2 writes by default, so ``ros2 bag``, RViz, Foxglove and PlotJuggler open the
file as one of their own. All messages are of packages that every ROS 2 has; their definitions are
in the file. rosbags (extra ``mcap``) knows these, encodes the messages and writes the file.

Poses are in the frame ``task``, which stands in ``map`` so that what the problem calls up points
up. Everything is offered as reliable, for then a subscriber of either kind gets it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np

from holdfast.config.loader import Configuration
from holdfast.errors import MissingRosbagsError, how_to_install
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import Belief
from holdfast.planning.planner import PlanningState
from holdfast.problems.attributes import choice_labels
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
    shown_decider,
)
from holdfast.reports.markers import GrowingPath, Marker, scene_markers, sensing_markers
from holdfast.reports.poses import pose_layout
from holdfast.runtime.events import severity

if TYPE_CHECKING:
    from rosbags.interfaces import Connection


MAP_FRAME = "map"
TASK_FRAME = "task"
ESTIMATE_FRAME = "estimate"
TRUTH_FRAME = "truth"

_NS_PER_S = 1_000_000_000
_BAG_VERSION: Final = 8
"""Version of rosbag2's metadata: the last one whose qualities of service Humble reads as well."""

_LEVELS = {"DEBUG": 10, "INFO": 20, "WARN": 30, "ERROR": 40}


def require_rosbags() -> None:
    """Make sure that rosbags is there.

    Raises MissingRosbagsError if it is not.
    """
    try:
        import rosbags.rosbag2  # noqa: F401
    except ImportError as error:
        advice = how_to_install("rosbags", "mcap")
        raise MissingRosbagsError(f"MCAP files need the library rosbags: {advice}") from error


class McapSink:
    """Writes the facts of a run as ROS 2 messages; to be used in a ``with`` statement.

    The file is made in ``directory``, which must not be there yet, with the ``metadata.yaml`` of a
    rosbag2, which gets the ``notes``.

    Raises MissingRosbagsError if rosbags is not installed, and ProblemError if what the problem
    says of its pose cannot be.
    """

    def __init__(
        self, directory: Path, configuration: Configuration, notes: Mapping[str, str]
    ) -> None:
        require_rosbags()
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        problem = configuration.problem
        self._problem = problem
        self._layout = pose_layout(problem)
        self.has_poses = self._layout is not None
        self._labels = state_labels(problem)
        self._choices = choice_labels(problem)
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._types: dict[str, Any] = dict(self._store.types)
        self._connections: dict[str, Connection] = {}
        self._directory = directory
        self._writer = Writer(directory, version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        for key, value in notes.items():
            self._writer.set_custom_data(key, value)
        self._paths: dict[str, GrowingPath[Any]] = {}
        self._belief_written: Belief | None = None
        self._has_frame = False

    def __enter__(self) -> Self:
        self._writer.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.__exit__(kind, error, trace)

    @property
    def file(self) -> Path:
        """The file that is written."""
        return self._directory / f"{self._directory.name}.mcap"

    # -- facts -------------------------------------------------------------------------------------

    def trial_begins(self, fact: TrialBeginFact) -> None:
        """Write the frames, once, and the scene, and say that the trial begins."""
        now = fact.time_ns
        self._paths = {}
        if self._layout is not None:
            if not self._has_frame:
                self._has_frame = True
                turned = np.array([0.0, 0.0, 0.0, *self._layout.upright])
                self._transform(now, "/tf_static", MAP_FRAME, {TASK_FRAME: turned})
            frames = TASK_FRAME, ESTIMATE_FRAME, TRUTH_FRAME
            markers = scene_markers(self._problem, self._layout, *frames)
            self._markers(now, "/holdfast/scene", markers, anew=True)
            self._markers(now, "/holdfast/sensing", [], anew=True)
        self._log(now, "INFO", f"trial {fact.trial} begins")

    def sensed(self, fact: SensingFact) -> None:
        """Write the belief and the choice, then the observation and the belief that it led to."""
        (before, sensed, _, after, info), now, later, decider = fact
        action, observation = sensed.sensing_action, sensed.numbers()
        self._place(now, before, before.stage)
        self._belief(now, before.belief)
        label = self._choices[action]
        self._number(now, "/holdfast/sensing_action", "Int32", action)
        self._write(now, "/holdfast/sensing_action_label", "std_msgs/msg/String", data=label)
        entropies = fact.step.sensing_info.entropies
        if entropies is not None:
            self._array(now, "/holdfast/entropies", entropies,
                        "; ".join(self._choices[: len(entropies)]))  # fmt: skip
        if self._layout is not None and action < len(self._problem.sensing_actions):
            markers = sensing_markers(
                self._problem, self._layout, TASK_FRAME, before.belief, action
            )
            self._markers(now, "/holdfast/sensing", markers)
        if observation is not None:
            self._array(later, "/holdfast/observation", observation, label)
        self._belief(later, after.belief)
        values: dict[str, Any] = {"sensing_action": label}
        values |= {
            name: getattr(info, name)
            for name in ("effective_sample_size", "mahalanobis_distance", "explained", "resampled")
        }
        self._diagnose(later, before, "sensing", decider, values)
        if not info.explained and decider is None:
            # With services there is an event of it.
            self._log(later, "WARN", f"trial {before.trial}, step {before.step}: no particle "
                      f"explains the observation of {label}")  # fmt: skip

    def acted(self, fact: TaskFact) -> None:
        """Write the belief, its estimate, the true state if it is known, and the action."""
        step, now, decider, true_state = fact
        state, reward, action = step.state, step.reward, step.executed
        self._place(now, state, step.task_info.stage)
        self._state(now, state.belief, step.task_info.estimate, true_state)
        labels = self._labels if len(action) == len(self._labels) else ["action"]
        self._array(now, "/holdfast/task_action", action, "; ".join(labels))
        for name, shown in zip(("motion", "move_observation"), step.moved.numbers(), strict=True):
            if shown is not None:
                self._array(now, f"/holdfast/{name}", shown, name)
        if reward is not None:
            self._number(now, "/holdfast/reward", "Float64", reward)
        self._diagnose(now, state, "task", decider, {"reward": reward})

    def observed_late(self, fact: LateFact) -> None:
        """Write a late observation and the belief that it led to."""
        (late, after, _), now = fact
        label = f"taken at step {late.taken}"
        self._array(now, "/holdfast/late_observation", late.numbers(), label)
        self._belief(now, after.belief)

    def trial_ends(self, fact: TrialEndFact) -> None:
        """Write the last belief, and what the trial came to."""
        now = fact.time_ns
        self._number(now, "/holdfast/step", "Int32", fact.steps)
        self._state(now, fact.belief, fact.estimate, fact.true_state, last=True)
        result = fact.result
        if result is None:
            self._log(now, "INFO", f"trial {fact.trial}: {fact.steps} steps so far; not finished")
            return
        level = "INFO" if result.outcome == "succeeded" else "WARN"
        self._log(
            now, level, f"trial {fact.trial} {result.in_words()}; decisions {result.digest[:16]}"
        )

    def happened(self, fact: EventFact) -> None:
        """Write an event of the services."""
        name, fields = fact.name, dict(fact.fields)
        if name == "trial":
            return  # its beginning and its end are there
        level = severity(name, fields)
        component = str(fields.pop("component", "robot"))
        text = ", ".join(f"{key} {value}" for key, value in fields.items())
        self._log(fact.time_ns, level, f"{name}: {text}" if text else name, component)

    # -- messages ----------------------------------------------------------------------------------

    def _place(self, now: int, state: PlanningState, stage: int) -> None:
        self._number(now, "/holdfast/trial", "Int32", state.trial)
        self._number(now, "/holdfast/step", "Int32", state.step)
        self._number(now, "/holdfast/stage", "Int32", stage)

    def _state(
        self,
        now: int,
        belief: Belief | None,
        estimate: FloatArray | None,
        true_state: FloatArray | None,
        *,
        last: bool = False,
    ) -> None:
        self._belief(now, belief)
        frames: dict[str, FloatArray] = {}
        if belief is not None and estimate is not None:
            self._array(now, "/holdfast/state_estimate", estimate, "; ".join(self._labels))
            if self._layout is not None:
                pose = frames[ESTIMATE_FRAME] = self._layout.poses(estimate)
                covariance = self._layout.covariance(belief).reshape(-1)
                self._write(
                    now,
                    "/holdfast/estimate",
                    "geometry_msgs/msg/PoseWithCovarianceStamped",
                    header=_header(now),
                    pose=(self._pose(pose), covariance),
                )
        if true_state is not None:
            self._array(now, "/holdfast/true_state", true_state, "; ".join(self._labels))
            if self._layout is not None:
                pose = frames[TRUTH_FRAME] = self._layout.poses(true_state)
                self._write(
                    now,
                    "/holdfast/truth",
                    "geometry_msgs/msg/PoseStamped",
                    header=_header(now),
                    pose=self._pose(pose),
                )
        if frames:
            self._transform(now, "/tf", TASK_FRAME, frames)
        for topic, frame in (("path", ESTIMATE_FRAME), ("true_path", TRUTH_FRAME)):
            if frame in frames:
                self._extend_path(now, f"/holdfast/{topic}", frames[frame], last=last)

    def _belief(self, now: int, belief: Belief | None) -> None:
        if belief is None or belief is self._belief_written:
            return
        self._belief_written = belief
        table = np.column_stack([belief.states, belief.weights])
        self._array(now, "/holdfast/belief", table, "; ".join([*self._labels, "weight"]))
        if self._layout is not None:
            self._write(
                now,
                "/holdfast/particle_cloud",
                "geometry_msgs/msg/PoseArray",
                header=_header(now),
                poses=self._poses(self._layout.poses(belief.states)),
            )

    def _extend_path(self, now: int, topic: str, pose: FloatArray, *, last: bool) -> None:
        path = self._paths.setdefault(topic, GrowingPath())
        stamped = (_header(now), self._pose(pose))
        if path.add(self._message("geometry_msgs/msg/PoseStamped", stamped), last=last):
            self._write(now, topic, "nav_msgs/msg/Path", header=_header(now), poses=path.places)

    def _transform(
        self, now: int, topic: str, parent: str, children: Mapping[str, FloatArray]
    ) -> None:
        transforms = [
            (_header(now, parent), child, (pose[:3], pose[3:])) for child, pose in children.items()
        ]
        self._write(now, topic, "tf2_msgs/msg/TFMessage", transforms=transforms)

    def _markers(
        self, now: int, topic: str, markers: Sequence[Marker], *, anew: bool = False
    ) -> None:
        gone = Marker(kind="DELETEALL", frame=TASK_FRAME, namespace="")
        numbers: dict[str, int] = {}
        made = []
        for marker in [gone, *markers] if anew else markers:
            number = numbers[marker.namespace] = numbers.get(marker.namespace, -1) + 1
            made.append(self._marker(now, marker, number))
        self._write(now, topic, "visualization_msgs/msg/MarkerArray", markers=made)

    def _marker(self, now: int, marker: Marker, number: int) -> dict[str, Any]:
        kind = self._types["visualization_msgs/msg/Marker"]
        is_end = marker.kind == "DELETEALL"
        return {
            # Time 0: wherever the frame is now.
            "header": _header(0 if marker.moves_with_frame else now, marker.frame),
            "ns": marker.namespace,
            "id": number,
            "type": 0 if is_end else getattr(kind, marker.kind),
            "action": kind.DELETEALL if is_end else kind.ADD,
            "pose": self._pose(np.asarray(marker.pose)),
            "scale": marker.scale,
            "color": marker.color,
            "frame_locked": marker.moves_with_frame,
            "points": marker.points,
            "text": marker.text,
        }

    def _diagnose(
        self,
        now: int,
        state: PlanningState,
        kind: str,
        decider: Timing | None,
        facts: Mapping[str, Any],
    ) -> None:
        status = "decided" if decider is None else decider.status
        entries: dict[str, Any] = {"trial": state.trial, "step": state.step, **facts}
        entries |= shown_decider(decider)
        level, message = 0, status
        if decider is not None and decider.status == Status.LOCAL_RECOVERY.value:
            level = 1
        if not facts.get("explained", True):
            level, message = 1, f"{status}; no particle explains the observation"
        values = [(key, str(entry)) for key, entry in entries.items() if entry is not None]
        service = "" if decider is None else decider.service
        self._write(
            now,
            "/diagnostics",
            "diagnostic_msgs/msg/DiagnosticArray",
            header=_header(now, ""),
            status=[(level, f"holdfast: {kind} decision", message, service, values)],
        )

    def _log(self, now: int, level: str, text: str, name: str = "robot") -> None:
        self._write(
            now,
            "/rosout",
            "rcl_interfaces/msg/Log",
            stamp=divmod(now, _NS_PER_S),
            level=_LEVELS[level],
            name=f"holdfast.{name}",
            msg=text,
        )

    def _number(self, now: int, topic: str, kind: str, value: float) -> None:
        self._write(now, topic, f"std_msgs/msg/{kind}", data=value)

    def _array(self, now: int, topic: str, values: FloatArray, columns: str) -> None:
        """Write numbers; of a table the rows are particles."""
        width = values.shape[-1]
        dimensions = [(columns, width, width)]
        if values.ndim == 2:
            dimensions.insert(0, ("particle", len(values), values.size))
        data = np.ascontiguousarray(values, dtype=np.float64).reshape(-1)
        self._write(now, topic, "std_msgs/msg/Float64MultiArray",
                    layout={"dim": dimensions}, data=data)  # fmt: skip

    def _poses(self, poses: FloatArray) -> list[Any]:
        # Of a belief there are many: without the detour of _message.
        pose, point, quaternion = (
            self._types[f"geometry_msgs/msg/{name}"] for name in ("Pose", "Point", "Quaternion")
        )
        return [pose(point(x, y, z), quaternion(*turn)) for x, y, z, *turn in poses.tolist()]

    def _pose(self, pose: FloatArray) -> Any:
        return self._poses(pose.reshape(1, 7))[0]

    def _write(self, now: int, topic: str, kind: str, **fields: Any) -> None:
        connection = self._connections.get(topic)
        if connection is None:
            latched = topic in ("/tf_static", "/holdfast/scene")
            connection = self._writer.add_connection(
                topic, kind, typestore=self._store, offered_qos_profiles=[_qos(latched=latched)]
            )
            self._connections[topic] = connection
        message = self._message(kind, fields)
        self._writer.write(connection, now, self._store.serialize_cdr(message, kind))

    def _message(self, kind: str, given: Any) -> Any:
        """Return a message from plain data: its fields by name, or all of them in their order.

        A field without a name there is zero or empty. What is a message already stays.
        """
        if hasattr(given, "__msgtype__"):
            return given
        fields = self._store.fielddefs[kind][1]
        if not isinstance(given, Mapping):
            given = dict(zip((name for name, _ in fields), given, strict=True))
        values = {name: self._field(form, given.get(name)) for name, form in fields}
        return self._types[kind](**values)

    def _field(self, form: Any, value: Any) -> Any:
        from rosbags.interfaces import Nodetype

        node, detail = form
        if node is Nodetype.NAME:
            return self._message(detail, {} if value is None else value)
        if node is Nodetype.BASE:
            return ("" if detail[0] == "string" else 0) if value is None else value
        (node, detail), _ = detail
        if node is Nodetype.NAME:
            return [self._message(detail, each) for each in value or ()]
        return np.zeros(0, dtype=detail[0]) if value is None else value


def _header(now: int, frame: str = TASK_FRAME) -> dict[str, Any]:
    return {"stamp": divmod(now, _NS_PER_S), "frame_id": frame}


def _qos(*, latched: bool) -> Any:
    from rosbags import interfaces as ros

    for_ever = ros.QosTime(9223372036, 854775807)
    return ros.Qos(
        history=ros.QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=ros.QosReliability.RELIABLE,
        durability=ros.QosDurability.TRANSIENT_LOCAL if latched else ros.QosDurability.VOLATILE,
        deadline=for_ever,
        lifespan=for_ever,
        liveliness=ros.QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=for_ever,
        avoid_ros_namespace_conventions=False,
    )
