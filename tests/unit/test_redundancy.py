"""Copies of datagrams and the budget that they share."""

import math

from holdfast.transport.redundancy import COPY_DELAY_S, Paths, RedundantSender


class Sent:
    """Two paths that remember what was sent."""

    def __init__(self) -> None:
        self.num_lost = 300
        self.datagrams: list[bytes] = []
        self.on_stream: list[tuple[int, bytes]] = []
        self.sender = RedundantSender(
            Paths(
                self.datagrams.append,
                lambda number, message: self.on_stream.append((number, message)),
                lambda: self.num_lost,
            )
        )


class TestSender:
    def test_a_message_carries_its_kind_and_the_loss_seen_here(self) -> None:
        sent = Sent()
        sent.sender.send_unbudgeted(4, b"body")
        sent.sender.send_on_stream(9, 2, b"body")
        assert sent.datagrams == [b"\x04\xffbody"]
        assert sent.on_stream == [(9, b"\x02\xffbody")]

    def test_a_copy_follows_while_the_path_loses_datagrams(self) -> None:
        sent = Sent()
        sent.sender.send_first(1, b"x", 10.0, lambda: True)
        assert sent.sender.due == 10.0 + COPY_DELAY_S
        sent.sender.expire(10.0 + 0.9 * COPY_DELAY_S)
        assert len(sent.datagrams) == 1
        sent.sender.expire(10.0 + COPY_DELAY_S)
        assert len(sent.datagrams) == 2
        assert sent.sender.due == math.inf

    def test_no_copy_without_loss_or_where_it_is_of_no_use_any_more(self) -> None:
        sent = Sent()
        sent.sender.send_first(1, b"x", 0.0, lambda: False)
        sent.sender.expire(1.0)
        sent.sender.num_lost = 0
        sent.sender.send_first(1, b"y", 1.0, lambda: True)
        sent.sender.expire(2.0)
        assert len(sent.datagrams) == 2

    def test_the_budget_bounds_repetition_and_is_earned_by_first_transmissions(self) -> None:
        sent = Sent()
        for _ in range(1000):
            sent.sender.retransmit(1, bytes(1000))
        burst = len(sent.datagrams)
        assert 1 <= burst < 9
        sent.sender.num_lost = 0
        sent.sender.send_first(1, bytes(1000), 0.0, lambda: True)
        for _ in range(1000):
            sent.sender.retransmit(1, bytes(1000))
        assert len(sent.datagrams) - burst in (3, 4)  # itself, twice again, and what was left

    def test_the_budget_counts_whole_packets_to_the_last_byte(self) -> None:
        """A message's kind and loss (2), header and tag (24), IPv4's and UDP's headers (28)."""
        body = bytes(4096 - 54)
        sent = Sent()
        for _ in range(9):
            sent.sender.retransmit(1, body)
        assert len(sent.datagrams) == 2  # of 8,192 bytes
        sent.sender.num_lost = 0
        for _ in range(9):
            sent.sender.send_first(1, body, 0.0, lambda: True)  # no more than the burst is kept
        before = len(sent.datagrams)
        for _ in range(9):
            sent.sender.retransmit(1, body)
        assert len(sent.datagrams) == before + 2
        sent.sender.send_first(1, bytes(46), 0.0, lambda: True)  # 100 bytes earn 200
        sent.sender.retransmit(1, bytes(147))
        assert len(sent.datagrams) == before + 3
        sent.sender.hedge(7, 1, bytes(146))
        assert len(sent.on_stream) == 1
        sent.sender.retransmit(1, b"")
        assert len(sent.datagrams) == before + 3

    def test_the_loss_is_said_as_it_is_up_to_a_byte(self) -> None:
        for lost in (0, 3, 255, 256):
            sent = Sent()
            sent.num_lost = lost
            sent.sender.send_unbudgeted(4, b"")
            sent.sender.send_on_stream(1, 4, b"")
            said = bytes((4, min(lost, 255)))
            assert (sent.datagrams, sent.on_stream) == ([said], [(1, said)])
