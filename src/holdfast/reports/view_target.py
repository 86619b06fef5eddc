"""What ``--view`` and ``--view-file`` ask for; it needs no Rerun to be told."""

from __future__ import annotations

import os
import re
from typing import NamedTuple

from holdfast.errors import InvalidValueError, ViewError, how_to_install

_PORT = 9876
LOCAL_URL = f"rerun+http://127.0.0.1:{_PORT}/proxy"
"""Address of a viewer on this machine."""

_URL = re.compile(r"rerun(\+https?)?://\S+/proxy")
_PLACE = re.compile(r"(\[[0-9a-fA-F:.%]+\]|[\w.-]+)(?::(\d{1,5}))?")


class ViewTarget(NamedTuple):
    """Where to show a run."""

    # URL of a viewer; empty for one on this machine, which is started if none is there.
    viewer: str | None = None
    file: str | None = None  # to be written (``.rrd``)


def viewer_url(place: str) -> str:
    """Return the URL of a viewer, from that or from ``HOST[:PORT]``.

    Raises InvalidValueError for anything else.
    """
    if _URL.fullmatch(place):
        return place
    found = _PLACE.fullmatch(place)
    port = int(found[2] or _PORT) if found else 0
    if found is None or not 0 < port < 65536:
        raise InvalidValueError("HOST, HOST:PORT or a URL such as rerun+http://HOST:9876/proxy")
    return f"rerun+http://{found[1]}:{port}/proxy"


def require_rerun(target: ViewTarget) -> None:
    """Make sure that a run can be shown there.

    Raises ViewError if Rerun is not installed, or a viewer would have to be started without a
    display.
    """
    from importlib import metadata

    try:
        metadata.version("rerun-sdk")
    except metadata.PackageNotFoundError as error:
        advice = how_to_install("rerun-sdk", "view")
        raise ViewError(f"a view needs Rerun, which is not installed: {advice}") from error
    if target.viewer == "" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewError(
            "there is no display for Rerun's viewer (neither DISPLAY nor WAYLAND_DISPLAY is set): "
            "write a file instead (view RUN --save FILE, run --view-file FILE) and open it "
            "elsewhere with rerun FILE, or name a viewer that runs elsewhere (view RUN --viewer "
            "HOST:PORT, run --view rerun=HOST:PORT; started there with rerun --bind 0.0.0.0)"
        )
