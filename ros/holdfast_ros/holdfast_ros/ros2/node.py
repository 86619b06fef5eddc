"""The lifecycle node: parameters in, a run on its own thread, and topics, services and actions.

It reads the parameters when it is configured. While it is active, a goal of ``~/run`` or a call of
``~/decide`` starts a segment of the run: the same robot process as in ``holdfast run``.
Deactivating the node pauses the segment; the next one continues the run.

Threads: rclpy's executor calls the node's methods on several threads. The robot's loop, the
environment and the telemetry have one thread each. Callbacks wait for the robot only with a
deadline, except the running goal's, which keeps one thread of the executor.
"""

from __future__ import annotations

import contextlib
import platform
import threading
import time
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import holdfast_interfaces.action
import holdfast_interfaces.srv
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseArray
from holdfast_interfaces.msg import Decision
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.logging import get_logger
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64MultiArray, String

from holdfast.errors import HoldfastError
from holdfast.planning.planner import PlanningState
from holdfast.problems.attributes import sensing_labels
from holdfast.protocol.robot_events import Act, Sense
from holdfast.reports.poses import PoseLayout, pose_layout
from holdfast.robot.links import check_services
from holdfast.robot.recomputing import resume_run_if_begun
from holdfast.runtime.log_lines import fields_as_text
from holdfast_ros.executive import DecideCode, DecideRequest
from holdfast_ros.ros2 import messages
from holdfast_ros.ros2.bond import Bond
from holdfast_ros.ros2.diagnostics import Diagnostics
from holdfast_ros.ros2.parameters import (
    OWN_DEFAULTS,
    NodeParameters,
    in_force,
    in_parameters,
    known_parameters,
    read_parameters,
    refusal_of_name,
)
from holdfast_ros.ros2.run_segment import Ending, RunSegment, SegmentResult, make_world
from holdfast_ros.ros2.telemetry import PublishedDecision, Telemetry
from holdfast_ros.ros2_environment import Connections

_Run = holdfast_interfaces.action.Run
_Decide = holdfast_interfaces.srv.Decide

_MOST_CALLS = 3  # of ~/decide may wait at once
NUM_THREADS = 4 + _MOST_CALLS
"""A goal and the calls may keep theirs for a while; the rest is always free."""

_DONE: Mapping[int, Any] = {0: False, 1: True, 2: "failed"}
"""Values of a call's ``done``; any other number is refused."""

_DIAGNOSTICS_S = 1.0
_RESULT_S = 0.5  # at the end of the process, for the client of the goal to get its result
_WARNINGS = {"holding", "lost", "sensor_suspect", "wrong_answer"}
_LOGGED = _WARNINGS | {"status", "resumed", "reinitialised", "stopped"}
_TOLD_AT_ONCE = _LOGGED | {"trial", "launch_failed", "recovery_exited", "unexplained"}
_TOLD_AT_ONCE |= {"service_vanished", "service_appeared"}
"""Events that change the diagnostics."""


