"""A new master's state, from the last master's state and the nodes' own answers.

A master knows what nodes have registered. Without a master, nodes may die or stop publishing
unnoticed. So before a new master begins, every node and every service is asked. A node's answer
decides about its topics, and the answer at a service's address about that service. Silent ones are
kept: they may be stopped, or far away.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Awaitable, Mapping
from typing import Any, Literal, NamedTuple, TypeAlias

from ros1_master_guard.errors import CallError, GoneError
from ros1_master_guard.process import MasterState
from ros1_master_guard.ros1_calls import CALLER, Connection, call, offers_service

__all__ = [
    "NodeAnswer",
    "NodeReport",
    "Reconciled",
    "ask_everyone",
    "lookups_of",
    "process_of",
    "reconcile",
    "snapshot",
    "state_of_snapshot",
    "unregistrations",
]

_ANY_TYPE = "*"

_ANSWER_S = 0.3
"""Longest wait for a node or service while there is no master."""

_ANSWERS_S = 1.0
"""Longest wait for all of them together."""

_ASKED_AT_ONCE = 64
_SNAPSHOT_S = 5.0

_REGISTRATIONS = {
    "publishers": "unregisterPublisher",
    "subscribers": "unregisterSubscriber",
    "parameter_subscribers": "unsubscribeParam",
}
"""Tables of a master, and the calls that remove a node from them."""


class NodeReport(NamedTuple):
    """A node's own answer: the type of each topic that it publishes or subscribes to."""

    publications: Mapping[str, str]
    subscriptions: Mapping[str, str]


NodeAnswer: TypeAlias = NodeReport | Literal["gone"] | None
"""None: it did not answer."""


class Reconciled(NamedTuple):
    """A new master's state.

    ``gone`` are the nodes that have ended, and ``lost_services`` the services that no longer exist.
    The ``silent`` nodes did not answer and are kept. ``doubtful`` is the part of the state that no
    answer has confirmed.
    """

    state: MasterState
    gone: tuple[str, ...]
    silent: tuple[str, ...]
    lost_services: tuple[str, ...]
    doubtful: MasterState


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


def reconcile(
    known: MasterState, nodes: Mapping[str, NodeAnswer], services: Mapping[str, bool | None]
) -> Reconciled:
    """Merge the last master's state with the answers of nodes and services.

    ``nodes`` has the answers by the URI of the node's XML-RPC server, and ``services`` whether each
    service is offered where it was; None if that is unknown.
    """
    uris = known.nodes()
    sharing = Counter(uris.values())
    state, doubtful = MasterState(), MasterState()
    state.parameters = known.parameters
    state.types = dict(known.types)
    for table in _REGISTRATIONS:
        for key, registered in getattr(known, table).items():
            staying = [each for each in registered if _still(table, key, nodes.get(each[1]))]
            silent = [each for each in registered if nodes.get(each[1]) is None]
            for kept, part in ((state, staying), (doubtful, silent)):
                if part:
                    getattr(kept, table)[key] = part
    for node, uri in uris.items():
        answer = nodes.get(uri)
        # Two names at one address: one node has died, and the topics are the other's.
        if isinstance(answer, NodeReport) and sharing[uri] == 1:
            _add(state, state.publishers, node, uri, answer.publications)
            _add(state, state.subscribers, node, uri, answer.subscriptions)
    for topic in state.publishers:
        state.types.setdefault(topic, _ANY_TYPE)
    for service, where in known.services.items():
        if services.get(service) is not False:
            state.services[service] = where
        if services.get(service) is None:
            doubtful.services[service] = where
    return Reconciled(
        state,
        gone=tuple(node for node, uri in uris.items() if nodes.get(uri) == "gone"),
        silent=tuple(node for node, uri in uris.items() if nodes.get(uri) is None),
        lost_services=tuple(known.services.keys() - state.services.keys()),
        doubtful=doubtful,
    )


def unregistrations(before: MasterState, after: MasterState) -> list[tuple[str, tuple[str, ...]]]:
    """Return the calls to a master that remove what is in one state and not in another.

    They are methods and their arguments, the first of which is the node's name. Each names the
    address, too, so it does not affect a node restarted at another address.
    """
    calls: list[tuple[str, tuple[str, ...]]] = []
    for table, method in _REGISTRATIONS.items():
        for key, registered in getattr(before, table).items():
            for node, uri in registered:
                if (node, uri) not in getattr(after, table).get(key, ()):
                    by_key = (node, uri, key) if table == "parameter_subscribers" else None
                    calls.append((method, by_key or (node, key, uri)))
    for service, (node, _, own_uri) in before.services.items():
        if service not in after.services:
            calls.append(("unregisterService", (node, service, own_uri)))
    return calls


