"""A robot behind ROS 2, which offers ``robot/sense``, ``robot/act`` and ``robot/trial``.

Their types are those of ``holdfast_interfaces``: ``srv/Sense``, ``action/Act`` (or ``srv/Act``) and
``srv/Trial``. A robot that has services and topics of other types is a Python class instead
(``examples/ros2/topic_robot.py``). This module makes the calls, from a thread that is not the
executor's. Every wait has a deadline, and ends early when it is cancelled or the service has
vanished. What the robot has answered is checked by
:mod:`holdfast.robot.environment_runner`, as for any environment.

An action is called as the three services that it is made of: send the goal, get the result, cancel.
So the goal's identifier is chosen here, and a goal can be cancelled before the robot accepts it.

An unanswered request may have been carried out. So a task action is never sent twice: the call
fails, and after a resume the robot's own count (``steps`` of ``robot/trial``) says whether it was
performed. The other requests are repeated when another server appears during the call.
"""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable
from typing import Any, NoReturn

import holdfast_interfaces.action
import holdfast_interfaces.srv
import numpy as np

from holdfast.errors import EnvironmentFailedError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import Done, Ending
from holdfast_ros.deadlines import Absence, Deadline
from holdfast_ros.ros2_connections import CallClients, Connections, RobotCall

__all__ = ["Ros2Environment"]

_Act = holdfast_interfaces.action.Act
_ActService = holdfast_interfaces.srv.Act
_Sense = holdfast_interfaces.srv.Sense
_Trial = holdfast_interfaces.srv.Trial

_PART = 0.45
"""Share of ``environment.timeout_ms``, for a task action and for asking whether it was the last."""

_LOOK_S = 0.2
"""Interval at which a wait checks that the service is still there."""

_CANCEL_S = 1.0
"""Longest wait for the answer to a cancellation."""

_GOAL_ENDED = {4: "succeeded", 5: "was cancelled", 6: "was aborted"}
"""``action_msgs/msg/GoalStatus`` of ended goals."""


