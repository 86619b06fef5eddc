"""Inputs of a trial, folded in at once."""

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.inputs import Late, Moved, Reinitialised, Sensed, encode_floats
from holdfast.planning.tracking import Trial


def sense(
    trial: Trial, sensing_action: int, observation: FloatArray | None, sensing_ms: float = 0.0
) -> Sensed:
    """Fold in a sensing action; without an observation it comes late."""
    shown = encode_floats(observation)
    return trial.take(Sensed(trial.state.step, sensing_action, shown, sensing_ms=sensing_ms))


def move(
    trial: Trial,
    action: FloatArray,
    reward: float | None = None,
    motion: FloatArray | None = None,
    observation: FloatArray | None = None,
) -> Moved:
    """Fold in a task action and what it has shown."""
    trial.pending = action
    shown = encode_floats(motion), encode_floats(observation)
    return trial.take(Moved(trial.state.step, reward, *shown))


def come_late(trial: Trial, taken: int, observation: FloatArray) -> Late:
    """Fold in an observation of an earlier step."""
    return trial.take(Late(trial.state.step, taken, encode_floats(observation)))


def begin_anew(trial: Trial) -> Reinitialised:
    """Begin the belief anew."""
    return trial.take(Reinitialised(trial.state.step))
