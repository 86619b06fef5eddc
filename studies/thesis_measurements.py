"""What the study of the thesis's chapter 6 measures, and what the thesis says of its own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from holdfast_lab.testbed.wide_area import Transport
from studies.statistics import Interval, clustered_median_interval

PARTICLES = (100, 200, 300, 400, 500)

THESIS_TRIALS = 10
THESIS_CLOUD_ROUND_TRIP_MS = 87.0
THESIS_TIMEOUT_MS = 5000.0
THESIS_LAUNCH_MS = 370.0
THESIS_FAILBACK_MS = 1000.0
THESIS_SUCCESS = 0.8
THESIS_SUCCESS_ABOVE_300 = 0.9
"""What the thesis's text says of its results: at least 87 ms to the cloud; less than 370 ms
after the timeout; less than a second; 8 of 10 trials, rising to 9 of 10 above 300 particles."""


class NetworkPath(NamedTuple):
    """A path between the robot and the cloud; ``loss`` is the share of packets, each way."""

    transport: Transport
    round_trip_ms: float
    loss: float

    @property
    def label(self) -> str:
        """By which it stands in tables and figures."""
        if self.round_trip_ms == 0.0:
            return "same machine"
        text = f"{self.transport}, {self.round_trip_ms:g} ms"
        return text + (f", {100.0 * self.loss:g} % lost" if self.loss else "")


NEAR = NetworkPath("tcp", 0.0, 0.0)
FAR = NetworkPath("tls", THESIS_CLOUD_ROUND_TRIP_MS, 0.0)

_FAR_TRANSPORTS: tuple[Transport, ...] = ("tls", "udp")

PATHS = (
    NEAR,
    *(
        NetworkPath(transport, round_trip_ms, loss)
        for round_trip_ms in (20.0, THESIS_CLOUD_ROUND_TRIP_MS)
        for transport in _FAR_TRANSPORTS
        for loss in (0.0, 0.01, 0.05)
    ),
)
"""Sizes of a full run; all with all numbers of particles."""

_TIMES = (
    "at_s", "waited_ms", "round_trip_ms", "computed_ms", "found_ms", "first_local_ms", "launch_ms",
    "failback_ms", "load", "rate_hz",
)  # fmt: skip


def measured(table: pd.DataFrame) -> pd.DataFrame:
    """Return rows of cloud trials with columns for what they are grouped by, and with round trips.

    These are ``whole_run``, a number for each run; ``path``, its label, in the order of
    :data:`PATHS`; and ``trip_ms``, the round trip of an answer with task actions, without what the
    service computed. A sensing action comes as the second part of an answer, whose first part was
    computed and sent meanwhile; so its own time holds more than one round trip.
    """
    rows = table.astype(dict.fromkeys(_TIMES, float))
    ends = zip(rows["transport"], rows["path_round_trip_ms"], rows["loss"], strict=True)
    trips = rows["round_trip_ms"] - rows["computed_ms"]
    return rows.assign(
        whole_run=1000.0 * rows["condition"] + rows["run"],
        path=pd.Categorical(
            [NetworkPath(*each).label for each in ends], [path.label for path in PATHS]
        ),
        trip_ms=trips.where(rows["what"] == "task"),
    )


def select(rows: pd.DataFrame, **wanted: object) -> pd.DataFrame:
    """Return the rows with these cells; a path stands for its label."""
    for name, cell in wanted.items():
        rows = rows[rows[name] == (cell.label if isinstance(cell, NetworkPath) else cell)]
    return rows


def paths_of(rows: pd.DataFrame) -> list[NetworkPath]:
    """Return the paths that there are, in order."""
    labels = set(rows["path"])
    return [path for path in PATHS if path.label in labels]


def clustered_median(rows: pd.DataFrame, name: str) -> Interval:
    """Return the median of a column; the values of a run belong together."""
    return clustered_median_interval(
        rows[name].to_numpy(np.float64), rows["whole_run"].to_numpy(np.float64)
    )
