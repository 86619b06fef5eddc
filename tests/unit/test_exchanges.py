"""Both ends over a network of numbers: a virtual clock, delays, losses drawn by seed."""

import heapq
import itertools
import math
import random
from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.transport.datagram_cipher import OVERHEAD, ReplayWindow
from holdfast.transport.exchanges import (
    ECHO,
    KEEP_ALIVE_S,
    MAX_CACHED_REQUESTS,
    MAX_DATAGRAM_BYTES,
    MAX_PAYLOAD_BYTES,
    MAX_REORDERED_BYTES,
    PROBE,
    ReceivedReply,
    RobotExchange,
    RoundTripEstimator,
    ServiceExchange,
)
from holdfast.transport.redundancy import Paths

NOWHERE = Paths(lambda _: None, lambda _number, _message: None, lambda: 0)


class Sent(NamedTuple):
    at: float
    kind: int
    size: int
    datagram: bool


class Network:
    """A robot and a service, and two paths between them.

    The service answers ``parts`` parts, each after ``work_s``, and then ends the call.
    """

    def __init__(
        self,
        *,
        delay_s: float = 0.04,
        loss: float = 0.0,
        twice: float = 0.0,
        jitter_s: float = 0.0,
        work_s: float = 0.0,
        parts: int = 2,
        answer: bytes = bytes(150),
        seed: int = 0,
        datagrams: bool = True,
    ) -> None:
        self.now = 0.0
        self.delay_s, self.loss, self.twice, self.jitter_s = delay_s, loss, twice, jitter_s
        self.work_s, self.parts, self.answer = work_s, parts, answer
        self.datagrams = datagrams
        self.stream = True
        self._chance = random.Random(seed)
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self.sent: dict[str, list[Sent]] = {"robot": [], "service": []}
        self.asked: list[bytes] = []
        self.parts_of: dict[int, list[ReceivedReply]] = {}
        self.done_at: dict[int, float] = {}
        self.drop: Callable[[str, int], bool] = lambda _who, _kind: False
        self._windows = {"robot": ReplayWindow(), "service": ReplayWindow()}
        self._counters = {"robot": itertools.count(), "service": itertools.count()}
        self.robot = RobotExchange(self._paths("robot"))
        self.service = ServiceExchange(self._paths("service"))

    def _paths(self, who: str) -> Paths:
        return Paths(
            lambda message: self._datagram(who, message),
            lambda _number, message: self._on_stream(who, message),
            lambda: self._windows[who].num_lost,
        )

    def _datagram(self, who: str, message: bytes) -> None:
        assert len(message) + OVERHEAD <= MAX_DATAGRAM_BYTES
        self.sent[who].append(Sent(self.now, message[0], len(message) + OVERHEAD, True))
        other = "service" if who == "robot" else "robot"
        counter = next(self._counters[who])
        lost = self._chance.random() < self.loss or self.drop(who, message[0])
        if not self.datagrams or lost:
            return
        for _ in range(1 + (self._chance.random() < self.twice)):
            due = self.now + self.delay_s + self.jitter_s * self._chance.random()
            self._at(due, lambda: self._arrive(other, message, counter))

    def _arrive(self, who: str, message: bytes, counter: int) -> None:
        if self._windows[who].is_fresh(counter):
            self._windows[who].note(counter)
            self._take(who, message, datagram=True)

    def _on_stream(self, who: str, message: bytes) -> None:
        self.sent[who].append(Sent(self.now, message[0], len(message), False))
        other = "service" if who == "robot" else "robot"
        if self.stream:
            self._at(self.now + self.delay_s, lambda: self._take(other, message, datagram=False))

    def _take(self, who: str, message: bytes, *, datagram: bool) -> None:
        if who == "robot":
            for part in self.robot.received(message, self.now, datagram=datagram):
                self.parts_of.setdefault(part.call, []).append(part)
                if part.last:
                    self.done_at[part.call] = self.now
        else:
            arrived = self.service.received(message, datagram=datagram)
            if arrived is not None:
                self.asked.append(arrived.payload)
                self._work(arrived.number, 0)

    def _work(self, number: int, part: int) -> None:
        last = part == self.parts
        payload = None if last else self.answer + b"%d" % part

        def answer() -> None:
            self.service.reply(number, payload, self.now, last=last)
            if not last:
                self._work(number, part + 1)

        self._at(self.now + (0.0 if last else self.work_s), answer)

    def _at(self, when: float, what: Callable[[], None]) -> None:
        heapq.heappush(self._queue, (when, next(self._order), what))

    def run(self, until: Callable[[], bool], limit_s: float = 60.0) -> None:
        """Let time pass until something is so."""
        end = self.now + limit_s
        while not until():
            due = min(
                self._queue[0][0] if self._queue else math.inf, self.robot.due, self.service.due
            )
            assert due <= end, f"nothing in {limit_s} s of its time"
            self.now = max(self.now, due)
            if self._queue and self._queue[0][0] <= self.now:
                heapq.heappop(self._queue)[2]()
            else:
                self.robot.expire(self.now)
                self.service.expire(self.now)

    def wait(self, seconds: float) -> None:
        done: list[bool] = []
        self._at(self.now + seconds, lambda: done.append(True))
        self.run(lambda: bool(done), seconds + 1.0)

    def is_open(self) -> bool:
        return self.robot.open

    def begin(self) -> None:
        self.robot.begin(self.now)
        if self.datagrams:
            self.run(self.is_open)
            self.wait(1.0)  # until it is known whether any are lost

    def ask(self, call: int, payload: bytes = bytes(75)) -> float:
        """Ask, wait for the answer, and return how long it took."""
        began = self.now
        self.robot.send(call, payload, self.now)
        self.run(lambda: call in self.done_at)
        return self.done_at[call] - began

    def ask_all(self, calls: Sequence[int], pause_s: float = 0.0) -> list[float]:
        """Ask one after the other, and return how long each answer took; it is the right one."""
        times = []
        for call in calls:
            times.append(self.ask(call))
            self.check(call)
            if pause_s:
                self.wait(pause_s)
        return times

    def check(self, call: int) -> None:
        replies = [ReceivedReply(call, self.answer + b"%d" % k, False) for k in range(self.parts)]
        assert self.parts_of[call] == [*replies, ReceivedReply(call, None, True)]

    def datagrams_of(self, who: str) -> list[Sent]:
        return [sent for sent in self.sent[who] if sent.datagram]


