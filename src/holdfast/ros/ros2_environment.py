"""The world reached through ROS 2: a robot's own services, actions and topics.

Parameters say what the robot offers and which fields take what; see
:mod:`holdfast.ros.robot_interface`. This module makes the calls. It is used from a thread that is
not the executor's, and waits there for what the executor's threads take off the wire, never without
a deadline. A wait also ends when it is cancelled, and when the service has vanished.

An action is three services: one takes the goal, one gives the result when the motion has ended, one
cancels. They are called as such. So a goal has a name that was chosen here and can be cancelled
before the robot has said that it accepts it.

What was asked and not answered may have been done all the same. A task action is never sent twice:
the call fails, and when the run is resumed the robot's own count (``environment.steps``) says
whether it was performed. Without that count the trial ends there. All else (sensing, ``done``,
``steps``, ``reset``) may be asked for again, and is when another server appears during the call.
"""

from __future__ import annotations

import threading
import time
import uuid
import weakref
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from holdfast import contract
from holdfast.errors import EnvironmentFailedError
from holdfast.outcome import Done
from holdfast.problems.problem import Problem
from holdfast.ros.field_paths import read_field, read_numbers, write
from holdfast.ros.robot_interface import RobotCall, RobotInterface, observation_path
from holdfast.runtime.environment import observation_size

__all__ = [
    "CountingRos2Environment",
    "Ros2Environment",
    "cancel_ros_environments",
    "make_ros_environment",
]

FloatArray = npt.NDArray[np.float64]

_LOOK_S = 0.2
"""How often a wait looks whether the service is still there."""

_SUSPENDED_S = 1.0
"""A wait that wakes so much too late was in a process that was stopped; it gets that time back."""

_CANCEL_S = 1.0
"""How long to wait for the answer to a cancellation."""

_GOAL_ENDED = {4: "succeeded", 5: "was cancelled", 6: "was aborted"}
"""``action_msgs/msg/GoalStatus`` of a goal that has ended."""

_GOAL_ACTIVE = (1, 2, 3)
"""Of one that is accepted, executing or being cancelled."""

_STATUS_S = 1.0
"""How long to wait for what a server says of its goals; it may have had none."""

_MESSAGES_KEPT = 10


def make_ros_environment(
    node: Node,
    parameters: Mapping[str, object],
    problem: Problem,
    seed: int,
    trial: int,
    resumed: bool = False,
) -> Ros2Environment:
    """Make the environment of a trial: a robot that is reached through ROS.

    Parameters
    ----------
    node : rclpy.node.Node
        It must be spun by an executor in other threads. Clients and subscriptions are made in a
        callback group of their own, once for a node, and go with it.
    parameters : mapping of str to object
        See :data:`~holdfast.ros.robot_interface.ROBOT_PARAMETERS`.
    problem : Problem
    seed : int
        Not used: the robot is real.
    trial : int
        Sent where a parameter names a field for it.
    resumed : bool, optional
        Whether the robot's process has died in the middle of this trial. If not, the robot is
        brought to its start (``environment.reset``).

    Returns
    -------
    Ros2Environment
        A :class:`CountingRos2Environment` if the robot tells its count.

    Raises
    ------
    ConfigurationError
        If a parameter cannot be used.
    EnvironmentFailedError
        If somebody who should offer a service is not there within
        ``environment.discovery_timeout_ms``, or the start fails.
    """
    del seed
    interface = RobotInterface(parameters, problem.sensing_actions, problem.action_size)
    made = CountingRos2Environment if "steps" in interface.calls else Ros2Environment
    return made(node, interface, problem, trial, resumed=resumed)


def cancel_ros_environments(node: Node, why: str = "cancelled") -> None:
    """Cancel what the environments of a node are doing; see :meth:`Ros2Environment.cancel`.

    For a node that is deactivated, from any thread. Environments made afterwards are not concerned.

    Parameters
    ----------
    node : rclpy.node.Node
    why : str, optional
        For the message of the error.
    """
    connections = _CONNECTIONS.get(node)
    if connections is not None:
        with _CONNECTIONS_LOCK:
            environments = list(connections.environments)
        for environment in environments:
            environment.cancel(why)


