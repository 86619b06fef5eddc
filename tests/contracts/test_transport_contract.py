"""What every wire must do, over all of them, in one process and between processes."""

import asyncio
import itertools
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
from tests.contracts import wires
from tests.process_states import stop

from holdfast.errors import InvalidValueError
from holdfast.protocol.robot_events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)
from holdfast.transport.contract import IncomingCall


class TestEveryWire:
    async def test_a_call_brings_the_reply_and_one_end(self, wire: wires.Wire) -> None:
        robot, inbox, _ = await wires.connected(wire)
        await wires.answers(robot, inbox, 7)

    async def test_several_replies_come_in_order(self, wire: wires.Wire) -> None:
        def count(call: IncomingCall) -> None:
            for i in range(50):
                call.reply(b"%d" % i)
            call.end()

        robot, inbox, _ = await wires.connected(wire, count)
        robot.call("cloud", 1, b"")
        expected: list[TransportEvent] = [ReplyReceived(1, b"%d" % i) for i in range(50)]
        assert await inbox.of_call(1) == [*expected, CallEnded(1)]

    async def test_replies_come_while_the_call_is_open(self, wire: wires.Wire) -> None:
        calls = wires.Received()
        robot, inbox, _ = await wires.connected(wire, calls)
        robot.call("cloud", 1, b"question")
        call = await calls.next()
        assert call.payload == b"question"
        call.reply(b"first")
        await inbox.wait_for(ReplyReceived(1, b"first"))
        assert CallEnded(1) not in inbox
        call.reply(b"second")
        call.end()
        assert await inbox.of_call(1) == [
            ReplyReceived(1, b"first"),
            ReplyReceived(1, b"second"),
            CallEnded(1),
        ]

    async def test_what_comes_after_the_end_is_no_error_and_goes_nowhere(
        self, wire: wires.Wire
    ) -> None:
        calls = wires.Received()
        robot, inbox, _ = await wires.connected(wire, calls)
        robot.call("cloud", 1, b"")
        call = await calls.next()
        call.end()
        call.end()
        call.reply(b"late")
        robot.call("cloud", 2, b"")
        wires.echo(await calls.next())
        assert await inbox.of_call(2) == [ReplyReceived(2, b""), CallEnded(2)]
        assert await inbox.of_call(1) == [CallEnded(1)]

    async def test_an_absent_service_ends_a_call(self, wire: wires.Wire) -> None:
        robot, inbox = wire.robot("cloud"), wires.Inbox()
        robot.start(inbox)
        robot.call("cloud", 1, b"question")
        assert await inbox.of_call(1) == [CallEnded(1)]

    async def test_nothing_is_delivered_from_inside_a_method(self, wire: wires.Wire) -> None:
        inside = False
        inbox = wires.Inbox()
        serving = wire.service("cloud", "b1")

        def deliver(event: TransportEvent) -> None:
            assert not inside
            inbox(event)

        def serve(call: IncomingCall) -> None:
            nonlocal inside
            assert not inside
            inside = True
            call.reply(call.payload)
            call.end()
            inside = False

        robot = wire.robot("cloud")
        inside = True
        robot.start(deliver)
        robot.call("cloud", 1, b"nobody is there")
        inside = False
        await serving.start(serve)
        await inbox.appeared()
        inside = True
        robot.call("cloud", 2, b"question")
        robot.call("cloud", 3, bytes(wires.MAX_BYTES + 1))
        robot.call("cloud", 4, b"given up")
        robot.abandon(4)
        inside = False
        assert await inbox.of_call(1) == [CallEnded(1)]
        assert await inbox.of_call(2) == [ReplyReceived(2, b"question"), CallEnded(2)]
        assert len(await inbox.of_call(3)) == 2
        assert inbox.threads == {threading.get_ident()}

    async def test_a_service_that_starts_after_the_robot_appears(self, wire: wires.Wire) -> None:
        robot, inbox = wire.robot("cloud"), wires.Inbox()
        robot.start(inbox)
        service = wire.service("cloud", "later")
        await service.start(wires.echo)
        await inbox.wait_for(ServiceAppeared("cloud", "later"))
        await wires.answers(robot, inbox, 1)

    async def test_a_service_that_has_appeared_can_be_called_as_soon_as_that_is_heard(
        self, wire: wires.Wire
    ) -> None:
        service = wire.service("cloud", "b1")
        robot = wire.robot("cloud")
        inbox = wires.Inbox()

        def deliver(event: TransportEvent) -> None:
            if isinstance(event, ServiceAppeared):
                robot.call("cloud", 1, b"question")
            inbox(event)

        robot.start(deliver)
        await service.start(wires.echo)
        assert await inbox.of_call(1) == [ReplyReceived(1, b"question"), CallEnded(1)]

    async def test_large_messages_both_ways(self, wire: wires.Wire) -> None:
        robot, inbox, _ = await wires.connected(wire, wires.echo)
        payload = bytes(range(256)) * (wires.TWO_MEGABYTES // 256)
        robot.call("cloud", 1, payload)
        robot.call("cloud", 2, b"small, while the large one is on its way")
        assert await inbox.of_call(1) == [ReplyReceived(1, payload), CallEnded(1)]
        assert len(await inbox.of_call(2)) == 2

    async def test_an_empty_message_is_a_message(self, wire: wires.Wire) -> None:
        robot, inbox, _ = await wires.connected(wire)
        await wires.answers(robot, inbox, 1, b"")

    async def test_many_calls_at_once_with_answers_from_other_threads(
        self, wire: wires.Wire
    ) -> None:
        loop = asyncio.get_running_loop()
        with ThreadPoolExecutor(4) as workers:

            def answer(call: IncomingCall) -> None:
                call.reply(b"first")
                wires.echo(call)

            def hand_over(call: IncomingCall) -> None:
                workers.submit(loop.call_soon_threadsafe, answer, call)

            robot, inbox, _ = await wires.connected(wire, hand_over)
            for number in range(200):
                robot.call("cloud", number, b"%d" % number)
            for number in range(200):
                assert await inbox.of_call(number) == [
                    ReplyReceived(number, b"first"),
                    ReplyReceived(number, b"%d" % number),
                    CallEnded(number),
                ]

    async def test_nothing_comes_of_an_abandoned_call(self, wire: wires.Wire) -> None:
        calls = wires.Received()
        robot, inbox, service = await wires.connected(wire, calls)
        robot.call("cloud", 1, b"abandoned")
        call = await calls.next()
        robot.abandon(1)
        robot.abandon(1)
        robot.abandon(99)
        wires.echo(call)
        robot.call("cloud", 2, b"other")
        wires.echo(await calls.next())
        assert await inbox.of_call(2) == [ReplyReceived(2, b"other"), CallEnded(2)]
        await service.close()
        await inbox.wait_for(ServiceVanished("cloud", "b1"))
        assert [
            e for e in inbox.events if isinstance(e, ReplyReceived | CallEnded) and e.call == 1
        ] == []

    async def test_a_service_that_closes_ends_the_calls_that_it_has(self, wire: wires.Wire) -> None:
        calls = wires.Received()
        robot, inbox, service = await wires.connected(wire, calls)
        for number in range(3):
            robot.call("cloud", number, b"")
        for _ in range(3):
            await calls.next()
        await service.close()
        await inbox.wait_for(ServiceVanished("cloud", "b1"))
        for number in range(3):
            assert await inbox.of_call(number) == [CallEnded(number)]

    async def test_a_call_after_the_service_has_gone_ends(self, wire: wires.Wire) -> None:
        robot, inbox, service = await wires.connected(wire)
        await service.close()
        await inbox.wait_for(ServiceVanished("cloud", "b1"))
        robot.call("cloud", 1, b"question")
        assert await inbox.of_call(1) == [CallEnded(1)]

    async def test_a_restarted_service_is_another_one(self, wire: wires.Wire) -> None:
        robot, inbox, service = await wires.connected(wire)
        incarnations = ["b1"]
        for k in range(2, 5):
            await service.close()
            await inbox.wait_for(ServiceVanished("cloud", incarnations[-1]))
            service = wire.service("cloud", f"b{k}")
            await service.start(wires.saying(b"%d" % k))
            incarnations.append(await inbox.appeared(times=k))
            robot.call("cloud", k, b"who?")
            assert await inbox.of_call(k) == [ReplyReceived(k, b"%d" % k), CallEnded(k)]
        kinds = ServiceAppeared, ServiceVanished
        seen = [(type(e), e.incarnation) for e in inbox.events if isinstance(e, kinds)]
        assert seen == [(kind, each) for each in incarnations for kind in kinds][:-1]
        assert len(set(incarnations)) == 4
        if not (isinstance(wire, wires.StreamWire) and wire.protocol in ("tls", "udp")):
            # Over TLS it is seen before it can say what it is called.
            assert incarnations == ["b1", "b2", "b3", "b4"]

    async def test_two_services_are_never_mixed(self, wire: wires.Wire) -> None:
        for name in ("east", "west"):
            await wire.service(name, "b1").start(wires.saying(name.encode()))
        robot, inbox = wire.robot("east", "west"), wires.Inbox()
        robot.start(inbox)
        await inbox.wait_for(ServiceAppeared("east", "b1"), ServiceAppeared("west", "b1"))
        for number in range(40):
            robot.call(("east", "west")[number % 2], number, b"who?")
        for number in range(40):
            name = ("east", "west")[number % 2]
            assert await inbox.of_call(number) == [
                ReplyReceived(number, name.encode()),
                CallEnded(number),
            ]

    async def test_one_of_two_services_vanishes_alone(self, wire: wires.Wire) -> None:
        services = {name: wire.service(name, "b1") for name in ("east", "west")}
        for service in services.values():
            await service.start(wires.silent)
        robot, inbox = wire.robot("east", "west"), wires.Inbox()
        robot.start(inbox)
        await inbox.wait_for(ServiceAppeared("east", "b1"), ServiceAppeared("west", "b1"))
        robot.call("east", 1, b"")
        robot.call("west", 2, b"")
        await services["east"].close()
        await inbox.wait_for(ServiceVanished("east", "b1"), CallEnded(1))
        assert ServiceVanished("west", "b1") not in inbox
        assert CallEnded(2) not in inbox

    async def test_a_service_that_is_about_to_end_answers_those_that_are_there(
        self, wire: wires.Wire
    ) -> None:
        calls = wires.Received()
        robot, inbox, service = await wires.connected(wire, calls)
        robot.call("cloud", 1, b"before")
        before = await calls.next()
        gone = service.dismiss()
        robot.call("cloud", 2, b"after")
        wires.echo(await calls.next())
        assert await inbox.of_call(2) == [ReplyReceived(2, b"after"), CallEnded(2)]
        assert ServiceVanished("cloud", "b1") not in inbox
        wires.echo(before)
        assert await inbox.of_call(1) == [ReplyReceived(1, b"before"), CallEnded(1)]
        if isinstance(wire, wires.StreamWire):  # others have no events
            await inbox.wait_for(ServiceVanished("cloud", "b1"))
        async with asyncio.timeout(wires.PATIENCE_S):
            await gone

    async def test_a_request_that_is_too_large_is_refused(self, wire: wires.Wire) -> None:
        robot, inbox, _ = await wires.connected(wire)
        robot.call("cloud", 1, bytes(wires.MAX_BYTES + 1))
        refused = wires.refusal_of(await inbox.of_call(1))
        assert refused.code == "too_large"
        assert str(wires.MAX_BYTES) in refused.text
        await wires.answers(robot, inbox, 2, bytes(wires.MAX_BYTES))

    async def test_a_reply_that_is_too_large_is_dropped(self, wire: wires.Wire) -> None:
        def answer(call: IncomingCall) -> None:
            call.reply(bytes(wires.MAX_BYTES + 1))
            call.reply(b"small")
            call.end()

        robot, inbox, _ = await wires.connected(wire, answer)
        robot.call("cloud", 1, b"")
        assert await inbox.of_call(1) == [ReplyReceived(1, b"small"), CallEnded(1)]

    async def test_a_robot_that_goes_hinders_nobody(self, wire: wires.Wire) -> None:
        if isinstance(wire, wires.StreamWire) and wire.launched:
            pytest.skip("a launched service has one robot")
        calls = wires.Received()
        robot, _, _ = await wires.connected(wire, calls)
        other, inbox = await wires.joined(wire)
        robot.call("cloud", 1, b"")
        orphan = await calls.next()
        await robot.close()
        orphan.reply(b"to nobody")
        orphan.end()
        other.call("cloud", 1, b"question")
        wires.echo(await calls.next())
        assert await inbox.of_call(1) == [ReplyReceived(1, b"question"), CallEnded(1)]

    async def test_a_robot_that_returns_sees_the_service(self, wire: wires.Wire) -> None:
        if isinstance(wire, wires.StreamWire) and wire.launched:
            pytest.skip("the robot's next process launches another one")
        robot, _, _ = await wires.connected(wire)
        await robot.close()
        again, inbox = await wires.joined(wire)
        await wires.answers(again, inbox, 1)

    async def test_a_closed_robot_delivers_nothing_more(self, wire: wires.Wire) -> None:
        calls = wires.Received()
        robot, inbox, service = await wires.connected(wire, calls)
        robot.call("cloud", 1, b"")
        call = await calls.next()
        await robot.close()
        await robot.close()
        before = list(inbox.events)
        robot.call("cloud", 2, b"")
        robot.abandon(1)
        wires.echo(call)
        await service.close()
        await service.close()
        assert inbox.events == before == [ServiceAppeared("cloud", "b1")]

    async def test_a_closed_service_delivers_nothing_more(self, wire: wires.Wire) -> None:
        received: list[IncomingCall] = []
        numbers = itertools.count()

        def serve(call: IncomingCall) -> None:
            received.append(call)
            wires.echo(call)

        robot, inbox, service = await wires.connected(wire, serve)

        async def flood() -> None:
            while True:
                for _ in range(10):
                    robot.call("cloud", next(numbers), b"")
                await asyncio.sleep(0)

        flooding = asyncio.get_running_loop().create_task(flood())
        await inbox.wait(lambda events: sum(isinstance(e, ReplyReceived) for e in events) > 20)
        await service.close()
        at_close = len(received)
        await inbox.wait_for(ServiceVanished("cloud", "b1"))
        flooding.cancel()
        assert len(received) == at_close

    async def test_ends_that_were_never_started_can_be_closed(self, wire: wires.Wire) -> None:
        robot, service = wire.robot("cloud"), wire.service("cloud", "b1")
        for end in (robot, service):
            await end.close()
            await end.close()

    async def test_mistakes_of_the_caller_are_told(self, wire: wires.Wire) -> None:
        robot, inbox, _ = await wires.connected(wire, wires.silent)
        with pytest.raises(InvalidValueError, match=r"'elsewhere'.*cloud"):
            robot.call("elsewhere", 1, b"")
        robot.call("cloud", 1, b"")
        with pytest.raises(InvalidValueError, match="call 1 is in flight"):
            robot.call("cloud", 1, b"")
        assert [e for e in inbox.events if isinstance(e, CallEnded)] == []


@pytest.mark.parametrize("kind", ["tcp", "tls", "udp", "unix", "launched"])
class TestProcesses:
    @pytest.fixture
    def wire(self, kind: str, wire_of: Callable[[str], wires.StreamWire]) -> wires.StreamWire:
        wire = wire_of(kind)
        wire.lease_ms = wires.LEASE_MS
        return wire

    @pytest.fixture
    def start(self, wire: wires.StreamWire) -> wires.Start:
        return lambda incarnation: wires.service_process(
            wire.connection("cloud") if wire.launched else wire.endpoint("cloud"),
            incarnation,
            tls=wire.service_tls,
        )

    async def test_kill_in_mid_call_ends_the_call_and_the_next_process_is_seen(
        self, wire: wires.StreamWire, start: wires.Start
    ) -> None:
        robot, inbox = wire.robot("cloud"), wires.Inbox()
        robot.start(inbox)
        for k in range(3):
            async with start(f"b{k}") as process:
                incarnation = await inbox.appeared(times=k + 1)
                robot.call("cloud", 2 * k, b"wait")
                await inbox.wait_for(ReplyReceived(2 * k, b"begun"))
                process.kill()
                await inbox.wait_for(ServiceVanished("cloud", incarnation))
                assert await inbox.of_call(2 * k) == [
                    ReplyReceived(2 * k, b"begun"),
                    CallEnded(2 * k),
                ]
                robot.call("cloud", 2 * k + 1, b"echo")
                assert await inbox.of_call(2 * k + 1) == [CallEnded(2 * k + 1)]
        assert len(set(inbox.incarnations())) == 3

    @pytest.mark.slow
    async def test_a_stopped_process_is_lost_after_the_lease_and_found_again(
        self, wire: wires.StreamWire, start: wires.Start
    ) -> None:
        robot, inbox = wire.robot("cloud"), wires.Inbox()
        robot.start(inbox)
        async with start("b1") as process:
            await inbox.wait_for(ServiceAppeared("cloud", "b1"))
            robot.call("cloud", 1, b"wait")
            await inbox.wait_for(ReplyReceived(1, b"begun"))
            stop(process.pid)
            await inbox.wait_for(ServiceVanished("cloud", "b1"), CallEnded(1))
            robot.call("cloud", 2, b"echo")
            assert await inbox.of_call(2) == [CallEnded(2)]
            if wire.launched:
                return  # the robot replaces it
            process.send_signal(signal.SIGCONT)
            await inbox.wait(lambda _: inbox.count(ServiceAppeared("cloud", "b1")) == 2)
            assert await wires.answered(robot, inbox, itertools.count(3))

    @pytest.mark.slow
    async def test_a_large_request_to_a_stopped_process_ends_and_holds_nobody_up(
        self, wire: wires.StreamWire, start: wires.Start
    ) -> None:
        await wire.service("idle", "b1").start(wires.echo)
        robot, inbox = wire.robot("cloud", "idle"), wires.Inbox()
        robot.start(inbox)
        numbers = itertools.count()
        for k in (1, 2):
            async with start(f"b{k}") as process:
                incarnation = await inbox.appeared(times=k)
                await inbox.wait_for(ServiceAppeared("idle", "b1"))
                stop(process.pid)
                large, small, other, late = itertools.islice(numbers, 4)
                robot.call("cloud", large, bytes(wires.MAX_BYTES))  # more than buffers take
                robot.call("cloud", small, b"echo")
                robot.call("idle", other, b"meanwhile")
                assert await inbox.of_call(other) == [
                    ReplyReceived(other, b"meanwhile"),
                    CallEnded(other),
                ]
                await inbox.wait_for(ServiceVanished("cloud", incarnation))
                assert await inbox.of_call(large) == [CallEnded(large)]
                assert await inbox.of_call(small) == [CallEnded(small)]
                robot.call("cloud", late, b"echo")
                assert await inbox.of_call(late) == [CallEnded(late)]

    @pytest.mark.slow
    async def test_a_service_that_goes_on_just_when_it_was_given_up_answers_again(
        self, wire: wires.StreamWire, start: wires.Start
    ) -> None:
        if wire.launched:
            pytest.skip("its robot launches another one")
        robot, inbox = wire.robot("cloud"), wires.Inbox()
        robot.start(inbox)
        numbers = itertools.count()
        async with start("b1") as process:
            for k in range(1, 4):
                await inbox.appeared(times=k)
                stop(process.pid)
                robot.call("cloud", next(numbers), bytes(wires.MAX_BYTES))
                await inbox.wait(lambda _, k=k: inbox.count(ServiceVanished("cloud", "b1")) >= k)  # type: ignore[misc]
                process.send_signal(signal.SIGCONT)
                await inbox.appeared(times=k + 1)
                assert await wires.answered(robot, inbox, numbers)