def _still(table: str, key: str, answer: NodeAnswer) -> bool:
    """Return whether a node stays registered."""
    match answer:
        case "gone":
            return False
        case NodeReport() if table == "publishers":
            return key in answer.publications
        case NodeReport() if table == "subscribers":
            return key in answer.subscriptions
    return True


def _add(
    state: MasterState,
    registrations: dict[str, list[tuple[str, str]]],
    node: str,
    uri: str,
    topics: Mapping[str, str],
) -> None:
    """Register a node for topics where it is missing."""
    for topic, kind in topics.items():
        registered = registrations.setdefault(topic, [])
        if (node, uri) not in registered:
            registered.append((node, uri))
        if kind != _ANY_TYPE and state.types.get(topic, _ANY_TYPE) == _ANY_TYPE:
            state.types[topic] = kind


# -- a master that keeps no journal ----------------------------------------------------------------


def lookups_of(system_state: Any) -> tuple[list[str], list[str]]:
    """Return the nodes and the services that a master's ``getSystemState`` names."""
    nodes = {node for table in system_state for _, names in table for node in names}
    named = {name for table in system_state for name, _ in table}
    if odd := [name for name in nodes | named if not isinstance(name, str)]:
        raise TypeError(f"{odd[0]!r:.100} is no name")
    return sorted(nodes), [service for service, _ in system_state[2]]


def state_of_snapshot(
    system_state: Any,
    types: Any,
    parameters: Mapping[str, Any],
    node_uris: Mapping[str, str | None],
    service_uris: Mapping[str, str | None],
) -> MasterState:
    """Return a stock master's state, from its answers.

    Nodes and services without a URI ended between two questions and are left out. No call returns
    the subscribers of parameters.

    The arguments are the answers to ``getSystemState``, ``getTopicTypes`` and ``getParam("/")``,
    and by name to ``lookupNode`` and ``lookupService``.
    """
    state = MasterState()
    state.parameters = dict(parameters)
    state.types = dict(types)
    publishers, subscribers, services = system_state
    for registrations, table in (
        (state.publishers, publishers),
        (state.subscribers, subscribers),
    ):
        for topic, nodes in table:
            registered = [(node, uri) for node in nodes if (uri := node_uris.get(node))]
            if registered:
                registrations[topic] = registered
    for service, nodes in services:
        own_uri = service_uris.get(service)
        uri = node_uris.get(nodes[0]) if nodes else None
        if own_uri and uri:
            state.services[service] = (nodes[0], uri, own_uri)
    return state


async def process_of(connection: Connection, *, within_s: float) -> int:
    """Return a master's process id; raise CallError if it does not tell one."""
    pid = await connection.call("getPid", within_s=within_s)
    if not isinstance(pid, int) or pid < 1:
        raise CallError(f"{connection.uri}: getPid answers {pid!r:.100}, which is no process id")
    return pid


async def snapshot(connection: Connection) -> MasterState:
    """Return a stock master's state; raise CallError if its answers cannot be understood."""
    system_state, types, parameters = await connection.calls(
        [
            ("getSystemState", (CALLER,)),
            ("getTopicTypes", (CALLER,)),
            ("getParam", (CALLER, "/")),
        ],
        within_s=_SNAPSHOT_S,
    )
    try:
        names, services = lookups_of(system_state)
        uris = await connection.calls(
            [
                *(("lookupNode", (CALLER, name)) for name in names),
                *(("lookupService", (CALLER, service)) for service in services),
            ],
            within_s=_SNAPSHOT_S,
        )
        uris = [uri if isinstance(uri, str) else None for uri in uris]
        return state_of_snapshot(
            system_state,
            types,
            parameters,
            dict(zip(names, uris, strict=False)),
            dict(zip(services, uris[len(names) :], strict=True)),
        )
    except CallError:
        raise
    except Exception as error:
        raise CallError(f"{connection.uri}: cannot be understood: {error}") from error
