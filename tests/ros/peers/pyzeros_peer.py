"""A node of ROS 2 made of pyzeros alone, as a client or a server of the typed service.

Keys, hashes, attachments and tokens are its own, the serialisation is Cyclone DDS's; nothing of
holdfast is imported, and the types are written down here once more.

usage: python pyzeros_peer.py client|server NAME DOMAIN PORT
"""

import asyncio
import dataclasses
import json
import sys
from dataclasses import dataclass, field
from typing import Any

import pyzeros
import zenoh
from lines import read, write
from ros2_pyterfaces.cyclone import idl
from ros2_pyterfaces.cyclone.idl import types

PACKAGE = "holdfast_interfaces"


# Cyclone DDS cannot read annotations that are text, so this module has no other ones.
@dataclass
class Belief(idl.IdlStruct, typename=f"{PACKAGE}/msg/Belief"):
    state_size: types.uint32 = 0
    states: types.sequence[types.float64] = field(default_factory=list)
    weights: types.sequence[types.float64] = field(default_factory=list)


@dataclass
class PlanningState(idl.IdlStruct, typename=f"{PACKAGE}/msg/PlanningState"):
    seed: types.int64 = 0
    trial: types.uint32 = 0
    step: types.uint32 = 0
    stage: types.uint32 = 0
    sensed: bool = False
    belief: Belief = field(default_factory=Belief)


@dataclass
class Request(idl.IdlStruct, typename=f"{PACKAGE}/srv/ActiveSensing_Request"):
    kind: types.uint8 = 0
    configuration: str = ""
    seed: types.int64 = 0
    trial: types.uint32 = 0
    state: PlanningState = field(default_factory=PlanningState)
    sensing_action: types.uint32 = 0
    observation: types.sequence[types.float64] = field(default_factory=list)


@dataclass
class Response(idl.IdlStruct, typename=f"{PACKAGE}/srv/ActiveSensing_Response"):
    error: types.uint8 = 0
    message: str = ""
    configuration: str = ""
    state: PlanningState = field(default_factory=PlanningState)
    sensing_action: types.uint32 = 0
    entropies: types.sequence[types.float64] = field(default_factory=list)
    action_size: types.uint32 = 0
    task_actions: types.sequence[types.float64] = field(default_factory=list)


TYPE = idl.make_idl_service(Request, Response, typename=f"{PACKAGE}/srv/ActiveSensing")


def made(kind: type[Any], fields: dict[str, Any]) -> Any:
    """Return a message with its nested messages."""
    nested = {"state": PlanningState, "belief": Belief}
    return kind(
        **{
            key: made(nested[key], value) if key in nested else value
            for key, value in fields.items()
        }
    )


async def ask(name: str) -> None:
    """Ask what is read, tell what is answered."""
    client = pyzeros.Client(TYPE, name)
    await client.wait_for_service()
    write({"ready": TYPE.hash_rihs01()})
    while (request := await asyncio.to_thread(read)) is not None:
        answer = await asyncio.wait_for(client.call_async(made(Request, request)), 20.0)
        write(dataclasses.asdict(answer))


async def serve(name: str) -> None:
    """Tell what is asked, answer what is read."""
    server = pyzeros.Server(TYPE, name)
    write({"ready": TYPE.hash_rihs01()})
    async for asked in server.listen_reliable():
        write(dataclasses.asdict(asked.request))
        answer = await asyncio.to_thread(read)
        if answer is None:
            break
        asked.send(made(Response, answer))


def main(role: str, name: str, domain: int, port: int) -> None:
    """Run until standard input ends."""
    configuration = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
    }.items():
        configuration.insert_json5(key, json.dumps(value))
    with (
        zenoh.open(configuration) as session,
        pyzeros.auto_context(node="peer", zenoh_session=session, domain_id=domain),
    ):
        asyncio.run(ask(name) if role == "client" else serve(name))


if __name__ == "__main__":
    role, name, domain, port = sys.argv[1:5]
    main(role, name, int(domain), int(port))
