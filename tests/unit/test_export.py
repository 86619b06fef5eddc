"""A recorded run as ROS 2 messages and as tables, read back by other people's readers."""

import csv
import itertools
import json
import resource
import shutil
import signal
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import mcap.reader
import mcap.records
import numpy as np
import pytest
import yaml
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.typesys import Stores, get_typestore
from tests.answers import answers_in
from tests.command_line import Said, done_here, run_here
from tests.unit.test_trial import one

import holdfast as hf
from holdfast.config.loader import Configuration, load
from holdfast.config.registry import BUILT_IN
from holdfast.errors import UntrustedCodeError
from holdfast.journal.journal import Journal
from holdfast.planning.belief import Belief
from holdfast.planning.inputs import ActingRecord, Moved, Sensed, encode_floats
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import PlanningState
from holdfast.reports.poses import PoseLayout, pose_layout
from holdfast.robot.trial import SensingStep, TaskStep, TrialObserver

PEG = """\
problem: peg_in_hole_2d
particle_filter: {num_particles: 25}
simulator: {num_trials: 2, max_steps: 20, sensing_intervals: 3, seed: 5}
"""

OWN_PROBLEM = '''
import numpy as np
from holdfast.problems.problem import ProblemBase

class Cart(ProblemBase):
    """A cart on rails along z that knows its battery as well."""
    name = "cart"
    state_size, action_size = 2, 1
    sensing_actions = ("where", "battery")
    state_labels = ("z (m)", "charge")
    motion_variance = np.array([0.01])
    POSE

    def initial_states(self, stream, count):
        return stream.normal((count, 2))

    def move(self, states, actions, stream):
        moved = states + 0.1 * stream.normal(states.shape)
        moved[..., 0] += actions[..., 0]
        return moved

    def observation_mean(self, states, sensing_action):
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states, sensing_action):
        return np.array([0.01])

    def policy(self, states, stage):
        return 0.3 * (1.0 - states[..., :1])

    def is_goal(self, states):
        return states[..., 0] > 2.5
'''
OWN_WORLD = """
import numpy as np

class World:
    def __init__(self, trial):
        self.steps, self.trial = 0, trial

    def perform_sensing(self, sensing_action):
        return np.array([1.0 + 0.1 * sensing_action + 0.01 * self.steps])

    def perform(self, task_action):
        self.steps += 1
        if (self.trial, self.steps) == (1, 5):
            raise RuntimeError("the cable is out")
        return -1.0

    def is_done(self):
        return self.steps == 7
"""


class Seen(TrialObserver):
    """Keeps all of a trial; the truths are those before each task action, and the last."""

    def __init__(self) -> None:
        self.sensed_steps: list[SensingStep] = []
        self.task_steps: list[TaskStep] = []
        self.truths: list[np.ndarray] = []
        self.beliefs: list[tuple[int, int, str, Belief]] = []
        self._environment: Any = None

    def trial_began(self, environment: Any, state: Any) -> None:
        self._environment = environment
        self.truths.append(environment.state.copy())

    def sensed(self, step: SensingStep) -> None:
        self.sensed_steps.append(step)
        self.note("sensing", step.before)

    def acted(self, step: TaskStep) -> None:
        self.task_steps.append(step)
        self.note("acting", step.state)
        self.truths.append(self._environment.state.copy())

    def trial_ended(self, state: Any, result: TrialResult) -> None:
        self.note("end", state)

    def note(self, when: str, state: PlanningState) -> None:
        self.beliefs.append((state.trial, state.step, when, state.belief))


def seen_in(configuration: Configuration, trials: range) -> list[Seen]:
    """Run trials once more, without the exporter."""
    observers = [Seen() for _ in trials]
    for trial, observer in zip(trials, observers, strict=True):
        one(configuration, trial, observer=observer)
    return observers


