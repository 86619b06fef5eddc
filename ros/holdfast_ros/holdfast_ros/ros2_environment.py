"""A robot behind ROS 2, which offers ``robot/sense``, ``robot/act`` and ``robot/trial``.

Their types are those of ``holdfast_interfaces``: ``srv/Sense``, ``action/Act`` (or ``srv/Act``) and
``srv/Trial``. This module makes the calls, from a thread that is not the executor's. Every wait has
a deadline, and ends early when it is cancelled or the service has vanished.

An action is called as the three services that it is made of: send the goal, get the result, cancel.
So the goal's identifier is chosen here, and a goal can be cancelled before the robot accepts it.

An unanswered request may have been carried out. So a task action is never sent twice: the call
fails, and after a resume the robot's own count (``steps`` of ``robot/trial``) says whether it was
performed. The other requests are repeated when another server appears during the call.
"""

from __future__ import annotations

import threading
import uuid
from typing import Any

import holdfast_interfaces.action
import holdfast_interfaces.srv
import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from holdfast.errors import EnvironmentFailedError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import Done, Ending
from holdfast_ros.deadlines import Deadline

_Act = holdfast_interfaces.action.Act
_ActService = holdfast_interfaces.srv.Act
_Sense = holdfast_interfaces.srv.Sense
_Trial = holdfast_interfaces.srv.Trial

_PART = 0.45
"""Share of ``environment.timeout_ms``, for a task action and for asking whether it was the last."""

_DISCOVERY = "environment.discovery_timeout_ms"
_FIND_S, _LOOK_S = 0.02, 0.2
"""Intervals at which a wait checks that a service is there: at first, and then still."""

_CANCEL_S = 1.0  # for the answer to a cancellation
_GOAL_ENDED = {4: "succeeded", 5: "was cancelled", 6: "was aborted"}
"""``action_msgs/msg/GoalStatus`` of ended goals."""


class RobotCall:
    """A service or an action of the robot's, by its resolved name, and its clients.

    An action has three: they send the goal, get the result, and cancel.
    """

    def __init__(self, node: Node, group: Any, name: str, type_: Any, *, may_repeat: bool) -> None:
        # ROS itself would not remap an action by one rule, only each of its services.
        self.name = node.resolve_service_name(name)
        self.type = type_
        self.may_repeat = may_repeat
        self.is_action = hasattr(type_, "Goal")
        parts = [(type_, "")]
        if self.is_action:
            parts = [
                (type_.Impl.SendGoalService, "/_action/send_goal"),
                (type_.Impl.GetResultService, "/_action/get_result"),
                (type_.Impl.CancelGoalService, "/_action/cancel_goal"),
            ]
        self.clients = [
            node.create_client(kind, self.name + end, callback_group=group) for kind, end in parts
        ]

    def are_ready(self) -> bool:
        """Return whether all of its servers are there."""
        return all(client.service_is_ready() for client in self.clients)

    def __str__(self) -> str:
        """Return a description for messages."""
        package, kind, *_ = self.type.__module__.split(".")
        word = "action" if self.is_action else "service"
        return f"{word} {self.name} ({package}/{kind}/{self.type.__name__})"


class Connections:
    """A node's clients, kept from trial to trial to save discovery.

    An executor must spin the node in other threads than those that use this.
    """

    def __init__(self, node: Node) -> None:
        self.node = node
        # Answers arrive whatever else the node does in its callbacks.
        self._group = ReentrantCallbackGroup()
        self._calls: dict[Any, RobotCall] = {}
        self.environment: Ros2Environment | None = None
        """The last one that was made."""

    def cancel(self, why: str = "cancelled") -> None:
        """Cancel the environment, from any thread; a later one is not affected."""
        if self.environment is not None:
            self.environment.cancel(why)

    def call(self, name: str, type_: Any, *, may_repeat: bool = True) -> RobotCall:
        """Return a service or an action by its name before remapping."""
        if type_ not in self._calls:
            made = RobotCall(self.node, self._group, name, type_, may_repeat=may_repeat)
            self._calls[type_] = made
        return self._calls[type_]


