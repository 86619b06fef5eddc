"""A robot behind ROS 2: calls of its own services, actions and topics.

Parameters map the robot's interface; see :mod:`holdfast.ros.robot_interface`. This module makes the
calls, from a thread that is not the executor's. Every wait has a deadline, and ends early when it
is cancelled or the service has vanished.

An action is called as the three services that it is made of: send the goal, get the result, cancel.
So the goal's identifier is chosen here, and a goal can be cancelled before the robot accepts it.

An unanswered request may have been carried out. So a task action is never sent twice: the call
fails, and after a resume the robot's own count (``environment.steps``) says whether it was
performed. Without that count the trial ends there. Requests for sensing, ``done``, ``steps`` and
``reset`` are repeated when another server appears during the call.
"""

from __future__ import annotations

import contextlib
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from holdfast.arrays import FloatArray, in_brief
from holdfast.errors import EnvironmentFailedError
from holdfast.outcome import Done, Ending, MoveResult
from holdfast.problem_attributes import sensing_labels
from holdfast.problems.problem import Problem
from holdfast.robot.environment import ObservationSizes
from holdfast.ros.deadlines import Absence, Deadline
from holdfast.ros.field_paths import Path, read_field, read_numbers, write
from holdfast.ros.robot_interface import RobotCall, RobotInterface, observation_path
from holdfast.ros.ros2_connections import CallClients, Connections, Instant

__all__ = [
    "CountingRos2Environment",
    "Ros2Environment",
    "make_ros_environment",
]


_LOOK_S = 0.2
"""Interval at which a wait checks that the service is still there."""

_CANCEL_S = 1.0
"""Longest wait for the answer to a cancellation."""

_GOAL_ENDED = {4: "succeeded", 5: "was cancelled", 6: "was aborted"}
"""``action_msgs/msg/GoalStatus`` of ended goals."""

_GOAL_ACTIVE = (1, 2, 3)
"""Of goals that are accepted, executing or being cancelled."""

_STATUS_S = 1.0
"""Longest wait for a server's goal status; a server without goals sends none."""


def make_ros_environment(
    connections: Connections,
    parameters: Mapping[str, object],
    problem: Problem,
    seed: int,
    trial: int,
    resumed: bool = False,
) -> Ros2Environment:
    """Make the environment of a trial: a robot that is reached through ROS.

    The parameters are :data:`~holdfast.ros.robot_interface.ROBOT_PARAMETERS`. The robot is real, so
    ``seed`` is not used. It is brought to its start (``environment.reset``) unless the trial is
    ``resumed``, because the robot's process has died in the midst of it.

    Raises ConfigurationError if a parameter cannot be used, and EnvironmentFailedError if a service
    is missing for ``environment.discovery_timeout_ms``, or the reset fails.
    """
    del seed
    interface = RobotInterface(parameters, sensing_labels(problem), problem.action_size)
    made = CountingRos2Environment if "steps" in interface.calls else Ros2Environment
    return made(connections, interface, problem, trial, resumed=resumed)