class Place:
    """A directory in which runs are made and exported."""

    def __init__(
        self, directory: Path, capsys: pytest.CaptureFixture[str], recorded: Path | None = None
    ) -> None:
        self.directory = directory
        self._capsys = capsys
        self._recorded = recorded

    def call(self, *words: str) -> Said:
        return run_here(self._capsys, self.directory, *words)

    def run(self, text: str, *options: str, code: int = 0) -> Path:
        (self.directory / "run.yaml").write_text(text)
        run = self.directory / "run"
        if text == PEG and not options and self._recorded:
            shutil.copytree(self._recorded, run)
            return run
        said = self.call(*RUN, *options)
        assert said.code == code, said.stderr
        return run

    def run_cart(self, pose: str = "") -> Path:
        (self.directory / "cart.py").write_text(OWN_PROBLEM.replace("POSE", pose))
        return self.run(PEG.replace("peg_in_hole_2d", "cart:Cart"))

    def export(self, *options: str, code: int = 0) -> Said:
        said = self.call("export", "run", *options)
        assert said.code == code, said.stderr
        left = [path.name for path in self.directory.iterdir() if path.name.startswith(".")]
        assert not left
        return said


RUN = ("run", "run.yaml", "--out", "run", "-q")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run that tests copy."""
    directory = tmp_path_factory.mktemp("recorded")
    (directory / "run.yaml").write_text(PEG)
    done_here(directory, RUN)
    return directory / "run"


@pytest.fixture
def place(tmp_path: Path, capsys: pytest.CaptureFixture[str], recorded: Path) -> Place:
    return Place(tmp_path, capsys, recorded)


class Message(NamedTuple):
    """A message as one of the readers has it."""

    topic: str
    time_ns: int
    data: Any


def by_rosbags(path: Path) -> list[Message]:
    with AnyReader([path]) as reader:
        return [
            Message(connection.topic, time, reader.deserialize(raw, connection.msgtype))
            for connection, time, raw in reader.messages()
        ]


def by_mcap(path: Path) -> list[Message]:
    with path.open("rb") as file:
        reader = mcap.reader.make_reader(
            file, validate_crcs=True, decoder_factories=[DecoderFactory()]
        )
        return [
            Message(channel.topic, message.log_time, data)
            for _, channel, message, data in reader.iter_decoded_messages()
        ]


READERS = pytest.mark.parametrize("read", [by_rosbags, by_mcap])


@cache
def messages_in(directory: Path, read: Callable[[Path], list[Message]]) -> list[Message]:
    """Return what the export of a built-in problem holds, which many tests look at."""
    return read(directory / "run.mcap")


def of_topic(messages: list[Message], topic: str) -> list[Message]:
    return [message for message in messages if message.topic == topic]


def numbers(pose: Any) -> list[float]:
    point, turn = pose.position, pose.orientation
    return [point.x, point.y, point.z, turn.x, turn.y, turn.z, turn.w]


@pytest.fixture(scope="module", params=tuple(BUILT_IN))
def built_in(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Configuration, Path, list[Seen]]]:
    directory = tmp_path_factory.mktemp("built_in")
    export = ("export", "run", "--mcap", "run.mcap", "--csv", "tables", "-q")
    (directory / "run.yaml").write_text(PEG.replace("peg_in_hole_2d", request.param))
    done_here(directory, RUN, export)
    configuration = load(directory / "run.yaml")
    yield configuration, directory, seen_in(configuration, range(2))


def layout_of(configuration: Configuration) -> PoseLayout:
    layout = pose_layout(configuration.problem)
    assert layout is not None
    return layout


class TestReadBack:
    """Every number of every belief, bit for bit, by rosbags and by mcap-ros2-support."""

    @READERS
    def test_particle_clouds_and_beliefs(self, built_in: Any, read: Any) -> None:
        configuration, directory, seen = built_in
        messages = messages_in(directory, read)
        clouds = of_topic(messages, "/holdfast/particle_cloud")
        tables = of_topic(messages, "/holdfast/belief")
        # After sensing it is the same as when acting.
        expected = [belief for observer in seen for *_, belief in observer.beliefs]
        assert len(clouds) == len(tables) == len(expected) > 40
        layout = layout_of(configuration)
        for cloud, table, belief in zip(clouds, tables, expected, strict=True):
            found = np.array([numbers(pose) for pose in cloud.data.poses])
            assert np.array_equal(found, layout.poses(belief.states))
            assert cloud.data.header.frame_id == "task"
            stamp = cloud.data.header.stamp
            assert 10**9 * stamp.sec + stamp.nanosec == cloud.time_ns
            particle, coordinates = table.data.layout.dim
            assert (particle.label, particle.size) == ("particle", 25)
            assert coordinates.label.endswith("; weight")
            rows = np.array(table.data.data).reshape(particle.size, coordinates.size)
            assert np.array_equal(rows, np.column_stack([belief.states, belief.weights]))

    @READERS
    def test_estimates_and_truths(self, built_in: Any, read: Any) -> None:
        configuration, directory, seen = built_in
        messages = messages_in(directory, read)
        layout = layout_of(configuration)
        rows: list[tuple[Belief, np.ndarray]] = []
        for observer in seen:
            beliefs = [belief for *_, when, belief in observer.beliefs if when != "sensing"]
            rows += zip(beliefs, observer.truths, strict=True)
        estimates = of_topic(messages, "/holdfast/estimate")
        truths = of_topic(messages, "/holdfast/truth")
        transforms = of_topic(messages, "/tf")
        assert len(estimates) == len(truths) == len(transforms) == len(rows)
        for estimate, truth, transform, (belief, true_state) in zip(
            estimates, truths, transforms, rows, strict=True
        ):
            mean = np.average(belief.states, axis=0, weights=belief.weights)
            np.testing.assert_allclose(
                numbers(estimate.data.pose.pose), layout.poses(mean), rtol=1e-12, atol=1e-12
            )
            covariance = np.array(estimate.data.pose.covariance).reshape(6, 6)
            assert np.array_equal(covariance, layout.covariance(belief))
            assert numbers(truth.data.pose) == layout.poses(true_state).tolist()
            children = {each.child_frame_id: each for each in transform.data.transforms}
            there = children["truth"].transform.translation
            assert [there.x, there.y, there.z] == layout.poses(true_state)[:3].tolist()
            assert children["estimate"].header.frame_id == "task"

    @READERS
    def test_choices_observations_and_actions(self, built_in: Any, read: Any) -> None:
        configuration, directory, seen = built_in
        messages = messages_in(directory, read)
        sensed = [step for observer in seen for step in observer.sensed_steps]
        actions = [step.executed.tolist() for observer in seen for step in observer.task_steps]
        chosen = [message.data.data for message in of_topic(messages, "/holdfast/sensing_action")]
        assert chosen == [step.sensing_action for step in sensed]
        labels = [
            message.data.data for message in of_topic(messages, "/holdfast/sensing_action_label")
        ]
        assert labels == [configuration.problem.sensing_actions[each] for each in chosen]
        observations = of_topic(messages, "/holdfast/observation")
        assert [list(message.data.data) for message in observations] == [
            np.asarray(step.observation).tolist() for step in sensed
        ]
        entropies = of_topic(messages, "/holdfast/entropies")
        assert [list(message.data.data) for message in entropies] == [
            step.sensing_info.entropies.tolist() for step in sensed
        ]
        performed = of_topic(messages, "/holdfast/task_action")
        assert [list(message.data.data) for message in performed] == actions

    def test_paths_end_with_the_whole_way(self, built_in: Any) -> None:
        configuration, directory, seen = built_in
        paths = of_topic(messages_in(directory, by_mcap), "/holdfast/true_path")
        layout = layout_of(configuration)
        ends = [
            [numbers(stamped.pose) for stamped in path.data.poses]
            for path, following in zip(paths, [*paths[1:], None], strict=True)
            if following is None or len(following.data.poses) < len(path.data.poses)
        ]
        for observer, end in zip(seen, ends, strict=True):
            assert end == layout.poses(observer.truths).tolist()

    def test_tables(self, built_in: Any) -> None:
        configuration, directory, seen = built_in
        labels = list(configuration.problem.state_labels)
        expected = {
            (trial, step, when): belief
            for observer in seen
            for trial, step, when, belief in observer.beliefs
        }
        found: dict[tuple[int, int, str], list[list[float]]] = defaultdict(list)
        for row in rows_of(directory / "tables" / "beliefs.csv"):
            key = (int(row["trial"]), int(row["step"]), row["when"])
            assert int(row["particle"]) == len(found[key])
            found[key].append([float(row[label]) for label in [*labels, "weight"]])
        assert found.keys() == expected.keys()
        for key, rows in found.items():
            belief = expected[key]
            assert np.array_equal(rows, np.column_stack([belief.states, belief.weights]))

    def test_decisions_in_the_tables_are_those_of_the_journal(self, built_in: Any) -> None:
        configuration, directory, _ = built_in
        with Journal.read(directory / "run" / "journal.bin") as journal:
            results = list(journal.results(with_decisions=True))
        told = {int(row["trial"]): row for row in rows_of(directory / "tables" / "trials.csv")}
        decisions: dict[int, list[Any]] = defaultdict(list)
        for row in rows_of(directory / "tables" / "steps.csv"):
            trial, step = int(row["trial"]), int(row["step"])
            if row["sensing_action"]:
                digest = bytes.fromhex(row["state_digest"])
                decisions[trial].append(Sensed(step, int(row["sensing_action"]), b"", digest))
            action = [
                float(row[f"action_{index}"]) for index in range(configuration.problem.action_size)
            ]
            decisions[trial].append(ActingRecord(step, encode_floats(action)))
        for result in results:
            assert result.decisions is not None
            assert decisions[result.trial] == list(result.decisions)
            assert told[result.trial]["digest"] == result.digest
            assert float(told[result.trial]["reward"]) == result.reward


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


class TestTheFile:
    """What rosbag2, RViz and Foxglove expect of an MCAP file besides its messages."""

    def test_summary_and_index_agree_with_the_messages(self, built_in: Any) -> None:
        _, directory, _ = built_in
        with (directory / "run.mcap").open("rb") as file:
            reader = mcap.reader.make_reader(file, validate_crcs=True)
            assert reader.get_header().profile == "ros2"
            summary = reader.get_summary()
            assert summary is not None
            statistics = summary.statistics
            assert statistics is not None
            counts: dict[int, int] = defaultdict(int)
            times = []
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                assert schema is not None
                assert schema.encoding == "ros2msg"
                assert channel.message_encoding == "cdr"
                counts[channel.id] += 1
                times.append(message.log_time)
            assert statistics.channel_message_counts == counts
            assert statistics.message_count == len(times)
            assert times == sorted(times)
            assert (statistics.message_start_time, statistics.message_end_time) == (
                times[0],
                times[-1],
            )
            assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
            metadata = next(reader.iter_metadata())
        half = times[len(times) // 2]
        with AnyReader([directory / "run.mcap"]) as bag:
            assert bag.message_count == len(times)
            sought = [time for _, time, _ in bag.messages(start=half)]
        assert sought == [time for time in times if time >= half]
        assert metadata.name == "rosbag2"
        info = yaml.safe_load(metadata.metadata["serialized_metadata"])
        assert info["version"] == 8
        assert info["message_count"] == len(times)
        assert info["custom_data"]["holdfast_seed"] == "5"

    def test_qualities_of_service(self, built_in: Any) -> None:
        _, directory, _ = built_in
        with AnyReader([directory / "run.mcap"]) as reader:
            offered = {
                connection.topic: connection.ext.offered_qos_profiles  # type: ignore[union-attr]
                for connection in reader.connections
            }
        assert "/holdfast/particle_cloud" in offered
        for topic, profiles in offered.items():
            (profile,) = profiles
            assert profile.reliability is QosReliability.RELIABLE
            latched = topic in ("/tf_static", "/holdfast/scene")
            assert (profile.durability is QosDurability.TRANSIENT_LOCAL) == latched

    def test_definitions_are_the_same_in_all_releases(self, built_in: Any) -> None:
        _, directory, _ = built_in
        stores = [
            get_typestore(store)
            for store in (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED)
        ]
        with AnyReader([directory / "run.mcap"]) as reader:
            kinds = {connection.msgtype for connection in reader.connections}
        assert len(kinds) > 10
        for kind in kinds:
            assert len({store.hash_rihs01(kind) for store in stores}) == 1, kind

    def test_frames(self, built_in: Any) -> None:
        configuration, directory, _ = built_in
        messages = messages_in(directory, by_mcap)
        (static,) = of_topic(messages, "/tf_static")
        (transform,) = static.data.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "task")
        turn = transform.transform.rotation
        assert (turn.x, turn.y, turn.z, turn.w) == layout_of(configuration).upright

    def test_the_scene_has_obstacles_bodies_and_a_goal(self, built_in: Any) -> None:
        _, directory, _ = built_in
        scenes = of_topic(messages_in(directory, by_mcap), "/holdfast/scene")
        assert len(scenes) == 2
        for scene in scenes:
            first, *markers = scene.data.markers
            assert first.action == 3  # all of the trial before go
            names = [marker.ns.split("_")[0] for marker in markers]
            assert {"obstacle", "goal", "body"} <= set(names)
            bodies = [marker for marker in markers if marker.ns.startswith("body")]
            assert {body.header.frame_id for body in bodies} == {"estimate", "truth"}
            assert len({(marker.ns, marker.id) for marker in markers}) == len(markers)
            for marker in markers:
                sizes = (marker.scale.x, marker.scale.y, marker.scale.z)
                assert all(0.0 <= size < 100.0 for size in sizes)


class TestTimes:
    def test_recorded_ones_are_kept(self, place: Place, tmp_path: Path) -> None:
        run = place.run(PEG, "--rate", "5000")
        said = place.export("--csv", "tables", "--mcap", "run.mcap")
        assert "without times" not in said.stderr
        rows = rows_of(run / "timings.csv")
        steps = {
            (row["trial"], row["step"]): row for row in rows_of(tmp_path / "tables" / "steps.csv")
        }
        kinds = {"sensing": "sensing", "task": "action"}
        for row in rows:
            step, kind = steps[row["trial"], row["step"]], kinds[row["kind"]]
            assert step[f"{kind}_service"] == row["service"] == "in_process"
            assert step[f"{kind}_status"] == row["status"]
            assert float(step[f"{kind}_waited_ms"]) == float(row["waited_ms"])
            moment = np.datetime64(row["time"].rstrip("Z"), "ns").astype(int) / 1e9
            assert float(step[f"{kind}_time"]) == pytest.approx(moment, abs=1e-5)
        # An answer has the actions up to the next sensing step.
        assert all(step["action_service"] == "in_process" for step in steps.values())
        messages = by_rosbags(tmp_path / "run.mcap")
        times = [message.time_ns for message in messages]
        assert times == sorted(times)
        statuses = of_topic(messages, "/diagnostics")
        assert {message.data.status[0].message for message in statuses} == {"standard"}
        assert {message.data.status[0].hardware_id for message in statuses} == {"in_process"}
        events = [row["event"] for row in rows_of(tmp_path / "tables" / "events.csv")]
        assert events.count("trial") == 2

    def test_events_are_told_between_the_steps(self, place: Place, tmp_path: Path) -> None:
        run = place.run(PEG, "--rate", "5000")
        rows = rows_of(run / "timings.csv")
        moment = next(row["time"] for row in rows if row["trial"] == "0" and row["step"] == "8")
        event = {"time": moment, "component": "robot", "event": "status", "from": "standard",
                 "to": "local_recovery", "reason": "the cloud is gone"}  # fmt: skip
        with (run / "events.jsonl").open("a") as file:
            file.write(json.dumps(event) + '\n{"torn')
        place.export("--mcap", "run.mcap", "--csv", "tables")
        logs = of_topic(by_mcap(tmp_path / "run.mcap"), "/rosout")
        told = [(log.data.level, log.data.msg) for log in logs]
        expected = "status: from standard, to local_recovery, reason the cloud is gone"
        assert told[0] == (20, "trial 0 begins")
        assert (30, expected) in told[1:-1]
        events = rows_of(tmp_path / "tables" / "events.csv")
        assert [row["event"] for row in events].count("status") == 1
        place.export("--csv", "second", "--trials", "1:2")
        second = rows_of(tmp_path / "second" / "events.csv")
        assert [row["trial"] for row in second if row["event"] == "trial"] == ["1"]
        assert "status" not in {row["event"] for row in second}


MINE = ("--problem-directory", ".")
"""Says that the code of the run's problem may run."""


