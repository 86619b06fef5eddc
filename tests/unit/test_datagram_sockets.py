"""A service's socket for datagrams, shared by links."""

import asyncio
import socket
from typing import Any

from holdfast.transport.datagram_cipher import DatagramCipher
from holdfast.transport.datagram_sockets import DatagramSocket


class Receiver:
    """Stands for a link."""

    def __init__(self) -> None:
        self.taken: asyncio.Queue[tuple[bytes, Any]] = asyncio.Queue()

    def take_datagram(self, datagram: bytes, address: Any) -> None:
        self.taken.put_nowait((datagram, address))


async def test_a_datagram_goes_to_the_link_whose_association_it_names() -> None:
    here = DatagramSocket(("127.0.0.1", 0))
    first, second = Receiver(), Receiver()
    keys = [here.add(each.take_datagram) for each in (first, second)]
    assert keys[0].association != keys[1].association
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind(("127.0.0.1", 0))
        robot.settimeout(30.0)
        there = ("127.0.0.1", here.port)
        robot.sendto(b"too short", there)
        here.remove(keys[1].association)
        for each in reversed(keys):
            robot.sendto(DatagramCipher(each, service=False).encrypt(b"hello"), there)
        datagram, address = await first.taken.get()
        assert DatagramCipher(keys[0], service=True).decrypt(datagram) == b"hello"
        assert address == robot.getsockname()
        assert second.taken.empty()
        here.send(b"reply", address)
        assert robot.recv(100) == b"reply"
    here.close()
    here.close()


async def test_where_the_port_is_taken_it_takes_another_one() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        opened = DatagramSocket(taken.getsockname())
        assert opened.port not in (0, taken.getsockname()[1])
        opened.close()
