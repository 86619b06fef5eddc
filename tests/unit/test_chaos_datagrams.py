"""Late and lost datagrams: what a line does to packets, and what it never does."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Iterator

import pytest
from tests.ports import free_port

from holdfast.chaos.datagrams import DatagramProxy, DelayLine
from holdfast.chaos.processes import CannotStartError
from holdfast.errors import InvalidValueError

PATIENCE_S = 20.0


class TestDelayLine:
    def test_everything_comes_later_and_in_order(self) -> None:
        line: DelayLine[int] = DelayLine(0.5, 0.0, "seed")
        assert line.due == float("inf")
        line.put(1, 10.0)
        line.put(2, 10.25)
        assert line.due == 10.5
        assert line.take(10.49) == []
        assert line.take(10.5) == [1]
        assert line.due == 10.75
        line.put(3, 10.6)
        assert line.take(20.0) == [2, 3]
        assert line.lost == 0

    def test_a_share_is_lost_and_the_seed_says_which(self) -> None:
        def arrived(seed: str) -> list[int]:
            line: DelayLine[int] = DelayLine(0.0, 0.2, seed, capacity=10_000)
            for number in range(10_000):
                line.put(number, 0.0)
            found = line.take(0.0)
            assert line.lost == 10_000 - len(found)
            return found

        found = arrived("a")
        # 2,000 expected, standard deviation 40: five of them, 6 in 10 million by chance, were the
        # seed not fixed.
        assert abs(10_000 - len(found) - 2000) < 200
        assert found == sorted(found) == arrived("a")
        assert found != arrived("b")

    def test_all_or_nothing(self) -> None:
        for loss, expected in ((0.0, 50), (1.0, 0)):
            line: DelayLine[int] = DelayLine(0.0, loss, "seed")
            for number in range(50):
                line.put(number, 0.0)
            assert len(line.take(0.0)) == expected

    def test_a_full_line_loses_what_comes(self) -> None:
        line: DelayLine[int] = DelayLine(1.0, 0.0, "seed", capacity=3)
        for number in range(5):
            line.put(number, 0.0)
        assert line.take(1.0) == [0, 1, 2]
        assert line.lost == 2

    @pytest.mark.parametrize(
        ("delay_s", "loss", "message"),
        [
            (-1.0, 0.0, "delay_s -1.0: must be from 0 to 60"),
            (float("nan"), 0.0, "delay_s nan"),
            (61.0, 0.0, "delay_s 61.0"),
            (0.0, 1.5, "loss 1.5: must be from 0 to 1"),
        ],
    )
    def test_what_is_out_of_bounds(self, delay_s: float, loss: float, message: str) -> None:
        with pytest.raises(InvalidValueError, match=message):
            DelayLine(delay_s, loss, "seed")


class Echo:
    """A service that sends datagrams back to whoever sent them."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.port: int = self._socket.getsockname()[1]
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            content, address = self._socket.recvfrom(65_536)
            if not content:
                return
            self._socket.sendto(content, address)

    def close(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as last:
            last.sendto(b"", ("127.0.0.1", self.port))
        self._thread.join(PATIENCE_S)
        self._socket.close()


@pytest.fixture
def echo() -> Iterator[Echo]:
    with contextlib.closing(Echo()) as echo:
        yield echo


def client_of(port: int) -> socket.socket:
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.connect(("127.0.0.1", port))
    client.settimeout(PATIENCE_S)
    return client


class TestDatagramProxy:
    def test_it_changes_nothing_and_confuses_nobody(self, echo: Echo) -> None:
        port = free_port()
        with (
            DatagramProxy(port, echo.port, round_trip_s=0.01, loss=0.0, seed="s"),
            client_of(port) as first,
            client_of(port) as second,
        ):
            for size in (1, 1200, 60_000):
                contents = [os.urandom(size), os.urandom(size)]
                for client, content in zip((first, second), contents, strict=True):
                    client.send(content)
                assert [first.recv(65_536), second.recv(65_536)] == contents

    def test_it_is_never_early(self, echo: Echo) -> None:
        port = free_port()
        with (
            DatagramProxy(port, echo.port, round_trip_s=0.05, loss=0.0, seed="s"),
            client_of(port) as client,
        ):
            began = time.monotonic()
            client.send(b"question")
            assert client.recv(100) == b"question"
            # Late it may be on any machine; that nothing overtakes the delay is no matter of speed.
            assert time.monotonic() - began >= 0.05

    def test_what_is_lost_is_lost_whole(self, echo: Echo) -> None:
        port = free_port()
        sent = [number.to_bytes(2, "big") * 300 for number in range(200)]
        with (
            DatagramProxy(port, echo.port, round_trip_s=0.0, loss=0.3, seed="s"),
            client_of(port) as client,
        ):
            for content in sent:
                client.send(content)
                time.sleep(0.0005)  # no buffer of the system overflows
            for _ in range(40):  # all of which get lost in 2 of 10^12 runs
                client.send(b"end")
            arrived = list(iter(lambda: client.recv(65_536), b"end"))
        # 98 expected, standard deviation 7.
        assert 50 < len(arrived) < 150
        assert set(arrived) <= set(sent)
        assert arrived == sorted(arrived)

    def test_nobody_behind_it(self) -> None:
        port, nobody = free_port(), free_port()
        with (
            DatagramProxy(port, nobody, round_trip_s=0.0, loss=0.0, seed="s") as proxy,
            client_of(port) as client,
        ):
            client.send(b"one")
            client.send(b"two")
            client.settimeout(0.1)
            with pytest.raises(TimeoutError):
                client.recv(100)
            proxy.close()
            proxy.close()

    def test_its_port_is_taken(self, echo: Echo) -> None:
        with pytest.raises(CannotStartError, match=rf"127.0.0.1:{echo.port} \(UDP\): "):
            DatagramProxy(echo.port, 1, round_trip_s=0.0, loss=0.0, seed="s")
