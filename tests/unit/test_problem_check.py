"""``hf.check_problem``: right problems have no error, and wrong ones have theirs named."""

import importlib
import itertools
import random
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.unit.test_lost_values import Bit

import holdfast as hf
from holdfast import numerics
from holdfast.config import registry
from holdfast.errors import InvalidValueError
from holdfast.planning.settings import PlanningSettings, SelectorSettings
from holdfast.problems.attributes import PARAMETERS
from holdfast.tuning.findings import CONTRACT, OVER, WHERE, Finding, Inspection
from holdfast.tuning.problem_check import CHECKS, check_problem

EXAMPLES = Path(__file__).parents[2] / "examples"
GENERATOR, CALLS = np.random.default_rng(0), itertools.count()
LONG_S = 3000.0
"""So that no busy machine cuts a check short."""


class Robot(hf.ProblemBase):
    """A right problem, but for its sensors: a point robot that drives to the origin."""

    name = "rover"
    state_size = action_size = 2
    sensing_actions: Any = ("x", "y")
    resolution: Any = 0.1
    motion_variance = np.array([0.0025, 0.0025])

    def initial_states(self, stream: Any, count: int) -> Any:
        return np.array([2.0, 1.0]) + 0.5 * stream.normal((count, 2))

    def move(self, states: Any, actions: Any, stream: Any) -> Any:
        return states + actions + 0.05 * stream.normal(states.shape)

    def policy(self, states: Any, stage: Any) -> Any:
        return -states

    def limit_action(self, actions: Any) -> Any:
        return np.clip(actions, -0.2, 0.2)

    def is_goal(self, states: Any) -> Any:
        return (np.abs(states) < 0.2).all(axis=-1)


class Rover(Robot):
    """It sees x or y, with a likelihood of its own."""

    deviation = 0.1

    def log_likelihood(self, states: Any, sensing_action: int, observation: Any) -> Any:
        deviations = (observation[0] - states[..., sensing_action]) / self.deviation
        return -0.5 * deviations * deviations

    def sample_observation(self, state: Any, sensing_action: int, stream: Any) -> Any:
        return state[sensing_action] + self.deviation * stream.normal((1,))


class Slow(Rover):
    def limit_action(self, actions: Any) -> Any:
        return np.clip(actions, -0.0025, 0.0025)

    def move(self, states: Any, actions: Any, stream: Any) -> Any:
        return states + actions + 1e-3 * stream.normal(states.shape)


class NoLimits:
    """Derived from nothing."""

    name = "no_limits"
    state_size = action_size = num_stages = 1
    sensing_actions = ("x",)
    resolution = 0.1
    motion_variance = np.array([0.01])
    initial_states = move = policy = is_goal = print
    observation_mean = observation_variance = print


class Gaussian(Robot):
    """The same with a mean and a variance."""

    deviations: Any = (0.1, 0.1)

    def observation_mean(self, states: Any, sensing_action: int) -> Any:
        return states[..., sensing_action % 2, np.newaxis]

    def observation_variance(self, states: Any, sensing_action: int) -> Any:
        return np.array([self.deviations[sensing_action] ** 2])


class FineBesideWeak(Gaussian):
    """The boat of docs/problems.md."""

    deviations = (0.02, 1.0)
    resolution = 0.05

    def is_goal(self, states: Any) -> Any:
        return (np.abs(states) < 0.3).all(axis=-1)


class Millimetres(Gaussian):
    """The second coordinate is in millimetres."""

    motion_variance = np.array([0.0025, 2500.0])
    scale = np.array([1.0, 1000.0])
    deviations = (0.1, 100.0)

    def initial_states(self, stream: Any, count: int) -> Any:
        return Gaussian.initial_states(self, stream, count) * self.scale

    def move(self, states: Any, actions: Any, stream: Any) -> Any:
        return states + actions + 0.05 * self.scale * stream.normal(states.shape)

    def limit_action(self, actions: Any) -> Any:
        return np.clip(actions, -0.2 * self.scale, 0.2 * self.scale)

    def is_goal(self, states: Any) -> Any:
        return (np.abs(states / self.scale) < 0.2).all(axis=-1)