class Ros2Environment:
    """A trial of a robot that is reached through ROS.

    The robot is brought to its start unless the trial is ``resumed``, because the robot's process
    has died in the midst of it. ``act`` says what ``robot/act`` is: ``action`` or ``service``.

    All methods raise EnvironmentFailedError if a service is missing for
    ``environment.discovery_timeout_ms``, or the robot does not answer in time, rejects what it is
    asked for, or fails. It may have moved then.
    """

    def __init__(
        self,
        connections: Connections,
        *,
        trial: int,
        resumed: bool,
        act: str,
        timeout_ms: float,
        discovery_timeout_ms: float,
    ) -> None:
        self._node = connections.node
        self._trial = trial
        self._step = 0
        self._timeout_s = 1e-3 * _PART * timeout_ms
        self._discovery_timeout_s = 1e-3 * discovery_timeout_ms
        # Guards the waits alone: an answer, or a cancellation, notifies.
        self._news = threading.Condition()
        self._cancelled: str | None = None
        connections.environment = self
        act_type = _ActService if act == "service" else _Act
        self._sense_call = connections.call("robot/sense", _Sense)
        self._act_call = connections.call("robot/act", act_type, may_repeat=False)
        self._trial_call = connections.call("robot/trial", _Trial)
        self._find_servers()
        if not resumed:
            self._ask(begin=True)
        else:
            # A robot that still moves answers when it stands.
            self._step = self.steps_performed()

    # -- what the robot's loop calls -------------------------------------------------------------

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        """Perform a sensing action and return the observation."""
        request = _Sense.Request(trial=self._trial, step=self._step, sensing_action=sensing_action)
        return np.array(self._call(self._sense_call, request).observation)

    def perform(self, task_action: FloatArray) -> float | None:
        """Perform a task action and return its reward."""
        call = self._act_call
        request = call.type.Goal() if call.is_action else call.type.Request()
        request.trial, request.step = self._trial, self._step
        request.task_action = [float(value) for value in task_action]
        reward = float(self._call(call, request).reward)
        self._step += 1
        return None if np.isnan(reward) else reward

    def is_done(self) -> Done:
        """Return whether the task is done; a failure has the robot's message as its reason."""
        answer = self._ask()
        return Ending("failed", answer.message) if answer.failed else bool(answer.done)

    def steps_performed(self) -> int:
        """Return how many task actions have been performed in this trial."""
        return int(self._ask().steps)

    def cancel(self, why: str = "cancelled") -> None:
        """End the current call, and all later ones, from any thread; an action's goal is cancelled.

        An interrupted task action may have been performed; the robot's count says so.
        """
        with self._news:
            self._cancelled = self._cancelled or why
            self._news.notify_all()

    def close(self) -> None:
        """Leave the robot where it is."""
        self.cancel("closed")

    def _ask(self, *, begin: bool = False) -> Any:
        return self._call(self._trial_call, _Trial.Request(trial=self._trial, begin=begin))

    # -- calls and waits -------------------------------------------------------------------------

    def _find_servers(self) -> None:
        """Wait until all that the robot has to offer is there."""
        deadline = Deadline(self._discovery_timeout_s, _DISCOVERY)
        for call in (self._sense_call, self._act_call, self._trial_call):
            while not call.are_ready():
                if deadline.is_over() or self._cancelled:
                    raise _missing(call, deadline)
                with self._news:
                    deadline.wait(self._news, _FIND_S)

    def _call(self, call: RobotCall, request: Any) -> Any:
        """Return the answer to a request, or the result of a goal, if it says that it succeeded."""
        if self._cancelled:
            raise EnvironmentFailedError(f"{call} was not called: {self._cancelled}")
        limits = (
            Deadline(self._timeout_s, f"{_PART:g} times environment.timeout_ms"),
            Deadline(self._discovery_timeout_s, _DISCOVERY),
        )
        if call.is_action:
            answer = self._result(call, request, *limits)
        else:
            answer = self._answer(call, call.clients[0], request, *limits, "an answer")
        if not answer.success:
            raise EnvironmentFailedError(f"{call} failed{_reason(answer)}")
        return answer

    def _result(self, call: RobotCall, request: Any, deadline: Deadline, absence: Deadline) -> Any:
        sending, getting, _ = call.clients
        goal = call.type.Impl.SendGoalService.Request(goal=request)
        goal.goal_id.uuid = np.frombuffer(uuid.uuid4().bytes, dtype=np.uint8)
        wanted = call.type.Impl.GetResultService.Request(goal_id=goal.goal_id)
        limits = deadline, absence
        try:
            what = "whether the goal is accepted"
            if not self._answer(call, sending, goal, *limits, what).accepted:
                raise EnvironmentFailedError(f"{call} rejected the goal")
            ended = self._answer(call, getting, wanted, *limits, "the result")
        except _UnansweredError as error:
            ending = self._cancel_goal(call, goal.goal_id)
            raise EnvironmentFailedError(f"{error}; {ending}") from None
        if _GOAL_ENDED.get(ended.status) != "succeeded":
            ending = _GOAL_ENDED.get(ended.status, f"ended with status {ended.status}")
            raise EnvironmentFailedError(f"{call}: the goal {ending}{_reason(ended.result)}")
        return ended.result

    def _answer(
        self,
        call: RobotCall,
        client: Any,
        request: Any,
        deadline: Deadline,
        absence: Deadline,
        what: str,
    ) -> Any:
        """Return the answer to a request; ``absence`` bounds the time without a server."""
        futures: list[Any] = []

        def answered() -> bool:
            return any(future.done() for future in futures)

        known = -1
        try:
            while not answered():
                servers = self._node.count_services(client.service_name)
                if not futures:
                    may_send = client.service_is_ready()
                else:
                    # ROS believes for seconds that a killed robot is there. What was sent meanwhile
                    # never reaches its successor.
                    may_send = servers != known and call.may_repeat
                if may_send:
                    futures.append(self._sent(call, client, request))
                    known = servers
                with self._news:
                    is_due = self._cancelled or answered()
                    waited = 0.0 if is_due else deadline.wait(self._news, _LOOK_S)
                absence.waited_s = 0.0 if call.are_ready() else absence.waited_s + waited
                if not answered():
                    self._require_time(call, absence, deadline, what if futures else "")
        finally:
            for future in futures:
                client.remove_pending_request(future)
        return next(future.result() for future in futures if future.done())

    def _require_time(
        self, call: RobotCall, absence: Deadline, deadline: Deadline, what: str
    ) -> None:
        """Raise an error if there is no time left; ``what`` is awaited, if the request was sent."""
        over = absence if absence.is_over() else deadline
        if self._cancelled:
            raise _UnansweredError(f"{call}: {self._cancelled} while {what or 'it'} was waited for")
        if not over.is_over():
            return
        if not what:
            raise _missing(call, over)
        limit = f"{over.limit_s:g} s ({over.key})"
        if over is absence:
            missing = f"nobody has offered it for {limit}"
            raise _UnansweredError(f"{call} has vanished while {what} was waited for; {missing}")
        raise _UnansweredError(f"{call} has not said {what} within {limit}")

    def _sent(self, call: RobotCall, client: Any, request: Any) -> Any:
        try:
            future = client.call_async(request)
        except Exception as error:  # rclpy's are many: of ranges, types, and of a node that is gone
            raise EnvironmentFailedError(
                f"{call} could not be called: {type(error).__name__}: {error}"
            ) from error
        future.add_done_callback(self._notify)
        return future

    def _notify(self, future: Any) -> None:
        del future
        with self._news:
            self._news.notify_all()

    def _cancel_goal(self, call: RobotCall, goal_id: Any) -> str:
        """Cancel a goal at the robot, accepted or not, and describe the result."""
        request = call.type.Impl.CancelGoalService.Request()
        request.goal_info.goal_id = goal_id
        client = call.clients[2]
        try:
            future = self._sent(call, client, request)
        except EnvironmentFailedError as error:  # the node may be on its way down
            return f"it could not be cancelled: {error}"
        deadline = Deadline(_CANCEL_S, "")
        with self._news:
            while not future.done() and not deadline.is_over():
                deadline.wait(self._news, _LOOK_S)
        client.remove_pending_request(future)
        if not future.done():
            return f"the cancellation of the goal was not answered within {_CANCEL_S:g} s"
        accepted = future.result().goals_canceling
        return "the goal is cancelled" if accepted else "there was no goal to cancel"


def _reason(answer: Any) -> str:
    text = answer.message[:1000]
    return f": {text}" if text else " and does not say why"


def _missing(call: RobotCall, over: Deadline) -> EnvironmentFailedError:
    waited = f"waited {over.waited_s:.3g} s ({over.key})"
    return EnvironmentFailedError(f"nobody offers {call}; {waited}")


class _UnansweredError(EnvironmentFailedError):
    """A request was perhaps sent, and its effect is unknown."""
