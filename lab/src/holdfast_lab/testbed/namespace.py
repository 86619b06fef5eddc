"""A network namespace of a trial's own, in which packets can be dropped.

The system's packet filter (nftables) can drop single packets of a connection, which no proxy can,
so the TCP of both ends has to cope. But its rules apply to a whole network. So robot and services
run in a new network namespace, with its own loopback, ports and rules, which ends with the last
process in it. The machine's own rules are never touched.

An idle process holds the namespace open; it ends when its standard input is closed.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from typing import Self

from holdfast_lab.errors import CannotStartError
from holdfast_lab.testbed.bad_line import Direction

_TOOLS = {"unshare": "util-linux", "nsenter": "util-linux", "ip": "iproute2", "nft": "nftables"}
_PATIENCE_S = 10.0
_TABLE = "inet holdfast_chaos"
_LOSS_STEPS = 1000
_PROTOCOLS = ("tcp", "udp")


class NetworkNamespace:
    """A new network with a loopback alone; to be used in a ``with`` statement.

    Its ``prefix`` is a command that runs another one in it. Raises CannotStartError if it cannot be
    made.
    """

    def __init__(self) -> None:
        unshare = ["unshare", "--net"]
        enter = ["--net"]
        if os.geteuid() != 0:
            unshare.append("--map-root-user")
            enter += ["--user", "--preserve-credentials"]
        hold = "ip link set lo up && echo up && exec cat"
        try:
            self._holder = subprocess.Popen(
                [*unshare, "--", "sh", "-c", hold],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                process_group=0,
            )
        except OSError as error:
            raise CannotStartError(f"unshare cannot be started: {error.strerror}") from error
        try:
            self._await_up()
            target = ["--target", str(self._holder.pid)]
            self.prefix: tuple[str, ...] = ("nsenter", *target, *enter, "--")
            self._number = 0
            self._nft(f"add table {_TABLE}")
        except BaseException:
            self.close()
            raise

    def _await_up(self) -> None:
        output, errors = self._holder.stdout, self._holder.stderr
        assert output is not None and errors is not None
        if output.readline() != b"up\n":
            said = errors.read().decode(errors="replace").strip()
            raise CannotStartError(f"no network namespace can be made: {said or 'unshare failed'}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release it; it ends with the last process in it. May be repeated."""
        self._holder.kill()
        self._holder.wait()
        for stream in (self._holder.stdin, self._holder.stdout, self._holder.stderr):
            if stream is not None:
                stream.close()

    def drop(self, port: int, direction: Direction, share: float) -> Callable[[], None]:
        """Drop a share of a service's packets; return what lets them through again."""
        # Each fault has its own chain, so that it can be healed by itself.
        chain = f"{_TABLE} fault_{self._number}"
        self._number += 1
        chosen = ""
        if share < 1.0:
            below = max(1, round(share * _LOSS_STEPS))
            chosen = f"numgen random mod {_LOSS_STEPS} < {below} "
        rules = [f"add chain {chain} {{ type filter hook input priority 0; policy accept; }}"]
        if direction in ("both", "to_service"):
            rules += [f"add rule {chain} {each} dport {port} {chosen}drop" for each in _PROTOCOLS]
        if direction in ("both", "to_robot"):
            rules += [f"add rule {chain} {each} sport {port} {chosen}drop" for each in _PROTOCOLS]
        self._nft("\n".join(rules))
        return lambda: self._nft(f"delete chain {chain}")

    def _nft(self, rules: str) -> None:
        self.run(("nft", "-f", "-"), f"nft refuses {rules!r}", text=f"{rules}\n")

    def run(
        self,
        command: Sequence[str],
        refusal: str,
        *,
        text: str = "",
        descriptors: Sequence[int] = (),
    ) -> None:
        """Run a command in it to its end, with a text as input and some open descriptors.

        Raises CannotStartError if it cannot be run or fails: the refusal, and what it says.
        """
        try:
            done = subprocess.run(
                [*self.prefix, *command],
                input=text.encode(),
                pass_fds=descriptors,
                capture_output=True,
                timeout=_PATIENCE_S,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise CannotStartError(f"{command[0]} cannot be run: {error}") from error
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip()
            raise CannotStartError(f"{refusal}: {said}")


def why_no_namespace(find: Callable[[str], str | None] = shutil.which) -> str | None:
    """Return why packets cannot be dropped on this machine; None if they can."""
    missing = [tool for tool in _TOOLS if find(tool) is None]
    if missing:
        return _absent(missing)
    try:
        with contextlib.closing(NetworkNamespace()) as namespace:
            namespace.drop(1, "both", 0.5)()
    except CannotStartError as error:
        return str(error).partition("\n")[0]
    return None


def _absent(missing: Sequence[str]) -> str:
    packages = ", ".join(dict.fromkeys(_TOOLS[tool] for tool in missing))
    are = "is" if len(missing) == 1 else "are"
    return f"{', '.join(missing)} {are} not installed (Debian's packages: {packages})"
