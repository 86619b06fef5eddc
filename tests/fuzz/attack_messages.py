"""Requests that mean harm, drawn from classes: odd values at every place, every number too large.

The places come from the structs themselves: a setting that is added is attacked as well.
"""

import collections
import itertools
import random
from collections.abc import Iterator, Mapping
from typing import Any, get_args

import msgspec
import numpy as np
from tests.fuzz import corpus
from tests.fuzz.hostile_settings import NumericKey, keys_of
from tests.fuzz.mutations import Mutator
from tests.fuzz.odd_values import STORMS, OddValues, replaced
from tests.questions import request_of

from holdfast.config import registry
from holdfast.planning.belief import Belief
from holdfast.planning.inputs import Sensed
from holdfast.planning.planner import PlanningState, encode_checkpoint
from holdfast.planning.settings import (
    ActiveSensingSettings,
    Estimator,
    Method,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.protocol.messages import (
    CHECKSUM_SIZE,
    MAX_WORD,
    Request,
    encode,
    settings_digest,
    unpack_configuration,
    with_checksum,
)

_CONFIGURATION, _SETTINGS = 9, 11
"""Places of a request's fields."""

_MODEL, _PLANNER, _PLANNING, _SEED = 1, 2, 3, 4
"""Places of a session configuration's."""

_NO_DIGEST = b"s" * 16
IN_AN_OBSTACLE: Mapping[str, tuple[float, ...]] = {
    "peg_in_hole_2d": (20.0, -50.0, 0.0),
    "peg_in_hole_3d": (20.0, 0.0, -50.0, 0.0, 0.0, 0.0),
    "multitier_peg_in_hole_2d": (8.0, -0.5, 0.5),
    "capsule_robot": (2.0, 2.0),
}
"""A state of each built-in problem with obstacles, as deep in one as noise cannot leave."""

_BEYOND = (0, 1, -1, 2**31, 2**32, 2**63 - 1, 2**63, 2**64 - 1, 1e-320, 1e150, 1e308)


def _value_of(key: NumericKey, chance: random.Random) -> Any:
    """Return a value at a bound, just beyond it, or far beyond all bounds."""
    step = 1 if key.is_whole else 1e-9
    bound = chance.choice((key.most, key.most, key.most + step, key.least - step))
    value = chance.choice((bound, bound, bound, chance.choice(_BEYOND)))
    if key.is_whole and abs(value) < 2**63 and chance.random() < 0.9:
        value = int(value)
    if not key.length:
        return value
    if not isinstance(value, int) or chance.random() < 0.1:
        return [value] * (key.length + 1)
    return list(range(max(0, value - key.length + 1), value + 1))


def _set(data: dict[str, Any], path: tuple[str, ...], value: object) -> None:
    for name in path[:-1]:
        inner = data.get(name)
        data = data.setdefault(name, {}) if not isinstance(inner, dict) else inner
    data[path[-1]] = value


def _fields_of(array: object) -> list[bytes]:
    return [
        msgspec.msgpack.encode(each)
        for each in msgspec.msgpack.decode(msgspec.msgpack.encode(array))
    ]


def _digest(configuration: bytes) -> bytes:
    """Return the digest that a packed session configuration has here."""
    try:
        return settings_digest(unpack_configuration(configuration))
    except Exception:  # noqa: BLE001 - a service will not come to the digest either
        return _NO_DIGEST


def _request(fields: list[bytes], configuration: bytes, settings: bytes | None = None) -> bytes:
    """Return a request with a packed session configuration, and its digest unless given."""
    settings = settings or _digest(configuration)
    fields = replaced_fields(
        fields,
        {
            _CONFIGURATION: msgspec.msgpack.encode(configuration),
            _SETTINGS: msgspec.msgpack.encode(settings),
        },
    )
    return with_checksum(bytes([0x90 | len(fields)]) + b"".join(fields))


def replaced_fields(fields: list[bytes], changes: Mapping[int, bytes]) -> list[bytes]:
    """Return fields with others at some places."""
    return [changes.get(place, each) for place, each in enumerate(fields)]


def _opening(chance: random.Random, name: str = corpus.PROBLEM) -> tuple[list[bytes], list[bytes]]:
    """Return the fields of a request that opens a session of its own, and its configuration's."""
    request = next(
        each for each in corpus.requests(chance.randbytes(16)) if each.session_configuration
    )
    request = msgspec.structs.replace(request, checkpoint=None, inputs=())
    fields = _fields_of(msgspec.msgpack.decode(encode(request)[:-CHECKSUM_SIZE]))
    return fields, _fields_of(corpus.session_configuration_of(name, chance.randrange(2**63)))


def odd_requests(chance: random.Random) -> Iterator[bytes]:
    """Yield requests with a value of any type at any place, at the top and in the configuration."""
    odd = OddValues(chance)
    while True:
        fields, opening = _opening(chance)
        draw = chance.random()
        if draw < 0.25:
            yield with_checksum(replaced(fields, chance.randrange(len(fields)), odd.value()))
        elif draw < 0.5:
            packed = replaced(opening, chance.randrange(len(opening)), odd.value())
            yield _request(fields, packed)
        elif draw < 0.55:
            # To decode it for its digest would cost the attacker what it costs the attacked.
            section = b"\x81\xa1a" + chance.choice([*STORMS.values()])
            packed = replaced(opening, chance.choice((_MODEL, _PLANNER)), section)
            yield _request(fields, packed, _NO_DIGEST)
        elif draw < 0.95:
            # A section that is a mapping as it should be, and anything in it.
            items = [b"\xa1" + bytes([97 + k]) + odd.value() for k in range(chance.randrange(1, 4))]
            section = bytes([0x80 | len(items)]) + b"".join(items)
            yield _request(fields, replaced(opening, chance.choice((_MODEL, _PLANNER)), section))
        else:
            yield with_checksum(odd.value(5))


def hostile_settings(chance: random.Random) -> Iterator[bytes]:
    """Yield openings with numbers at their bounds and beyond, of every method and problem.

    One key, some or all of them; those of the settings, and those of the problem's own sections.
    """
    planning_keys = keys_of(PlanningSettings)
    methods, estimators = get_args(Method), (None, *get_args(Estimator))
    rounds = itertools.cycle(itertools.product(methods, estimators, tuple(registry.BUILT_IN)))
    while True:
        for key in chance.sample(planning_keys, len(planning_keys)):
            method, estimator, name = next(rounds)
            fields, opening = _opening(chance, name)
            planning = msgspec.to_builtins(PlanningSettings())
            planning["selector"] |= {"method": method, "estimator": estimator}
            # Few enough to be worth the attempt, where they are not what is attacked.
            planning["particle_filter"]["num_particles"] = chance.choice((12, 300, 4096))
            others = chance.sample(planning_keys, chance.choice((0, 0, 1, 3, len(planning_keys))))
            for each in (key, *others):
                _set(planning, each.path, _value_of(each, chance))
            changes = {_PLANNING: msgspec.msgpack.encode(planning)}
            if chance.random() < 0.3:
                changes |= dict(_hostile_sections(chance, name))
            if chance.random() < 0.05:
                changes[_SEED] = msgspec.msgpack.encode(chance.choice(_BEYOND))
            opening = replaced_fields(opening, changes)
            yield _request(fields, bytes([0x90 | len(opening)]) + b"".join(opening))


def checkpoints_in_obstacles(chance: random.Random) -> Iterator[bytes]:
    """Yield openings whose particles are where none can be: each move takes very long."""
    for name in itertools.cycle(IN_AN_OBSTACLE):
        count = chance.choice((12, 300, 8000))
        selector = SelectorSettings(method="random")
        planning = msgspec.structs.replace(
            corpus.PLANNING,
            particle_filter=ParticleFilterSettings(num_particles=count),
            selector=selector,
            sensing_interval=chance.choice((0, 2)),
        )
        belief = Belief(np.tile(IN_AN_OBSTACLE[name], (count, 1)), np.full(count, 1.0 / count))
        seed = chance.randrange(2**63)
        state = PlanningState(seed, 0, 0, 0, True, belief)
        yield encode(
            request_of(
                state,
                chance.randbytes(16),
                1,
                session_configuration=corpus.session_configuration_of(
                    name, seed, planning=planning
                ),
                checkpoint=encode_checkpoint(state),
            )
        )


def nearly_right(chance: random.Random, session: bytes, changes: int) -> Request:
    """Return what an honest robot might ask, but for some changes."""
    request = chance.choice(corpus.requests(session, chance.choice((1, 2, 3))))
    words = (0, 1, 2, 7, 64, 2**31, MAX_WORD)
    for _ in range(changes):
        field = chance.choice(("number", "trial", "step", "sensed", "digest", "inputs", "own"))
        value: object = chance.choice(words)
        match field:
            case "sensed":
                value = not request.sensed
            case "digest":
                value = chance.randbytes(16)
            case "inputs":
                kept = list(request.inputs)
                chance.shuffle(kept)
                shown = chance.choice((b"", b"\0" * 8, b"\xff" * 8, bytes(8 * 4096)))
                kept.append(Sensed(chance.choice(words), chance.choice((0, 1, 99)), shown))
                value = () if request.checkpoint is not None else tuple(kept)
            case "own":
                field = "session_configuration"
                planning = PlanningSettings(
                    particle_filter=ParticleFilterSettings(
                        num_particles=chance.choice((1, 4, 150))
                    ),
                    active_sensing=ActiveSensingSettings(num_observation_samples=2, num_cores=1),
                    sensing_interval=chance.choice((0, 5, 10**6)),
                )
                value = corpus.session_configuration_of(seed=chance.randrange(3), planning=planning)
        request = msgspec.structs.replace(request, **{field: value})
    return request


def spoilt_requests(chance: random.Random) -> Iterator[bytes]:
    """Yield spoilt, wrong, honest and replayed requests, of sessions of one's own, and noise."""
    own = [chance.randbytes(16) for _ in range(60)]
    mutator = Mutator(chance, [corpus.content_of(each) for each in corpus.requests()])
    sent: collections.deque[bytes] = collections.deque([b""], maxlen=500)
    while True:
        match chance.choices(("spoilt", "noise", "own", "replayed"), (35, 15, 40, 10))[0]:
            case "own":
                session = chance.choice((*own, chance.randbytes(16)))
                sent.append(encode(nearly_right(chance, session, chance.choice((0, 1, 1, 4)))))
            case "replayed":
                sent.append(chance.choice(sent))
            case kind:
                size = chance.choice((0, 1, 2, 16, 75, 300, 2000, 300_000))
                content = mutator.spoilt() if kind == "spoilt" else chance.randbytes(size)
                # Without its checksum, no more of it is looked at.
                sent.append(with_checksum(content) if chance.random() < 0.8 else content)
        yield sent[-1]


def _hostile_sections(chance: random.Random, name: str) -> Iterator[tuple[int, bytes]]:
    problem = registry.problem_class(name)
    for place, attribute in ((_MODEL, "Model"), (_PLANNER, "StateSpacePlanner")):
        keys = keys_of(getattr(problem, attribute)) if hasattr(problem, attribute) else []
        section: dict[str, Any] = {}
        for key in chance.sample(keys, min(len(keys), chance.choice((1, 1, 2, 99)))):
            _set(section, key.path, _value_of(key, chance))
        yield place, msgspec.msgpack.encode(section)