class TestWithoutLoss:
    def test_an_answer_takes_one_round_trip(self) -> None:
        network = Network(delay_s=0.04)
        network.begin()
        assert network.ask_all(range(100)) == pytest.approx([0.08] * 100)

    def test_nothing_is_sent_twice(self) -> None:
        network = Network(delay_s=0.04)
        network.begin()
        before = {who: len(sent) for who, sent in network.sent.items()}
        network.ask_all(range(300), pause_s=0.02)
        assert len(network.sent["robot"]) - before["robot"] == 300
        assert len(network.sent["service"]) - before["service"] == 3 * 300
        assert all(sent.datagram for who in network.sent for sent in network.sent[who])
        assert len(network.asked) == 300

    def test_an_answer_that_takes_its_time_is_asked_for_ever_more_rarely(self) -> None:
        network = Network(delay_s=0.04, work_s=5.0, parts=1)
        network.begin()
        assert network.ask_all([1]) == pytest.approx([5.08])
        assert len(network.asked) == 1
        times = [sent.at for sent in network.sent["robot"] if sent.kind == 1]
        pauses = [b - a for a, b in itertools.pairwise(times)]
        assert len(pauses) < 10
        assert max(pauses) <= 1.1

    def test_a_service_that_shows_that_it_works_is_asked_no_more(self) -> None:
        network = Network(delay_s=0.04, work_s=0.05, parts=20, answer=b"working")
        network.begin()
        before = len(network.sent["robot"])
        network.ask(1)
        network.check(1)
        # Once in the beginning: that the first sign takes longer than the way is not known.
        assert len(network.sent["robot"]) - before <= 2

    def test_it_is_asked_now_and_then_whether_the_way_is_open(self) -> None:
        network = Network()
        network.begin()
        before = len(network.sent["robot"])
        network.wait(10.5 * KEEP_ALIVE_S)
        probes = [sent.at for sent in network.sent["robot"][before:]]
        assert len(probes) == 10
        assert min(b - a for a, b in itertools.pairwise(probes)) >= KEEP_ALIVE_S
        assert network.is_open()


