"""The trials of a run as a robot performs them: the same decisions, and a row for each."""

from pathlib import Path

from tests.recordings import configuration_of, record_trial

from holdfast.journal.run_directory import RunDirectory
from holdfast.journal.timings import read_timings
from holdfast.planning.outcome import TrialResult
from holdfast.robot.environment_maker import load_environment
from holdfast.robot.robot_run import RobotObserver, perform_trials


def test_it_decides_what_the_planner_decides(tmp_path: Path) -> None:
    configuration = configuration_of(tmp_path)
    results: list[TrialResult] = []
    steps: list[int] = []
    kinds: list[str] = []
    with RunDirectory.create(tmp_path / "run", configuration) as directory:

        def on_result(result: TrialResult) -> None:
            directory.add(result)
            results.append(result)

        observer = RobotObserver(
            process=lambda _: None,
            order=lambda state, _: steps.append(state.step),
            timing=lambda timing: kinds.append(timing.kind),
        )
        perform_trials(
            configuration,
            directory,
            load_environment(configuration),
            on_result,
            rate_hz=None,
            sinks=[],
            observer=observer,
        )
    expected = [record_trial(configuration, trial).record.result for trial in range(3)]
    assert [result.digest for result in results] == [
        result.digest for result in expected if result is not None
    ]
    assert max(steps) == 29
    rows = [row.timing for row in read_timings(tmp_path / "run" / "timings.csv")]
    assert [row.kind for row in rows] == kinds
    assert {row.trial for row in rows} == {0, 1, 2}
    assert not (tmp_path / "run" / "verification.csv").exists()
