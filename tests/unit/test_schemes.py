"""The links of each protocol."""

from tests.programs import said_by


def test_what_no_endpoint_uses_is_not_imported() -> None:
    program = (
        "import sys; from holdfast.transport.schemes import link_maker; "
        "link_maker('tcp', 'service'); print(*sys.modules)"
    )
    loaded = {name for name in said_by(program).split() if name.startswith("holdfast.transport.")}
    assert not loaded & {"holdfast.transport.datagram_links", "holdfast.transport.tls"}
