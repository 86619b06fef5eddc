"""What ``holdfast serve`` refuses before it listens: in words, with exit code 2."""

import pytest
from tests.command_line import Workplace

from holdfast.transport.key_ring import make_credentials


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        *(
            (["--listen", f"tcp/{address}"], [f"tcp/{address}", "--tls", "--insecure"])
            for address in ("0.0.0.0:0", "[::]:0", "192.0.2.1:7447")
        ),
        (["--listen", "tls/127.0.0.1:0"], ["--tls KEYS/NAME"]),
        (["--listen", "tcp/127.0.0.1:0", "--tls", "keys/service"], ["tcp does not use the cred"]),
        (["--listen", "quic/127.0.0.1:0"], ["quic"]),
        (["--listen", "tcp/127.0.0.1"], ["no port"]),
        (["--wokers", "2"], ["'--wokers' is no option of holdfast serve; did you mean --workers?"]),
        (["--ros1"], ["'--ros1' is no option of holdfast serve"]),
        (["--lease-ms", "1"], ["from 50 to 60000"]),
        (["--lease-ms", "nan"], ["from 50 to 60000"]),
        (["--workers", "0"], ["from 1 to 256"]),
        (["--max-sessions", "many"], ["from 1 to"]),
        (["--metrics", "65536"], ["from 0 to 65535"]),
        (["--name", "a b"], ["a b"]),
        (["--problem", "nix", "--listen", "unix/nix"], ["problem: nix"]),
        (["--tls", "/nowhere"], ["/nowhere"]),
        (["--lis", "tcp/127.0.0.1:0"], ["--lis"]),
        (["--processes", "2", "--until-stdin-closes"], ["--until-stdin-closes"]),
        (["--processes", "2", "--health", "here"], ["here"]),
        *(
            (
                ["--listen", f"tcp/{host}:7447", "--insecure", option, f"{other}:7447"],
                [f"{option} {other}:7447", f"--listen tcp/{host}:7447", "same port"],
            )
            for host, other, option in (
                ("127.0.0.1", "127.0.0.1", "--health"),
                ("0.0.0.0", "127.0.0.1", "--metrics"),
                ("[::1]", "[::]", "--health"),
            )
        ),
        (["--health", "7447", "--processes", "2"], ["--health 127.0.0.1:7447", "same port"]),
        *(
            ([*options, f"{'b' * 70}.example:7447"], ["b" * 70, "at most 63"])
            for options in (["--health"], ["--processes", "2", "--metrics"])
        ),
        *(
            (["--insecure", *options, "--listen", f"tcp/{host}:7447"], [host, "at most"])
            for options in ([], ["--processes", "2"])
            for host in (f"{'b' * 70}.example", f"[fe80::1%{'a' * 70}\u00e9]")
        ),
    ],
)
def test_it_says_why(arguments: list[str], texts: list[str], workplace: Workplace) -> None:
    if "keys/service" in arguments:
        make_credentials(workplace.directory / "keys")
    said = workplace.fails("serve", *arguments)
    assert [text for text in texts if text not in said] == []
