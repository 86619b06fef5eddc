"""What a service accepts before it says that it is busy, and what it counts."""

from __future__ import annotations

import msgspec

from holdfast.planning.inputs import MAX_INPUTS


class ServiceLimits(msgspec.Struct, frozen=True, kw_only=True):
    """Limits of a service, beyond which robots are turned away or their sessions dropped."""

    # Sessions held. The least recently used is dropped first, of the owners with the most; one that
    # was never served, while such sessions fill half of the room.
    max_sessions: int = 1000
    # Sessions of one certificate; a further one replaces its least recently used. None: no limit.
    max_sessions_per_robot: int | None = None
    # max_state_bytes, max_configuration_bytes: of all states held, and of all session
    # configurations, packed.
    max_state_bytes: int = 256 << 20
    max_configuration_bytes: int = 64 << 20
    max_idle_s: float = 600.0  # a session unused for this long is dropped
    # Tasks that wait in a lane; in that of new robots half as many. (A service always queues as
    # many tasks of each kind as it has workers.)
    max_waiting: int = 1000
    max_waiting_per_robot: int = 500  # the same of one certificate
    # Bytes of the requests that wait in a lane, likewise. A certificate has half at most.
    max_waiting_bytes: int = 64 << 20
    # A request with a longer expected wait is turned away, unless fewer wait than there are
    # workers.
    max_wait_ms: float = 100.0
    max_calls_per_request: int = 8  # calls that wait for the same answer; the oldest is ended
    # From one progress reply to the next; twice that where many calls wait.
    progress_interval_ms: float = 50.0
    prefetch_patience_ms: float = 20.0  # time for which a prefetch lets urgent tasks go first
    max_particles: int = 1_000_000
    # Estimated time of one decision on one core (:mod:`holdfast.protocol.decision_cost`).
    max_decision_s: float = 10.0
    # max_brief_s, max_medium_s: estimated time of a decision in the lanes of these names
    # (:mod:`holdfast.protocol.service_lanes`).
    max_brief_s: float = 0.02
    max_medium_s: float = 0.1
    # Estimated memory of one decision, and of all long ones that run at a time.
    max_decision_bytes: int = 256 << 20
    max_medium_bytes: int = 32 << 20  # estimated memory of a decision that is not long
    max_steps: int = 16 * MAX_INPUTS  # steps by which a state is rolled forward for one request
    max_problems: int = 32  # distinct problems of which unused instances are kept
    answers_per_session: int = 8  # cached parts of answers


class ServiceStatistics(msgspec.Struct):
    """What a service has done since its start, and what it holds now."""

    task_parts: int = 0
    sensing_parts: int = 0
    cache_hits: int = 0  # requests answered, fully or in part, from the cache
    attached: int = 0  # requests that joined a pending task
    superseded: int = 0  # requests and prefetches dropped for a newer request of the same robot
    # restores, states_diverged: states that came from a checkpoint, or came out differently than on
    # the robot.
    restores: int = 0
    # state_requests, busy: requests answered with the need for the state, or turned away for lack
    # of capacity.
    state_requests: int = 0
    states_diverged: int = 0
    busy: int = 0
    defects: int = 0  # unexpected exceptions, each of which has ended a request or a link
    refusals: dict[str, int] = msgspec.field(default_factory=dict)  # by code
    sessions_opened: int = 0
    sessions_taken_over: int = 0
    sessions_evicted: int = 0
    # sessions, state_bytes, waiting, running, calls: held now.
    sessions: int = 0
    state_bytes: int = 0
    waiting: int = 0
    running: int = 0
    calls: int = 0
