"""Deliberate defects about what comes late, what moves show and sensing that is left out."""

from __future__ import annotations

from tests.simulation.edits import Change, Defect, Edit

from holdfast.planning.tracking import Trial
from holdfast.protocol import records
from holdfast.protocol.question import Question
from holdfast.protocol.records import TrialHistory
from holdfast.protocol.robot import Robot

__all__ = ["LATE_DEFECTS"]

LATE_DEFECTS: dict[str, Defect] = {}


def _defect(name: str, story: str, *changes: Change) -> None:
    LATE_DEFECTS[name] = Defect(name, story, changes)


_FOLDED_AGAIN = "state = self._folded(state, self._inputs[at])"

# -- the fold --------------------------------------------------------------------------------------

_defect(
    "late_folded_in_now",
    "A late observation is folded in where the robot is, not where it was taken.",
    Edit(Trial, "observe_late", "state = self._before[position]", "state = self.state"),
    Edit(Trial, "observe_late", _FOLDED_AGAIN, "pass"),
)
_defect(
    "moves_not_folded_again",
    "After a late observation the robot goes on with the belief of the step at which it was taken; "
    "only the step is set right.",
    Edit(
        Trial,
        "observe_late",
        "self.state = state",
        "self.state = self.state._replace(belief=state.belief)",
    ),
    Edit(Trial, "observe_late", _FOLDED_AGAIN, "pass"),
)
_defect(
    "observations_not_folded_again",
    "After a late observation the moves are folded again, but not what was sensed since.",
    Edit(
        Trial,
        "observe_late",
        _FOLDED_AGAIN,
        "given = self._inputs[at]\n"
        "if hasattr(given, 'sensing_action'):\n"
        "    given = given._replace(observation=None)\n"
        "state = self._folded(state, given)",
    ),
)
_defect(
    "late_in_order_only",
    "Observations are taken to come in the order in which they were awaited.",
    Edit(
        Trial,
        "observe_late",
        "next((at for at, state in self._before.items() if state.step == late.step), None)",
        "next(iter(self._before), None)",
    ),
)
_defect(
    "late_not_kept",
    "Of a late observation only the state is kept: when another one comes that belongs before it, "
    "it is not folded again.",
    Edit(
        Trial,
        "observe_late",
        "self._inputs[position] = _Sensed(sensed.sensing_action, late.observation)",
        "pass",
    ),
)
_defect(
    "states_before_not_renewed",
    "A late observation does not change the states that are kept for those still awaited.",
    Edit(Trial, "observe_late", "self._before |= again", "pass"),
)
_defect(
    "late_folded_in_twice",
    "An observation that has come is still awaited: when the environment tells it again, after a "
    "crash of the robot, it is folded in again.",
    Edit(Trial, "observe_late", "del self._before[position]", "pass"),
)

# -- the robot and its journal ---------------------------------------------------------------------

_defect(
    "late_not_written",
    "The journal does not get late observations.",
    Edit(Robot, "_take_late_observation", "self._unwritten.append(record)", "pass"),
)
_defect(
    "late_between_order_and_performance",
    "A journal that has a late observation between an action and its performance cannot be read.",
    Edit(
        records,
        "_replay_record",
        "isinstance(record, ObservedRecord | ActingRecord) and history.pending is not None",
        "not isinstance(record, PerformedRecord) and history.pending is not None",
    ),
)
_defect(
    "late_at_resume_not_asked",
    "A robot that is started again does not use what was sensed before the crash.",
    Edit(Robot, "begin_trial", "for late in begun.late:", "for late in ():"),
)
_defect(
    "last_move_not_used",
    "The environment tells again what the last move before a crash has shown; the robot takes the "
    "model's move.",
    Edit(
        Robot,
        "_settle_pending_action",
        "begun.last or Acted(known, None, None)",
        "Acted(known, None, None)",
    ),
)
_defect(
    "move_not_written",
    "The journal has that an action was performed, but not what the move has shown.",
    Edit(
        Robot,
        "_fold_move",
        "self._unwritten.append(record)",
        "self._unwritten.append(PerformedRecord(event.step, event.reward))",
    ),
)

_defect(
    "new_belief_not_written",
    "The journal does not say that the belief of a lost robot was begun anew.",
    Edit(
        Robot,
        "_reinitialise",
        "self._write(history.fold_reinitialisation())",
        "history.fold_reinitialisation()",
    ),
)
_defect(
    "new_belief_not_folded_again",
    "A late observation that was taken before the belief was begun anew brings the old one back.",
    Edit(Trial, "_folded", "return self.planner.reinitialise(state)", "return state"),
)

# -- questions and services ------------------------------------------------------------------------

_STALE_QUESTION = Edit(
    Robot, "_question", "or question.num_inputs != self._current_history.num_inputs", ""
)

_defect(
    "stale_answer_used",
    "The robot goes on with the answer that it has, although an observation has come late.",
    _STALE_QUESTION,
)
_defect(
    "acts_on_the_asked_belief",
    "A robot that takes its task actions itself takes them from the belief with which it asked, "
    "although an observation has come late.",
    _STALE_QUESTION,
    Edit(
        Robot,
        "_next_action",
        "self._planner.choose_task_action(state)[0]",
        "self._planner.plan_until_sensing(question.state, offset + 1)[0][offset]",
    ),
)
_defect(
    "choice_of_another_step",
    "The robot counts from where it asks up to the step for which it wants a sensing action, and "
    "at that step does not look whether it has asked for it.",
    Edit(Question, "__init__", "(state.step // interval + 1) * interval", "state.step + interval"),
    Edit(Robot, "_next_sensing", "question.sensing_step != state.step", "False"),
)
_defect(
    "late_not_told",
    "To a service that knows everything up to a late observation the robot sends the input before.",
    Edit(
        TrialHistory,
        "_add",
        "() if given is None else (*self.inputs, given)[-MAX_INPUTS:]",
        "(*self.inputs, *((given,) if given else ()))[-MAX_INPUTS:]",
    ),
)
_defect(
    "motion_not_told",
    "Services get the observation that came with a move, but not the measured motion.",
    Edit(
        TrialHistory,
        "fold_move",
        "Moved(record.step, motion, observation)",
        "Moved(record.step, b'', observation)",
    ),
)
_defect(
    "moves_planned_ahead",
    "The robot asks for all actions up to the next sensing step, although each move shows "
    "something.",
    Edit(Question, "__init__", "elif planner.moves_give_observations:", "elif False:"),
)
_defect(
    "not_sensing_ordered",
    "The robot orders the choice not to sense from the environment, like the others.",
    Edit(
        Robot, "_next_sensing", "if answer.sensing_action == self._planner.no_sensing:", "if False:"
    ),
)
