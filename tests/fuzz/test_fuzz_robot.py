"""A robot whose services send it anything at all: it decides what it would have decided.

A service that answers well-formed, within the problem's limits and wrong is found out by computing
again (`tests/unit/test_verification.py`), perhaps after the robot has obeyed it. Everything else
that is not the answer must have no effect but on time; `Refused` is how a service says that it
cannot.
"""

import random
from collections.abc import Callable

import msgspec
import pytest
from hypothesis import strategies as st
from tests.fuzz import corpus
from tests.fuzz.examples import always, examples
from tests.fuzz.mutations import Mutator
from tests.robot_world import LOCAL, World

from holdfast.planning.inputs import encode_floats
from holdfast.planning.settings import SimulatorSettings
from holdfast.protocol.dispatcher import Dispatcher
from holdfast.protocol.messages import (
    Busy,
    NeedState,
    Progress,
    Refused,
    Reply,
    SensingAnswer,
    TaskAnswer,
    encode,
    with_checksum,
)
from holdfast.protocol.robot_events import (
    CallEnded,
    Halt,
    ReplyReceived,
    RobotEffect,
    Send,
    ServiceAppeared,
    ServiceVanished,
)

ONE_TRIAL = SimulatorSettings(num_trials=1, max_steps=14, seed=11)


class HostileWorld(World):
    """Beside each honest reply come others; nobody but the honest service is ever believed."""

    def __init__(self, seed: int, share: float, *kinds: str) -> None:
        chance = random.Random(seed)
        services = ("first", "second")[: chance.randint(1, 2)]
        # Whoever sends too much of what is no answer is asked no more.
        launch = "on_failure" if "beyond" in kinds else chance.choice(("on_failure", "never"))
        super().__init__(services=services, launch=launch, simulator=ONE_TRIAL)
        self.chance = chance
        self.share = share
        self.kinds = ("spoilt", "nonsense", "late", "shapeless", "mild", *kinds)
        self.specimens = [corpus.content_of(reply) for reply in corpus.replies()]
        self.mutator = Mutator(chance, self.specimens)
        self.seen: list[bytes] = []

    def send(self, effect: Send) -> None:
        super().send(effect)
        if self.chance.random() < self.share:
            for _ in range(self.chance.randint(1, 4)):
                self.after(self.chance.uniform(0.0, 0.02), self.hostile(effect.call))

    def reply(self, call: int, reply: Reply) -> list[RobotEffect]:
        self.seen.append(corpus.content_of(reply))
        return super().reply(call, reply)

    def hostile(self, call: int) -> Callable[[], list[RobotEffect]]:
        """Return what delivers something, to this call or to any."""

        def deliver() -> list[RobotEffect]:
            any_call = self.chance.choice((call, call, call + 1, call - 1, 0, -1, 2**63))
            if self.chance.random() < 0.1:
                return self.robot.handle(CallEnded(any_call), self.now)
            if self.chance.random() < 0.1:
                name = self.chance.choice((*self.services, "nobody"))
                boot = self.chance.choice(("", "0", "1", "other"))
                event = self.chance.choice((ServiceAppeared, ServiceVanished))
                if name in self.services:
                    # A transport that erred finds that out.
                    self.after(0.05, lambda: self.truth(name))
                return self.robot.handle(event(name, boot), self.now)
            return self.robot.handle(ReplyReceived(any_call, self.payload(any_call)), self.now)

        return deliver

    def truth(self, name: str) -> list[RobotEffect]:
        service = self.services[name]
        event = ServiceAppeared if service.up else ServiceVanished
        return self.robot.handle(event(name, str(service.boot)), self.now)

    def payload(self, call: int) -> bytes:
        """Return anything but a good answer to that call, and but a word that ends the run."""
        match self.chance.choice(self.kinds):
            case "beyond":
                count = self.chance.randint(1, 4)
                far = [self.chance.choice((-1.0, 1.0)) * self.chance.uniform(0.2, 9.0)]
                return encode(TaskAnswer(call % 2**32, count, encode_floats(far * 3 * count), 1))
            case "late" if self.seen:
                return self.other_number(self.chance.choice(self.seen), call)
            case "nonsense":
                nonsense = self.chance.randbytes(self.chance.choice((0, 1, 20, 300)))
                return with_checksum(nonsense) if self.chance.random() < 0.5 else nonsense
            case "shapeless":
                return encode(self.chance.choice(self.impossible(call)))
            case "mild":
                number = call % 2**32
                return encode(
                    self.chance.choice(
                        (
                            Progress(number, self.chance.random() < 0.5),
                            NeedState(number, self.chance.random() < 0.5),
                            Busy(number, self.chance.choice((0, 1, 30))),
                            Busy(0, 1),
                            Refused(number, "malformed", "spoilt on its way"),
                        )
                    )
                )
            case _:
                return self.other_number(self.mutator.spoilt(), call)

    def other_number(self, content: bytes, call: int) -> bytes:
        """Return a reply as that to another request, so that it cannot pass for an answer."""
        try:
            fields = msgspec.msgpack.decode(content)
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError, ValueError):
            return with_checksum(content)
        if isinstance(fields, list) and len(fields) > 1 and fields[0] in (1, 2, 6):
            fields[1] = (call + 1) % 2**32 or 1
            return with_checksum(msgspec.msgpack.encode(fields))
        return with_checksum(content)

    def impossible(self, call: int) -> list[Reply]:
        """Return answers of that number which cannot be answers to any question of this robot."""
        number = call % 2**32
        nothing, long = encode_floats([]), encode_floats([0.1] * 3 * 64)
        return [
            TaskAnswer(number, 64, long, 1),
            TaskAnswer(number, 4, nothing, 1),
            TaskAnswer(number, 4, encode_floats([float("nan")] * 12), 1),
            TaskAnswer(number, 4, encode_floats([0.0] * 12)[:-1], 1),
            SensingAnswer(number, 0, 2**32 - 1, bytes(16), 1),
            SensingAnswer(number, 2**32 - 1, 0, bytes(16), 1),
            SensingAnswer(number, 5, 0, bytes(16), 1),
        ]


@pytest.mark.parametrize("how", [(), ("beyond",)], ids=["anything", "beyond the limits"])
@examples(quick=15, slow=800)
def test_whatever_comes_the_decisions_are_the_same(examples: int, how: tuple[str, ...]) -> None:
    def check(seed: int) -> None:
        world = HostileWorld(seed, 0.7, *how)
        world.start()
        world.run(until_s=600.0)
        assert world.stopped is None, world.stopped
        world.assert_same_as_without_faults()
        dispatcher = world.robot._source
        assert isinstance(dispatcher, Dispatcher)
        calls = dispatcher._calls._open
        assert len(calls) <= 4 * len(world.services)

    always(examples, check, st.integers(0, 2**48))


@examples(quick=15, slow=800)
def test_a_service_that_is_nothing_but_hostile(examples: int) -> None:
    """The robot holds still, goes on with its local service, or says that all refuse."""

    def check(seed: int) -> None:
        world = HostileWorld(seed, share=1.0)
        for name in world.offload.services:
            world.services[name].rule = lambda _: []
        world.start()
        world.after(10.0, list)  # a robot without any service waits for nothing else
        world.run(until_s=5.0)
        assert not [effect for _, effect in world.trace if isinstance(effect, Halt)]
        for result in world.results:
            assert LOCAL in world.services
            world.assert_same_as_without_faults()
            assert result.steps > 0

    always(examples, check, st.integers(0, 2**48))