class Ros2Environment:
    """A robot that is reached through ROS."""

    def __init__(
        self,
        connections: Connections,
        interface: RobotInterface,
        problem: Problem,
        trial: int,
        *,
        resumed: bool,
    ) -> None:
        self._connections = connections
        self._node = connections.node
        self._interface = interface
        self._problem = problem
        self._trial = trial
        self._step = 0
        self._observation_sizes = ObservationSizes(problem)
        # Guards the waits alone: an answer, or a cancellation, notifies.
        self._news = threading.Condition()
        self._cancelled: str | None = None
        connections.add_user(self)
        self._clients = {
            role: connections.clients(call)
            for role, call in interface.calls.items()
            if call.kind != "msg"
        }
        done = interface.calls.get("done")
        self._done_topic = (
            None
            if done is None or done.kind != "msg"
            else connections.topic(done.name, done.type, latched=True)
        )
        topic = interface.observation
        self._observations = (
            None if topic is None else connections.topic(topic.name, topic.type, latched=False)
        )
        self._find_servers()
        reset = interface.calls.get("reset")
        if reset is not None and not resumed:
            deadline = Deadline(reset.timeout_s, reset.key("timeout_ms"))
            self._check_success(reset, self._call(reset, self._request(reset), deadline))
            self._wait_until_not_done(reset, deadline)
        if resumed and "steps" in interface.calls:
            self._wait_until_it_stands()
            self._step = self._count()

    # -- what the robot's loop calls -------------------------------------------------------------

    def perform_sensing(self, sensing_action: int) -> FloatArray | None:
        """Perform a sensing action and return the observation, shape ``(observation_size,)``.

        None if all of it is NaN: messages say so that there was no reading.

        Raises EnvironmentFailedError if the robot does not answer in time, refuses, or returns no
        valid observation.
        """
        call = self._interface.calls.get("sense")
        topic = self._interface.observation
        begun = self._now()
        deadline = (
            Deadline(self._interface.timeout_s, "0.45 times environment.timeout_ms")
            if call is None
            else Deadline(call.timeout_s, call.key("timeout_ms"))
        )
        label = sensing_labels(self._problem)[sensing_action]
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
            with _named(f"{shown_by}: {key}"):
                numbers += read_numbers(answer, path)
        observation = np.array(numbers)
        size = self._observation_sizes[sensing_action]
        if not observation.size or size not in (None, observation.size):
            raise EnvironmentFailedError(
                f"{shown_by} showed {observation.size} numbers ({key}) for sensing action "
                f"{sensing_action} ({label}); {self._problem.name} needs {size or 'some'}"
            )
        if np.isnan(observation).all():
            return None
        if not np.isfinite(observation).all():
            raise EnvironmentFailedError(
                f"{shown_by} showed {in_brief(observation)} ({key}) for sensing action "
                f"{sensing_action} ({label}); an observation must be finite, or NaN in every "
                "component, which is no reading"
            )
        return observation

    def perform(self, task_action: FloatArray) -> float | MoveResult | None:
        """Perform a task action and return what it has shown.

        Raises EnvironmentFailedError if the robot rejects it, fails, or does not answer in time. It
        may have moved.
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
        motion = self._shown(call, answer, "motion", call.paths.get("motion", ()))
        fields = [observation_path(text, 0, "", "") for text in call.observation]
        shown = self._shown(call, answer, "observation", fields)
        reward = self._reward(call, answer)
        return reward if motion is None and shown is None else MoveResult(reward, motion, shown)

    def _shown(
        self, call: RobotCall, answer: Any, key: str, paths: Sequence[Path]
    ) -> FloatArray | None:
        """Return what fields of the answer have shown; None if there are none."""
        numbers: list[float] = []
        for path in paths:
            with _named(f"{call}: {call.key(key)}"):
                numbers += read_numbers(answer, path)
        if not paths:
            return None
        if not numbers or not np.isfinite(numbers).all():
            raise EnvironmentFailedError(
                f"{call} answered with the {key} {numbers!r:.80} ({call.key(key)}); it must be "
                "finite numbers"
            )
        return np.array(numbers)

    def _reward(self, call: RobotCall, answer: Any) -> float | None:
        reward_path = call.path("reward")
        if reward_path is None:
            return None
        with _named(f"{call}: {call.key('reward')}"):
            reward = self._number(read_field(answer, reward_path))
        if np.isinf(reward):
            raise EnvironmentFailedError(
                f"{call} answered with the reward {reward} ({call.key('reward')}); it must be "
                "finite, or NaN where there is none"
            )
        return None if np.isnan(reward) else reward

    def _wait_until_it_stands(self) -> None:
        """Wait for the end of a goal of an earlier process: until then the count may change."""
        act = self._interface.calls["act"]
        if act.kind != "action":
            return
        status = self._connections.topic(
            f"{act.name}/_action/status", act.type.Impl.GoalStatusMessage, latched=True
        )
        # The topic is latched, but a server without goals has published nothing.
        first = Deadline(_STATUS_S, "")
        while not status.messages and not self._wait(first, lambda: False, 0.02):
            pass
        deadline = Deadline(act.timeout_s, act.key("timeout_ms"))
        while status.messages and any(
            goal.status in _GOAL_ACTIVE for goal in status.messages[-1].message.status_list
        ):
            if self._wait(deadline, lambda: False, 0.02):
                raise EnvironmentFailedError(
                    f"{act} is still busy with a goal of before"
                    + (
                        f": {self._cancelled}"
                        if self._cancelled
                        else f", {deadline.limit_s:g} s later ({deadline.key})"
                    )
                )

    def _wait_until_not_done(self, reset: RobotCall, deadline: Deadline) -> None:
        """Wait until a topic no longer reports the end of the last trial."""
        while self._done_topic is not None and self.is_done():
            if self._wait(deadline, lambda: False, _LOOK_S):
                raise EnvironmentFailedError(
                    f"{self._interface.calls['done']} still says that the task has ended, "
                    f"{deadline.limit_s:g} s after {reset} was called ({deadline.key})"
                )

    def is_done(self) -> Done:
        """Return whether the task is done; always False if the robot does not report it.

        Raises EnvironmentFailedError if the robot does not answer in time.
        """
        call = self._interface.calls.get("done")
        if call is None:
            return False
        if self._done_topic is None:
            answer = self._call(call, self._request(call))
            self._check_success(call, answer)
        else:
            answer = self._done_topic.messages[-1].message
        for key, ending in (("failed", Ending("failed")), ("done", Ending("succeeded"))):
            path = call.path(key)
            if path is not None:
                with _named(f"{call}: {call.key(key)}"):
                    value = read_field(answer, path)
                if value not in (0, 1):
                    raise EnvironmentFailedError(
                        f"{call} answered {value!r:.80} ({call.key(key)}); it must be true or false"
                    )
                if value:
                    told = call.path("reason")
                    return (
                        ending
                        if told is None
                        else Ending(ending.outcome, str(read_field(answer, told)))
                    )
        return False

    def cancel(self, why: str = "cancelled") -> None:
        """End the current call, from any thread; an action's goal is cancelled at the robot.

        The call raises, as do all later ones. An interrupted task action may have been performed.
        Without ``environment.steps`` that remains unknown, and the trial cannot be resumed.
        """
        with self._news:
            self._cancelled = self._cancelled or why
            self._news.notify_all()

    def close(self) -> None:
        """Leave the robot where it is."""
        self.cancel("closed")

    def _count(self) -> int:
        call = self._interface.calls["steps"]
        answer = self._call(call, self._request(call))
        self._check_success(call, answer)
        path = call.path("steps")
        assert path is not None
        with _named(f"{call}: {call.key('steps')}"):
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
        with _named(f"{call}: {call.key(key)}"):
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

    def _now(self) -> Instant:
        return Instant(self._node.get_clock().now().nanoseconds, time.time_ns())

    # -- calls and waits -------------------------------------------------------------------------

    def _find_servers(self) -> None:
        """Wait until all services and topics that the parameters name are there."""
        calls = self._interface.calls
        deadline = Deadline(self._interface.discovery_timeout_s, "environment.discovery_timeout_ms")
        for role, clients in self._clients.items():
            while not clients.are_ready():
                if self._wait(deadline, lambda: False, 0.02):
                    self._nobody(calls[role], deadline.waited_s(), deadline.key)
        topic = self._interface.observation
        while topic is not None and not self._node.count_publishers(topic.name):
            if self._wait(deadline, lambda: False, 0.02):
                raise EnvironmentFailedError(
                    f"nobody publishes topic {topic.name} (environment.observation.topic); waited "
                    f"{deadline.waited_s():.3g} s ({deadline.key})"
                )
        while self._done_topic is not None and not self._done_topic.messages:
            if self._wait(deadline, lambda: False, 0.02):
                raise EnvironmentFailedError(
                    f"{calls['done']} has brought no message within {deadline.limit_s:g} s "
                    f"({deadline.key}); one that tells a state must be latched (transient local)"
                )

    @staticmethod
    def _nobody(call: RobotCall, waited_s: float, key: str) -> NoReturn:
        raise EnvironmentFailedError(
            f"nobody offers {call} of type {call.type_name}; waited {waited_s:.3g} s ({key})"
        )

    def _call(self, call: RobotCall, request: Any, deadline: Deadline | None = None) -> Any:
        clients = self._clients[call.role]
        deadline = deadline or Deadline(call.timeout_s, call.key("timeout_ms"))
        absent = Absence(clients.are_ready, self._interface.discovery_timeout_s)
        if call.kind == "srv":
            return self._answer(call, clients.main, request, deadline, absent, "an answer")
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
            raise EnvironmentFailedError(
                f"{call}: the goal {ending}{self._reason(call, ended.result)}"
            )
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
                if not futures or (servers != known and call.role != "act"):
                    # ROS believes for seconds that a killed robot is there. What was sent meanwhile
                    # never reaches its successor.
                    with _named(f"{call} could not be called"):
                        futures.append(_sent(client, request))
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

    def _observation_message(self, earliest: Instant, deadline: Deadline) -> Any:
        """Wait for a message taken at an instant or later."""
        topic, received = self._interface.observation, self._observations
        assert topic is not None and received is not None
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
            if self._wait(deadline, newer, _LOOK_S):
                break
        found = f"topic {topic.name} (environment.observation.topic)"
        when = "requested" if topic.taken_during else "answered"
        if self._cancelled:
            raise EnvironmentFailedError(
                f"{found}: {self._cancelled} while a message was waited for"
            )
        raise EnvironmentFailedError(
            f"{found} brought no message of type {topic.type_name} that was taken after the "
            f"sensing action was {when}, within {deadline.limit_s:g} s ({deadline.key}); "
            + (
                f"{refused} were older, the last by {age_s:.3g} s (are the clocks the same?)"
                if refused
                else f"none came, and {self._node.count_publishers(topic.name)} publish it"
            )
        )


class CountingRos2Environment(Ros2Environment):
    """A robot that reports how many task actions it has performed."""

    def steps_performed(self) -> int:
        """Return how many task actions have been performed in this trial.

        Raises EnvironmentFailedError if the robot does not answer in time.
        """
        return self._count()


class _UnansweredError(EnvironmentFailedError):
    """A request was perhaps sent, and its effect is unknown."""


@contextlib.contextmanager
def _named(name: str) -> Iterator[None]:
    """Prefix errors with a name."""
    try:
        yield
    except EnvironmentFailedError as error:
        raise EnvironmentFailedError(f"{name}: {error}") from None


def _sent(client: Any, request: Any) -> Any:
    try:
        return client.call_async(request)
    except Exception as error:  # rclpy's are many: of ranges, types, and of a node that is gone
        raise EnvironmentFailedError(f"{type(error).__name__}: {error}") from error
