"""The picture of a trial."""

import io
import itertools
import shutil
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from tests.recordings import record_trial

from holdfast.config.loader import load
from holdfast.numerics import wrapped
from holdfast.reports.figure import _draw_entropies, _draw_workspace, _follow_turns, trial_figure

EXAMPLES = Path(__file__).parents[2] / "examples"

TWELVE = """
from light_dark_room import LightDarkRoom


class Twelve(LightDarkRoom):
    sensing_actions = (
        "camera in front", "camera at the left", "camera at the right", "lidar, coarse scan",
        "lidar, fine scan", "force-torque sensor", "ultrasonic range finder", "radio beacon",
        "depth camera", "tactile array of the gripper", "inertial unit", "wheel odometry",
    )

    def observation_mean(self, states, sensing_action):
        return super().observation_mean(states, sensing_action % 2)
"""


class TestFigure:
    @pytest.mark.parametrize(
        "example", ["light_dark_room", "capsule_robot", "peg_in_hole_3d", "docking"]
    )
    def test_nothing_is_cut_off(self, example: str) -> None:
        overrides = {"simulator.max_steps": 40, "simulator.seed": 10**18}  # a long title
        overrides["particle_filter.num_particles"] = 50
        configuration = load(EXAMPLES / f"{example}.yaml", overrides=overrides)
        recorder = record_trial(configuration, trial=9_000_000)
        picture = imread(io.BytesIO(trial_figure(configuration, recorder.record)))[..., :3]
        for edge in (picture[0], picture[-1], picture[:, 0], picture[:, -1]):
            assert (edge == 1.0).all()
        assert (picture < 1.0).any()

    def test_twelve_sensing_actions_have_room(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        shutil.copy(EXAMPLES / "light_dark_room.py", tmp_path)
        (tmp_path / "twelve.py").write_text(TWELVE)
        (tmp_path / "twelve.yaml").write_text(
            "problem: twelve:Twelve\nsimulator: {max_steps: 60, sensing_intervals: 2}\n"
        )
        drawn: list[Figure] = []
        saved = Figure.savefig

        def savefig(figure: Figure, *arguments: Any, **options: Any) -> None:
            drawn.append(figure)
            saved(figure, *arguments, **options)

        monkeypatch.setattr(Figure, "savefig", savefig)
        configuration = load(tmp_path / "twelve.yaml")
        recorder = record_trial(configuration, trial=0)
        picture = imread(io.BytesIO(trial_figure(configuration, recorder.record)))[..., :3]
        for edge in (picture[0], picture[-1], picture[:, 0], picture[:, -1]):
            assert (edge == 1.0).all()
        (figure,) = drawn
        left, right = figure.subfigs
        legend = left.axes[0].get_legend()
        assert legend is not None
        assert legend.get_window_extent().x1 <= left.bbox.x1
        labels = [each.get_window_extent() for each in right.axes[-2].get_yticklabels()]
        assert len(labels) == 12
        for upper, lower in itertools.pairwise(labels):
            assert upper.y0 >= lower.y1 - 1.0

    def test_it_is_the_same_whatever_the_user_has_set(self) -> None:
        """LaTeX, which need not be installed, and the look of the user's other figures."""
        configuration = load(EXAMPLES / "capsule_robot.yaml", overrides={"simulator.max_steps": 12})
        record = record_trial(configuration, trial=0).record
        plain = trial_figure(configuration, record)
        theirs: Any = {"text.usetex": True, "font.size": 30.0, "savefig.dpi": 20}
        with mpl.rc_context(theirs):
            assert trial_figure(configuration, record) == plain
            assert mpl.rcParams["font.size"] == 30.0

    @pytest.mark.parametrize(
        ("method", "label"),
        [
            ("action_entropy", "expected entropy of\nthe actions (nats)"),
            ("state_entropy", "expected entropy of\nthe state (nats)"),
            ("path_entropy", "expected entropies of\nthe actions, sum (nats)"),
            ("action_covariance", "expected covariance\nof the actions (trace)"),
            ("expected_return", "expected loss\n(minus the return)"),
        ],
    )
    def test_the_scores_say_of_what_they_are_and_which_were_not_chosen(
        self, method: str, label: str
    ) -> None:
        overrides = {
            "selector.method": method,
            "simulator.max_steps": 12,
            "particle_filter.num_particles": 50,
        }
        configuration = load(EXAMPLES / "peg_in_hole_2d.yaml", overrides=overrides)
        record = record_trial(configuration, trial=0).record
        panel = Figure().subplots()
        _draw_entropies(panel, configuration, record)
        assert panel.get_ylabel() == label
        legend = panel.get_legend()
        assert legend is not None
        assert [text.get_text() for text in legend.get_texts()] == ["chosen", "not chosen (hollow)"]

    def test_a_problem_without_a_scene_and_without_scores_is_drawn(self, tmp_path: Path) -> None:
        (tmp_path / "sceneless.py").write_text(
            "from holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
            "class Sceneless(PegInHole2D):\n"
            "    state_labels = ()\n"
            "    def scene(self):\n"
            "        return None\n"
        )
        path = tmp_path / "run.yaml"
        path.write_text(
            "problem: sceneless:Sceneless\n"
            "selector: {method: random}\n"
            "simulator: {num_trials: 1, max_steps: 12}\n"
        )
        configuration = load(path)
        recorder = record_trial(configuration, trial=0)
        assert trial_figure(configuration, recorder.record).startswith(b"\x89PNG\r\n")

    @pytest.mark.parametrize(
        "points",
        [
            pytest.param([(4.5, 3.5), (-0.9, -0.9)], id="far from where anything happened"),
            pytest.param([(30.0, 1.0), (2.0, -12.0)], id="outside the scene's limits"),
        ],
    )
    def test_points_of_interest_are_seen(
        self, tmp_path: Path, points: list[tuple[float, float]]
    ) -> None:
        configuration = load(EXAMPLES / "light_dark_room.yaml")
        record = record_trial(configuration, trial=0).record
        scene = configuration.problem.scene()
        assert scene is not None
        # Short of the lamp and of the door: nothing but the points makes the drawn part large.
        for rows in (record.true_states, record.estimates, record.standard_deviations):
            del rows[3:]
        del record.sensing[1:]
        scene.points, scene.goal = np.array(points), None
        panel = Figure().subplots()
        _draw_workspace(panel, configuration.problem, scene, record)
        (x_min, x_max), (y_min, y_max) = panel.get_xlim(), panel.get_ylim()
        for x, y in points:
            # The whole of the mark, not its edge.
            assert x_min < x < x_max
            assert y_min < y < y_max


class TestTurns:
    """A heading is drawn as a line without jumps, the estimate beside the truth."""

    def test_with_a_true_state(self) -> None:
        heading = np.linspace(3.0, 9.0, 50)
        truth, estimates = wrapped(heading), wrapped(heading[:-1] + 0.1)
        _follow_turns(estimates, truth)
        np.testing.assert_allclose(truth, heading, atol=1e-12)
        np.testing.assert_allclose(estimates, heading[:-1] + 0.1, atol=1e-12)

    def test_without(self) -> None:
        estimates = wrapped(np.linspace(3.0, -9.0, 50))
        _follow_turns(estimates, np.empty(0))
        np.testing.assert_allclose(estimates, np.linspace(3.0, -9.0, 50), atol=1e-12)