class Heading(Gaussian):
    """A heading that wraps, not declared to be an angle."""

    def initial_states(self, stream: Any, count: int) -> Any:
        return np.array([2.0, 3.1]) + np.array([0.5, 0.2]) * stream.normal((count, 2))

    def move(self, states: Any, actions: Any, stream: Any) -> Any:
        moved = states + actions + 0.05 * stream.normal(states.shape)
        return np.stack([moved[..., 0], numerics.wrapped(moved[..., 1])], axis=-1)

    def policy(self, states: Any, stage: Any) -> Any:
        return np.stack([-states[..., 0], numerics.wrapped(np.pi - states[..., 1])], axis=-1)

    def is_goal(self, states: Any) -> Any:
        return np.abs(states[..., 0]) < 0.2


VARIANTS = """
LikelihoodForLogarithm(Rover).log_likelihood:
    numerics.exp(Rover.log_likelihood(self, states, sensing_action, observation))
VarianceForDeviation(Rover).sample_observation:
    state[sensing_action] + self.deviation ** 2 * stream.normal((1,))
DeviationForVariance(Rover).log_likelihood:
    -0.5 * (observation[0] - states[..., sensing_action]) ** 2 / self.deviation
Impossible(Rover).log_likelihood:
    np.where(np.abs(observation[0] - states[..., sensing_action]) < 0.1, 0.0, -np.inf)
WrongSign(Rover).log_likelihood: -Rover.log_likelihood(self, states, sensing_action, observation)
OtherCoordinate(Rover).sample_observation:
    Rover.sample_observation(self, state, 1 - sensing_action, stream)
GlobalGenerator(Rover).move: states + actions + 0.05 * np.random.normal(size=states.shape)
PythonsGenerator(Rover).sample_observation:
    np.array([state[sensing_action] + random.gauss(0.0, self.deviation)])
FixedGenerator(Rover).move:
    states + actions + 0.05 * np.random.default_rng(0).normal(size=states.shape)
SharedNoise(Rover).move: states + actions + 0.05 * stream.normal((2,))
SharedStart(Rover).initial_states:
    np.tile(np.array([2.0, 1.0]) + 0.5 * stream.normal((2,)), (count, 1))
GridStart(Rover).initial_states:
    np.stack([np.linspace(1.0, 3.0, count), 1.0 + 0.5 * stream.normal((count,))], axis=-1)
NotFinite(Rover).move:
    np.where((moved := Rover.move(self, states, actions, stream)) < 1.0, np.nan, moved)
OneStateOnly(Rover).policy: np.array([-states[0], -states[1]])
OneNumber(Rover).sample_observation: state[sensing_action] + self.deviation * stream.normal()
Branches(Rover).policy: -states if states[0] > 0.0 else 0.0 * states
MeanOfTheBelief(Rover).policy: -states + 0.1 * states.reshape(-1, 2).mean(axis=0)
OneGoalForAll(Rover).is_goal: (np.abs(states) < 0.2).all()
Integers(Rover).reward: np.full(states.shape[:-1], -1)
NeverAtTheGoal(Rover).is_goal: (np.abs(states - 9.0) < 0.2).all(axis=-1)
AlwaysAtTheGoal(Rover).is_goal: (np.abs(states) < 99.0).all(axis=-1)
NeverMoves(Rover).limit_action: 0.0 * actions
ChangesItsArgument(Rover).limit_action: np.multiply(actions, 0.5, out=actions)
KeepsItsStream(Rover).move:
    states + actions + 0.05 * vars(self).setdefault("kept", stream).normal(states.shape)
OwnGenerator(Rover).move: states + actions + 0.05 * GENERATOR.normal(size=states.shape)
Counts(Rover).policy: -states + 1e-3 * next(CALLS)
Misspelt(Rover).sensing_cost = 3.0
GivesUp(Rover).policy: sys.exit(3)
FailsAtTheGoal(Rover).is_failure: self.is_goal(states)
Angles(Rover).circular_observations = ((), ())
AlwaysFails(Rover).is_failure: states[..., 0] > -5.0
ZeroReward(Rover).reward: np.zeros(np.broadcast_shapes(states.shape[:-1], actions.shape[:-1]))
GoodReward(Rover).reward: np.ones(np.broadcast_shapes(states.shape[:-1], actions.shape[:-1]))
NegativeVariance(Gaussian).observation_variance: states[..., :1] - 1.0
VarianceOfTheBelief(Gaussian).observation_variance:
    np.full((*states.shape[:-1], 1), 0.01 + 0.01 * states.size)
CoarseResolution(Rover).resolution = 100.0
TooSharp(Gaussian).deviations = (1e-4, 1e-4)
NoiseAsDeviation(Gaussian).motion_variance = np.array([0.05, 0.05])
Dominated(Gaussian).deviations = (0.03, 0.1, 0.3)
Silent(Gaussian).deviations = (0.1, 0.1, 1e6)
WeakAlone(Gaussian).deviations = (0.01, 2.0)
StaticBit(Bit).static_parameters = (1,)
Priced(Gaussian).sensing_costs = (0.0, 2.0)
"""
"""Problems that are wrong in what one function returns, or in one attribute."""


