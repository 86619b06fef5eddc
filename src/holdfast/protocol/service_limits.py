"""What a service accepts before it says that it is busy, and what it counts."""

from __future__ import annotations

import msgspec

from holdfast.protocol.messages import MAX_INPUTS


class ServiceLimits(msgspec.Struct, frozen=True, kw_only=True):
    """Limits of a service, beyond which robots are turned away or their sessions dropped.

    Attributes
    ----------
    max_sessions : int
        Sessions held. The least recently used is dropped first, of the owners with the most; one
        that was never served, while such sessions fill half of the room.
    max_sessions_per_robot : int or None
        Sessions of one certificate; a further one replaces its least recently used. None: no limit.
    max_state_bytes, max_configuration_bytes : int
        Of all states held, and of all session configurations, packed.
    max_idle_s : float
        A session unused for this long is dropped.
    max_waiting : int
        Tasks that wait in a lane; in that of new robots half as many. (A service always queues as
        many tasks of each kind as it has workers.)
    max_waiting_per_robot : int
        The same of one certificate.
    max_waiting_bytes : int
        Bytes of the requests that wait in a lane, likewise. A certificate has half at most.
    max_wait_ms : float
        A request with a longer expected wait is turned away, unless fewer wait than there are
        workers.
    max_calls_per_request : int
        Calls that wait for the same answer; the oldest is ended.
    progress_interval_ms : float
        From one progress reply to the next; twice that where many calls wait.
    prefetch_patience_ms : float
        Time for which a prefetch lets urgent tasks go first.
    max_decision_s : float
        Estimated time of one decision on one core (:mod:`holdfast.protocol.decision_cost`).
    max_brief_s, max_medium_s : float
        Estimated time of a decision in the lanes of these names (:mod:`holdfast.protocol.lanes`).
    max_decision_bytes : int
        Estimated memory of one decision, and of all long ones that run at a time.
    max_medium_bytes : int
        Estimated memory of a decision that is not long.
    max_steps : int
        Steps by which a state is rolled forward for one request.
    max_problems : int
        Distinct problems of which unused instances are kept.
    answers_per_session : int
        Cached parts of answers.
    """

    max_sessions: int = 1000
    max_sessions_per_robot: int | None = None
    max_state_bytes: int = 256 << 20
    max_configuration_bytes: int = 64 << 20
    max_idle_s: float = 600.0
    max_waiting: int = 1000
    max_waiting_per_robot: int = 500
    max_waiting_bytes: int = 64 << 20
    max_wait_ms: float = 100.0
    max_calls_per_request: int = 8
    progress_interval_ms: float = 50.0
    prefetch_patience_ms: float = 20.0
    max_particles: int = 1_000_000
    max_decision_s: float = 10.0
    max_brief_s: float = 0.02
    max_medium_s: float = 0.1
    max_decision_bytes: int = 256 << 20
    max_medium_bytes: int = 32 << 20
    max_steps: int = 16 * MAX_INPUTS
    max_problems: int = 32
    answers_per_session: int = 8


class ServiceStatistics(msgspec.Struct):
    """What a service has done since its start, and what it holds now.

    Attributes
    ----------
    cache_hits : int
        Requests answered, fully or in part, from the cache.
    attached : int
        Requests that joined a pending task.
    superseded : int
        Requests and prefetches dropped for a newer request of the same robot.
    restores, states_diverged : int
        States that came from a checkpoint, or came out differently than on the robot.
    state_requests, busy : int
        Requests answered with the need for the state, or turned away for lack of capacity.
    refusals : dict of str to int
        By code.
    defects : int
        Unexpected exceptions, each of which has ended a request or a link.
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
    defects: int = 0
    refusals: dict[str, int] = msgspec.field(default_factory=dict)
    sessions_opened: int = 0
    sessions_taken_over: int = 0
    sessions_evicted: int = 0
    sessions: int = 0
    state_bytes: int = 0
    waiting: int = 0
    running: int = 0
    calls: int = 0