class TestTheBeginning:
    """Before anybody knows whether the way loses any, it is taken for one that does."""

    def test_the_first_questions_are_sent_twice_and_no_others(self) -> None:
        network = Network(delay_s=0.04)
        network.robot.begin(0.0)
        network.run(network.is_open)
        network.ask_all(range(50))
        sent = [each for each in network.sent["robot"] if each.kind == 1]
        assert 50 < len(sent) < 60
        assert [each.at for each in sent[-40:]] == sorted({each.at for each in sent[-40:]})

    def test_a_few_questions_over_a_way_that_loses_some(self) -> None:
        times = []
        for seed in range(60):
            network = Network(delay_s=0.0435, loss=0.05, seed=seed)
            network.robot.begin(0.0)
            network.run(network.is_open)
            times += network.ask_all(range(15), pause_s=0.05)
        times.sort()
        assert times[int(0.95 * len(times))] <= 0.105


class TestLoss:
    @pytest.mark.parametrize("seed", range(3))
    def test_five_per_cent_each_way(self, seed: int) -> None:
        network = Network(delay_s=0.0435, loss=0.05, seed=seed)
        network.begin()
        times = sorted(network.ask_all(range(1000)))
        assert times[500] == pytest.approx(0.087)
        assert times[949] <= 0.105
        plain = Network(delay_s=0.0435)
        plain.begin()
        plain.ask_all(range(1000))
        for who in network.sent:
            sizes = [sum(s.size + 28 for s in n.datagrams_of(who)) for n in (network, plain)]
            assert sizes[0] <= 3 * sizes[1]
        # Before any loss is known, two in a row may be taken for silence.
        assert sum(not sent.datagram for sent in network.sent["robot"]) <= 10

    def test_only_the_direction_that_loses_is_doubled(self) -> None:
        network = Network(delay_s=0.04)
        chance = random.Random(1)
        network.drop = lambda who, _kind: who == "service" and chance.random() < 0.1
        network.begin()
        network.ask_all(range(500))
        assert len(network.sent["service"]) > 1.8 * 3 * 500
        asked_again = len(network.sent["robot"]) - 501
        assert asked_again < 100

    def test_nothing_is_doubled_any_more_when_the_way_is_good_again(self) -> None:
        network = Network(delay_s=0.04, loss=0.1, seed=3)
        network.begin()
        network.ask_all(range(200))
        network.loss = 0.0
        network.ask_all(range(200, 400))
        before = len(network.sent["robot"])
        network.ask_all(range(400, 500))
        assert len(network.sent["robot"]) - before == 100

    @pytest.mark.parametrize("lost_kind", [1, 2])
    def test_the_first_of_all_is_lost(self, lost_kind: int) -> None:
        network = Network(delay_s=0.04)
        network.begin()
        network.ask(1)
        lost: list[int] = []

        def drop(who: str, kind: int) -> bool:
            if kind == lost_kind and not lost:
                lost.append(kind)
                return True
            return False

        network.drop = drop
        # One more round trip, and the patience beyond the first.
        assert network.ask(2) <= 0.08 + 0.08 + 0.03 + 4 * 0.04
        assert lost
        network.check(2)

    @given(
        st.builds(
            Network,
            loss=st.floats(0.0, 0.5),
            twice=st.floats(0.0, 0.5),
            jitter_s=st.floats(0.0, 0.2),
            delay_s=st.sampled_from([0.0001, 0.01, 0.1]),
            work_s=st.sampled_from([0.0, 0.001, 0.2]),
            parts=st.integers(0, 4),
            seed=st.integers(0, 1000),
        )
    )
    @settings(max_examples=60)
    def test_each_part_comes_once_in_order_whatever_is_lost(self, network: Network) -> None:
        network.robot.begin(0.0)
        calls = range(30)
        for call in calls:
            size = 2 * MAX_PAYLOAD_BYTES if call % 7 == 3 else 75
            network.robot.send(call, bytes([call]) * size, network.now)
            network.wait(0.01)
        network.run(lambda: len(network.done_at) == len(calls), 600.0)
        for call in calls:
            network.check(call)
        assert sorted(payload[0] for payload in network.asked) == list(calls)
        assert not network.robot._requests