def kind_of(name: str) -> Any:
    found = re.search(rf"^{name}\((\w+)\)\.(\w+)(:| =)\s+(.+)$", VARIANTS, re.MULTILINE)
    if found is None:
        return globals()[name]
    base, attribute, kind, expression = found.groups()
    if kind == ":":
        expression = (
            f"lambda self, {', '.join(PARAMETERS.get(attribute, ('states',)))}: {expression}"
        )
    code = compile(expression, __file__, "eval")
    own = {attribute: eval(code, {**globals(), "random": random})}
    if attribute == "deviations":
        own["sensing_actions"] = ("x", "y", "another look")[: len(own[attribute])]
    return type(name, (globals()[base],), own)


E, W, NOTE = "error", "warning", "information"
WRONG = {
    "LikelihoodForLogarithm": (E, "likelihood", "seems to return the likelihood"),
    "DeviationForVariance": (E, "likelihood", "0.32 times as wide|0.35 times|0.3 times"),
    "VarianceForDeviation": (E, "likelihood", "does not fit what is sampled"),
    "WrongSign": (E, "likelihood", "with the other sign"),
    "OtherCoordinate": (E, "likelihood", "does not fit what is sampled"),
    "Impossible": (E, "likelihood", "impossible .* in the very state"),
    "GlobalGenerator": (E, "purity", "move draws from the global generator"),
    "PythonsGenerator": (E, "purity", "sample_observation draws from the global generator"),
    "OwnGenerator": (E, "purity", "move returned something else"),
    "FixedGenerator": (E, "streams", "the same with each of 200 streams"),
    "SharedNoise": (E, "streams", "move gives all states of one call the same draw"),
    "SharedStart": (E, "streams", "initial_states gives all states of one call the same draw"),
    "GridStart": (E, "streams", "initial_states draws coordinate 0 .* of a belief at random, but"),
    "Counts": (E, "purity", "policy returned something else"),
    "ChangesItsArgument": (E, "contract", "limit_action raised ValueError: .*read-only"),
    "OneStateOnly": (E, "contract", r"policy of rover returned .* of shape \(2, 2\)"),
    "OneNumber": (E, "contract", r"sample_observation of .* need a float64 array of shape \(n,\)"),
    "Branches": (E, "contract", "policy raised ValueError: The truth value"),
    "MeanOfTheBelief": (E, "contract", "policy of a belief is .* in another leading shape"),
    "OneGoalForAll": (E, "contract", "is_goal of rover returned"),
    "Integers": (E, "contract", "reward of rover returned int64"),
    "NotFinite": (E, "contract", "move of rover put particle"),
    "KeepsItsStream": (E, "contract", "move raised ProblemError: a stream is for the one call"),
    "NeverAtTheGoal": (E, "goals", "comes to the goal in 0 of 64 trials"),
    "Slow": (E, "goals", "comes to the goal in .* within max_steps, 200, it is 0"),
    "Misspelt": (W, "contract", "sensing_cost: did you mean sensing_costs"),
    "AlwaysAtTheGoal": (E, "goals", "all of 64 initial states are goals"),
    "NeverMoves": (E, "goals", "the policy never moves"),
    "AlwaysFails": (E, "goals", "0 of 64 trials, and 64 fail$"),
    "FailsAtTheGoal": (E, "goals", "64 fail; 64 of the failures are at a goal"),
    "Angles": (E, "contract", r"circular_observations .* leave it out, or give \(\)"),
    "CoarseResolution": (E, "resolution", "resolution is 1e\\+02, 1e\\+02, .* all of them are the"),
    "ZeroReward": (NOTE, "goals", "the reward is 0 in all"),
    "GoodReward": (W, "goals", "the reward is 1 in all"),
    "GivesUp": (E, "contract", "policy raised SystemExit: 3"),
    "NoLimits": (E, "contract", "no_limits has no limit_action and no next_stage"),
    "Dominated": (W, "sensors", r"sensing action 2 \(another look\) is dominated: .* \(x\)"),
    "Silent": (W, "sensors", r"sensing action 2 \(another look\) tells nothing"),
    "TooSharp": (W, "depletion", "too sharp for 300 particles"),
    "NegativeVariance": (E, "contract", "every entry must be positive and finite"),
    "VarianceOfTheBelief": (E, "contract", "observation_variance of sensing action 0 of a belief"),
    "FineBesideWeak": (W, "resolution", r"coordinate 0 .* tolerates about 0\.3; but"),
    "Millimetres": (W, "units", "coordinates 1 and 0 of the task action"),
    "NoiseAsDeviation": (
        W,
        "motion",
        "coordinate 0 of a state with a variance above what move does",
    ),
    "Heading": (W, "units", r"coordinate 1 of a state jumps by a whole turn"),
}


