"""What a service takes on before it says that it is busy, and what it counts.

Nothing here decides anything: the limits are what the other parts of a service look up, and the
statistics are what a person is shown of it.
"""

from __future__ import annotations

import msgspec

from holdfast.session.messages import MAX_OBSERVATIONS

__all__ = ["ServiceLimits", "ServiceStatistics"]


class ServiceLimits(msgspec.Struct, frozen=True, kw_only=True):
    """What a service takes on. Beyond it robots are turned away, or forgotten and handed over anew.

    Attributes
    ----------
    max_sessions : int
        Robots remembered; the one unused the longest is forgotten first, but for newcomers one
        that was never served if these are half of them. Of robots with certificates it is one of
        those that have the most sessions.
    max_sessions_per_robot : int or None
        Sessions with one robot's certificate; one more takes the place of the one unused the
        longest. None: as many as there is room for.
    max_state_bytes : int
        Of all states remembered.
    max_opening_bytes : int
        Of all openings remembered, which are kept as they came.
    max_idle_s : float
        A robot that was not heard for this long is forgotten.
    max_waiting : int
        Requests that wait for a worker; robots that were never served have half of it at most.
        (Or of these, and of those that were served, as many each as there are workers, if that is
        more: a service is never too small for one robot.)
    max_waiting_per_robot : int
        Of these, with one certificate.
    max_waiting_bytes : int
        Of these requests, likewise; with one certificate half of it at most.
    max_wait_ms : float
        A request that would wait longer than this, by estimate, is turned away; not as
        long as fewer wait than there are workers.
    max_calls_per_request : int
        Calls that wait for the same answer; the oldest is ended.
    progress_interval_ms : float
        A robot is told this often that its request is in work; half as often where many wait.
    prefetch_patience_ms : float
        A sensing part that no robot stands still for lets others go first for this long.
    max_particles : int
        Of one robot.
    max_work : int
        Of one decision: particles times observation samples times sensing actions times horizon.
    max_steps : int
        Steps that a state is rolled forward for one request.
    max_threads : int
        Of one decision, whatever a robot's settings say; one, while several are computed.
    max_problems : int
        Problems kept for the next robot that has the same.
    answers_per_session : int
        Parts of answers remembered.
    """

    max_sessions: int = 1000
    max_sessions_per_robot: int | None = None
    max_state_bytes: int = 256 << 20
    max_opening_bytes: int = 64 << 20
    max_idle_s: float = 600.0
    max_waiting: int = 1000
    max_waiting_per_robot: int = 500
    max_waiting_bytes: int = 64 << 20
    max_wait_ms: float = 100.0
    max_calls_per_request: int = 8
    progress_interval_ms: float = 50.0
    prefetch_patience_ms: float = 20.0
    max_particles: int = 1_000_000
    max_work: int = 10**9
    max_steps: int = 16 * MAX_OBSERVATIONS
    max_threads: int = 64
    max_problems: int = 32
    answers_per_session: int = 8


class ServiceStatistics(msgspec.Struct):
    """What a service has done since it began, and what it holds now.

    Attributes
    ----------
    task_parts, sensing_parts : int
        Parts of answers computed.
    cache_hits : int
        Requests answered, wholly or up to what is in work, from what was computed before.
    attached : int
        Requests that joined one already in work.
    superseded : int
        Requests dropped for a newer one of the same robot.
    restores : int
        States taken from a checkpoint.
    state_requests : int
        Requests answered with the wish for the state.
    states_diverged : int
        States that came out otherwise than on the robot, which its copy has replaced since.
    busy : int
        Requests turned away for lack of capacity.
    refusals : dict of str to int
        By code.
    sessions_opened, sessions_taken_over, sessions_evicted : int
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
