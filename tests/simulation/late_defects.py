"""Deliberate defects about what comes late, what moves show and sensing that is left out."""

from tests.simulation.edits import Change, Defect, Edit

from holdfast.planning.tracking import Trial
from holdfast.protocol import messages
from holdfast.protocol.question import Question
from holdfast.protocol.robot import Robot

LATE_DEFECTS: dict[str, Defect] = {}


def _defect(name: str, story: str, *changes: Change) -> None:
    LATE_DEFECTS[name] = Defect(name, story, changes)


_FOLDED_AGAIN = "state = fold(self.planner, state, *self._inputs[at])[0]"

# -- the fold --------------------------------------------------------------------------------------

_defect(
    "late_folded_in_now",
    "A late observation is folded in where the robot is, not where it was taken.",
    Edit(Trial, "_take_late", "self._before[position], sensed", "self.state, sensed"),
    Edit(Trial, "_take_late", _FOLDED_AGAIN, "pass"),
)
_defect(
    "moves_not_folded_again",
    "After a late observation the robot goes on with the belief of the step at which it was taken; "
    "only the step is set right.",
    Edit(
        Trial,
        "_take_late",
        "self.state = state",
        "self.state = self.state._replace(belief=state.belief)",
    ),
    Edit(Trial, "_take_late", _FOLDED_AGAIN, "pass"),
)
_defect(
    "observations_not_folded_again",
    "After a late observation the moves are folded again, but not what was sensed since.",
    Edit(
        Trial,
        "_take_late",
        _FOLDED_AGAIN,
        "given, action = self._inputs[at]\n"
        "if hasattr(given, 'sensing_action'):\n"
        "    given = msgspec.structs.replace(given, observation=b'')\n"
        "state = fold(self.planner, state, given, action)[0]",
    ),
)
_defect(
    "late_in_order_only",
    "Observations are taken to come in the order in which they were awaited.",
    Edit(
        Trial,
        "_take_late",
        "next((at for at, each in self._before.items() if each.step == late.taken), None)",
        "next(iter(self._before), None)",
    ),
)
_defect(
    "late_not_kept",
    "Of a late observation only the state is kept: when another one comes that belongs before it, "
    "it is not folded again.",
    Edit(Trial, "_take_late", "self._inputs[position] = sensed, None", "pass"),
)
_defect(
    "states_before_not_renewed",
    "A late observation does not change the states that are kept for those still awaited.",
    Edit(Trial, "_take_late", "self._before |= again", "pass"),
)
_defect(
    "late_folded_in_twice",
    "An observation that has come is still awaited: when the environment tells it again, after a "
    "crash of the robot, it is folded in again.",
    Edit(Trial, "_take_late", "del self._before[position]", "pass"),
)

# -- the robot and its journal ---------------------------------------------------------------------

_defect(
    "late_not_written",
    "The journal does not get late observations.",
    Edit(
        Robot,
        "_take_late_observation",
        "self._unwritten.append(history.take(given))",
        "history.take(given)",
    ),
)
_defect(
    "late_between_order_and_performance",
    "A journal that has a late observation between an action and its performance cannot be read.",
    Edit(
        Trial,
        "_take",
        "isinstance(given, Sensed | ActingRecord) and pending is not None",
        "not isinstance(given, Moved) and pending is not None",
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
    Edit(Robot, "_settle_pending_action", "begun.last or Moved(known, None)", "Moved(known, None)"),
)
_defect(
    "move_not_written",
    "The journal has that an action was performed, but not what the move has shown.",
    Edit(
        Robot,
        "_fold_move",
        "self._unwritten.append(self._current_history.take(moved))",
        "self._current_history.take(moved)\n"
        "self._unwritten.append(Moved(moved.step, moved.reward))",
    ),
)

_defect(
    "new_belief_not_written",
    "The journal does not say that the belief of a lost robot was begun anew.",
    Edit(
        Robot,
        "_reinitialise",
        "self._write(history.take(Reinitialised(history.state.step)))",
        "history.take(Reinitialised(history.state.step))",
    ),
)
_defect(
    "new_belief_not_folded_again",
    "A late observation that was taken before the belief was begun anew brings the old one back.",
    Edit(
        Trial,
        "_take_late",
        _FOLDED_AGAIN,
        "given, action = self._inputs[at]\n"
        "if not isinstance(given, Reinitialised):\n"
        "    state = fold(self.planner, state, given, action)[0]",
    ),
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
        Trial,
        "_note_input",
        "(*self.inputs, given)[-MAX_INPUTS:] if isinstance(given, Sensed | Moved) else ()",
        "(*self.inputs, *((given,) if isinstance(given, Sensed | Moved) else ()))[-MAX_INPUTS:]",
    ),
)
_defect(
    "motion_not_told",
    "Services get the observation that came with a move, but not the measured motion.",
    Edit(
        messages,
        "_sent",
        "_SentMoved(given.step, given.motion, given.observation)",
        "_SentMoved(given.step, b'', given.observation)",
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