class Ros2Environment:
    """A robot that is reached through ROS.

    Parameters
    ----------
    node : rclpy.node.Node
    interface : RobotInterface
    problem : Problem
    trial : int
    resumed : bool
    """

    def __init__(
        self, node: Node, interface: RobotInterface, problem: Problem, trial: int, *, resumed: bool
    ) -> None:
        self._node = node
        self._interface = interface
        self._problem = problem
        self._trial = trial
        self._step = 0
        self._observation_sizes: dict[int, int | None] = {}
        # Guards nothing but the waits: whoever brings an answer, or cancels, notifies.
        self._news = threading.Condition()
        self._cancelled: str | None = None
        self._connections = _connections(node)
        with _CONNECTIONS_LOCK:
            self._connections.environments.add(self)
        self._clients = {
            role: self._connections.clients(call)
            for role, call in interface.calls.items()
            if call.kind != "msg"
        }
        done = interface.calls.get("done")
        self._done_topic = (
            None
            if done is None or done.kind != "msg"
            else self._connections.topic(done.name, done.type, latched=True)
        )
        topic = interface.observation
        self._observations = (
            None
            if topic is None
            else self._connections.topic(topic.name, topic.type, latched=False)
        )
        self._find_everybody()
        reset = interface.calls.get("reset")
        if reset is not None and not resumed:
            deadline = _Deadline(reset.timeout_s)
            self._check_success(reset, self._call(reset, self._request(reset), deadline))
            self._wait_until_not_done(reset, deadline)
        if resumed and "steps" in interface.calls:
            self._wait_until_it_stands()
            self._step = self._count()

    # -- what the robot's loop calls -------------------------------------------------------------

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        """Perform a sensing action and return what it shows, shape ``(observation_size,)``.

        Raises
        ------
        EnvironmentFailedError
            If the robot does not answer in time, refuses, or shows what cannot be an observation.
        """
        call = self._interface.calls.get("sense")
        topic = self._interface.observation
        begun = self._now()
        deadline = _Deadline(self._interface.timeout_s if call is None else call.timeout_s)
        label = self._problem.sensing_actions[sensing_action]
        answer: Any = None
        if call is not None:
            request = self._request(call)
            self._write(call, request, "index", sensing_action)
            self._write(call, request, "label", label)
            fields = call.paths.get("fields", ())
            for number, path in enumerate(fields):
                value = call.values[sensing_action * len(fields) + number]
                self._put(call, "fields", request, path, value)
            answer = self._call(call, request, deadline)
            self._check_success(call, answer)
        if topic is None:
            assert call is not None
            shown_by, key, texts = str(call), call.key("observation"), call.observation
        else:
            earliest = begun if topic.taken_during else self._now()
            answer = self._observation_message(earliest, deadline)
            shown_by, key = f"topic {topic.name}", "environment.observation.fields"
            texts = topic.fields
        numbers: list[float] = []
        for text in texts:
            path = observation_path(text, sensing_action, label, key)
            with _Named(f"{shown_by}: {key}"):
                numbers += read_numbers(answer, path)
        observation = np.array(numbers)
        size = self._observation_size(sensing_action)
        if not observation.size or size not in (None, observation.size):
            raise EnvironmentFailedError(
                f"{shown_by} showed {observation.size} numbers ({key}) for sensing action "
                f"{sensing_action} ({label}); {self._problem.name} needs {size or 'some'}"
            )
        if not np.isfinite(observation).all():
            raise EnvironmentFailedError(
                f"{shown_by} showed {contract.in_brief(observation)} ({key}) for sensing action "
                f"{sensing_action} ({label}); an observation must be finite"
            )
        return observation

    def perform(self, task_action: FloatArray) -> float | None:
        """Perform a task action and return its reward, or None where there is none.

        Raises
        ------
        EnvironmentFailedError
            If the robot rejects it, fails, or does not answer in time. It may have moved.
        """
        call = self._interface.calls["act"]
        request = self._request(call)
        scale = np.array(call.scale) if len(call.scale) else 1.0
        values = [float(value) for value in np.asarray(task_action) * scale]
        paths = call.paths.get("action", ())
        if len(paths) == 1 and len(values) > 1:
            self._put(call, "action", request, paths[0], values)
        else:
            for path, value in zip(paths, values, strict=True):
                self._put(call, "action", request, path, value)
        answer = self._call(call, request)
        self._check_success(call, answer)
        self._step += 1
        reward_path = call.path("reward")
        if reward_path is None:
            return None
        with _Named(f"{call}: {call.key('reward')}"):
            reward = self._number(read_field(answer, reward_path))
        if np.isinf(reward):
            raise EnvironmentFailedError(
                f"{call} answered with the reward {reward} ({call.key('reward')}); it must be "
                "finite, or NaN where there is none"
            )
        return None if np.isnan(reward) else reward

    def _wait_until_it_stands(self) -> None:
        """Wait for a goal that was sent before this process: the count is right when it has ended.

        Raises
        ------
        EnvironmentFailedError
            If it has not ended within the time for a task action.
        """
        act = self._interface.calls["act"]
        if act.kind != "action":
            return
        status = self._connections.topic(
            f"{act.name}/_action/status", act.type.Impl.GoalStatusMessage, latched=True
        )
        # It is latched, but a server that has had no goal has nothing to say.
        first = _Limit(_Deadline(_STATUS_S), "")
        while not status.messages and not self._wait(first, lambda: False, 0.02):
            pass
        limit = _Limit(_Deadline(act.timeout_s), act.key("timeout_ms"))
        while status.messages and any(
            goal.status in _GOAL_ACTIVE for goal in status.messages[-1].message.status_list
        ):
            if self._wait(limit, lambda: False, 0.02):
                raise EnvironmentFailedError(
                    f"{act} is still busy with a goal of before"
                    + (
                        f": {self._cancelled}"
                        if self._cancelled
                        else f", {limit.deadline.limit_s:g} s later ({limit.key})"
                    )
                )

    def _wait_until_not_done(self, reset: RobotCall, deadline: _Deadline) -> None:
        """Wait until a topic does not tell any more how the last trial ended."""
        limit = _Limit(deadline, reset.key("timeout_ms"))
        while self._done_topic is not None and self.is_done():
            if self._wait(limit, lambda: False, _LOOK_S):
                raise EnvironmentFailedError(
                    f"{self._interface.calls['done']} still says that the task has ended, "
                    f"{deadline.limit_s:g} s after {reset} was called ({limit.key})"
                )

    def is_done(self) -> Done:
        """Tell whether the task is done; False always where the robot does not tell.

        Raises
        ------
        EnvironmentFailedError
            If the robot does not answer in time.
        """
        call = self._interface.calls.get("done")
        if call is None:
            return False
        if self._done_topic is None:
            answer = self._call(call, self._request(call))
            self._check_success(call, answer)
        else:
            answer = self._done_topic.messages[-1].message
        for key, meaning in (("failed", "failed"), ("done", True)):
            path = call.path(key)
            if path is not None:
                with _Named(f"{call}: {call.key(key)}"):
                    value = read_field(answer, path)
                if value not in (0, 1):
                    raise EnvironmentFailedError(
                        f"{call} answered {value!r:.80} ({call.key(key)}); it must be true or false"
                    )
                if value:
                    return meaning  # type: ignore[return-value]
        return False

    def cancel(self, why: str = "cancelled") -> None:
        """End the call that goes on, from any thread; one of an action is cancelled at the robot.

        The call raises, as does every later one. A task action that is cut off may have been
        performed: without ``environment.steps`` nobody can tell, and the trial cannot be resumed.

        Parameters
        ----------
        why : str, optional
            For the message of the error.
        """
        with self._news:
            self._cancelled = self._cancelled or why
            self._news.notify_all()

    def close(self) -> None:
        """Leave the robot where it is."""
        self.cancel("closed")
        with _CONNECTIONS_LOCK:
            self._connections.environments.discard(self)

    def _count(self) -> int:
        call = self._interface.calls["steps"]
        answer = self._call(call, self._request(call))
        self._check_success(call, answer)
        path = call.path("steps")
        assert path is not None
        with _Named(f"{call}: {call.key('steps')}"):
            count = self._number(read_field(answer, path))
        if count != int(count) or count < 0:
            raise EnvironmentFailedError(
                f"{call} answered {count:g} ({call.key('steps')}); a count must be a whole number "
                ">= 0"
            )
        return int(count)

    # -- requests and answers --------------------------------------------------------------------

    def _request(self, call: RobotCall) -> Any:
        request = call.type.Goal() if call.kind == "action" else call.type.Request()
        for path, value in call.constants:
            self._put(call, "constants", request, path, value)
        self._write(call, request, "trial", self._trial)
        self._write(call, request, "step", self._step)
        return request

    def _write(self, call: RobotCall, request: Any, key: str, value: Any) -> None:
        for path in call.paths.get(key, ()):
            self._put(call, key, request, path, value)

    @staticmethod
    def _put(call: RobotCall, key: str, request: Any, path: Any, value: Any) -> None:
        with _Named(f"{call}: {call.key(key)}"):
            write(request, path, value)

    @staticmethod
    def _number(value: object) -> float:
        try:
            return float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            raise EnvironmentFailedError(f"{value!r:.80} is no number") from None

    def _check_success(self, call: RobotCall, answer: Any) -> None:
        path = call.path("success")
        if path is not None and not read_field(answer, path):
            raise EnvironmentFailedError(f"{call} failed{self._reason(call, answer)}")

    @staticmethod
    def _reason(call: RobotCall, answer: Any) -> str:
        path = call.path("message")
        text = "" if path is None else str(read_field(answer, path))[:1000]
        return f": {text}" if text else " and does not say why"

    def _observation_size(self, sensing_action: int) -> int | None:
        if sensing_action not in self._observation_sizes:
            self._observation_sizes[sensing_action] = observation_size(
                self._problem, sensing_action
            )
        return self._observation_sizes[sensing_action]

    def _now(self) -> _Instant:
        return _Instant(self._node.get_clock().now().nanoseconds, time.time_ns())

    # -- calls and waits -------------------------------------------------------------------------

    def _find_everybody(self) -> None:
        """Wait until everybody is there whom the parameters name."""
        calls = self._interface.calls
        deadline = _Deadline(self._interface.discovery_timeout_s)
        limit = _Limit(deadline, "environment.discovery_timeout_ms")
        for role, clients in self._clients.items():
            while not clients.are_ready():
                if self._wait(limit, lambda: False, 0.02):
                    self._nobody(calls[role], limit)
        topic = self._interface.observation
        while topic is not None and not self._node.count_publishers(topic.name):
            if self._wait(limit, lambda: False, 0.02):
                raise EnvironmentFailedError(
                    f"nobody publishes topic {topic.name} (environment.observation.topic); waited "
                    f"{deadline.waited_s():.3g} s ({limit.key})"
                )
        while self._done_topic is not None and not self._done_topic.messages:
            if self._wait(limit, lambda: False, 0.02):
                raise EnvironmentFailedError(
                    f"{calls['done']} has brought no message within {deadline.limit_s:g} s "
                    f"({limit.key}); one that tells a state must be latched (transient local)"
                )

    def _nobody(self, call: RobotCall, limit: _Limit) -> NoReturn:
        raise EnvironmentFailedError(
            f"nobody offers {call} of type {call.type_name}; waited "
            f"{limit.deadline.waited_s():.3g} s ({limit.key})"
        )

    def _call(self, call: RobotCall, request: Any, deadline: _Deadline | None = None) -> Any:
        clients = self._clients[call.role]
        limit = _Limit(deadline or _Deadline(call.timeout_s), call.key("timeout_ms"))
        absent = _Absence(clients, self._interface.discovery_timeout_s)
        if call.kind == "srv":
            return self._answer(call, clients.main, request, limit, absent, "an answer")
        goal = call.type.Impl.SendGoalService.Request()
        goal.goal_id.uuid = np.frombuffer(uuid.uuid4().bytes, dtype=np.uint8)
        goal.goal = request
        try:
            accepted = self._answer(
                call, clients.main, goal, limit, absent, "whether the goal is accepted"
            )
            if not accepted.accepted:
                raise EnvironmentFailedError(f"{call} rejected the goal")
            wanted = call.type.Impl.GetResultService.Request()
            wanted.goal_id = goal.goal_id
            ended = self._answer(call, clients.result, wanted, limit, absent, "the result")
        except _UnansweredError as error:
            raise EnvironmentFailedError(
                f"{error}; {self._cancel_goal(call, clients, goal.goal_id)}"
            ) from None
        if _GOAL_ENDED.get(ended.status) != "succeeded":
            ending = _GOAL_ENDED.get(ended.status, f"ended with status {ended.status}")
            raise EnvironmentFailedError(
                f"{call}: the goal {ending}{self._reason(call, ended.result)}"
            )
        return ended.result

    def _answer(
        self, call: RobotCall, client: Any, request: Any, limit: _Limit, absent: _Absence, what: str
    ) -> Any:
        if self._cancelled:
            raise EnvironmentFailedError(f"{call} was not called: {self._cancelled}")
        while not client.service_is_ready():
            # It may be on its way up again. Nothing has been sent yet.
            if absent.is_over() or self._wait(limit, client.service_is_ready, _LOOK_S):
                if self._cancelled:
                    raise _UnansweredError(f"{call} was not called: {self._cancelled}")
                self._nobody(call, _Limit(limit.deadline, absent.key))
        futures: list[Any] = []

        def answered() -> bool:
            return any(future.done() for future in futures)

        known = -1
        try:
            while not answered():
                servers = self._node.count_services(client.service_name)
                if not futures or (servers != known and call.role != "act"):
                    # A robot that was killed and started again has not got what was sent before it
                    # was found; the dead one is still taken to be there for some seconds.
                    with _Named(f"{call} could not be called"):
                        futures.append(_sent(client, request))
                    futures[-1].add_done_callback(self._notify)
                    known = servers
                if absent.is_over():
                    raise _UnansweredError(
                        f"{call} has vanished while {what} was waited for; nobody has offered it "
                        f"for {absent.limit_s:g} s ({absent.key})"
                    )
                if self._wait(limit, answered, _LOOK_S):
                    if self._cancelled:
                        raise _UnansweredError(
                            f"{call}: {self._cancelled} while {what} was waited for"
                        )
                    raise _UnansweredError(
                        f"{call} has not said {what} within "
                        f"{limit.deadline.limit_s:g} s ({limit.key})"
                    )
        finally:
            for future in futures:
                client.remove_pending_request(future)
        return next(future.result() for future in futures if future.done())

    def _notify(self, future: Any) -> None:
        del future
        with self._news:
            self._news.notify_all()

    def _wait(self, limit: _Limit, ready: Callable[[], bool], at_most_s: float) -> bool:
        """Wait a little for something; tell whether the time is over, or the call cancelled."""
        with self._news:
            if not self._cancelled and not ready():
                limit.deadline.wait(self._news, at_most_s)
            return self._cancelled is not None or (limit.deadline.is_over() and not ready())

    def _cancel_goal(self, call: RobotCall, clients: _Clients, goal_id: Any) -> str:
        """Cancel a goal at the robot, accepted or not, and return what came of it."""
        request = call.type.Impl.CancelGoalService.Request()
        request.goal_info.goal_id = goal_id
        try:
            future = clients.cancel.call_async(request)
        except Exception as error:  # noqa: BLE001 - the node may be on its way down
            return f"it could not be cancelled: {error}"
        future.add_done_callback(self._notify)
        deadline = _Deadline(_CANCEL_S)
        with self._news:
            while not future.done() and not deadline.is_over():
                deadline.wait(self._news, _LOOK_S)
        clients.cancel.remove_pending_request(future)
        if not future.done():
            return f"the cancellation of the goal was not answered within {_CANCEL_S:g} s"
        accepted = future.result().goals_canceling
        return "the goal is cancelled" if accepted else "there was no goal to cancel"

    def _observation_message(self, earliest: _Instant, deadline: _Deadline) -> Any:
        """Wait for a message that was taken at an instant or later."""
        topic, received = self._interface.observation, self._observations
        assert topic is not None and received is not None
        limit = _Limit(
            deadline,
            "environment.sense.timeout_ms"
            if "sense" in self._interface.calls
            else "0.45 times environment.timeout_ms",
        )
        refused, seen = 0, -1
        age_s = 0.0
        received.condition = self._news

        def newer() -> bool:
            return received.number > seen + 1

        while True:
            for item in list(received.messages):
                if item.number > seen:
                    seen = item.number
                    age_ns = item.age_ns(earliest)
                    if age_ns <= 0:
                        return item.message
                    refused, age_s = refused + 1, 1e-9 * age_ns
            if self._wait(limit, newer, _LOOK_S):
                break
        found = f"topic {topic.name} (environment.observation.topic)"
        when = "requested" if topic.taken_during else "answered"
        if self._cancelled:
            raise EnvironmentFailedError(
                f"{found}: {self._cancelled} while a message was waited for"
            )
        raise EnvironmentFailedError(
            f"{found} brought no message of type {topic.type_name} that was taken after the "
            f"sensing action was {when}, within {deadline.limit_s:g} s ({limit.key}); "
            + (
                f"{refused} were older, the last by {age_s:.3g} s (are the clocks the same?)"
                if refused
                else f"none came, and {self._node.count_publishers(topic.name)} publish it"
            )
        )