ADVICE = {
    "OneNumber": "np.array([value])",
    "ChangesItsArgument": "take a copy",
    "Angles": "this attribute of the class",
    "FailsAtTheGoal": "let is_failure be false where is_goal is true",
}


def check(problem: Any, **options: Any) -> list[Finding]:
    return check_problem(problem, max_steps=200, budget_s=LONG_S, **{"trials": 0, **options})


@pytest.mark.parametrize("kind", WRONG)
def test_what_is_wrong_is_named(kind: str) -> None:
    severity, name, pattern = WRONG[kind]
    found = check(kind_of(kind)())
    named = [
        each for each in found if each.check == name and re.search(pattern, each.seen) is not None
    ]
    assert named, found
    assert named[0].severity == severity
    assert named[0].advice
    for own, words in ADVICE.items():
        assert (words in named[0].advice) == (kind == own)
    if name == "purity":  # neither what calls it, nor the noise that it makes
        assert [each.check for each in found if each.check in (name, "motion")] == [name]
    blamed = re.findall(r"\b(\w+) of rover returned", " ".join(each.seen for each in found))
    assert len(set(blamed)) == len(blamed)
    if severity == E:
        assert found[0].severity == E
        if "raised" in named[0].seen:
            assert "test_problem_check.py" in named[0].details
    else:
        assert not [each for each in found if each.severity == E]


@pytest.mark.parametrize("seed", [1, 2, 6])
def test_what_a_sensor_alone_shows_is_not_dominated(seed: int) -> None:
    """However sharp another one is: the few particles that it leaves show it by chance."""
    assert not [
        each for each in check(kind_of("WeakAlone")(), seed=seed) if "dominated" in each.seen
    ]


@pytest.mark.parametrize("declared", [(), (0,)])
def test_static_parameters_are_advised_where_none_are_declared(declared: tuple[int, ...]) -> None:
    problem = kind_of("TooSharp")()
    problem.static_parameters = declared
    (advice,) = [each.advice for each in check(problem) if "lies beyond all" in each.seen]
    assert ("static_parameters" in advice) == (not declared)


def test_of_a_bit_it_says_how_many_trials_end_wrong() -> None:
    found = [each for each in check(Bit()) if each.check == "depletion"]
    ended = r"([2-8]) of 8 trials ended sure of a wrong value \(\1 of these did not reach the goal"
    assert re.search(rf"{ended}\): .* true one of bit", found[0].seen)
    for each in found:
        assert "particle_filter.num_particles" in each.advice
        assert "less sharp than they are" in each.advice
        assert not re.search("static_parameters|threshold|more often", each.advice)
        assert each.where == CONTRACT
    inspection = Inspection(kind_of("StaticBit")(), PlanningSettings(), 200, 0, LONG_S)
    CHECKS["contract"](inspection)
    assert "names bit, with the values 0, 1 alone" in inspection.findings[0].seen
    assert inspection.findings[0].severity == W


RIGHT = [
    *registry.BUILT_IN,
    "light_dark_room:LightDarkRoom",
    "corridor_doors:CorridorDoors",
    "wrapping_heading:WrappingHeading",
    "two_ends:TwoCues",
    "two_ends:Sorting",
]
WARNED = {"two_ends:TwoCues": {"sensors", "resolution"}, "two_ends:Sorting": {"resolution"}}
"""Checks that warn of problems on which looking one step ahead fails."""


@pytest.mark.parametrize("name", RIGHT)
def test_right_problems_have_no_error(name: str) -> None:
    sys.path.insert(0, str(EXAMPLES))
    module, _, kind = name.partition(":")
    problem = (
        hf.make_problem(name) if not kind else getattr(importlib.import_module(module), kind)()
    )
    found = check_problem(problem, max_steps=1500, budget_s=LONG_S, trials=0)
    assert [each for each in found if each.severity == E] == []
    warned = {each.check for each in found if each.severity == W} - {"depletion"}
    assert warned == WARNED.get(name, set())


