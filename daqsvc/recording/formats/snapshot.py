"""Snapshots of the service's recorder: a channel a sensor, of the streams that are sampled fastest."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.acquisition.samples import SampleBlock
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import STATED_START, Contents, check_columns
from daqsvc.recording.streams import FIRST_NS, LAST_NS, iso_ns

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.confined.limits import Budget

RATE = "fs_hz"
"""How the rate is called."""


def read_snapshot_channels(path: Path, budget: Budget) -> Contents:
    """Samples in the sensors' units, NaN where they are missing, by the names of sensors; and the rate.

    Of streams of several rates those of the highest are read. Streams of that rate begin and end together.
    """
    from daqsvc.snapshots.contents import ABOUT, SCHEMA  # noqa: PLC0415 - brings protobuf
    from daqsvc.snapshots.mcap import Attachment, Damage, McapError  # noqa: PLC0415
    from daqsvc.snapshots.reading import entries_of  # noqa: PLC0415

    budget.spend(path.stat().st_size)
    about: dict[str, Any] = {}
    blocks: dict[str, list[SampleBlock]] = {}
    try:
        for one in entries_of(memoryview(path.read_bytes()), Damage()):
            if isinstance(one, Attachment):
                continue
            if isinstance(one.what, SampleBlock):
                blocks.setdefault(one.what.stream, []).append(one.what)
            elif one.what.topic == ABOUT:
                about = about or one.what.document
    except McapError as error:
        raise RecordingError(
            f"{path} cannot be read: it {error}; copy it anew, or give another one"
        ) from None
    if about.get("schema") != SCHEMA:
        raise RecordingError(f"{path} is no snapshot of daqsvc: its first message is not {SCHEMA}")
    facts = {name: one for name, one in about["streams"].items() if name in blocks and any(one["sensors"])}
    rate_hz = max((one["rate_hz"] for one in facts.values()), default=0.0)
    fastest = {name: one for name, one in facts.items() if one["rate_hz"] == rate_hz}
    if not fastest:
        raise RecordingError(f"{path} holds no samples of any sensor; give another snapshot")
    begin_ns = max(blocks[name][0].t_first_ns for name in fastest)
    entries: dict[str, NDArray[np.generic]] = {}
    units: dict[str, str] = {}
    for name, one in fastest.items():
        samples = _joined(blocks[name], begin_ns, budget)
        sensors = [sensor or channel for sensor, channel in zip(one["sensors"], one["channels"], strict=True)]
        entries |= dict(zip(sensors, samples.T, strict=True))
        units |= dict(zip(sensors, map(str, one.get("units", ())), strict=False))
    shortest = min(map(len, entries.values()))
    check_columns(len(entries))
    cut = {name: values[:shortest] for name, values in entries.items()} | {RATE: np.array(float(rate_hz))}
    wall_ns = about.get("wall_ns_at_0")
    if isinstance(wall_ns, int) and FIRST_NS <= wall_ns + begin_ns <= LAST_NS:
        cut[STATED_START] = np.array(iso_ns(wall_ns + begin_ns))
    return Contents(cut, units={name: unit for name, unit in units.items() if unit})


def _joined(blocks: list[SampleBlock], begin_ns: int, budget: Budget) -> NDArray[np.float32]:
    """The samples of a stream from a time on, with rows of NaN for those that are missing."""
    first = blocks[0]
    origin, end = first.first_index, blocks[-1].end_index
    budget.check_declared(4.0 * max(end - origin, 0) * first.samples.shape[1])
    rows = np.full((max(end - origin, 0), first.samples.shape[1]), np.nan, np.float32)
    for block in blocks:
        at = block.first_index - origin
        if at >= 0 and block.samples.shape[1] == rows.shape[1]:
            rows[at : at + len(block.samples)] = block.samples[: max(len(rows) - at, 0)]
    return rows[max(round((begin_ns - first.t_first_ns) / first.period_ns), 0) :]
