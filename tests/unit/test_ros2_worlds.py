"""The environments of a node: the configuration's own, and an executive's."""

from pathlib import Path
from typing import Any

import numpy as np

from holdfast_ros.executive import DecideCode, DecideRequest, ExecutiveEnvironment
from holdfast_ros.ros2.parameters import NodeParameters, read_parameters
from holdfast_ros.ros2.run_segment import World, make_world

EXAMPLE = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"


def parameters(tmp_path: Path, kind: str) -> NodeParameters:
    values: dict[str, Any] = {
        "configuration": str(EXAMPLE),
        "run_directory": str(tmp_path),
        "environment.kind": kind,
        "environment.max_missing_in_a_row": 3,
    }
    return read_parameters(values)


def world_of(tmp_path: Path, kind: str) -> World:
    return make_world(None, parameters(tmp_path, kind))


def test_the_configurations_world_is_not_interrupted(tmp_path: Path) -> None:
    world = world_of(tmp_path, "configuration")
    assert world.maker.simulated
    assert world.handover is None
    assert not world.interrupt_at_once
    world.interrupt("the node was deactivated")


def test_an_executives_world_ends_its_calls_when_interrupted(tmp_path: Path) -> None:
    world = world_of(tmp_path, "executive")
    environment = world.maker(3, resumed=True, performed=[np.zeros(3)])
    assert isinstance(environment, ExecutiveEnvironment)
    assert environment.steps_performed() == 1
    assert world.maker.max_missing_in_a_row == 3
    assert world.handover is not None
    world.interrupt("the node was deactivated")
    reply = world.handover.call(DecideRequest(), 0.0)
    assert (reply.code, reply.message) == (DecideCode.ENDED, "the node was deactivated")
