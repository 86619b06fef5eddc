"""Which epochs a service remembers of sessions that it has forgotten."""

from __future__ import annotations

from holdfast.protocol.forgotten_epochs import ForgottenEpochs


def test_an_epoch_is_kept_until_its_session_is_held_again() -> None:
    epochs = ForgottenEpochs(4)
    epochs.note(("arm", b"1"), 3)
    epochs.note(("arm", b"1"), 5)
    assert epochs.get(("arm", b"1")) == 5
    assert epochs.get((None, b"1")) == 0
    epochs.forget(("arm", b"1"))
    assert epochs.get(("arm", b"1")) == 0
    assert list(epochs) == []


def test_the_owner_with_the_most_loses_its_oldest() -> None:
    epochs = ForgottenEpochs(3)
    epochs.note(("small", b"0"), 7)
    for number in range(3):
        epochs.note(("large", bytes([number])), 1)
    assert list(epochs) == [("small", b"0"), ("large", b"\1"), ("large", b"\2")]