class HoldfastNode(LifecycleNode):  # type: ignore[misc]
    """The robot's part of active sensing."""

    SUCCESS = TransitionCallbackReturn.SUCCESS

    _parameters_read: NodeParameters | None
    _last_result: SegmentResult | None
    _telemetry: Telemetry | None
    _diagnostics: Diagnostics | None

    def __init__(self, name: str = "holdfast") -> None:
        super().__init__(
            name,
            allow_undeclared_parameters=True,
            automatically_declare_parameters_from_overrides=True,
        )
        self._declare()
        self._shown: dict[str, Any] = {}
        self._robot = Connections(self)
        # Guards the fields below.
        self._changed = threading.RLock()
        self._layout: PoseLayout | None = None
        self._active = False
        self._segment: RunSegment | None = None
        self._goal: Any = None
        self._forget()
        self._calls = threading.BoundedSemaphore(_MOST_CALLS)
        self._goals_ended = threading.Event()
        self._goals_ended.set()

        best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        publish = self.create_lifecycle_publisher
        self._cloud_publisher = publish(PoseArray, "~/particle_cloud", best_effort)
        self._belief_publisher = publish(Float64MultiArray, "~/belief", best_effort)
        self._decision_publisher = publish(Decision, "~/decision", 100)
        self._status_publisher = publish(String, "~/status", 10)
        self._diagnostics_publisher = publish(DiagnosticArray, "/diagnostics", 10)
        self._frame_publisher = None
        with contextlib.suppress(ImportError):  # in every ROS but that of the wheels
            from tf2_msgs.msg import TFMessage

            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._frame_publisher = publish(TFMessage, "/tf_static", latched)
        self._bond = Bond(self)
        group = ReentrantCallbackGroup()
        self.create_service(_Decide, "~/decide", self._decide, callback_group=group)
        self._run_server = ActionServer(
            *(self, _Run, "~/run", self._execute),
            callback_group=group,
            goal_callback=self._judge_goal,
            cancel_callback=self._cancel,
        )
        # Simulated time may stand still; the diagnostics are to come all the same.
        clock, alone = Clock(clock_type=ClockType.STEADY_TIME), MutuallyExclusiveCallbackGroup()
        self.create_timer(_DIAGNOSTICS_S, self._tell_diagnostics, alone, clock)
        self.add_on_set_parameters_callback(self._judge_parameters)

    def _log(self, text: str, level: str) -> None:
        # A logger of rclpy's lets a place in the code have one level for ever.
        getattr(get_logger(self.get_logger().name), level)(text)

    # -- parameters ------------------------------------------------------------------------------

    def _declare(self) -> None:
        for name, text in known_parameters().items():
            descriptor = ParameterDescriptor(description=text, dynamic_typing=True)
            if self.has_parameter(name):
                self.set_descriptor(name, descriptor)
            else:
                # An empty list has no type in ROS.
                default = OWN_DEFAULTS.get(name)
                self.declare_parameter(name, None if default == [] else default, descriptor)

    def _judge_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for each in parameters:
            if refusal := refusal_of_name(each.name):
                return SetParametersResult(successful=False, reason=refusal)
        known = known_parameters()
        ours = [each.name for each in parameters if each.name in known or "." in each.name]
        if self._parameters_read is None or not ours:
            return SetParametersResult(successful=True)
        reason = f"{ours[0]} is read-only once the node is configured: clean it up first"
        return SetParametersResult(successful=False, reason=reason)

    def _values(self) -> Mapping[str, Any]:
        """Return what was given: not what the node itself has shown, and nobody has changed."""
        parameters = self.get_parameters_by_prefix("").items()
        values = {name: _plain(parameter.value) for name, parameter in parameters}
        return {name: value for name, value in values.items() if self._shown.get(name) != value}

    def _show_in_force(self, read: NodeParameters, given: Mapping[str, Any]) -> None:
        """Set the parameters that were not given to the values in force, for ``ros2 param``."""
        values = in_force(read)
        self._shown = {key: value for key, value in values.items() if given.get(key) is None}
        self.set_parameters([Parameter(key, value=value) for key, value in self._shown.items()])

    @property
    def autostart(self) -> bool:
        """Whether the node is to configure and activate itself."""
        return self.get_parameter("autostart").value is True

    def how_to_activate(self) -> str:
        """Return the commands that activate the node."""
        set_state = f"ros2 lifecycle set {self.get_fully_qualified_name()}"
        steps = {
            "unconfigured": f"{set_state} configure, then {set_state} activate",
            "inactive": f"{set_state} activate",
            "finalized": "start it again",
        }
        return steps.get(self._state_machine.current_state[1], "wait until it has changed")

    # -- lifecycle -------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, and check all that can be checked before a run."""
        try:
            given = self._values()
            read = read_parameters(given)
            check_services(read.configuration)
            layout = pose_layout(read.configuration.problem)
            make_world(self._robot, read)
            # Whether a run can begin there, or go on.
            resume_run_if_begun(read.run_directory, read.configuration).close()
            self._show_in_force(read, given)
        except Exception as error:  # noqa: BLE001 - rclpy would hide it
            self.get_logger().error(f"not configured: {_in_words(error)}")
            return TransitionCallbackReturn.FAILURE
        self._forget()
        with self._changed:
            self._parameters_read, self._layout = read, layout
            self._diagnostics = Diagnostics(read.configuration.recovery)
        self.get_logger().info(
            f"configured: {read.configuration.problem_name}, "
            f"{read.configuration.simulator.num_trials} trials in {read.run_directory}"
        )
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take goals and calls from now on, and publish."""
        result = super().on_activate(state)
        with self._changed:
            self._active = True
            read, layout = self._parameters_read, self._layout
        if read is not None:
            self._bond.form(read.own.bond_heartbeat_period)
            if self._frame_publisher is not None and layout is not None and read.own.map_frame:
                frames = read.own.map_frame, read.own.frame_id
                message = messages.frame_message(*frames, layout.upright, self._now())
                self._frame_publisher.publish(message)
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Hold the run, if there is one, and publish nothing more."""
        self._hold("the node was deactivated")
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the parameters that were read."""
        self._forget()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Hold the run and forget everything."""
        self._hold("the node was shut down")
        super().on_deactivate(state)
        self._forget()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Go back to the beginning after a defect."""
        self.get_logger().error("a transition has failed; the node is unconfigured again")
        self._hold("a transition of the node has failed")
        super().on_deactivate(state)
        self._forget()
        return TransitionCallbackReturn.SUCCESS

    def _hold(self, why: str) -> None:
        """End what runs, so that it can go on later, and let nothing begin."""
        self._bond.break_up()
        with self._changed:
            self._active = False
            segment, telemetry = self._segment, self._telemetry
        if segment is not None:
            within_s = self._pause(segment, why)
            # It ends itself within the time that it was given; the rest is for a slow disk.
            if not segment.ended.wait(within_s + 10.0):
                self.get_logger().error("the run has not ended; its journal has everything")
        if telemetry is not None:
            telemetry.close()

    def _pause(self, segment: RunSegment, why: str) -> float:
        """Pause a segment; return the time that it was given, in seconds."""
        read = self._parameters_read
        within_s = 0.0 if read is None else read.own.pause_timeout_s
        segment.pause(why, within_s)
        return within_s

    def _forget(self) -> None:
        with self._changed:
            self._parameters_read = self._last_result = None
            self._telemetry = self._diagnostics = None

    def end(self) -> bool:
        """End in order, in any state, when the process is asked to; return whether the run has."""
        is_asked = not self._goals_ended.is_set()
        if self._state_machine.current_state[1] in ("unconfigured", "inactive", "active"):
            self.trigger_shutdown()
        if is_asked and self._goals_ended.wait(_RESULT_S):
            # rclpy sends the result some turns of the executor later, and does not say when.
            time.sleep(_RESULT_S)
        return self._segment is None

    # -- runs ------------------------------------------------------------------------------------

    def _begin_segment(self, read: NodeParameters) -> RunSegment:
        """Start the next part of the run; the caller holds the lock."""
        diagnostics, world = self._diagnostics, make_world(self._robot, read)
        assert diagnostics is not None
        telemetry = Telemetry(
            read.configuration,
            self._show_order,
            self._show_belief,
            self._tell_diagnostics,
            self._tell_failure,
            belief_rate_hz=read.own.belief_rate_hz,
            wants_entropies=self._wants_entropies,
        )

        def event(name: str, /, **fields: object) -> None:
            """Take an event, on the robot's loop."""
            if name in _TOLD_AT_ONCE:
                diagnostics.event(name)
                if name in _LOGGED:
                    words = f"{name.replace('_', ' ')}: {in_parameters(fields_as_text(fields))}"
                    self._log(words, "warning" if name in _WARNINGS else "info")
                telemetry.notice()

        def on_order(state: PlanningState, order: Act | Sense) -> None:
            telemetry.order(state, order, segment.status)

        segment = RunSegment(
            configuration=read.configuration,
            path=read.run_directory,
            world=world,
            rate_hz=read.own.rate_hz or None,
            after_reboot=read.own.after_reboot,
            sink=SimpleNamespace(event=event, close=lambda: None),
            on_order=on_order,
            on_timing=telemetry.time,
            on_end=self._segment_ended,
        )
        self._telemetry, self._segment = telemetry, segment
        segment.start()
        return segment

    def _segment_ended(self, outcome: SegmentResult) -> None:
        with self._changed:
            telemetry, segment = self._telemetry, self._segment
            self._last_result = outcome
        if segment is not None and segment.world.handover is not None:
            finished = outcome.ending == Ending.FINISHED
            code = DecideCode.FINISHED if finished else DecideCode.ENDED
            segment.world.handover.end(code, outcome.message)
        if telemetry is not None:
            telemetry.close()
        level = "info" if outcome.ending in (Ending.FINISHED, Ending.PAUSED) else "error"
        self._log(f"{outcome.ending.name.lower()}: {outcome.message}", level)
        with self._changed:
            self._segment = None
        self._tell_diagnostics()

    def _judge_goal(self, request: Any) -> GoalResponse:
        del request
        if self._active:
            return GoalResponse.ACCEPT
        state, how = self._state_machine.current_state[1], self.how_to_activate()
        reason = f"the node is {state}, and takes goals while it is active: {how}"
        self.get_logger().warning(f"a goal of ~/run was rejected: {reason}")
        return GoalResponse.REJECT

    def _cancel(self, goal: Any) -> CancelResponse:
        with self._changed:
            segment = self._segment if goal == self._goal else None
        if segment is not None:
            self._pause(segment, "the goal was cancelled")
        return CancelResponse.ACCEPT

    def _execute(self, goal: Any) -> Any:
        """Run until it is done, or held; on a thread of the executor."""
        read = self._parameters_read
        refused = _Run.Result(code=_Run.Result.REFUSED, message="the node is not active")
        segment = None
        with self._changed:
            if self._goal is not None:
                refused.message = "another goal is running; cancel it, or wait for its result"
            elif self._active and read is not None:
                try:
                    # One that a call of ~/decide has begun is gone on with.
                    segment = self._segment or self._begin_segment(read)
                    self._goal = goal
                    self._goals_ended.clear()
                except Exception as error:  # noqa: BLE001 - rclpy would call it finished
                    refused = _Run.Result(code=_Run.Result.HELD, message=_in_words(error))
        if segment is None or read is None:
            goal.abort()
            return refused
        try:
            if goal.is_cancel_requested:
                self._pause(segment, "the goal was cancelled")
            segment.ended.wait()
            outcome = segment.outcome
            assert outcome is not None
            if outcome.ending == Ending.FINISHED:
                goal.succeed()
            elif goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
            return _Run.Result(
                code=int(outcome.ending),
                message=outcome.message,
                run_directory=str(read.run_directory),
                trials=[messages.outcome_message(result) for result in outcome.trials],
            )
        finally:
            with self._changed:
                self._goal = None
            self._goals_ended.set()

    # -- ~/decide --------------------------------------------------------------------------------

    def _decide(self, request: Any, response: Any) -> Any:
        if not self._calls.acquire(blocking=False):
            response.code = DecideCode.HOLDING
            response.message = f"{_MOST_CALLS} calls are waiting already; make the same call again"
            return response
        try:
            self._decide_one(request, response)
        except Exception as error:  # noqa: BLE001 - else there is no answer at all
            response.code, response.message = DecideCode.ENDED, _in_words(error)
        finally:
            self._calls.release()
        return response

    def _decide_one(self, request: Any, response: Any) -> None:
        with self._changed:
            read, last = self._parameters_read, self._last_result
            if not self._active or read is None:
                response.code = DecideCode.INACTIVE
                response.message = f"the node is not active: {self.how_to_activate()}"
                return
            if (kind := read.own.environment) != "executive":
                response.code = DecideCode.INACTIVE
                response.message = (
                    f"environment.kind is {kind}: the node itself performs what it decides; it "
                    "must be executive for calls of ~/decide"
                )
                return
            if last is not None and last.ending == Ending.FINISHED:
                response.code, response.message = DecideCode.FINISHED, last.message
                return
            segment = self._segment or self._begin_segment(read)
        assert segment.world.handover is not None
        call = DecideRequest(
            request.trial,
            request.number,
            np.array(request.observation, dtype=np.float64),
            request.reward if request.has_reward else None,
            _DONE.get(request.done, request.done),
        )
        reply = segment.world.handover.call(call, read.own.decide_timeout_s)
        response.code, response.message = reply.code, reply.message
        response.status = segment.status
        due = reply.due
        if due is not None:
            response.trial, response.number, response.step = due.trial, due.number, due.step
            if due.sensing_action is None:
                response.kind = _Decide.Response.ACT
                response.task_action = messages.floats(due.task_action)
            else:
                response.kind = _Decide.Response.SENSE
                response.sensing_action = due.sensing_action
                names = sensing_labels(read.configuration.problem)
                response.sensing_action_name = names[due.sensing_action]

    # -- what others see -------------------------------------------------------------------------

    def _show_order(self, shown: PublishedDecision) -> None:
        read, goal, segment = self._parameters_read, self._goal, self._segment
        if read is None or not self._active:
            return
        place = read.configuration.problem, read.own.frame_id, self._now()
        message = messages.decision_message(shown, *place)
        self._decision_publisher.publish(message)
        if goal is not None:
            finished = 0 if segment is None else segment.num_finished
            goal.publish_feedback(_Run.Feedback(finished=finished, decision=message))

    def _wants_entropies(self) -> bool:
        read = self._parameters_read
        heard = self._goal is not None or self._decision_publisher.get_subscription_count() > 0
        return heard and read is not None and read.own.publish_entropies

    def _tell_failure(self, error: Exception) -> None:
        reason = _in_words(error)
        self.get_logger().warning(f"not all is published of what the robot decides: {reason}")

    def _now(self) -> Any:
        return self.get_clock().now().to_msg()

    def _show_belief(self, state: PlanningState) -> None:
        read, layout = self._parameters_read, self._layout
        if read is None or not self._active:
            return
        if self._belief_publisher.get_subscription_count():
            problem = read.configuration.problem
            self._belief_publisher.publish(messages.belief_message(state.belief, problem))
        if layout is not None and self._cloud_publisher.get_subscription_count():
            poses = layout.poses(state.belief.states)
            cloud = messages.pose_array(poses, read.own.frame_id, self._now())
            self._cloud_publisher.publish(cloud)

    def _tell_diagnostics(self) -> None:
        with self._changed:
            read, segment, telemetry = self._parameters_read, self._segment, self._telemetry
            last, active, diagnostics = self._last_result, self._active, self._diagnostics
        if read is None or diagnostics is None or not active:
            return
        told = diagnostics.tell(segment, last, telemetry)
        facts = told.facts | {"run_directory": str(read.run_directory)}
        status = DiagnosticStatus(
            level=bytes((told.level,)),
            name=f"{self.get_fully_qualified_name()[1:]}: active sensing",
            message=told.word,
            hardware_id=read.configuration.offload.name or platform.node(),
            values=[KeyValue(key=key, value=value) for key, value in facts.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._now()
        self._diagnostics_publisher.publish(message)
        # The status; after the end of the run, how it ended.
        word = told.word if segment is None else told.facts["status"] or told.word
        self._status_publisher.publish(String(data=word))


def _in_words(error: Exception) -> str:
    if isinstance(error, HoldfastError):
        return in_parameters(str(error))
    return f"{type(error).__name__}: {error}"


def _plain(value: Any) -> Any:
    """Return a parameter's value as plain data."""
    return value if value is None or isinstance(value, bool | int | float | str) else list(value)
