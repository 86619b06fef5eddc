"""What the study of the thesis's chapter 6 measures, and what the thesis says of its own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd

from holdfast.arrays import BoolArray, FloatArray
from holdfast.lab.studies.statistics import Interval, clustered_median_interval
from holdfast.lab.testbed.wide_area import Transport

__all__ = [
    "FAR",
    "NEAR",
    "PARTICLES",
    "PATHS",
    "THESIS_CLOUD_ROUND_TRIP_MS",
    "THESIS_FAILBACK_MS",
    "THESIS_LAUNCH_MS",
    "THESIS_LOCAL_ROUND_TRIP_MS",
    "THESIS_SUCCESS",
    "THESIS_SUCCESS_ABOVE_300",
    "THESIS_TIMEOUT_MS",
    "THESIS_TRIALS",
    "MeasuredRows",
    "NetworkPath",
]

PARTICLES = (100, 200, 300, 400, 500)

THESIS_TRIALS = 10
THESIS_LOCAL_ROUND_TRIP_MS = 6.0
THESIS_CLOUD_ROUND_TRIP_MS = 87.0
THESIS_TIMEOUT_MS = 5000.0
THESIS_LAUNCH_MS = 370.0
THESIS_FAILBACK_MS = 1000.0
THESIS_SUCCESS = 0.8
THESIS_SUCCESS_ABOVE_300 = 0.9
"""What the thesis's text says of its results: less than 6 ms, at least 87 ms; less than 370 ms
after the timeout; less than a second; 8 of 10 trials, rising to 9 of 10 above 300 particles."""


class NetworkPath(NamedTuple):
    """A path between the robot and the cloud.

    Attributes
    ----------
    transport : {"tcp", "tls", "udp"}
    loss : float
        Share of packets, each way.
    """

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
"""Of a full run; all with all numbers of particles."""


class MeasuredRows:
    """Rows of cloud trials as arrays.

    Parameters
    ----------
    table : DataFrame
        Columns of :data:`~holdfast.lab.studies.cloud_trials.COLUMNS` and, before them, those that
        say which runs they are: ``condition``, ``particles``, ``transport``,
        ``path_round_trip_ms`` and ``loss``.

    Attributes
    ----------
    runs : array
        A number for each run.
    """

    def __init__(self, table: pd.DataFrame) -> None:
        self._table = table
        self.runs = 1000.0 * self.number("condition") + self.number("run")

    def number(self, name: str) -> FloatArray:
        """Return a column of numbers."""
        return np.asarray(self._table[name].to_numpy(dtype=np.float64))

    def word(self, name: str) -> npt.NDArray[np.object_]:
        """Return a column of words."""
        return np.asarray(self._table[name].to_numpy(dtype=object))

    def where(self, **wanted: object) -> BoolArray:
        """Return which rows have these cells; a path stands for the three columns that name it."""
        chosen = np.ones(self.runs.shape, dtype=bool)
        for name, cell in wanted.items():
            if isinstance(cell, NetworkPath):
                chosen &= self.where(
                    transport=cell.transport,
                    path_round_trip_ms=cell.round_trip_ms,
                    loss=cell.loss,
                )
            else:
                chosen &= np.asarray(self._table[name] == cell, dtype=bool)
        return chosen

    @property
    def paths(self) -> list[NetworkPath]:
        """Those that there are, in order."""
        found = self._table[["transport", "path_round_trip_ms", "loss"]].drop_duplicates()
        names = set(found.itertuples(index=False, name=None))
        return [path for path in PATHS if tuple(path) in names]

    @property
    def round_trips(self) -> FloatArray:
        """Of answers with task actions: from the question, without what the service computed.

        A sensing action comes as the second part of an answer, whose first part was computed and
        sent meanwhile; so its own time holds more than one round trip.
        """
        trips = self.number("round_trip_ms") - self.number("computed_ms")
        return np.where(self.where(what="task"), trips, np.nan)

    def median(self, values: FloatArray, chosen: BoolArray) -> Interval:
        """Return the median of some rows' values; those of a run belong together."""
        return clustered_median_interval(values[chosen], self.runs[chosen])
