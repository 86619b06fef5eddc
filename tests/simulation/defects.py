"""Deliberate defects: what a careless engineer might have written, for the simulator to find.

A checker that never fails shows nothing. So here are small changes of the production code, each of
which leaves a run without faults as it was, and most of which need one particular fault to do harm:
a reply that goes astray, a process that dies between two effects, a clock whose rounding is
unlucky. Each is written as the lines that are replaced, so it is seen at once what is wrong, and a
change of the production code that makes a defect meaningless is an error and not a silence.

``python -m tests.simulation.defects`` prints a table of how many seeds each takes.
"""

import argparse
import multiprocessing
from typing import Any, NamedTuple

from tests.simulation.edits import Change, Defect, Edit, Replacement, applied
from tests.simulation.late_defects import LATE_DEFECTS

from holdfast.protocol import requests, service
from holdfast.protocol.dispatcher import Dispatcher
from holdfast.protocol.failure_detector import FailureDetector
from holdfast.protocol.local_service import RestartPolicy
from holdfast.protocol.question import Question
from holdfast.protocol.robot import Robot
from holdfast.protocol.service import Service
from holdfast.protocol.service_jobs import Job
from holdfast.protocol.service_sessions import SessionTable
from holdfast_lab.simulation import service_node
from holdfast_lab.simulation.schedule import RunSettings, SimulationSchedule
from holdfast_lab.simulation.schedule_draws import draw_schedule
from holdfast_lab.simulation.world import Simulator

LIMIT = 2000
"""Seeds within which each defect is to be found."""


class Finding(NamedTuple):
    """Where a defect was found."""

    seed: int
    violation: str


def without_faults(defect: Defect, trials: range) -> str | None:
    """Return what runs without faults show of a defect, which is to be nothing."""
    with applied(defect):
        simulator = Simulator()
        for trial in trials:
            violation = simulator.run(SimulationSchedule(RunSettings(trial=trial))).violation
            if violation is not None:
                return violation
    return None


def seeds_needed(defect: Defect, limit: int = LIMIT) -> Finding | None:
    """Return the first seed whose run shows a defect; None if none below the limit does."""
    with applied(defect):
        # One of its own, for what it remembers was computed with the defect.
        simulator = Simulator()
        for seed in range(limit):
            violation = simulator.run(draw_schedule(seed)).violation
            if violation is not None:
                return Finding(seed, violation)
    return None


def violation_of(defect: Defect, schedule: SimulationSchedule) -> str | None:
    """Return what one schedule shows of a defect."""
    with applied(defect):
        return Simulator().run(schedule).violation


class _DrawingJob(Job):
    """Takes the random numbers of a sensing decision from a generator that its session keeps.

    A generator goes wrong by how often it was asked before; so the position is counted, and the
    numbers are those of the sensing step that would be at this position in a run without faults.
    """

    __slots__ = ("position",)

    # By session, which its opening stands for: it is kept, so its identity is not another one's.
    drawn: dict[int, tuple[bytes, dict[int, int]]] = {}  # noqa: RUF012

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.position = 0
        named = self.request or self.state
        assert named is not None
        if self.kind == "sensing":
            _, positions = self.drawn.setdefault(id(self._configuration), (self._configuration, {}))
            self.position = positions.get(named.trial, 0)
            positions[named.trial] = self.position + 1

    @property
    def identity(self) -> tuple[object, ...]:
        return (*super().identity, self.position)


DEFECTS: dict[str, Defect] = {}


def _defect(name: str, story: str, *changes: Change) -> None:
    DEFECTS[name] = Defect(name, story, changes)


# -- the service -----------------------------------------------------------------------------------