class CountingRos2Environment(Ros2Environment):
    """A robot that tells how many task actions it has performed, whoever asks and when."""

    def steps_performed(self) -> int:
        """Return how many task actions have been performed in this trial.

        Raises
        ------
        EnvironmentFailedError
            If the robot does not answer in time.
        """
        return self._count()


class _UnansweredError(EnvironmentFailedError):
    """Something was sent, or nearly, and nobody knows what became of it."""


class _Named:
    """Puts a name in front of what is raised."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, EnvironmentFailedError):
            raise EnvironmentFailedError(f"{self._name}: {error}") from None


def _sent(client: Any, request: Any) -> Any:
    try:
        return client.call_async(request)
    except Exception as error:  # rclpy's are many: of ranges, types, and of a node that is gone
        raise EnvironmentFailedError(f"{type(error).__name__}: {error}") from error


class _Deadline:
    """A point in time until which to wait, in parts."""

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._begun = time.monotonic()
        self._end = self._begun + limit_s

    def waited_s(self) -> float:
        return time.monotonic() - self._begun

    def is_over(self) -> bool:
        return time.monotonic() >= self._end

    def wait(self, condition: threading.Condition, at_most_s: float) -> None:
        before = time.monotonic()
        planned = max(0.0, min(at_most_s, self._end - before))
        condition.wait(planned)
        late = time.monotonic() - before - planned
        if late > _SUSPENDED_S:
            self._end += late


class _Limit:
    """A deadline, and the parameter that it comes from."""

    def __init__(self, deadline: _Deadline, key: str) -> None:
        self.deadline = deadline
        self.key = key


class _Absence:
    """Since when nobody has offered a service."""

    key = "environment.discovery_timeout_ms"

    def __init__(self, clients: _Clients, limit_s: float) -> None:
        self._clients = clients
        self.limit_s = limit_s
        self._since: _Deadline | None = None

    def is_over(self) -> bool:
        if self._clients.are_ready():
            self._since = None
        elif self._since is None:
            self._since = _Deadline(self.limit_s)
        return self._since is not None and self._since.is_over()


class _Instant:
    """A moment on the node's clock and on the machine's; they differ in simulated time."""

    def __init__(self, ros_ns: int, system_ns: int) -> None:
        self.ros_ns = ros_ns
        self.system_ns = system_ns


class _Received:
    """A message, and when it was received by the machine's clock."""

    def __init__(self, number: int, message: Any, system_ns: int) -> None:
        self.number = number
        self.message = message
        self._system_ns = system_ns

    def age_ns(self, instant: _Instant) -> int:
        """Return how long before an instant it was taken; not above 0: not before."""
        stamp = getattr(getattr(self.message, "header", None), "stamp", None)
        if stamp is not None and (stamp.sec or stamp.nanosec):
            return instant.ros_ns - (1_000_000_000 * int(stamp.sec) + int(stamp.nanosec))
        return instant.system_ns - self._system_ns


