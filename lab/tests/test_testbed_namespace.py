"""A network of one's own, where this machine permits it; and what is said where it does not."""

import shutil
import subprocess

import pytest

from holdfast_lab.testbed.namespace import NetworkNamespace, why_no_namespace

WHY_NOT = why_no_namespace()

needs_namespace = pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))


def test_what_is_missing_is_named() -> None:
    def find(tool: str) -> str | None:
        return None if tool == "nft" else f"/bin/{tool}"

    assert why_no_namespace(find) == "nft is not installed (Debian's packages: nftables)"
    assert why_no_namespace(lambda _: None) == (
        "unshare, nsenter, ip, nft are not installed (Debian's packages: util-linux, iproute2, "
        "nftables)"
    )


def inside(namespace: NetworkNamespace, *command: str) -> str:
    done = subprocess.run(
        [*namespace.prefix, *command], capture_output=True, text=True, timeout=30, check=True
    )
    return done.stdout


@needs_namespace
def test_rules_come_and_go() -> None:
    with NetworkNamespace() as namespace:
        heal = namespace.drop(7447, "to_service", 1.0)
        heal_the_other = namespace.drop(7447, "both", 0.25)
        rules = inside(namespace, "nft", "list", "ruleset")
        assert "tcp dport 7447 drop" in rules
        assert "udp dport 7447 drop" in rules
        # Of streams and of datagrams, each way.
        assert rules.count("numgen random mod 1000 < 250 drop") == 4
        heal()
        rules = inside(namespace, "nft", "list", "ruleset")
        assert "dport 7447 drop" not in rules
        assert "numgen" in rules
        heal_the_other()
        assert "7447" not in inside(namespace, "nft", "list", "ruleset")


@needs_namespace
def test_it_has_a_loopback_and_nothing_else() -> None:
    with NetworkNamespace() as namespace:
        lines = inside(namespace, "ip", "-o", "addr").splitlines()
    assert lines
    assert {line.split()[1] for line in lines} == {"lo"}


@needs_namespace
@pytest.mark.skipif(shutil.which("ip") is None, reason="ip is not installed")
def test_its_holder_ends_with_it() -> None:
    with NetworkNamespace() as namespace:
        holder = int(namespace.prefix[namespace.prefix.index("--target") + 1])
    namespace.close()  # may be repeated
    assert subprocess.run(["kill", "-0", str(holder)], capture_output=True).returncode != 0