class TestOwnCode:
    @pytest.mark.parametrize(
        ("pose", "positions"),
        [("", None), ('pose = ("z", None)', (0.0, 0.0, 1.0)), ('pose = ("x",)', (1.0, 0.0, 0.0))],
    )
    def test_a_problem_says_its_pose_or_has_none(
        self, pose: str, positions: tuple[float, float, float] | None, place: Place, tmp_path: Path
    ) -> None:
        place.run_cart(pose)
        said = place.export("--mcap", "run.mcap", *MINE)
        messages = by_mcap(tmp_path / "run.mcap")
        tables = of_topic(messages, "/holdfast/belief")
        clouds = of_topic(messages, "/holdfast/particle_cloud")
        assert len(tables) > 40
        assert tables[0].data.layout.dim[1].label == "z (m); charge; weight"
        if positions is None:
            assert "does not say which coordinates of its state are a pose" in said.stderr
            assert not clouds
            assert not of_topic(messages, "/tf")
            return
        assert "are a pose" not in said.stderr
        for table, cloud in zip(tables, clouds, strict=True):
            states = np.array(table.data.data).reshape(25, 3)
            found = np.array([numbers(each)[:3] for each in cloud.data.poses])
            assert np.array_equal(found, states[:, :1] * np.array(positions))

    def test_code_that_a_record_names_is_not_run_unasked(
        self, place: Place, tmp_path: Path
    ) -> None:
        """Wherever a module of that name lies: where it did, beside the journal, or here."""
        run = place.run_cart()
        ran = tmp_path / "ran"
        source = f"open({str(ran)!r}, 'w')\n"
        for directory in (tmp_path, run):
            (directory / "cart.py").write_text(source + OWN_PROBLEM.replace("POSE", ""))
        for command in (["export", "run", "--csv", "tables"], ["view", "run", "--save", "a.rrd"]):
            said = place.call(*command)
            assert said.code == 2
            assert "its problem is cart:Cart, and the code that a record names" in said.stderr
            assert f"--problem-directory {tmp_path}" in said.stderr
        with pytest.raises(UntrustedCodeError, match=r"open_run\(\.\.\., problem_directory="):
            hf.open_run(run)
        assert place.call("compare", "run", "run").code == 0
        assert not ran.exists()
        (tmp_path / "cart.py").write_text(OWN_PROBLEM.replace("POSE", ""))
        place.export("--csv", "tables", "--problem-directory", str(tmp_path))
        opened = hf.open_run(run, problem_directory=tmp_path)
        assert len(list(opened.read())) == len(opened.trials)
        sys.modules.pop("cart", None)
        assert not ran.exists()

    def test_a_module_is_looked_for_only_where_the_caller_says(
        self, place: Place, tmp_path: Path
    ) -> None:
        place.run_cart()
        (tmp_path / "elsewhere").mkdir()
        options = ("--csv", "tables", "--problem-directory", "elsewhere")
        assert "there is no module cart" in place.export(*options, code=2).stderr

    def test_in_a_world_of_ones_own(self, place: Place, tmp_path: Path) -> None:
        """What the world has shown is in the journal, of the trial that is not finished as well."""
        (tmp_path / "world.py").write_text(OWN_WORLD)
        options = ("--environment", "world:World", "--rate", "5000")
        place.run(PEG, *options, code=2)
        said = place.export("--mcap", "run.mcap", "--csv", "tables")
        assert "the run is not finished: 1 of 2 trials are" in said.stderr
        steps = rows_of(tmp_path / "tables" / "steps.csv")
        places = [(int(row["trial"]), int(row["step"])) for row in steps]
        assert places == [(0, step) for step in range(7)] + [(1, step) for step in range(5)]
        times = [float(row["action_time"]) for row in steps]
        assert times[0] > 1.7e9
        assert all(later > earlier for earlier, later in itertools.pairwise(times))
        sensed = [row for row in steps if row["sensing_action"]]
        assert [row["step"] for row in sensed] == ["0", "4", "0", "4"]
        for row in sensed:
            value = 1.0 + 0.1 * int(row["sensing_action"]) + 0.01 * int(row["step"])
            assert row["observation"] == repr(value)
        beliefs = rows_of(tmp_path / "tables" / "beliefs.csv")
        assert {row["trial"] for row in beliefs} == {"0", "1"}
        assert [row["outcome"] for row in rows_of(tmp_path / "tables" / "trials.csv")] == [
            "succeeded",
            "unfinished",
        ]
        messages = by_rosbags(tmp_path / "run.mcap")
        assert not of_topic(messages, "/holdfast/truth")
        assert len(of_topic(messages, "/holdfast/task_action")) == 12
        assert len(of_topic(messages, "/holdfast/estimate")) == 13

    def test_a_run_that_was_copied_from_the_robot(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path
    ) -> None:
        """Its world is not here, and the problem lies elsewhere: beside the run, say."""
        robot, desk = tmp_path / "robot", tmp_path / "desk"
        robot.mkdir()
        desk.mkdir()
        (robot / "world.py").write_text(OWN_WORLD.replace("(1, 5)", "None"))
        (robot / "cart.py").write_text(OWN_PROBLEM.replace("POSE", 'pose = ("z",)'))
        text = PEG.replace("peg_in_hole_2d", "cart:Cart")
        Place(robot, capsys).run(text, "--environment", "world:World", "--rate", "5000")
        (robot / "run").rename(desk / "run")
        (robot / "cart.py").rename(desk / "cart.py")
        shutil.rmtree(robot)
        said = Place(desk, capsys).export("--csv", "tables", "--mcap", "run.mcap", *MINE)
        assert "note" not in said.stderr
        assert len(rows_of(desk / "tables" / "steps.csv")) == 14
        (desk / "cart.py").unlink()
        said = Place(desk, capsys).export("--csv", "again", *MINE, code=2)
        assert "cart" in said.stderr