_defect(
    "stale_epoch_accepted",
    "The service answers whoever asks, also a process of the robot that has been replaced.",
    Edit(Service, "_handle", "if request.epoch < epoch:", "if False:"),
)
_defect(
    "new_epoch_not_noted",
    "The service drops what a robot's last process waited for, but does not note the epoch of the "
    "next one.",
    Edit(Service, "_take_over", "session.epoch, session.number = epoch, -1", "session.number = -1"),
)
_defect(
    "old_process_still_served",
    "The service notes that a robot's process was replaced, but still answers what that one had "
    "asked before.",
    Edit(Service, "_take_over", "self._supersede(session, None)", "pass"),
)
_defect(
    "epoch_forgotten_with_session",
    "A service that forgets a robot's session also forgets which of its processes was the last.",
    Edit(SessionTable, "forget", "self.note_epoch(session.key, session.epoch)", "pass"),
)
_defect(
    "draws_by_position",
    "The service draws from one generator for each session, instead of by the name of the step.",
    Replacement(service, "Job", _DrawingJob),
    Edit(
        Job,
        "_computed",
        "choose_sensing_action(self.state)",
        "choose_sensing_action(\n"
        "    self.state._replace(step=self.position * (planning.sensing_interval + 1)))",
    ),
    Edit(
        Job,
        "_computed",
        "choose_sensing_action(state)",
        "choose_sensing_action(\n"
        "    state._replace(step=self.position * (planning.sensing_interval + 1)))",
    ),
)
_defect(
    "no_reply_cache",
    "The service remembers which states it has answered, but not the answers: who asks again is "
    "told that the call is over.",
    Edit(
        Service,
        "_answer_from_cache",
        "following = answer.following",
        "self._effects.append(EndCall(call))\nreturn True, None\nfollowing = answer.following",
    ),
)
_defect(
    "half_an_answer_cached",
    "A task part that is answered from memory ends the call; the sensing part is not thought of.",
    Edit(
        Service,
        "_answer_from_cache",
        "if rest is not None:\n    self._calls.attach(",
        "if answer.num_actions:\n"
        "    self._effects.append(EndCall(call))\n"
        "    return True, None\n"
        "if rest is not None:\n"
        "    self._calls.attach(",
    ),
)
_defect(
    "answers_by_step",
    "Answers are remembered by step, not by the digest of the state.",
    Edit(
        Service,
        "_answer_from_cache",
        "answer = session.answers.get(request.digest)",
        "asked = request.step, request.sensed\n"
        "answer = next((kept for kept in session.answers.values()\n"
        "               if (kept.step, kept.sensed) == asked), None)",
    ),
    Edit(
        Service,
        "_answer_from_cache",
        "if (answer.trial, answer.step, answer.sensed) != asked:",
        "if False:",
    ),
)
_defect(
    "restored_unverified",
    "A checkpoint is restored without looking at the digest, nor at the checksum of its request.",
    Edit(
        service_node,
        "decode_request",
        "_checked_content(payload)",
        "memoryview(payload)[:-CHECKSUM_SIZE]",
    ),
    Edit(
        Job, "_restored", "if planner.digest(state)[:DIGEST_SIZE] != request.digest:", "if False:"
    ),
)
_defect(
    "held_work_left",
    "A request that waited for the robot's one before is not lined up when that has run.",
    Edit(Service, "next_jobs", "self._queue.release_held(session)", "pass"),
)
_defect(
    "forgotten_at_work",
    "A robot that was not heard is forgotten even while something is computed for it.",
    Edit(SessionTable, "idle_at", "if session is None or session.pending:", "if session is None:"),
)
_defect(
    "idle_by_difference",
    "Whether a robot was not heard for too long is told by a difference of times, when to look by "
    "a sum.",
    Edit(
        SessionTable,
        "idle",
        "due > now",
        "now - next(iter(self._sessions.values())).used_at < self._limits.max_idle_s",
    ),
)
_defect(
    "superseded_calls_left",
    "The calls of a request that a newer one has replaced are dropped instead of ended.",
    Edit(Service, "_supersede", "self._calls.end(task)", "self._calls.detach(task)"),
)
_defect(
    "late_calls_left",
    "The call of a request that comes after a newer one is dropped instead of ended.",
    Edit(Service, "_handle", "self._effects.append(EndCall(call))", "pass"),
)

# -- messages --------------------------------------------------------------------------------------