class _Topic:
    """The last messages of a topic."""

    def __init__(self) -> None:
        self.messages: deque[_Received] = deque(maxlen=_MESSAGES_KEPT)
        self.number = 0
        self.condition: threading.Condition | None = None

    def take(self, message: Any, info: Mapping[str, int]) -> None:
        received_ns = int(info.get("received_timestamp") or 0) or time.time_ns()
        self.messages.append(_Received(self.number, message, received_ns))
        self.number += 1
        condition = self.condition
        if condition is not None:
            with condition:
                condition.notify_all()


class _Clients:
    """The clients of one service, or the three of one action."""

    def __init__(self, main: Any, result: Any = None, cancel: Any = None) -> None:
        self.main = main
        self.result = result
        self.cancel = cancel

    def are_ready(self) -> bool:
        return all(
            client.service_is_ready()
            for client in (self.main, self.result, self.cancel)
            if client is not None
        )


class _Connections:
    """What a node has open to robots: kept from trial to trial, so that nobody is sought again."""

    def __init__(self, node: Node) -> None:
        # Of itself: the node must go when nobody else holds it.
        self._node = weakref.ref(node)
        # Whatever else the node is doing in its callbacks, answers come through.
        self._group = ReentrantCallbackGroup()
        self._clients: dict[tuple[str, str], _Clients] = {}
        self._topics: dict[tuple[str, str], _Topic] = {}
        self.environments: weakref.WeakSet[Ros2Environment] = weakref.WeakSet()

    def clients(self, call: RobotCall) -> _Clients:
        key = (call.name, call.type_name)
        if key not in self._clients:
            if call.kind == "srv":
                self._clients[key] = _Clients(self._client(call.type, call.name))
            else:
                parts = call.type.Impl
                self._clients[key] = _Clients(
                    self._client(parts.SendGoalService, f"{call.name}/_action/send_goal"),
                    self._client(parts.GetResultService, f"{call.name}/_action/get_result"),
                    self._client(parts.CancelGoalService, f"{call.name}/_action/cancel_goal"),
                )
        return self._clients[key]

    def topic(self, name: str, message_type: Any, *, latched: bool) -> _Topic:
        key = (name, f"{message_type.__module__}.{message_type.__name__}")
        if key not in self._topics:
            topic = _Topic()
            # Without reliability whoever publishes is heard, with it too; a message that is lost
            # is followed by the next one. A state that is latched must not be lost.
            quality = (
                QoSProfile(
                    depth=1,
                    reliability=ReliabilityPolicy.RELIABLE,
                    durability=DurabilityPolicy.TRANSIENT_LOCAL,
                )
                if latched
                else QoSProfile(depth=_MESSAGES_KEPT, reliability=ReliabilityPolicy.BEST_EFFORT)
            )

            def take(message: Any, info: Mapping[str, int]) -> None:
                topic.take(message, info)

            self._open().create_subscription(
                message_type, name, take, quality, callback_group=self._group
            )
            self._topics[key] = topic
        return self._topics[key]

    def _client(self, service_type: Any, name: str) -> Any:
        return self._open().create_client(service_type, name, callback_group=self._group)

    def _open(self) -> Node:
        node = self._node()
        assert node is not None
        return node


_CONNECTIONS: weakref.WeakKeyDictionary[Node, _Connections] = weakref.WeakKeyDictionary()
_CONNECTIONS_LOCK = threading.Lock()


def _connections(node: Node) -> _Connections:
    with _CONNECTIONS_LOCK:
        connections = _CONNECTIONS.get(node)
        if connections is None:
            connections = _CONNECTIONS[node] = _Connections(node)
        return connections
