"""A cloud far away: how soon its end is found, how soon it is used again, and what loss costs.

Robot and service are the commands as anybody starts them, each in a network of its own; between the
two, packets take half a round trip each way, or never arrive
(:mod:`holdfast_lab.testbed.wide_area`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd

from benchmarks.common import Context
from benchmarks.report import Bar, Result, Table, paragraph
from holdfast_lab.testbed.wide_area import Transport, why_no_wide_area
from studies.cloud_trials import run_cloud_trials

__all__ = ["far"]

# What was asked for.
FOUND_BAR_MS = 10.0
"""Beyond a round trip."""

USED_AGAIN_BAR_MS = 350.0
LOSS_BAR_MS = 105.0
BYTES_BAR = 3.0

ROUND_TRIP_MS = 87.0
"""Round trip to the thesis's cloud."""

LOSS = 0.05
_TRANSPORTS: tuple[Transport, ...] = ("tls", "udp")
_RATE_HZ = 100.0
_HEADER = ("", "kills", "found, ms", "worst", "used again, ms", "worst")


def far(context: Context) -> Result:
    """Kill a far cloud and start it again; then let packets be lost."""
    reason = why_no_wide_area()
    if reason is not None:
        return Result([f"Not measured: {reason}."])
    rounds = 1 if context.quick else 8
    killed: dict[Transport, list[pd.DataFrame]] = {transport: [] for transport in _TRANSPORTS}
    calm: dict[tuple[Transport, float], list[pd.DataFrame]] = {
        (transport, loss): [] for transport in _TRANSPORTS for loss in (0.0, LOSS)
    }
    for number in range(rounds):
        for done, transport in enumerate(_TRANSPORTS):
            killed[transport].append(_run(transport, 0.0, number, kills=True))
            for loss in (0.0, LOSS):
                calm[transport, loss].append(_run(transport, loss, number, kills=False))
            context.progress((number + 0.5 * (done + 1)) / rounds)
    bars = []
    rows = []
    for transport, found in killed.items():
        found_ms, used_ms = (_of_kills(found, name) for name in ("found_ms", "failback_ms"))
        rows.append(
            [
                transport,
                str(len(found_ms)),
                *(f"{value:.0f}" for ms in (found_ms, used_ms) for value in _median_and_worst(ms)),
            ]
        )
        where = f"{transport}, {ROUND_TRIP_MS:g} ms"
        bars += [
            Bar(
                f"{where}: cloud killed: found",
                float(np.median(found_ms)),
                ROUND_TRIP_MS + FOUND_BAR_MS,
                "ms",
            ),
            Bar(
                f"{where}: relaunched cloud: ready line to used",
                float(np.median(used_ms)),
                USED_AGAIN_BAR_MS,
                "ms",
            ),
        ]
    lossy = []
    plain_bytes = _bytes_per_turn(calm["tls", 0.0])
    for (transport, loss), found in calm.items():
        trips = _round_trips_ms(found)
        lossy.append(
            [
                f"{transport}, {loss:.0%} lost each way",
                str(len(trips)),
                *(f"{np.percentile(trips, share):.1f}" for share in (50, 95, 99)),
                f"{_bytes_per_turn(found):.0f}",
                f"{_bytes_per_turn(found) / plain_bytes:.2f}",
            ]
        )
    bars += [
        Bar(
            f"udp, {ROUND_TRIP_MS:g} ms, {LOSS:.0%} lost each way: 95 % of round trips, without "
            "computation",
            float(np.percentile(_round_trips_ms(calm["udp", LOSS]), 95)),
            LOSS_BAR_MS,
            "ms",
        ),
        Bar(
            "its bytes, in those of tls without loss",
            _bytes_per_turn(calm["udp", LOSS]) / plain_bytes,
            BYTES_BAR,
            "times",
        ),
    ]
    return Result(
        [
            paragraph(
                f"""A robot of {_RATE_HZ:g} steps a second whose cloud is {ROUND_TRIP_MS:g} ms away
                and there and back. The cloud is killed (SIGKILL) at any moment, found dead, started
                again and used again: from the kill until the robot says so, and from the ready line
                of the new one until its first decision is carried out; medians. All runs decide as
                without faults."""
            ),
            Table(_HEADER, rows),
            paragraph(
                """Without kills, but with packets lost: round trips of questions for task actions,
                less what the service computed, in milliseconds, and all bytes that were sent for a
                sensing step, headers, acknowledgements, keep-alives and the opening of the link
                among them."""
            ),
            Table(
                ("", "asked", "median", "95 %", "99 %", "bytes", "in those of tls without loss"),
                lossy,
            ),
        ],
        bars,
    )


def _run(transport: Transport, loss: float, number: int, *, kills: bool) -> pd.DataFrame:
    table = run_cloud_trials(
        particles=100,
        transport=transport,
        round_trip_ms=ROUND_TRIP_MS,
        loss=loss,
        seed=number,
        rate_hz=_RATE_HZ,
        kills=kills,
    )
    if not table["identical"].all():
        raise RuntimeError(f"a run over {transport} decided otherwise")
    return table


def _of_kills(found: Sequence[pd.DataFrame], name: str) -> npt.NDArray[np.float64]:
    """Return a column of the kills; a run may have ended before it was measured."""
    values: npt.NDArray[np.float64] = np.concatenate(
        [table[name][table["what"] == "kill"].to_numpy(float) for table in found]
    )
    return values[~np.isnan(values)]


def _round_trips_ms(found: Sequence[pd.DataFrame]) -> npt.NDArray[np.float64]:
    """Return how long task actions took to come from the cloud, less what it computed."""
    trips = []
    for table in found:
        asked = table[(table["what"] == "task") & (table["service"] == "cloud")]
        trips.append((asked["round_trip_ms"] - asked["computed_ms"]).to_numpy(float))
    return np.concatenate(trips)


def _bytes_per_turn(found: Sequence[pd.DataFrame]) -> float:
    total = sum(float(table["carried_bytes"].iloc[0]) for table in found)
    return total / sum(int((table["what"] == "sensing").sum()) for table in found)


def _median_and_worst(values: npt.NDArray[np.float64]) -> tuple[float, float]:
    return float(np.median(values)), float(values.max())
