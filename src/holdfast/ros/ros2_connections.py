"""A node's clients and subscriptions to a robot, kept from trial to trial."""

from __future__ import annotations

import threading
import time
import weakref
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from holdfast.ros.robot_interface import RobotCall

__all__ = ["CallClients", "Connections", "Instant", "TopicBuffer"]

_MESSAGES_KEPT = 10


class Instant(NamedTuple):
    """A moment on the node's clock and on the machine's clock; they differ in simulated time."""

    ros_ns: int
    system_ns: int


class ReceivedMessage(NamedTuple):
    """A message, and when the machine's clock saw it arrive."""

    number: int
    message: Any
    system_ns: int

    def age_ns(self, instant: Instant) -> int:
        """Return how long before an instant it was taken; 0 or less if it was not before."""
        stamp = getattr(getattr(self.message, "header", None), "stamp", None)
        if stamp is not None and (stamp.sec or stamp.nanosec):
            return instant.ros_ns - (1_000_000_000 * int(stamp.sec) + int(stamp.nanosec))
        return instant.system_ns - self.system_ns


class TopicBuffer:
    """The last messages of a topic."""

    def __init__(self) -> None:
        self.messages: deque[ReceivedMessage] = deque(maxlen=_MESSAGES_KEPT)
        self.number = 0
        self.condition: threading.Condition | None = None

    def take(self, message: Any, info: Mapping[str, int]) -> None:
        """Keep a message, and wake the waiting environment."""
        received_ns = int(info.get("received_timestamp") or 0) or time.time_ns()
        self.messages.append(ReceivedMessage(self.number, message, received_ns))
        self.number += 1
        condition = self.condition
        if condition is not None:
            with condition:
                condition.notify_all()


class CallClients(NamedTuple):
    """The clients of one service, or the three of one action."""

    main: Any
    result: Any = None
    cancel: Any = None

    def are_ready(self) -> bool:
        """Return whether all of their servers are there."""
        return all(client.service_is_ready() for client in self if client is not None)


class Connections:
    """A node's clients and subscriptions, kept from trial to trial to save discovery.

    An executor must spin the node in other threads than those that use this.
    """

    def __init__(self, node: Node) -> None:
        self.node = node
        # Answers arrive whatever else the node does in its callbacks.
        self._group = ReentrantCallbackGroup()
        self._clients: dict[tuple[str, str], CallClients] = {}
        self._topics: dict[tuple[str, str], TopicBuffer] = {}
        self._lock = threading.Lock()
        self._users: weakref.WeakSet[Any] = weakref.WeakSet()

    def add_user(self, environment: Any) -> None:
        """Have :meth:`cancel` reach an environment, as long as that exists."""
        with self._lock:
            self._users.add(environment)

    def cancel(self, why: str = "cancelled") -> None:
        """Cancel all existing environments, from any thread; later ones are not affected."""
        with self._lock:
            environments = list(self._users)
        for environment in environments:
            environment.cancel(why)

    def clients(self, call: RobotCall) -> CallClients:
        """Return the clients of a call."""
        key = (call.name, call.type_name)
        if key not in self._clients:
            if call.kind == "srv":
                self._clients[key] = CallClients(self._client(call.type, call.name))
            else:
                parts = call.type.Impl
                self._clients[key] = CallClients(
                    self._client(parts.SendGoalService, f"{call.name}/_action/send_goal"),
                    self._client(parts.GetResultService, f"{call.name}/_action/get_result"),
                    self._client(parts.CancelGoalService, f"{call.name}/_action/cancel_goal"),
                )
        return self._clients[key]

    def topic(self, name: str, message_type: Any, *, latched: bool) -> TopicBuffer:
        """Return the last messages of a topic."""
        key = (name, f"{message_type.__module__}.{message_type.__name__}")
        if key not in self._topics:
            topic = TopicBuffer()
            # Best effort hears every kind of publisher, and a lost message is followed by another
            # one. A latched state must not be lost.
            quality = (
                QoSProfile(
                    depth=1,
                    reliability=ReliabilityPolicy.RELIABLE,
                    durability=DurabilityPolicy.TRANSIENT_LOCAL,
                )
                if latched
                else QoSProfile(depth=_MESSAGES_KEPT, reliability=ReliabilityPolicy.BEST_EFFORT)
            )
            self.node.create_subscription(
                message_type, name, topic.take, quality, callback_group=self._group
            )
            self._topics[key] = topic
        return self._topics[key]

    def _client(self, service_type: Any, name: str) -> Any:
        return self.node.create_client(service_type, name, callback_group=self._group)
