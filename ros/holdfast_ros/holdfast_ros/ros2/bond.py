"""The node's end of a bond, by which Nav2's lifecycle manager sees that a node has died.

The manager takes a node for dead whose heartbeats on the topic ``bond`` stop. A bond has the node's
name as its identifier, and each of its ends another one. After its end the next is a new one.
"""

from __future__ import annotations

import uuid
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType

_TIMEOUT_S = 4.0  # after which an end without heartbeats is dead, as Nav2 has it


class Bond:
    """Heartbeats of a node; none where the package ``bond`` is not installed."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._publisher: Any = None
        self._timer: Any = None
        self._instance = ""
        self._period_s = 0.0

    def form(self, period_s: float) -> None:
        """Send a heartbeat every ``period_s`` from now on; 0: none."""
        try:
            from bond.msg import Status
        except ImportError:
            return
        if period_s > 0.0 and self._timer is None:
            self._publisher = self._publisher or self._node.create_publisher(Status, "bond", 1)
            self._instance, self._period_s = str(uuid.uuid4()), period_s
            clock = Clock(clock_type=ClockType.STEADY_TIME)  # simulated time may stand still
            group = MutuallyExclusiveCallbackGroup()  # no other callback delays it
            self._timer = self._node.create_timer(period_s, self._beat, group, clock)

    def break_up(self) -> None:
        """Say that the bond has ended; may be repeated."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None
            self._beat(active=False)

    def _beat(self, *, active: bool = True) -> None:
        message = self._publisher.msg_type(id=self._node.get_name(), instance_id=self._instance)
        message.active, message.heartbeat_period = active, self._period_s
        message.heartbeat_timeout = _TIMEOUT_S
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
