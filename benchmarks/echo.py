"""The wire alone: a service that answers whatever comes with as many bytes as a sensing action has.

It hands each call to another thread, as every service must. Takes its endpoint, prints a line when
it listens, and ends with its standard input.
"""

from __future__ import annotations

import sys
import threading
from queue import SimpleQueue

from holdfast.runtime.transport.contract import IncomingCall
from holdfast.runtime.transport.zenoh_transport import ZenohServiceTransport
from holdfast.session.messages import DIGEST_SIZE, SensingAnswer, encode

_ANSWER = encode(SensingAnswer(1, 9, 1, bytes(DIGEST_SIZE), 100))


def main() -> None:
    """Answer until standard input ends."""
    calls: SimpleQueue[IncomingCall] = SimpleQueue()

    def answer() -> None:
        while True:
            call = calls.get()
            call.reply(_ANSWER)
            call.end()

    threading.Thread(target=answer, daemon=True).start()
    transport = ZenohServiceTransport("echo", boot="echo", listen=[sys.argv[1]])
    transport.start(calls.put)
    print("ready", flush=True)
    sys.stdin.read()
    transport.close()


if __name__ == "__main__":
    main()