_defect(
    "reply_checksum_ignored",
    "The robot leaves it to TCP to find damaged replies.",
    Edit(
        requests,
        "decode_reply",
        "_checked_content(payload)",
        "memoryview(payload)[:-CHECKSUM_SIZE]",
    ),
)
_defect(
    "request_checksum_ignored",
    "The service leaves it to TCP to find damaged requests.",
    Edit(
        service_node,
        "decode_request",
        "_checked_content(payload)",
        "memoryview(payload)[:-CHECKSUM_SIZE]",
    ),
)
_defect(
    "reply_number_ignored",
    "A reply is taken for the answer to the call that it comes in, whatever number it repeats.",
    Edit(requests, "_check_number", "if reply.number != asked and not unread:", "if False:"),
)
_defect(
    "reply_matched_by_kind",
    "Any sensing answer is taken for the one that is waited for; its number, its step and its "
    "state are not looked at.",
    Edit(
        requests,
        "_check_number",
        "if reply.number != asked and not unread:",
        "if reply.number != asked and not unread and not isinstance(reply, SensingAnswer):",
    ),
    Edit(
        Question,
        "check_sensing",
        "if self.task_count == 0 and reply.digest != self.digest:",
        "if False:",
    ),
    Edit(Question, "check_sensing", "if reply.step != self.sensing_step:", "if False:"),
    Edit(
        Robot,
        "_next_sensing",
        "answer.digest != self._planner.digest(state)[:DIGEST_SIZE]",
        "False",
    ),
)

# -- the robot and its journal ---------------------------------------------------------------------

_defect(
    "act_before_journal",
    "The robot performs a task action before it writes it to the journal.",
    Edit(
        Robot,
        "_next_action",
        "self._write(ActingRecord(",
        "self._effects.append(Act(state.step, action))\nself._write(ActingRecord(",
    ),
    Edit(
        Robot,
        "_next_action",
        "self._awaits_environment = True\nself._effects.append(Act(state.step, action))",
        "self._awaits_environment = True",
    ),
)
_defect(
    "observation_not_written",
    "The journal gets the task actions, but not the observations.",
    Edit(Robot, "_sensed", "self._unwritten.append(record)", "pass"),
)
_defect(
    "performance_not_written",
    "The journal does not record that an action was performed; the next action implies it.",
    Edit(
        Robot,
        "_fold_move",
        "self._unwritten.append(self._current_history.take(moved))",
        "self._current_history.take(moved)",
    ),
)
_defect(
    "pending_action_assumed_done",
    "A restarted robot assumes that the last action in its journal was performed.",
    Edit(
        Robot,
        "_settle_pending_action",
        "if history.pending is not None and performed == known + 1:",
        "if history.pending is not None:",
    ),
)
_defect(
    "pending_action_repeated",
    "A restarted robot performs the last action in its journal without asking whether it "
    "was performed.",
    Edit(
        Robot,
        "_settle_pending_action",
        "if performed is None:",
        "if history.pending is not None:\n    return history.pending\nif performed is None:",
    ),
)
_defect(
    "unknown_performance_guessed",
    "Where the environment cannot tell whether the last action was performed, it is performed.",
    Edit(
        Robot,
        "_settle_pending_action",
        "if not resumed or (",
        "if history.pending is not None:\n    return history.pending\nif not resumed or (",
    ),
)
_defect(
    "journal_tail_trusted",
    "After a power cut the robot assumes that its journal is complete.",
    Edit(Robot, "_settle_pending_action", "(history.paused or tail_is_certain)", "True"),
)
_defect(
    "paused_while_performing",
    "A robot that is asked to end does not wait for the action that it is performing.",
    Edit(
        Robot,
        "_go_on",
        "self._awaits_environment or",
        "(self._awaits_environment and not self._pausing) or",
    ),
)

# -- the robot and its services --------------------------------------------------------------------