class TestDecisionsAreCompared:
    def test_another_problem_is_noticed(self, place: Place, tmp_path: Path) -> None:
        place.run_cart()
        (tmp_path / "cart.py").write_text(OWN_PROBLEM.replace("POSE", "").replace("0.3", "0.45"))
        said = place.export("--csv", "tables", "--mcap", "run.mcap", *MINE, code=2)
        assert "trial 0: the decision of step 0 differs when it is computed again" in said.stderr
        assert "the problem's source has changed since (module cart)" in said.stderr
        assert not (tmp_path / "tables").exists()
        assert not (tmp_path / "run.mcap").exists()


class TestUnfinished:
    def test_a_trial_that_was_begun(self, place: Place, tmp_path: Path) -> None:
        """With what is known of it, up to an observation that nothing has followed yet."""
        run = place.run(PEG)
        configuration = load(tmp_path / "run.yaml")
        (seen,) = seen_in(configuration, range(1, 2))
        with Journal.read(run / "journal.bin") as journal:
            meta, first = journal.meta(), next(iter(journal.results(with_decisions=True)))
        (run / "journal.bin").unlink()
        records: list[Any] = []
        sensed = {step.before.step: step for step in seen.sensed_steps}
        for number, step in enumerate(seen.task_steps[:7]):
            if number in sensed:
                records.append(sensed[number].sensed)
            if number < 6:
                records.append(ActingRecord(number, step.executed.tobytes()))
                records.append(Moved(number, None))
        assert isinstance(records[-1], Sensed) == (6 in sensed)
        with Journal.create(run / "journal.bin", meta) as journal:
            journal.add(first)
            journal.append(1, records)
        said = place.export("--csv", "tables", "--mcap", "run.mcap")
        assert "the run is not finished: 1 of 2 trials are" in said.stderr
        rows = [row for row in rows_of(tmp_path / "tables" / "steps.csv") if row["trial"] == "1"]
        performed = [row for row in rows if row["action_time"]]
        assert len(performed) == 6
        for row, truth in zip(performed, seen.truths, strict=False):
            labels = configuration.problem.state_labels
            assert [float(row[f"true {label}"]) for label in labels] == truth.tolist()
        tables = of_topic(by_mcap(tmp_path / "run.mcap"), "/holdfast/belief")
        last = np.array(tables[-1].data.data).reshape(25, 4)
        if 6 in sensed:
            assert np.array_equal(last[:, :3], sensed[6].after.belief.states)

    def test_nothing_at_all(self, place: Place, tmp_path: Path) -> None:
        (tmp_path / "run.yaml").write_text(PEG)
        meta = {"configuration": load(tmp_path / "run.yaml").to_yaml()}
        (tmp_path / "run").mkdir()
        Journal.create(tmp_path / "run" / "journal.bin", meta).close()
        said = place.export("--csv", "tables", code=2)
        assert "no trial of that run is finished or begun" in said.stderr
        assert not (tmp_path / "tables").exists()


