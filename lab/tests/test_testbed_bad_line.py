"""What a bad line does to datagrams and packets, whatever its ends are."""

import queue

import pytest

from holdfast_lab.testbed import bad_line
from holdfast_lab.testbed.bad_line import BadLine, Impairment

PATIENCE_S = 20.0


def carry(line: BadLine, contents: range, arrived: queue.Queue[bytes]) -> None:
    """Put datagrams on the line, all in one turn of its loop."""

    async def put() -> None:
        for number in contents:
            line._carry_datagram(bytes([number]), "to_robot", arrived.put)

    line._call(put())


def test_a_share_is_lost_and_the_seed_says_which() -> None:
    def lost(seed: str) -> list[int]:
        with BadLine("line", seed) as line:
            line.impair(Impairment(loss=0.2))
            return [n for n in range(10_000) if line._fate("datagrams", "to_robot")[1]]

    found = lost("a")
    # 2,000 expected, standard deviation 40: five of them, 6 in 10 million by chance, were the
    # seed not fixed.
    assert abs(len(found) - 2000) < 200
    assert found == lost("a")
    assert found != lost("b")


def test_a_full_line_loses_what_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bad_line, "_CAPACITY", 3)
    arrived: queue.Queue[bytes] = queue.Queue()
    with BadLine("line", "seed") as line:
        line.impair(Impairment(latency_s=0.02))
        carry(line, range(5), arrived)
        assert [arrived.get(timeout=PATIENCE_S)[0] for _ in range(3)] == [0, 1, 2]
        carry(line, range(5, 6), arrived)
        assert arrived.get(timeout=PATIENCE_S) == bytes([5])
