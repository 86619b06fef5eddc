"""The wire alone: a service that answers whatever comes with as many bytes as a sensing action has.

Takes its endpoint, prints a line when it listens, and ends when it is killed.
"""

from __future__ import annotations

import asyncio
import sys

from holdfast.session.messages import DIGEST_SIZE, SensingAnswer, encode
from holdfast.transport.contract import IncomingCall
from holdfast.transport.service_end import StreamServiceTransport

_ANSWER = encode(SensingAnswer(1, 9, 1, bytes(DIGEST_SIZE), 100))


def _answer(call: IncomingCall) -> None:
    call.reply(_ANSWER)
    call.end()


async def main() -> None:
    """Answer until this process ends."""
    transport = StreamServiceTransport("echo", boot="echo", listen=[sys.argv[1]])
    await transport.start(_answer)
    print("ready", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())