class TestRefusals:
    @pytest.mark.parametrize(
        ("line", "message"),
        [
            *answers_in("export_mistakes.txt"),
            ("", "nothing to write: give --mcap FILE, --csv DIR or --figure FILE"),
        ],
    )
    def test_options(self, line: str, message: str, place: Place, tmp_path: Path) -> None:
        place.run(PEG)
        (tmp_path / "there").mkdir()
        (tmp_path / "there" / "file").write_text("mine")
        said = place.export(*line.split(), code=2)
        assert message in said.stderr
        assert (tmp_path / "there" / "file").read_text() == "mine"
        assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "run.yaml", "there"]

    @pytest.mark.parametrize(
        ("run", "message"),
        [
            ("nothing", "there is no such directory or journal, so no run to export"),
            ("empty", "holds no journal.bin, so no run to export"),
            ("run.yaml", "run.yaml: is not a journal; name the directory of a run"),
        ],
    )
    def test_what_is_no_run(self, run: str, message: str, place: Place, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        (tmp_path / "run.yaml").write_text(PEG)
        said = place.call("export", run, "--csv", "tables")
        assert said.code == 2
        assert message in said.stderr
        assert not (tmp_path / "tables").exists()

    def test_without_rosbags(
        self, place: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        place.run(PEG)
        monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
        said = place.export("--mcap", "run.mcap", code=2)
        assert "library rosbags: pip install 'holdfast-sensing[mcap]'" in said.stderr
        place.export("--csv", "tables")

    def test_an_empty_directory_may_be_there(self, place: Place, tmp_path: Path) -> None:
        place.run(PEG)
        (tmp_path / "tables").mkdir()
        place.export("--csv", "tables", "--trials", "1:5")
        assert [row["trial"] for row in rows_of(tmp_path / "tables" / "trials.csv")] == ["1"]


class TestNothingHalfWritten:
    """Neither at the places nor beside them; :func:`export` looks for the latter."""

    def test_interrupted(
        self, place: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        from holdfast.reports.csv_export import CsvSink

        place.run(PEG)

        def interrupt(self: CsvSink, fact: Any) -> None:
            signal.raise_signal(signal.SIGINT)

        monkeypatch.setattr(CsvSink, "trial_ends", interrupt)
        place.export("--csv", "tables", "--mcap", "run.mcap", code=130)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "run.yaml"]

    def test_a_full_disk(self, place: Place, tmp_path: Path) -> None:
        place.run(PEG)
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        for option, name in (("--csv", "tables"), ("--mcap", "run.mcap")):
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
            try:
                said = place.export(option, name, code=2)
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, before)
            assert f"{name}: cannot be written: File too large" in said.stderr
            assert not (tmp_path / name).exists()
        signal.signal(signal.SIGXFSZ, ignored)