class TestManyAreLost:
    """While the service's port is flooded: only datagrams to it are lost."""

    @staticmethod
    def flooded(seed: int, loss: float = 0.5, delay_s: float = 0.0005) -> Network:
        network = Network(delay_s=delay_s, seed=seed)
        network.begin()
        network.ask_all(range(-100, 0))
        chance = random.Random(seed)
        network.drop = lambda who, _kind: who == "robot" and chance.random() < loss
        return network

    @pytest.mark.parametrize("loss", [0.3, 0.5, 0.7, 0.9, 1.0])
    @pytest.mark.parametrize("seed", range(3))
    def test_a_question_is_lost_no_more_than_twice(self, seed: int, loss: float) -> None:
        network = self.flooded(seed, loss)
        times = network.ask_all(range(150), pause_s=0.02)
        # After 10 ms, the least margin, and twice as many it goes on the stream as well.
        assert max(times) <= 0.04
        # Once it is known that many are lost, it does so at once.
        assert sum(each > 0.0011 for each in times[100:]) <= (10 if loss < 0.5 else 1)
        assert len(network.asked) == 250

    def test_the_stream_takes_the_place_of_the_copy(self) -> None:
        network = self.flooded(5)
        network.ask_all(range(150))
        before = {who: len(sent) for who, sent in network.sent.items()}
        network.ask_all(range(150, 250))
        for who, of_each in (("robot", 1), ("service", 3)):
            sent = [each for each in network.sent[who][before[who] :] if each.kind in (1, 2, 6)]
            assert len(sent) == 2 * of_each * 100
            assert sum(each.datagram for each in sent) == of_each * 100

    def test_what_is_hedged_is_answered_by_datagrams_where_the_stream_is_held_up(self) -> None:
        network = self.flooded(6)
        network.ask_all(range(150))
        # What the service sends there does not come; what the robot sends comes first.
        paths = network.service._sender.paths
        network.service._sender.paths = paths._replace(stream=lambda _number, _message: None)
        network.ask_all(range(150, 200))

    def test_nothing_goes_there_any_more_when_the_flood_is_over(self) -> None:
        network = self.flooded(7)
        network.ask_all(range(150))
        network.drop = lambda _who, _kind: False
        for call in range(150, 300):
            network.ask(call)
        network.wait(2.0 * KEEP_ALIVE_S)  # a probe comes back
        before = len(network.sent["robot"])
        network.ask_all(range(300, 400))
        asked = network.sent["robot"][before:]
        assert len(asked) == 100
        assert all(each.datagram for each in asked)


