"""Parallel questions to nodes, services and stock masters."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable

from holdfast.errors import CallError, GoneError
from holdfast.ros.master.plan import NodeAnswer, NodeReport, lookups_of, state_of_snapshot
from holdfast.ros.master.process import MasterState
from holdfast.transport.ros1_calls import CALLER, Connection, call, offers_service

__all__ = ["ask_everyone", "snapshot"]

_ANSWER_S = 0.3
"""Longest wait for a node or service while there is no master."""

_ANSWERS_S = 1.0
"""Longest wait for all of them together."""

_ASKED_AT_ONCE = 64
_SNAPSHOT_S = 5.0


async def ask_everyone(
    known: MasterState,
) -> tuple[dict[str, NodeAnswer], dict[str, bool | None]]:
    """Ask all nodes and services of a dead master, in parallel, whether they are alive."""
    nodes: dict[str, NodeAnswer] = dict.fromkeys(known.nodes().values())
    services: dict[str, bool | None] = dict.fromkeys(known.services)
    few = asyncio.Semaphore(_ASKED_AT_ONCE)

    async def ask_node(uri: str) -> None:
        async with few:
            nodes[uri] = await _report_of(uri)

    async def ask_services(uri: str, names: list[str]) -> None:
        # One after another: a rospy node lets five wait, and the sixth connects a second later.
        async with few:
            for name in names:
                services[name] = await offers_service(uri, name, within_s=_ANSWER_S)
                if services[name] is None:
                    return

    by_address: dict[str, list[str]] = {}
    for service, (_, _, uri) in known.services.items():
        by_address.setdefault(uri, []).append(service)
    questions: list[Awaitable[None]] = [ask_node(uri) for uri in nodes]
    questions += [ask_services(uri, names) for uri, names in by_address.items()]
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_ANSWERS_S):
            await asyncio.gather(*questions)
    return nodes, services


async def _report_of(uri: str) -> NodeAnswer:
    try:
        publications, subscriptions = await asyncio.gather(
            call(uri, "getPublications", within_s=_ANSWER_S),
            call(uri, "getSubscriptions", within_s=_ANSWER_S),
        )
        return NodeReport(
            {str(topic): str(kind) for topic, kind in publications},
            {str(topic): str(kind) for topic, kind in subscriptions},
        )
    except GoneError:
        return "gone"
    except (CallError, TypeError, ValueError):
        return None


async def snapshot(connection: Connection) -> MasterState:
    """Return a stock master's state."""
    system_state, types, parameters = await connection.calls(
        [
            ("getSystemState", (CALLER,)),
            ("getTopicTypes", (CALLER,)),
            ("getParam", (CALLER, "/")),
        ],
        within_s=_SNAPSHOT_S,
    )
    names, services = lookups_of(system_state)
    uris = await connection.calls(
        [
            *(("lookupNode", (CALLER, name)) for name in names),
            *(("lookupService", (CALLER, service)) for service in services),
        ],
        within_s=_SNAPSHOT_S,
    )
    return state_of_snapshot(
        system_state,
        types,
        parameters,
        dict(zip(names, uris, strict=False)),
        dict(zip(services, uris[len(names) :], strict=True)),
    )
