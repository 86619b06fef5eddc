"""What a new master begins with: the last one's state, without the nodes that have ended.

Nodes may die unnoticed while there is no master. So every node is asked before a new one begins.
Silent ones are kept: they may be stopped, or far away.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Collection

from ros1_master_guard.errors import CallError, GoneError, SilentError
from ros1_master_guard.process import MasterState
from ros1_master_guard.ros1_calls import CALLER, Connection, call

_ANSWER_S, _ANSWERS_S = 0.3, 1.0
"""Longest wait for a node while there is no master, and for all of them together."""

_BROKEN_AGAIN_S = (0.02, 0.1, 0.2)
"""Pauses after a broken connection: the node may be about to end."""

_ASKED_AT_ONCE = 64
_SNAPSHOT_S = 5.0


async def gone_and_silent(uris: Collection[str]) -> tuple[set[str], set[str]]:
    """Ask nodes, in parallel, whether they live; return who has ended, and who does not answer."""
    gone: set[str] = set()
    silent = set(uris)
    few = asyncio.Semaphore(_ASKED_AT_ONCE)

    async def ask(uri: str) -> None:
        async with few:
            for pause_s in _BROKEN_AGAIN_S:
                try:
                    await call(uri, "getPid", within_s=_ANSWER_S)
                except GoneError:
                    gone.add(uri)
                except SilentError:
                    return
                except CallError:
                    await asyncio.sleep(pause_s)
                    continue
                silent.discard(uri)
                return

    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_ANSWERS_S):
            await asyncio.gather(*map(ask, set(uris)))
    return gone, silent


def without(known: MasterState, gone: Collection[str]) -> MasterState:
    """Return a master's state without the nodes at some addresses."""
    state = MasterState(parameters=known.parameters, types=dict(known.types))
    for table in ("publishers", "subscribers", "parameter_subscribers"):
        for key, registered in getattr(known, table).items():
            if staying := [each for each in registered if each[1] not in gone]:
                getattr(state, table)[key] = staying
    state.services = {name: at for name, at in known.services.items() if at[1] not in gone}
    for topic in state.publishers:
        state.types.setdefault(topic, "*")  # without one, `rostopic list` fails
    return state


# -- a master that tells nothing of itself ---------------------------------------------------------


async def process_of(connection: Connection, *, within_s: float) -> int:
    """Return a master's process id; raise CallError if it does not tell one."""
    pid = await connection.call("getPid", within_s=within_s)
    if not isinstance(pid, int) or pid < 1:
        raise CallError(f"{connection.uri}: getPid answers {pid!r:.100}, which is no process id")
    return pid


async def snapshot(connection: Connection) -> MasterState:
    """Return a stock master's state; raise CallError if its answers cannot be understood.

    Nodes and services that ended between two questions are left out. No call returns the
    subscribers of parameters.
    """
    asked: list[tuple[str, tuple[str, ...]]]
    asked = [(method, (CALLER,)) for method in ("getSystemState", "getTopicTypes")]
    asked.append(("getParam", (CALLER, "/")))
    tables, types, parameters = await connection.calls(asked, within_s=_SNAPSHOT_S)
    try:
        state = MasterState(parameters=dict(parameters), types=dict(types))
        publishers, subscribers, services = tables
        names = sorted({node for table in tables for _, nodes in table for node in nodes})
        asked = [("lookupNode", (CALLER, node)) for node in names]
        asked += [("lookupService", (CALLER, service)) for service, _ in services]
        found = await connection.calls(asked, within_s=_SNAPSHOT_S)
        uris = dict(zip(names, found, strict=False))
        for kept, table in ((state.publishers, publishers), (state.subscribers, subscribers)):
            for topic, nodes in table:
                if registered := [(node, uris[node]) for node in nodes if uris[node]]:
                    kept[topic] = registered
        for (service, nodes), uri in zip(services, found[len(names) :], strict=True):
            if nodes and uri and uris[nodes[0]]:
                state.services[service] = (nodes[0], uris[nodes[0]], uri)
    except CallError:
        raise
    except Exception as error:
        raise CallError(f"{connection.uri}: cannot be understood: {error}") from error
    return state
