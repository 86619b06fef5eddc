"""What a new master is to know, from what the last one knew and what the nodes say themselves.

A master's knowledge is a memory of what nodes told it. While no master was there, nodes died, and
nodes stopped publishing; nobody took note. So before a new master begins, every node and every
service is asked. Of a topic the node has the last word, and of a service the one who answers at its
address. Who is silent is believed to be there still: it may be stopped, or far away.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, TypeAlias

from holdfast.ros.master.process import MasterState

__all__ = [
    "NodeAnswer",
    "NodeReport",
    "Reconciled",
    "lookups_of",
    "reconcile",
    "state_of_snapshot",
    "unregistrations",
]

_ANY_TYPE = "*"

_REGISTRATIONS = {
    "publishers": "unregisterPublisher",
    "subscribers": "unregisterSubscriber",
    "parameter_subscribers": "unsubscribeParam",
}
"""Tables of a master, and how a node takes back what it has in them."""


class NodeReport(NamedTuple):
    """A node's own account: the type of each topic that it publishes, or subscribes to."""

    publications: Mapping[str, str]
    subscriptions: Mapping[str, str]


NodeAnswer: TypeAlias = NodeReport | Literal["gone"] | None
"""None: it did not answer."""


class Reconciled(NamedTuple):
    """What a new master is to know.

    Attributes
    ----------
    state : MasterState
    gone : tuple of str
        Nodes that have ended.
    silent : tuple of str
        Nodes that did not answer, which are kept.
    lost_services : tuple of str
        Services that nobody offers any more.
    doubtful : MasterState
        That part of the state of which nobody could say that it is still so.
    """

    state: MasterState
    gone: tuple[str, ...]
    silent: tuple[str, ...]
    lost_services: tuple[str, ...]
    doubtful: MasterState


def reconcile(
    known: MasterState, nodes: Mapping[str, NodeAnswer], services: Mapping[str, bool | None]
) -> Reconciled:
    """Merge what the last master knew with what nodes and services answered.

    Parameters
    ----------
    known : MasterState
        Left as it is.
    nodes : mapping
        Answers by the URI of the node's XML-RPC server.
    services : mapping
        Whether each service is offered where it was; None if that is unknown.
    """
    uris = known.nodes()
    sharing = Counter(uris.values())
    state = MasterState()
    state.parameters = known.parameters
    state.types = dict(known.types)
    for table in _REGISTRATIONS:
        kept = getattr(state, table)
        for key, registered in getattr(known, table).items():
            staying = [
                (node, uri) for node, uri in registered if _still(table, key, nodes.get(uri))
            ]
            if staying:
                kept[key] = staying
    for node, uri in uris.items():
        answer = nodes.get(uri)
        # Two names at one address: one of them has died, and the other one's topics are not its.
        if isinstance(answer, NodeReport) and sharing[uri] == 1:
            _add(state, state.publishers, node, uri, answer.publications)
            _add(state, state.subscribers, node, uri, answer.subscriptions)
    for topic in state.publishers:
        state.types.setdefault(topic, _ANY_TYPE)
    state.services = {
        service: where
        for service, where in known.services.items()
        if services.get(service) is not False
    }
    return Reconciled(
        state,
        gone=tuple(node for node, uri in uris.items() if nodes.get(uri) == "gone"),
        silent=tuple(node for node, uri in uris.items() if nodes.get(uri) is None),
        lost_services=tuple(known.services.keys() - state.services.keys()),
        doubtful=_doubtful(known, nodes, services),
    )


def _doubtful(
    known: MasterState, nodes: Mapping[str, NodeAnswer], services: Mapping[str, bool | None]
) -> MasterState:
    part = MasterState()
    for table in _REGISTRATIONS:
        for key, registered in getattr(known, table).items():
            silent = [(node, uri) for node, uri in registered if nodes.get(uri) is None]
            if silent:
                getattr(part, table)[key] = silent
    part.services = {
        service: where for service, where in known.services.items() if services.get(service) is None
    }
    return part


def unregistrations(before: MasterState, after: MasterState) -> list[tuple[str, tuple[str, ...]]]:
    """Return the calls to a master that take back what is in one state and not in another.

    Each call names the address, too: of a node that has been started again meanwhile, at another
    one, it takes nothing back.

    Returns
    -------
    list of tuple
        Methods and their arguments, the first of which is the node's name.
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
    """Tell whether a node is to stay registered."""
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
    """Register a node for its topics where it is not."""
    for topic, kind in topics.items():
        registered = registrations.setdefault(topic, [])
        if (node, uri) not in registered:
            registered.append((node, uri))
        if kind != _ANY_TYPE and state.types.get(topic, _ANY_TYPE) == _ANY_TYPE:
            state.types[topic] = kind


# -- a master that keeps no journal ----------------------------------------------------------------


def lookups_of(system_state: Any) -> tuple[list[str], list[str]]:
    """Return the nodes and the services that a master's ``getSystemState`` names."""
    publishers, subscribers, services = system_state
    nodes = {node for table in system_state for _, names in table for node in names}
    del publishers, subscribers
    return sorted(nodes), [service for service, _ in services]


def state_of_snapshot(
    system_state: Any,
    types: Any,
    parameters: Mapping[str, Any],
    node_uris: Mapping[str, str | None],
    service_uris: Mapping[str, str | None],
) -> MasterState:
    """Return what a stock master knows, from its answers.

    What has no URI any more went away between two questions, and is left out. Who watches
    parameters, no master tells.

    Parameters
    ----------
    system_state : list
        Of ``getSystemState``: publishers, subscribers, services.
    types : list
        Of ``getTopicTypes``.
    parameters : mapping
        Of ``getParam("/")``.
    node_uris, service_uris : mapping
        Of ``lookupNode`` and ``lookupService``.
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
