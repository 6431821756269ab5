"""Snapshots as the recorder of the service writes them, of samples that are given."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from daqsvc.acquisition.samples import SampleBlock
from daqsvc.snapshots.contents import SCHEMA, Entry
from daqsvc.snapshots.writing import SnapshotWriter

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

BLOCK_ROWS = 64
MONOTONIC_NS = 5_000_000_000
"""When the first sample of all was taken, by the clock of the box."""


class Sampled(NamedTuple):
    """A stream of a snapshot.

    Attributes:
        rate_hz: samples per second.
        sensors: by sensor, its unit.
        samples: ``[n, sensors]``; of a block with NaN nothing has come.
        behind_ns: how long after the first sample of all the stream begins.
    """

    rate_hz: float
    sensors: Mapping[str, str]
    samples: NDArray[Any]
    behind_ns: int = 0


def write_snapshot(path: Path, streams: Mapping[str, Sampled], start_ns: int) -> Path:
    """Write one whose first sample was taken at a wall time, ns since the Unix epoch."""
    about = {
        "schema": SCHEMA,
        "site": "lab",
        "box": "box-1",
        "machine": "rig",
        "begin_ns": MONOTONIC_NS,
        "wall_ns_at_0": start_ns - MONOTONIC_NS,
        "streams": {
            name: {
                "rate_hz": one.rate_hz,
                "channels": [f"ch{number}" for number in range(len(one.sensors))],
                "sensors": list(one.sensors),
                "units": list(one.sensors.values()),
            }
            for name, one in streams.items()
        },
    }
    writer = SnapshotWriter(path, about, {}, start_ns - MONOTONIC_NS)
    writer.write([entry for name, one in streams.items() for entry in _blocks(name, one)])
    writer.finish()
    return path


def _blocks(name: str, one: Sampled) -> Sequence[Entry]:
    period_ns = 1e9 / one.rate_hz
    entries, lost = [], 0
    for first in range(0, len(one.samples), BLOCK_ROWS):
        rows = np.ascontiguousarray(one.samples[first : first + BLOCK_ROWS], np.float32)
        if np.isnan(rows).any():
            lost += len(rows)
            continue
        t_ns = MONOTONIC_NS + one.behind_ns + round(first * period_ns)
        entries.append(
            Entry(
                t_ns, SampleBlock(name, 1000 + first, rows, t_ns, period_ns, lost_before=lost, t_error_ns=1e3)
            )
        )
        lost = 0
    return entries
