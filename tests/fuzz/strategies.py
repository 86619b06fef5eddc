"""What Hypothesis draws: every message, every record and every state, and what spoils them."""

import random
from collections.abc import Sequence

import numpy as np
from hypothesis import strategies as st
from tests.fuzz.mutations import Mutator

from holdfast.planning.belief import Belief
from holdfast.planning.inputs import (
    MAX_INPUTS,
    ActingRecord,
    Late,
    LocalTookOverRecord,
    Moved,
    PausedRecord,
    Record,
    Reinitialised,
    Sensed,
    encode_floats,
)
from holdfast.planning.planner import PlanningState
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    MAX_TASK_ACTIONS,
    PROTOCOL_VERSION,
    Busy,
    NeedState,
    Progress,
    Refused,
    Reply,
    Request,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
)

words = st.integers(0, 2**32 - 1)
digests = st.binary(min_size=DIGEST_SIZE, max_size=DIGEST_SIZE)
finite = st.floats(allow_nan=False, allow_infinity=False)
numbers = st.lists(finite, max_size=12).map(encode_floats)
plain_data: st.SearchStrategy[object] = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | finite | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=12,
)
sections = st.dictionaries(st.text(max_size=12), plain_data, max_size=6)

plannings = st.builds(
    PlanningSettings,
    particle_filter=st.builds(ParticleFilterSettings, num_particles=st.integers(1, 1_000_000)),
    active_sensing=st.builds(
        ActiveSensingSettings,
        horizon=st.integers(1, 1000),
        discount=st.floats(0.0, 1.0),
        num_observation_samples=st.integers(1, 1_000_000),
        num_cores=st.integers(0, 100),
    ),
    selector=st.builds(
        SelectorSettings,
        method=st.sampled_from(
            (
                "action_entropy",
                "path_entropy",
                "state_entropy",
                "action_covariance",
                "expected_return",
                "random",
                "fixed",
            )
        ),
        sensing_action=st.integers(0, 100),
    ),
    sensing_interval=st.integers(0, 1000),
)
session_configurations = st.builds(
    SessionConfiguration,
    problem=st.text(min_size=1, max_size=60),
    model=sections,
    state_space_planner=sections,
    planning=plannings,
    seed=st.integers(0, 2**63 - 1),
)
observed = st.builds(Sensed, step=words, sensing_action=words, observation=numbers)
# A service is not told of rewards.
moved = st.builds(Moved, step=words, reward=st.none(), motion=numbers, observation=numbers)
_asked = {
    "version": st.just(PROTOCOL_VERSION),
    "session": st.binary(min_size=16, max_size=16),
    "epoch": words,
    "number": words,
    "trial": words,
    "step": words,
    "sensed": st.booleans(),
    "digest": digests,
    "session_configuration": st.none() | session_configurations,
}
requests: st.SearchStrategy[Request] = st.builds(
    Request, **_asked, inputs=st.lists(observed | moved, max_size=MAX_INPUTS).map(tuple)
) | st.builds(Request, **_asked, checkpoint=st.binary(max_size=500))
"""With and without an opening, inputs and a checkpoint."""

replies: st.SearchStrategy[Reply] = st.one_of(
    st.builds(
        TaskAnswer,
        number=words,
        count=st.integers(1, MAX_TASK_ACTIONS),
        actions=numbers,
        computed_us=words,
    ),
    st.builds(
        SensingAnswer,
        number=words,
        step=words,
        sensing_action=words,
        digest=digests,
        computed_us=words,
    ),
    st.builds(Progress, number=words, waiting=st.booleans()),
    st.builds(NeedState, number=words, differs=st.booleans()),
    st.builds(Busy, number=words, retry_after_ms=words),
    st.builds(Refused, number=words, code=st.text(max_size=40), text=st.text(max_size=300)),
)

records: st.SearchStrategy[Record] = st.one_of(
    st.builds(
        Sensed,
        step=words,
        sensing_action=words,
        observation=numbers,
        digest=st.binary(min_size=32, max_size=32),
        sensing_ms=finite,
    ),
    st.builds(ActingRecord, step=words, action=numbers),
    st.builds(Moved, step=words, reward=st.none() | finite, motion=numbers, observation=numbers),
    st.builds(
        Late,
        step=words,
        taken=words,
        observation=numbers,
        digest=st.binary(min_size=32, max_size=32),
    ),
    st.builds(Reinitialised, step=words, digest=st.binary(min_size=32, max_size=32)),
    st.just(PausedRecord()),
    st.builds(LocalTookOverRecord, times=words),
)


@st.composite
def states(draw: st.DrawFn) -> PlanningState:
    """Return a valid state, of no problem in particular."""
    count, size = draw(st.integers(1, 20)), draw(st.integers(1, 5))
    values = draw(st.lists(finite, min_size=count * size, max_size=count * size))
    weights = np.array(draw(st.lists(st.floats(0.0, 1.0), min_size=count, max_size=count)))
    total = float(weights.sum())
    weights = weights / total if total > 1e-3 else np.full(count, 1.0 / count)
    return PlanningState(
        draw(st.integers(0, 2**63 - 1)),
        draw(words),
        draw(words),
        draw(words),
        draw(st.booleans()),
        Belief(np.array(values).reshape(count, size), weights),
    )


def spoilt(specimens: Sequence[bytes]) -> st.SearchStrategy[bytes]:
    """Return messages like these that were spoilt, and bytes that are no message."""

    def spoil(seed: int) -> bytes:
        return Mutator(random.Random(seed), specimens).spoilt()

    return st.integers(0, 2**48).map(spoil) | st.binary(max_size=300)
