"""Where a run is shown, and what is said where it cannot be."""

import importlib.metadata

import pytest

from holdfast.errors import InvalidValueError, ViewError
from holdfast.reports.view_target import ViewTarget, require_rerun, viewer_url


@pytest.mark.parametrize(
    ("place", "url"),
    [
        ("10.0.0.7", "rerun+http://10.0.0.7:9876/proxy"),
        ("lab-2.local:9000", "rerun+http://lab-2.local:9000/proxy"),
        ("[::1]:9000", "rerun+http://[::1]:9000/proxy"),
        ("rerun://there:1/proxy", "rerun://there:1/proxy"),
        ("rerun+https://there/proxy", "rerun+https://there/proxy"),
    ],
)
def test_an_address(place: str, url: str) -> None:
    assert viewer_url(place) == url


@pytest.mark.parametrize(
    "place", ["", "a b", "host:0", "host:65536", "http://there", ":9876", "a/b"]
)
def test_no_address(place: str) -> None:
    with pytest.raises(InvalidValueError, match="HOST:PORT"):
        viewer_url(place)


def test_without_a_display_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ViewError, match=r"no display .* write a file .* HOST:PORT"):
        require_rerun(ViewTarget(""))
    require_rerun(ViewTarget("rerun+http://there:9876/proxy"))
    require_rerun(ViewTarget(None, "run.rrd"))
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    require_rerun(ViewTarget(""))


def test_without_rerun_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", lacking)
    with pytest.raises(ViewError, match=r"pip install 'holdfast-sensing\[view\]'"):
        require_rerun(ViewTarget(None, "run.rrd"))
    monkeypatch.setenv("HOLDFAST_INSTALL", "build with {}")  # as an image says it
    with pytest.raises(ViewError, match="not installed: build with rerun-sdk"):
        require_rerun(ViewTarget(None, "run.rrd"))
