"""What a service counts."""

from __future__ import annotations

import msgspec

__all__ = ["ServiceStatistics"]


class ServiceStatistics(msgspec.Struct):
    """What a service has done since its start, and what it holds now.

    Attributes
    ----------
    task_parts, sensing_parts : int
        Parts of answers computed.
    cache_hits : int
        Requests answered, fully or in part, from the cache.
    attached : int
        Requests that joined a pending task.
    superseded : int
        Requests dropped for a newer one of the same robot.
    restores : int
        States restored from a checkpoint.
    state_requests : int
        Requests answered with the need for the state.
    states_diverged : int
        States that came out differently than on the robot.
    busy : int
        Requests turned away for lack of capacity.
    refusals : dict of str to int
        By code.
    sessions, state_bytes, waiting, running, calls : int
        Held now.
    """

    task_parts: int = 0
    sensing_parts: int = 0
    cache_hits: int = 0
    attached: int = 0
    superseded: int = 0
    restores: int = 0
    state_requests: int = 0
    states_diverged: int = 0
    busy: int = 0
    refusals: dict[str, int] = msgspec.field(default_factory=dict)
    sessions_opened: int = 0
    sessions_taken_over: int = 0
    sessions_evicted: int = 0
    sessions: int = 0
    state_bytes: int = 0
    waiting: int = 0
    running: int = 0
    calls: int = 0
