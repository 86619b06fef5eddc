"""The exceptions of this package; each message says what is wrong, and with what."""


class GuardError(Exception):
    """The guard cannot guard the ROS 1 master; the message says why."""


class CallError(Exception):
    """No usable answer came."""


class SilentError(CallError):
    """No answer came in time."""


class GoneError(CallError):
    """Nothing listens at the endpoint: its process has ended."""


class ProtocolError(CallError):
    """A peer breaks the protocol; the message continues a sentence about it."""
