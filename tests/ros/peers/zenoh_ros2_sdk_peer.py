"""A node of ROS 2 made of zenoh-ros2-sdk alone, as a client or a server of the typed service.

Keys, hashes, attachments and tokens are its own; nothing of holdfast is imported.

usage: python zenoh_ros2_sdk_peer.py client|server NAME DOMAIN PORT DEFINITIONS
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np
from lines import read, write
from zenoh_ros2_sdk import ROS2ServiceClient, ROS2ServiceServer
from zenoh_ros2_sdk.message_registry import get_registry
from zenoh_ros2_sdk.session import ZenohSession

TYPE = "holdfast_interfaces/srv/ActiveSensing"


def plain(value: Any) -> Any:
    """Return a message as JSON has it."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if dataclasses.is_dataclass(value):
        fields = dataclasses.fields(value)
        return {each.name: plain(getattr(value, each.name)) for each in fields}
    return value


def made(store: Any, name: str, fields: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a message with its nested messages."""
    package = name.split("/")[0]
    nested = {"state": f"{package}/msg/PlanningState", "belief": f"{package}/msg/Belief"}
    values: dict[str, Any] = {}
    for key, value in fields.items():
        if key in nested:
            values[key] = store.types[nested[key]](**made(store, nested[key], value))
        else:
            values[key] = np.array(value, dtype=np.float64) if isinstance(value, list) else value
    return values


def main(role: str, name: str, domain: int, port: int, definitions: str) -> None:
    """Run until standard input ends."""
    session = ZenohSession.get_instance("127.0.0.1", port)
    store = session.store
    # Else it looks for them in the network.
    get_registry(definitions)
    package = Path(definitions) / "holdfast_interfaces"
    for each in ("Belief", "PlanningState"):
        text = (package / "msg" / f"{each}.msg").read_text()
        session.register_message_type(text, f"holdfast_interfaces/msg/{each}")
    # It takes a name without a package for one of the folder srv.
    text = (package / "srv" / "ActiveSensing.srv").read_text()
    parts = text.replace("\nPlanningState ", "\nholdfast_interfaces/PlanningState ").split(
        "\n---\n"
    )
    where = {
        "domain_id": domain,
        "router_ip": "127.0.0.1",
        "router_port": port,
        "request_definition": parts[0],
        "response_definition": parts[1],
    }
    if role == "client":
        client = ROS2ServiceClient(name, TYPE, timeout=20.0, **where)
        write({"ready": client.type_hash})
        while (request := read()) is not None:
            answer = client.call(**made(store, TYPE, request))
            write({"error": -1} if answer is None else plain(answer))
        client.close()
    else:
        server = ROS2ServiceServer(name, TYPE, mode="queue", **where)
        write({"ready": server.type_hash})
        while True:
            key, request = server.take_request()
            write(plain(request))
            answer = read()
            if answer is None:
                break
            server.send_response(key, server.response_msg_class(**made(store, TYPE, answer)))
        server.close()
    ZenohSession.get_instance().close()


if __name__ == "__main__":
    role, name, domain, port, definitions = sys.argv[1:]
    main(role, name, int(domain), int(port), definitions)
