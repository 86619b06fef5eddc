"""The typed service and its client: decisions as in process, whoever answers and whoever dies."""

from pathlib import Path

import numpy as np

from holdfast.config.loader import Configuration, load
from holdfast.planning.planner import Planner
from holdfast_ros.active_sensing import ActiveSensing, DecisionRequest, ErrorCode, RequestKind

EXAMPLE = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"


def configuration(**changes: object) -> Configuration:
    return load(EXAMPLE, overrides={"particle_filter.num_particles": 50, **changes})


def test_what_nobody_can_answer_is_said() -> None:
    service = ActiveSensing(configuration())
    state = service.answer(DecisionRequest(RequestKind.INITIALIZE, seed=3, trial=1)).state
    assert state is not None

    def refused(request: DecisionRequest) -> str:
        answer = service.answer(request)
        assert answer.error is ErrorCode.BAD_REQUEST
        assert answer.state is None
        return answer.message

    assert "state" in refused(DecisionRequest(RequestKind.CHOOSE_SENSING_ACTION))
    assert "kind 9" in refused(DecisionRequest(9))
    assert "sensing action 77" in refused(
        DecisionRequest(
            RequestKind.CHOOSE_TASK_ACTIONS, state=state, sensing_action=77, observation=np.zeros(2)
        )
    )
    sensed = state._replace(sensed=True)
    assert "needs no sensing" in refused(
        DecisionRequest(RequestKind.CHOOSE_SENSING_ACTION, state=sensed)
    )
    assert "observation of 2" in refused(
        DecisionRequest(RequestKind.CHOOSE_TASK_ACTIONS, state=sensed, observation=np.zeros(2))
    )
    assert "particles" in refused(
        DecisionRequest(
            RequestKind.CHOOSE_SENSING_ACTION,
            state=state._replace(belief=type(state.belief).uniform(np.zeros((3, 3)))),
        )
    )


def test_nan_is_no_reading() -> None:
    service = ActiveSensing(configuration())
    state = service.answer(DecisionRequest(RequestKind.INITIALIZE, seed=3, trial=1)).state
    assert state is not None
    answer = service.answer(
        DecisionRequest(
            RequestKind.CHOOSE_TASK_ACTIONS, state=state, observation=np.array([np.nan])
        )
    )
    used = configuration()
    planner = Planner(used.problem, used.planning)
    expected, _ = planner.observe(state, 0, None)
    assert answer.error is ErrorCode.OK
    action, _ = planner.choose_task_action(expected)
    assert np.array_equal(answer.task_actions[0], action)


def test_another_configuration_is_told_by_its_digest_but_not_by_its_seed() -> None:
    ours = ActiveSensing(configuration())
    assert (
        ours.configuration == ActiveSensing(configuration(**{"simulator.seed": 77})).configuration
    )
    theirs = ActiveSensing(configuration(**{"particle_filter.num_particles": 51}))
    answer = ours.answer(
        DecisionRequest(RequestKind.INITIALIZE, configuration=theirs.configuration)
    )
    assert answer.error is ErrorCode.OTHER_CONFIGURATION
    assert theirs.configuration in answer.message
    assert ours.configuration in answer.message