def test_the_same_seed_finds_the_same_and_says_what_it_does() -> None:
    begun: list[str] = []
    first = check(Rover(), seed=3, on_check=begun.append)
    assert begun == list(CHECKS)
    again = check(Rover(), seed=3)
    (time,) = [each for each in first if each.check == "time"]
    assert "ms of processor time (path_entropy, 300 particles): " in time.seen
    assert re.search(r"\d% in move \(\d+ calls\)", time.seen)
    assert [each for each in first if each.check != "time"] == [
        each for each in again if each.check != "time"
    ]


def test_standard_deviations_are_right_to_two_digits() -> None:
    for seed in range(10):
        inspection = Inspection(Rover(), PlanningSettings(), 200, seed, LONG_S)
        CHECKS["contract"](inspection)
        (noises,) = [each.seen for each in inspection.findings if each.check == "noises"]
        told = re.findall(r"of a state (0\.\d+)", noises)
        assert [float(each) for each in told] == pytest.approx([0.5, 0.5], abs=0.022), noises


def test_a_constant_reward_is_an_error_where_it_is_asked_for() -> None:
    settings = PlanningSettings(selector=SelectorSettings(method="expected_return"))
    found = check(kind_of("ZeroReward")(), settings=settings)
    assert any("the reward is 0" in each.seen and each.severity == E for each in found)


def test_without_time_it_says_what_was_left_out() -> None:
    found = check_problem(Rover(), max_steps=200, budget_s=1e-9)
    assert {each.check for each in found if each.seen == OVER} >= {"streams", "goals", "method"}
    assert not [each for each in found if each.severity == E]


def test_no_problem_at_all() -> None:
    for nothing in (None, 3, Rover, object()):
        assert check(nothing)[0].severity == E


def test_arguments_are_checked() -> None:
    cases: Any = (({"budget_s": 0.0}, "budget_s is 0"), ({"max_steps": 0}, "max_steps"))
    for given, says in (*cases, ({"problem": "peg.yaml"}, "'peg.yaml'.*load_configuration")):
        with pytest.raises(InvalidValueError, match=says):
            check_problem(**{"problem": Rover(), **given})


def test_the_places_that_findings_name_are_there() -> None:
    root = EXAMPLES.parent
    named = {CONTRACT, *WHERE.values()}
    for place in named:
        page, _, anchor = place.partition("#")
        text = (root / page).read_text(encoding="utf-8")
        headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
        anchors = {re.sub(r"[^\w-]", "", each.lower().replace(" ", "-")) for each in headings}
        assert anchor in {*anchors, ""}, place


def test_prices_that_nobody_weighs(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("streams", "goals", "likelihoods", "trials", "time"):
        monkeypatch.delitem(CHECKS, name)
    (found,) = [each for each in check(kind_of("Priced")()) if each.check == "prices"]
    assert found.severity == W
    assert "path_entropy does not weigh them: selector.nats_per_cost is 0" in found.seen
    page = (Path(__file__).parents[2] / "docs" / "problems.md").read_text(encoding="utf-8")
    cases: Any = (
        ("path_entropy", "1.04 (the nats", "1.5 log 2 = 1.04 / P"),
        ("action_entropy", "0.69 (the nats", "log 2 = 0.69 nats"),
        ("action_covariance", "how much smaller the trace", "(the trace) plus `nats_per_cost`"),
    )
    for method, worth, written in cases:
        own = check(
            kind_of("Priced")(), settings=PlanningSettings(selector=SelectorSettings(method=method))
        )
        (advice,) = [each.advice for each in own if each.check == "prices"]
        assert f"Set selector.nats_per_cost to {worth}" in advice
        assert written in page
    for selector in (
        SelectorSettings(nats_per_cost=0.1),
        SelectorSettings(method="expected_return"),
    ):
        own = check(kind_of("Priced")(), settings=PlanningSettings(selector=selector))
        assert not [each for each in own if each.check == "prices"]


def test_the_method_is_compared_with_random_sensing() -> None:
    """The boat's difference is 4 standard errors of 40 trials."""
    found = {each.check: each for each in check(FineBesideWeak(), trials=40)}["method"]
    assert found.severity == W
    assert re.search(r"takes \+\d.* steps .* in 40 paired .* worse", found.seen)
    found = {each.check: each for each in check(Rover(), trials=12)}["method"]
    assert found.severity == NOTE
    assert re.search("12 trials cannot tell|here it is better", found.seen)