class TestBudget:
    def test_a_way_that_loses_nearly_all_is_given_no_more_than_three_times_the_load(self) -> None:
        network = Network(delay_s=0.04)
        network.begin()
        network.ask_all(range(50))
        network.loss = 0.6
        before = len(network.sent["robot"]), len(network.sent["service"])
        network.ask_all(range(50, 550))
        for who, start in zip(("robot", "service"), before, strict=True):
            sent = [each for each in network.sent[who][start:] if each.datagram]
            first = 500 * (75 + 10 + 2 + OVERHEAD + 28) if who == "robot" else 0
            if who == "service":
                first = 500 * (2 * (151 + 8 + OVERHEAD + 28) + 8 + OVERHEAD + 28)
            extra = sum(each.size + 28 for each in sent if each.kind in (1, 2))
            assert extra <= 3 * first + 8192


class TestTheStream:
    def test_before_datagrams_are_known_to_get_through(self) -> None:
        network = Network()
        assert network.ask_all([1]) == pytest.approx([0.08])
        assert not any(sent.datagram for who in network.sent for sent in network.sent[who])

    def test_where_no_datagram_gets_through(self) -> None:
        network = Network(datagrams=False)
        network.begin()
        assert network.ask_all(range(10)) == pytest.approx([0.08] * 10)
        assert not network.is_open()
        before = len(network.datagrams_of("robot"))
        network.wait(60.0)
        # It is asked every second whether that has changed.
        assert 55 <= len(network.datagrams_of("robot")) - before <= 70
        network.datagrams = True
        network.wait(2.0)
        assert network.is_open()

    def test_what_is_large_goes_there_with_its_answer(self) -> None:
        network = Network()
        network.begin()
        network.ask(1, bytes(MAX_PAYLOAD_BYTES))
        network.ask(2, bytes(MAX_PAYLOAD_BYTES + 1))
        assert [sent.datagram for sent in network.sent["robot"] if sent.kind == 1] == [True, False]
        answers = [sent.datagram for sent in network.sent["service"] if sent.kind == 2]
        assert answers == [True] * 3 + [False] * 3
        network.check(2)

    def test_a_large_question_is_not_copied(self) -> None:
        """Nobody else is heard meanwhile."""
        answers = ServiceExchange(NOWHERE)
        message = bytearray(b"\1\0" + (1).to_bytes(4, "big") * 2 + b"\0\0" + bytes(2_000_000))
        arrived = answers.received(cast(bytes, message), datagram=False)
        assert arrived is not None and len(arrived.payload) == 2_000_000
        assert np.shares_memory(np.frombuffer(arrived.payload, np.uint8), message)

    def test_a_large_part_among_small_ones(self) -> None:
        network = Network(parts=3)
        network.answer = bytes(MAX_PAYLOAD_BYTES + 100)
        network.begin()
        network.ask_all([1])
        answers = [sent.datagram for sent in network.sent["service"] if sent.kind == 2]
        assert answers == [False, False, False, True]

    @pytest.mark.parametrize("work_s", [0.0, 2.0])
    def test_datagrams_stop_getting_through(self, work_s: float) -> None:
        network = Network(work_s=work_s)
        network.begin()
        network.ask(1)
        network.datagrams = False
        assert network.ask(2) <= 1.0 + 2 * work_s
        network.check(2)
        assert not network.is_open()
        assert network.ask(3) == pytest.approx(0.08 + 2 * work_s)
        network.datagrams = True
        network.wait(2.0)
        assert network.is_open()
        assert network.asked == [bytes(75)] * 3  # none was taken for a new one

    def test_answers_that_are_on_their_way_when_datagrams_stop(self) -> None:
        network = Network(work_s=0.5, parts=4)
        network.begin()
        network.robot.send(1, bytes(75), network.now)
        network.wait(0.7)
        network.datagrams = False
        network.run(lambda: 1 in network.done_at)
        network.check(1)

    def test_silence_is_noticed_though_nothing_is_asked(self) -> None:
        network = Network()
        network.begin()
        network.datagrams = False
        network.wait(3.0 * KEEP_ALIVE_S)
        assert not network.is_open()

    def test_a_service_that_ends_sends_there_what_the_robot_may_lack(self) -> None:
        network = Network()
        network.begin()
        network.drop = lambda who, _kind: who == "service"
        network.robot.send(1, bytes(75), network.now)
        network.wait(0.06)
        began = network.now
        network.service.flush()
        network.run(lambda: 1 in network.done_at)
        network.check(1)
        assert network.done_at[1] - began <= 0.05

    def test_what_was_passed_over_because_it_is_too_large(self) -> None:
        network = Network()
        network.robot.send(5, bytes(75), 0.0)
        assert network.robot.oversized(1) == [ReceivedReply(5, None, True)]
        assert network.robot.oversized(1) == []
        assert network.service.oversized(1)
        assert not network.service.oversized(1)
        network.robot.send(6, bytes(75), 0.0)
        network.service.oversized(2)
        network.service.reply(2, b"too large", 0.0, last=True)
        network.run(lambda: 6 in network.done_at)
        assert network.parts_of[6] == [ReceivedReply(6, b"too large", True)]