_defect(
    "both_answers_performed",
    "The robot performs each answer, also the second one to a request that it sent twice.",
    Edit(
        Robot,
        "handle",
        "self._source.handle(event, now)",
        "self._source.handle(event, now)\n"
        "question = self._source.question\n"
        "tasks_come = getattr(event, 'payload', b'..')[1] == 1\n"
        "if tasks_come and question is not None and question.task_actions is not None:\n"
        "    self._awaits_environment = False",
    ),
)
_defect(
    "suspected_never_asked",
    "The robot asks a suspected service nothing, so the service can never answer and be trusted "
    "again.",
    Edit(Dispatcher, "_hold_and_retry", "replica.detector.present\n", "replica.detector.trusted\n"),
    Edit(
        requests.OpenRequests,
        "probe_at",
        "not replica.detector.present",
        "not replica.detector.trusted",
    ),
)
_defect(
    "given_up_cloud_never_tried",
    "The robot never asks a cloud again that it considers lost, neither periodically nor "
    "when the cloud reappears, because the local service decides.",
    Edit(Dispatcher, "_try_others", "if at is not None and at <= now:", "if False:"),
    Edit(Dispatcher, "_appeared", "self.tracker.is_recovering and question", "False and question"),
)
_defect(
    "old_process_taken_for_new",
    "A report that a service's process has ended is applied to the process that replaced it.",
    Edit(
        FailureDetector,
        "vanished",
        "if incarnation != self.incarnation:",
        "if self.incarnation is None:",
    ),
)
_defect(
    "launch_tried_once",
    "A local service that failed to start is not started again.",
    Edit(RestartPolicy, "failed", "if self._launch_after is not None:", "if True:"),
)
_defect(
    "silence_not_timed",
    "The robot sets no timeout for a request, because sooner or later an answer will come.",
    Edit(
        Dispatcher,
        "next_wakeup",
        "due += [replica.detector.deadline() for replica in services]",
        "pass",
    ),
    Edit(Dispatcher, "next_wakeup", "elif self.needed_at is not None:", "elif False:"),
)
_defect(
    "retry_not_timed",
    "The robot sets no timer for asking a service again.",
    Edit(
        Dispatcher,
        "next_wakeup",
        "if replica.detector.present and replica.refusal is None",
        "if False",
    ),
)
_defect(
    "cloud_back_when_seen",
    "The status returns to the cloud when a cloud service appears, before it has answered.",
    Edit(
        Dispatcher,
        "_appeared",
        "# It need not wait for the next turn",
        "self.tracker.change(Cause.CLOUD_ANSWERED, 'seen', now)\n# It need not wait",
    ),
)
_defect(
    "session_of_anybody",
    "A service identifies a session by its bytes alone, and does not compare the certificate.",
    Edit(Service, "receive", "(owner, request.session)", "(None, request.session)"),
)
_defect(
    "any_answer_ends_recovery",
    "An answer of the local service also counts as the cloud's return.",
    Edit(
        Dispatcher, "_replied", "elif is_answer and is_first and", "if is_answer and is_first and"
    ),
)
_defect(
    "cloud_lost_twice",
    "The robot reports the loss of the cloud in every status.",
    Edit(Dispatcher, "_note_lost_cloud", "and not self.tracker.is_recovering", ""),
)
DEFECTS |= LATE_DEFECTS


def _row(name: str, limit: int) -> str:
    defect = DEFECTS[name]
    before = without_faults(defect, range(4))
    if before is not None:
        raise ValueError(f"{name} shows without any fault, and so proves nothing: {before}")
    finding = seeds_needed(defect, limit)
    seeds, found = ("none", "") if finding is None else (finding.seed + 1, finding.violation)
    return f"| `{name}` | {defect.story} | {seeds} | {found} |"


def main() -> None:
    """Print how many seeds each defect takes."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--only", metavar="NAME", nargs="*", choices=DEFECTS, default=DEFECTS)
    parser.add_argument("--limit", type=int, default=LIMIT, help="seeds for each (%(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (%(default)s)")
    options = parser.parse_args()
    print("| defect | what it is | seeds needed | what was found |")
    print("|---|---|---:|---|")
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        arguments = [(name, options.limit) for name in options.only]
        for row in pool.starmap(_row, arguments, chunksize=1):
            print(row)


if __name__ == "__main__":
    main()
