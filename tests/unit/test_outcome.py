"""A trial's decisions as bytes, and its outcome."""

import hashlib
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.recordings import failed, result_of

from holdfast.errors import InvalidValueError
from holdfast.planning.inputs import ActingRecord, Sensed, encode_floats
from holdfast.planning.outcome import TRIAL_COLUMNS, DecisionLog, Decisions, RewardAccount
from holdfast.problems.peg_in_hole_2d import PegInHole2D

DIGEST = bytes(range(32))


def whole() -> Decisions:
    log = DecisionLog(2)
    log.sensed(0, 1, DIGEST)
    log.acted(0, np.array([0.5, -0.0]))
    log.acted(1, np.array([1e-300, 2.0]))
    log.ended(2, DIGEST)
    return log.decisions()


def test_what_is_noted_is_read_back() -> None:
    decisions = whole()
    assert list(decisions) == [
        Sensed(0, 1, b"", DIGEST),
        ActingRecord(0, encode_floats([0.5, -0.0])),
        (last := ActingRecord(1, encode_floats([1e-300, 2.0]))),
    ]
    assert last.task_action.tolist() == [1e-300, 2.0]
    assert decisions.digest() == hashlib.blake2b(decisions.log, digest_size=32).hexdigest()


def test_the_layout_is_pinned() -> None:
    """Runs of years ago are compared by it."""
    assert whole().log.hex() == (
        "53" + 8 * "00" + "01000000" + DIGEST.hex()
        + "41" + 8 * "00" + "000000000000e03f" + "0000000000000080"
        + "41" + "0100000000000000" + np.float64(1e-300).tobytes().hex() + "0000000000000040"
        + "45" + "0200000000000000" + DIGEST.hex()
    )  # fmt: skip


def test_a_result_in_words() -> None:
    lost = msgspec.structs.replace(failed(result_of(990)), reason="hit a wall")
    assert lost.in_words() == "failed after 1,000 steps, 0 sensing actions: hit a wall; reward -1"
    quiet = msgspec.structs.replace(result_of(0), reward=None)
    assert quiet.in_words() == "succeeded after 10 steps, 0 sensing actions"


@pytest.mark.parametrize("length", [1, 20, 44, 50, 60, 94, 130])
def test_a_log_that_is_cut_short(length: int) -> None:
    with pytest.raises(InvalidValueError, match=rf"of {length} is cut short"):
        list(Decisions(2, whole().log[:length]))


def test_a_record_of_no_kind() -> None:
    with pytest.raises(InvalidValueError, match="byte 0 is b'X', which begins no record"):
        list(Decisions(2, b"X" + whole().log[1:]))


def test_the_sum_of_rewards_begins_with_the_first() -> None:
    rewards = RewardAccount(PegInHole2D())
    rewards.sensed(0)
    rewards.acted(None)
    totals = [rewards.total]
    for reward in (-1.0, None, -0.5):
        rewards.acted(reward)
        totals.append(rewards.total)
    assert totals == [None, -1.0, -1.0, -1.5]


def test_sensing_actions_cost_their_price() -> None:
    problem = PegInHole2D()
    problem.sensing_costs = (0.5, 0.25, 0.0)  # type: ignore[attr-defined]
    rewards = RewardAccount(problem)
    assert rewards.total == 0.0
    for sensing_action in (0, 2, 1):
        rewards.sensed(sensing_action)
    assert rewards.total == -0.75


@pytest.mark.parametrize(
    ("ending", "outcome"),
    [
        ({"success": True}, "succeeded"),
        ({"success": False, "failed": True}, "failed"),
        ({"success": False}, "truncated"),
    ],
)
def test_outcomes(ending: dict[str, Any], outcome: str) -> None:
    assert msgspec.structs.replace(result_of(0), **ending).outcome == outcome


def test_every_column_is_of_a_result() -> None:
    result = failed(result_of(3))
    row = {column: getattr(result, column) for column in TRIAL_COLUMNS}
    assert (row["trial"], row["success"], row["outcome"]) == (3, False, "failed")
    assert not {"decisions", "sensing_ms", "failed"} & row.keys()


def test_when_a_belief_was_begun_anew_is_in_the_log() -> None:
    """Moves that have shown nothing are no inputs; those that have, and late observations, are."""
    log = DecisionLog(1)
    state = bytes(32)
    log.sensed(0, 1, state)
    log.acted(0, np.zeros(1))
    log.acted(1, np.zeros(1))
    log.moved(1, state)
    log.reinitialised(2, state)
    log.reinitialised(2, state)
    log.observed_late(0, 2, state)
    log.reinitialised(2, state)
    log.ended(2, state)
    assert log.decisions().reinitialised_after() == {2, 3, 5}
    assert DecisionLog(1).decisions().reinitialised_after() == frozenset()