class TestOfOneEnd:
    """A robot's end, whose messages are looked at."""

    def setup_method(self) -> None:
        self.datagrams: list[bytes] = []
        self.streamed: list[bytes] = []
        self.robot = RobotExchange(
            Paths(self.datagrams.append, lambda _, message: self.streamed.append(message), int)
        )

    def test_a_probe_of_the_service_is_echoed_and_shows_no_more_than_it_does(self) -> None:
        for now in range(40):
            self.robot.probe(float(now))
        assert self.robot.unanswered_probes == 40
        self.datagrams.clear()
        probe = bytes((PROBE, 0)) + b"12345678"
        for odd, datagram in ((probe, False), (probe[:-1], True), (probe + b"9", True)):
            assert self.robot.received(odd, 1.0, datagram=datagram) == []
        assert self.datagrams == []
        assert self.robot.unanswered_probes == 40
        assert self.robot.received(probe, 1.0, datagram=True) == []
        assert self.datagrams == [bytes((ECHO, 0)) + b"12345678"]
        assert self.robot.unanswered_probes == 0  # both directions work: no other socket is needed
        assert not self.robot.open  # but the replies may go to another address
        assert self.robot.received(self.datagrams[0], 1.0, datagram=True) == []
        assert self.robot.open

    def test_a_probe_on_suspicion_changes_nothing_else(self) -> None:
        self.robot.begin(1.0)
        before = self.robot.due, self.robot.unanswered_probes
        self.robot.probe(2.0, counted=False)
        assert (self.robot.due, self.robot.unanswered_probes) == before
        assert len(self.datagrams) == 2

    @pytest.mark.parametrize(("lost", "hedged"), [(31, False), (32, True)])
    def test_at_a_quarter_lost_the_stream_helps_at_once(self, lost: int, hedged: bool) -> None:
        self.robot.received(bytes((ECHO, lost)) + bytes(8), 1.0, datagram=True)
        self.robot.send(1, b"question", 1.0)
        assert [message[0] for message in self.datagrams] == [1]
        assert [message[0] for message in self.streamed] == ([6] if hedged else [])


