"""What a client says that means harm and speaks the wire; drawn by seed, for the attacker."""

from __future__ import annotations

import collections
import itertools
import random
from collections.abc import Callable, Iterator
from typing import NamedTuple

import msgspec
from tests.fuzz import corpus
from tests.fuzz.mutations import Mutator
from tests.wire import frame_of, hello_of

from holdfast.planning.inputs import MAX_INPUTS, Sensed
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
)
from holdfast.protocol.messages import Request, encode, with_checksum

_OWN_SESSIONS = 60
_COSTLY_SHARE = 0.0002
_FRAMES_SHARE = 0.01
_WORDS = (0, 1, 2, 3, 7, 64, 2**16, 2**31, 2**32 - 1)


class Message(NamedTuple):
    """A request, or other bytes that are no call but go the same way."""

    kind: str
    payload: bytes
    is_call: bool = True


class HostileMessages:
    """An endless row of messages that mean harm; the same seed gives the same row."""

    def __init__(self, seed: int) -> None:
        self._chance = random.Random(seed)
        # Its own sessions, each with the epoch of its last process.
        self._epochs = {self._chance.randbytes(16): 1 for _ in range(_OWN_SESSIONS)}
        self._numbers = itertools.count(1)
        self._requests = corpus.requests()
        self._mutator = Mutator(self._chance, [corpus.content_of(each) for each in self._requests])
        self._sent: collections.deque[bytes] = collections.deque(maxlen=500)
        self._ways: tuple[tuple[int, str, Callable[[], bytes]], ...] = (
            (15, "random", self._random),
            (33, "spoilt", self._spoilt),
            (14, "own", self._own),
            (10, "wrong", self._wrong),
            (4, "epoch", self._epoch),
            (6, "replayed", self._replayed),
            (10, "new session", self._new_session),
            (1, "unusual", self._unusual),
        )
        self._weights = [weight for weight, _, _ in self._ways]

    def __iter__(self) -> Iterator[Message]:
        chance = self._chance
        while True:
            draw = chance.random()
            if draw < _FRAMES_SHARE:
                yield Message("frames", self._frames(), is_call=False)
            elif draw < _FRAMES_SHARE + _COSTLY_SHARE:
                yield Message("costly", self._costly())
            elif draw < _FRAMES_SHARE + 0.001:
                yield Message("large", chance.randbytes(chance.choice((50_000, 300_000))))
            else:
                _, kind, way = chance.choices(self._ways, self._weights)[0]
                payload = way()
                self._sent.append(payload)
                yield Message(kind, payload)

    def _random(self) -> bytes:
        return self._sealed(
            self._chance.randbytes(self._chance.choice((0, 1, 2, 16, 75, 300, 2000)))
        )

    def _spoilt(self) -> bytes:
        return self._sealed(self._mutator.spoilt())

    def _sealed(self, content: bytes) -> bytes:
        """Return it with its checksum, mostly: without, no more of it is looked at."""
        return with_checksum(content) if self._chance.random() < 0.8 else content

    def _request(self, key: bytes) -> Request:
        request = self._chance.choice(self._requests)
        return msgspec.structs.replace(
            request, session=key, number=next(self._numbers), epoch=self._epochs.get(key, 1)
        )

    def _key(self) -> bytes:
        return self._chance.choice(list(self._epochs))

    def _own(self) -> bytes:
        """Return what an honest robot would ask, of one of this client's sessions."""
        return encode(self._request(self._key()))

    def _wrong(self) -> bytes:
        """Return a request with wrong numbers, digests or observations."""
        chance = self._chance
        request = self._request(self._key())
        field = chance.choice(("number", "trial", "step", "digest", "observations"))
        if field == "digest":
            return encode(msgspec.structs.replace(request, digest=chance.randbytes(16)))
        if field == "observations" and request.checkpoint is None:
            shown = chance.choice((b"", b"\0" * 8, b"\xff" * 8, bytes(8 * 4096)))
            false = Sensed(chance.choice(_WORDS), chance.choice((0, 1, 99)), shown)
            count = chance.choice((1, 2, MAX_INPUTS - len(request.inputs)))
            if len(shown) > 100:
                count = 1
            observations = (*request.inputs, *[false] * count)
            return encode(msgspec.structs.replace(request, inputs=observations))
        field = "step" if field == "observations" else field
        return encode(msgspec.structs.replace(request, **{field: chance.choice(_WORDS)}))

    def _epoch(self) -> bytes:
        """Return a request of a process that was replaced, or that replaces the one before."""
        key = self._key()
        request = self._request(key)
        epoch = self._epochs[key] + self._chance.choice((-1, -1, 1))
        self._epochs[key] = max(self._epochs[key], epoch)
        if self._chance.random() < 0.02:
            del self._epochs[key]
            self._epochs[self._chance.randbytes(16)] = 1
            epoch = 2**32 - 1  # after which nobody can take this session over
        return encode(msgspec.structs.replace(request, epoch=epoch))

    def _replayed(self) -> bytes:
        return self._chance.choice(self._sent) if self._sent else b""

    def _new_session(self) -> bytes:
        return encode(self._request(self._chance.randbytes(16)))

    def _unusual(self) -> bytes:
        """Return a request with another problem, more work than allowed, or a large opening."""
        chance = self._chance
        request = self._request(chance.randbytes(16))
        planning = PlanningSettings(
            particle_filter=ParticleFilterSettings(num_particles=chance.choice((1, 300))),
            active_sensing=ActiveSensingSettings(
                num_observation_samples=chance.choice((1, 30, 10**6)), num_cores=0
            ),
            sensing_interval=chance.choice((0, 8, 10**6)),
        )
        name = chance.choice((corpus.PROBLEM, "multitier_peg_in_hole_2d", "no_such", "os:system"))
        model: dict[str, object] = {}
        if name.startswith("multitier"):
            holes = [{"center": [4.0, 6.0 - 0.01 * number], "depth": 0.01} for number in range(900)]
            model = {"holes": holes}
        session_configuration = corpus.session_configuration_of(
            name, chance.randrange(2**63), model, planning
        )
        return encode(
            msgspec.structs.replace(
                request, session_configuration=session_configuration, checkpoint=None
            )
        )

    def _costly(self) -> bytes:
        """Return a question that keeps a worker busy for some tenths of a second."""
        planning = PlanningSettings(
            particle_filter=ParticleFilterSettings(num_particles=30_000),
            active_sensing=ActiveSensingSettings(num_observation_samples=10, num_cores=0),
        )
        session_configuration = corpus.session_configuration_of(
            seed=self._chance.randrange(2**63), planning=planning
        )
        request = self._request(self._chance.randbytes(16))
        changes = {
            "session_configuration": session_configuration,
            "checkpoint": None,
            "inputs": (),
        }
        return encode(msgspec.structs.replace(request, **changes))

    def _frames(self) -> bytes:
        """Return frames that no robot sends; most of them end the link."""
        chance = self._chance
        kind, call = chance.choice((*range(10), 255)), chance.choice((*_WORDS, *range(8)))
        content = chance.choice((b"", chance.randbytes(40), self._spoilt()))
        match chance.choice(("frame", "frame", "hello", "length", "bytes")):
            case "frame":
                return frame_of(kind, call, content)
            case "hello":
                return hello_of(chance.choice(("robot", "service")), "cloud")
            case "length":
                size = chance.choice((*_WORDS, len(content) + 1))
                return size.to_bytes(4, "little") + frame_of(kind, call, content)[4:]
            case _:
                return chance.randbytes(chance.choice((1, 9, 500)))
