"""A node's clients to a robot, kept from trial to trial."""

from __future__ import annotations

import threading
import weakref
from typing import Any, NamedTuple

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node


class RobotCall(NamedTuple):
    """A service or an action of the robot's, by its resolved name."""

    name: str
    type: Any
    may_repeat: bool

    @property
    def is_action(self) -> bool:
        """Whether it is an action."""
        return hasattr(self.type, "Goal")

    def __str__(self) -> str:
        """Return a description for messages."""
        package, kind, *_ = self.type.__module__.split(".")
        word = "action" if self.is_action else "service"
        return f"{word} {self.name} ({package}/{kind}/{self.type.__name__})"


class CallClients(NamedTuple):
    """The clients of one service, or the three of one action."""

    main: Any
    result: Any = None
    cancel: Any = None

    def are_ready(self) -> bool:
        """Return whether all of their servers are there."""
        return all(client.service_is_ready() for client in self if client is not None)


class Connections:
    """A node's clients, kept from trial to trial to save discovery.

    An executor must spin the node in other threads than those that use this.
    """

    def __init__(self, node: Node) -> None:
        self.node = node
        # Answers arrive whatever else the node does in its callbacks.
        self._group = ReentrantCallbackGroup()
        self._clients: dict[RobotCall, CallClients] = {}
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

    def call(self, name: str, call_type: Any, *, may_repeat: bool = True) -> RobotCall:
        """Return a service or an action by its name before remapping."""
        # ROS itself would not remap an action by one rule, only each of its services.
        return RobotCall(self.node.resolve_service_name(name), call_type, may_repeat)

    def clients(self, call: RobotCall) -> CallClients:
        """Return the clients of a call."""
        if call not in self._clients:
            if not call.is_action:
                self._clients[call] = CallClients(self._client(call.type, call.name))
            else:
                parts = call.type.Impl
                self._clients[call] = CallClients(
                    self._client(parts.SendGoalService, f"{call.name}/_action/send_goal"),
                    self._client(parts.GetResultService, f"{call.name}/_action/get_result"),
                    self._client(parts.CancelGoalService, f"{call.name}/_action/cancel_goal"),
                )
        return self._clients[call]

    def _client(self, service_type: Any, name: str) -> Any:
        return self.node.create_client(service_type, name, callback_group=self._group)