class TestBounds:
    def test_a_call_that_is_forgotten_is_heard_of_no_more(self) -> None:
        network = Network(work_s=1.0)
        network.begin()
        network.robot.send(1, bytes(75), network.now)
        network.wait(0.2)
        network.robot.abandon(1)
        assert network.ask(2) > 0
        assert 1 not in network.parts_of
        before = len(network.sent["robot"])
        network.wait(4.0)
        assert len(network.sent["robot"]) == before

    def test_answers_are_kept_until_the_robot_has_them(self) -> None:
        network = Network()
        network.begin()
        network.ask_all(range(5 * MAX_CACHED_REQUESTS))
        # All but the last are settled, so a late copy of an old question is no new one.
        late = b"\1\0" + b"\0\0\0\1" * 2 + b"\0\0" + bytes(75)
        assert network.service.received(late, datagram=True) is None
        assert len(network.asked) == 5 * MAX_CACHED_REQUESTS

    def test_parts_without_those_before_them_take_no_more_memory_than_the_bound(self) -> None:
        robot = RobotExchange(NOWHERE)
        robot.send(7, bytes(2000), 0.0)
        part = bytes(MAX_REORDERED_BYTES // 4)
        found = []
        for index in range(1, 6):  # never the first
            reply = b"\2\0" + (1).to_bytes(4, "big") + index.to_bytes(2, "big") + part
            found.append(robot.received(reply, 0.0, datagram=False))
        assert found == [[], [], [], [], [ReceivedReply(7, None, True)]]
        assert not robot._requests

    def test_no_more_answers_are_kept_than_the_bound(self) -> None:
        answers = ServiceExchange(NOWHERE)
        for number in range(1, 3 * MAX_CACHED_REQUESTS):
            question = b"\1\0" + number.to_bytes(4, "big") + b"\0\0\0\1\0\0x"
            assert answers.received(question, datagram=True) is not None
            answers.reply(number, b"answer", 0.0, last=True)
        assert len(answers._cached) == MAX_CACHED_REQUESTS
        assert answers.held_bytes == MAX_CACHED_REQUESTS * len(b"\0\0\0\1\0\0answer")

    def test_what_is_kept_for_a_robot_is_measured(self) -> None:
        answers = ServiceExchange(NOWHERE)
        size = 6 + len(b"answer")

        def ask(number: int, settled: int, *, datagram: bool = True) -> None:
            head = number.to_bytes(4, "big") + settled.to_bytes(4, "big") + b"\0\0"
            answers.received(b"\1\0" + head + b"x", datagram=datagram)

        for number in (1, 2, 3):
            ask(number, 1)
            answers.reply(number, b"answer", 0.0, last=False)
            answers.reply(number, b"answer", 0.0, last=True)
        assert answers.held_bytes == 6 * size
        ask(2, 1)  # once more: it is still kept
        assert answers.held_bytes == 6 * size
        ask(2, 1, datagram=False)  # the stream loses nothing
        assert answers.held_bytes == 4 * size
        ask(3, 3)
        assert answers.held_bytes == 2 * size
        ask(4, 4)
        assert answers.held_bytes == 0

    @given(st.binary(max_size=60), st.booleans())
    def test_arbitrary_messages_do_no_harm(self, message: bytes, datagram: bool) -> None:
        network = Network()
        network.begin()
        network.robot.send(1, bytes(75), network.now)
        network.robot.received(message, network.now, datagram=datagram)
        network.service.received(message, datagram=datagram)
        for kind in range(7):
            network.robot.received(bytes((kind, 0)) + message, network.now, datagram=datagram)
            network.service.received(bytes((kind, 0)) + message, datagram=datagram)


class TestRoundTrips:
    def test_as_in_the_standard(self) -> None:
        trips = RoundTripEstimator()
        assert trips.timeout_s == 0.2
        trips.add(0.1)
        assert trips.timeout_s == pytest.approx(0.1 + 4 * 0.05)
        trips.add(0.1)
        assert trips.timeout_s == pytest.approx(0.1 + 4 * 0.0375)
        trips.add(0.2)
        assert trips.smoothed_s == pytest.approx(0.1125)
        assert trips.timeout_s == pytest.approx(0.1125 + 4 * (0.75 * 0.0375 + 0.25 * 0.1))

    def test_the_margin_is_never_less_than_ten_milliseconds_nor_the_sum_more_than_a_second(
        self,
    ) -> None:
        trips = RoundTripEstimator()
        for _ in range(200):
            trips.add(0.0002)
        assert trips.timeout_s == pytest.approx(0.0102, abs=1e-6)
        trips.add(30.0)
        assert trips.timeout_s == 1.0