class Ros2Environment:
    """A trial of a robot that is reached through ROS.

    The robot is brought to its start unless the trial is ``resumed``, because the robot's process
    has died in the midst of it. ``act`` says what ``robot/act`` is: ``action`` or ``service``.

    Raises EnvironmentFailedError if a service is missing for ``environment.discovery_timeout_ms``,
    or the robot cannot begin the trial.
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
        self._connections = connections
        self._node = connections.node
        self._trial = trial
        self._step = 0
        self._timeout_s = 1e-3 * _PART * timeout_ms
        self._discovery_timeout_s = 1e-3 * discovery_timeout_ms
        # Guards the waits alone: an answer, or a cancellation, notifies.
        self._news = threading.Condition()
        self._cancelled: str | None = None
        connections.add_user(self)
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
        """Perform a sensing action and return the observation.

        Raises EnvironmentFailedError if the robot does not answer in time, or refuses.
        """
        request = _Sense.Request(trial=self._trial, step=self._step, sensing_action=sensing_action)
        return np.array(self._call(self._sense_call, request).observation)

    def perform(self, task_action: FloatArray) -> float | None:
        """Perform a task action and return its reward.

        Raises EnvironmentFailedError if the robot rejects it, fails, or does not answer in time. It
        may have moved.
        """
        call = self._act_call
        request = call.type.Goal() if call.is_action else call.type.Request()
        request.trial, request.step = self._trial, self._step
        request.task_action = [float(value) for value in task_action]
        reward = float(self._call(call, request).reward)
        self._step += 1
        return None if np.isnan(reward) else reward

    def is_done(self) -> Done:
        """Return whether the task is done; a failure has the robot's message as its reason.

        Raises EnvironmentFailedError if the robot does not answer in time.
        """
        answer = self._ask()
        return Ending("failed", answer.message) if answer.failed else bool(answer.done)

    def steps_performed(self) -> int:
        """Return how many task actions have been performed in this trial.

        Raises EnvironmentFailedError if the robot does not answer in time.
        """
        return int(self._ask().steps)

    def cancel(self, why: str = "cancelled") -> None:
        """End the current call, from any thread; an action's goal is cancelled at the robot.

        The call raises, as do all later ones. An interrupted task action may have been performed;
        the robot's count says so.
        """
        with self._news:
            self._cancelled = self._cancelled or why
            self._news.notify_all()

    def close(self) -> None:
        """Leave the robot where it is."""
        self.cancel("closed")

    def _ask(self, *, begin: bool = False) -> Any:
        return self._call(self._trial_call, _Trial.Request(trial=self._trial, begin=begin))

    @staticmethod
    def _reason(answer: Any) -> str:
        text = answer.message[:1000]
        return f": {text}" if text else " and does not say why"

    # -- calls and waits -------------------------------------------------------------------------

    def _deadline(self) -> Deadline:
        return Deadline(self._timeout_s, f"{_PART:g} times environment.timeout_ms")

    def _find_servers(self) -> None:
        """Wait until all that the robot has to offer is there."""
        deadline = Deadline(self._discovery_timeout_s, Absence.key)
        for call in (self._sense_call, self._act_call, self._trial_call):
            while not self._connections.clients(call).are_ready():
                if self._wait(deadline, lambda: False, 0.02):
                    self._nobody(call, deadline.waited_s(), deadline.key)

    @staticmethod
    def _nobody(call: RobotCall, waited_s: float, key: str) -> NoReturn:
        raise EnvironmentFailedError(f"nobody offers {call}; waited {waited_s:.3g} s ({key})")

    def _call(self, call: RobotCall, request: Any) -> Any:
        """Return the answer to a request, or the result of a goal, if it says that it succeeded."""
        clients = self._connections.clients(call)
        deadline = self._deadline()
        absent = Absence(clients.are_ready, self._discovery_timeout_s)
        if call.is_action:
            answer = self._result(call, clients, request, deadline, absent)
        else:
            answer = self._answer(call, clients.main, request, deadline, absent, "an answer")
        if not answer.success:
            raise EnvironmentFailedError(f"{call} failed{self._reason(answer)}")
        return answer

    def _result(
        self,
        call: RobotCall,
        clients: CallClients,
        request: Any,
        deadline: Deadline,
        absent: Absence,
    ) -> Any:
        goal = call.type.Impl.SendGoalService.Request()
        goal.goal_id.uuid = np.frombuffer(uuid.uuid4().bytes, dtype=np.uint8)
        goal.goal = request
        try:
            what = "whether the goal is accepted"
            if not self._answer(call, clients.main, goal, deadline, absent, what).accepted:
                raise EnvironmentFailedError(f"{call} rejected the goal")
            wanted = call.type.Impl.GetResultService.Request()
            wanted.goal_id = goal.goal_id
            ended = self._answer(call, clients.result, wanted, deadline, absent, "the result")
        except _UnansweredError as error:
            raise EnvironmentFailedError(
                f"{error}; {self._cancel_goal(call, clients, goal.goal_id)}"
            ) from None
        if _GOAL_ENDED.get(ended.status) != "succeeded":
            ending = _GOAL_ENDED.get(ended.status, f"ended with status {ended.status}")
            raise EnvironmentFailedError(f"{call}: the goal {ending}{self._reason(ended.result)}")
        return ended.result

    def _answer(
        self,
        call: RobotCall,
        client: Any,
        request: Any,
        deadline: Deadline,
        absent: Absence,
        what: str,
    ) -> Any:
        if self._cancelled:
            raise EnvironmentFailedError(f"{call} was not called: {self._cancelled}")
        while not client.service_is_ready():
            # It may be restarting. Nothing has been sent yet.
            if absent.is_over() or self._wait(deadline, client.service_is_ready, _LOOK_S):
                if self._cancelled:
                    raise _UnansweredError(f"{call} was not called: {self._cancelled}")
                self._nobody(call, deadline.waited_s(), absent.key)
        futures: list[Any] = []

        def answered() -> bool:
            return any(future.done() for future in futures)

        known = -1
        try:
            while not answered():
                servers = self._node.count_services(client.service_name)
                if not futures or (servers != known and call.may_repeat):
                    # ROS believes for seconds that a killed robot is there. What was sent meanwhile
                    # never reaches its successor.
                    futures.append(self._sent(call, client, request))
                    futures[-1].add_done_callback(self._notify)
                    known = servers
                if absent.is_over():
                    raise _UnansweredError(
                        f"{call} has vanished while {what} was waited for; nobody has offered it "
                        f"for {absent.limit_s:g} s ({absent.key})"
                    )
                if self._wait(deadline, answered, _LOOK_S):
                    if self._cancelled:
                        raise _UnansweredError(
                            f"{call}: {self._cancelled} while {what} was waited for"
                        )
                    raise _UnansweredError(
                        f"{call} has not said {what} within {deadline.limit_s:g} s ({deadline.key})"
                    )
        finally:
            for future in futures:
                client.remove_pending_request(future)
        return next(future.result() for future in futures if future.done())

    @staticmethod
    def _sent(call: RobotCall, client: Any, request: Any) -> Any:
        try:
            return client.call_async(request)
        except Exception as error:  # rclpy's are many: of ranges, types, and of a node that is gone
            raise EnvironmentFailedError(
                f"{call} could not be called: {type(error).__name__}: {error}"
            ) from error

    def _notify(self, future: Any) -> None:
        del future
        with self._news:
            self._news.notify_all()

    def _wait(self, deadline: Deadline, ready: Callable[[], bool], at_most_s: float) -> bool:
        """Wait a little; return whether the deadline is over or the call was cancelled."""
        with self._news:
            if not self._cancelled and not ready():
                deadline.wait(self._news, at_most_s)
            return self._cancelled is not None or (deadline.is_over() and not ready())

    def _cancel_goal(self, call: RobotCall, clients: CallClients, goal_id: Any) -> str:
        """Cancel a goal at the robot, accepted or not, and describe the result."""
        request = call.type.Impl.CancelGoalService.Request()
        request.goal_info.goal_id = goal_id
        try:
            future = clients.cancel.call_async(request)
        except Exception as error:  # noqa: BLE001 - the node may be on its way down
            return f"it could not be cancelled: {error}"
        future.add_done_callback(self._notify)
        deadline = Deadline(_CANCEL_S, "")
        with self._news:
            while not future.done() and not deadline.is_over():
                deadline.wait(self._news, _LOOK_S)
        clients.cancel.remove_pending_request(future)
        if not future.done():
            return f"the cancellation of the goal was not answered within {_CANCEL_S:g} s"
        accepted = future.result().goals_canceling
        return "the goal is cancelled" if accepted else "there was no goal to cancel"


class _UnansweredError(EnvironmentFailedError):
    """A request was perhaps sent, and its effect is unknown."""
