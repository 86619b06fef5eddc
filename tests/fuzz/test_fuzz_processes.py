"""The fuzzers as programs, for a bounded time; `make fuzz` and `make soak` run them at length."""

import importlib.util
import itertools
import random
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from tests.fuzz.attack_messages import IN_AN_OBSTACLE, checkpoints_in_obstacles
from tests.fuzz.attacker import TRANSPORTS, attacked
from tests.fuzz.hostile_settings import keys_of
from tests.fuzz.soak import run_soak
from tests.fuzz.targets import TARGETS
from tests.programs import completed
from tests.unit.test_protocol_service import Bench

from holdfast.config import registry
from holdfast.config.registry import BUILT_IN
from holdfast.planning.settings import PlanningSettings
from holdfast.protocol.messages import SensingAnswer, TaskAnswer, decode_request

ROOT = Path(__file__).parents[2]
RUNS = 20_000
SOAK_S = 75.0
ATTACK_S = 2.0


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("atheris") is None, reason="atheris is not there for this platform"
)
@pytest.mark.parametrize("target", sorted(TARGETS))
def test_decoders_guided_by_coverage(target: str, tmp_path: Path) -> None:
    # PyYAML parses in Python: a configuration takes a hundred times as long as a message.
    runs = RUNS // 10 if target == "configuration" else RUNS
    done = completed(
        [
            sys.executable,
            *("-m", "tests.fuzz.decoders", target),
            *("--runs", str(runs), "--seed", "1", "--crashes", str(tmp_path)),
        ],
        cwd=ROOT,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert f"Done {runs} runs" in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_an_attacker_ends_no_process_and_changes_no_decision(
    transport: str, tmp_path: Path
) -> None:
    """The long form, which also looks at the robot's waits, is the program itself."""
    report, findings = attacked(transport, ATTACK_S, 1, tmp_path)
    assert not findings, (findings, report)
    assert report["service_lives"]
    assert report["decides_identically"]
    assert report["robot"]["trials"] > 0
    # Each class of attack has come about.
    attacks = [each for way in report["attacks"].values() for each in way.values()]
    assert len(attacks) == (13 if transport == "udp" else 10)
    assert all(attacks)


def test_every_number_of_the_settings_is_attacked() -> None:
    keys = {".".join(key.path) for key in keys_of(PlanningSettings)}
    plain = msgspec.to_builtins(PlanningSettings())
    numbers = {
        f"{section}.{key}"
        for section, values in plain.items()
        if isinstance(values, dict)
        for key, value in values.items()
        if isinstance(value, int | float | tuple | list) and not isinstance(value, bool)
    }
    assert numbers | {"sensing_interval", "selector.resolution"} == keys


@pytest.mark.parametrize("name", BUILT_IN)
def test_each_built_in_problem_is_asked_about_states_in_an_obstacle(name: str) -> None:
    assert (
        registry.problem_class(name)
        .from_settings({}, {})
        .world.collides(np.array([IN_AN_OBSTACLE[name]]))
        .all()
    )
    # Draws 300 particles for each.
    for payload in itertools.islice(checkpoints_in_obstacles(random.Random(36)), len(BUILT_IN)):
        configuration = decode_request(payload).session_configuration
        assert configuration is not None
        if configuration.problem == name:
            assert isinstance(Bench().ask(payload)[0], TaskAnswer | SensingAnswer)


@pytest.mark.slow
def test_nothing_grows_while_sessions_come_and_go(tmp_path: Path) -> None:
    figures, findings = run_soak(SOAK_S, 1, directory=tmp_path)
    assert not findings, (findings, figures)
