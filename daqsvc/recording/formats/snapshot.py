"""Snapshots of the service's recorder: a channel a sensor, of streams that were sampled together.

Those are the streams that are sampled fastest, or the grid that the service has put several streams on. Other
streams are read where their channels are asked for by name.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.acquisition.samples import SampleBlock
from daqsvc.errors.recordings import SNAPSHOT, TOO_SHORT
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import STATED_START, Contents, Elsewhere, check_columns
from daqsvc.recording.streams import FIRST_NS, LAST_NS, iso_ns

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.confined.limits import Budget
    from daqsvc.snapshots.mcap import Damage

RATE = "fs_hz"
"""How the rate is called."""
GRID = "+"
"""Between the names of the streams of a grid."""


def read_snapshot_channels(path: Path, budget: Budget) -> Contents:
    """Samples in the sensors' units, NaN where they are missing, by the names of sensors; and the rate.

    Of streams of several rates those of the highest are read, or the first grid that one of them is on. Its
    sensors are at one rate, and the service's detectors take them from there. Streams of one rate begin and
    end together. The others' channels are `Contents.elsewhere`.
    """
    from daqsvc.snapshots.contents import SCHEMA  # noqa: PLC0415 - brings protobuf
    from daqsvc.snapshots.reading import WAS_CUT, notes_of  # noqa: PLC0415

    budget.spend(path.stat().st_size)
    about, blocks, damage = _read(path)
    if damage.ends_early and not blocks:
        raise RecordingError(f"{path} {WAS_CUT}", SNAPSHOT)
    if about.get("schema") != SCHEMA:
        raise RecordingError(f"{path} is no snapshot of daqsvc: its first message is not {SCHEMA}", SNAPSHOT)
    streams = _Streams(about, blocks, budget, tuple(notes_of(damage)))
    groups = streams.groups()
    if not groups:
        raise RecordingError(f"{path} holds no samples of any sensor; give another snapshot", TOO_SHORT)
    contents = streams.read(groups[0])
    elsewhere: dict[str, Elsewhere] = {}
    for group in groups[1:]:
        one = Elsewhere(f"is {streams.why_not(group, groups[0])}", partial(streams.read, group))
        for name in streams.names(group):
            if name not in contents.entries:
                elsewhere.setdefault(name, one)
    return replace(contents, elsewhere=elsewhere)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, list[SampleBlock]], Damage]:
    """The first message of a snapshot, its samples by stream or grid, and what is wrong with it.

    Raises:
        RecordingError: it is none.
    """
    from daqsvc.snapshots.contents import ABOUT  # noqa: PLC0415 - brings protobuf
    from daqsvc.snapshots.mcap import Attachment, Damage, McapError  # noqa: PLC0415
    from daqsvc.snapshots.reading import entries_of  # noqa: PLC0415

    about: dict[str, Any] = {}
    blocks: dict[str, list[SampleBlock]] = {}
    damage = Damage()
    try:
        for one in entries_of(memoryview(path.read_bytes()), damage):
            if isinstance(one, Attachment):
                continue
            if isinstance(one.what, SampleBlock):
                blocks.setdefault(one.what.stream, []).append(one.what)
            elif one.what.topic == ABOUT:
                about = about or one.what.document
    except McapError as error:
        raise RecordingError(
            f"{path} cannot be read: it {error}; copy it again, or give another one", SNAPSHOT
        ) from None
    return about, blocks, damage


class _Streams:
    """The streams of a snapshot, and the grids that some of them are on.

    Args:
        about: its first message.
        blocks: samples by stream or grid.
        budget: of the file.
        notes: what is wrong with the file, in sentences.
    """

    def __init__(
        self,
        about: dict[str, Any],
        blocks: dict[str, list[SampleBlock]],
        budget: Budget,
        notes: tuple[str, ...],
    ) -> None:
        self._blocks = blocks
        self._budget = budget
        self._notes = notes
        self._wall_ns = about.get("wall_ns_at_0")
        self._facts: dict[str, Any] = {name: one for name, one in about["streams"].items() if name in blocks}
        self._sensors: dict[str, list[str]] = {}
        self._units: dict[str, str] = {}
        on_grids: dict[str, str] = {}
        for name, one in about["streams"].items():
            sensors = [s or channel for s, channel in zip(one["sensors"], one["channels"], strict=True)]
            if any(one["sensors"]):
                self._sensors[name] = sensors
                self._units |= dict(zip(sensors, map(str, one.get("units", ())), strict=False))
                on_grids |= {
                    f"{name}.{c}": s for c, s in zip(one["channels"], one["sensors"], strict=True) if s
                }
        for name in self._facts:
            if GRID in name and name not in self._sensors:
                self._sensors[name] = [on_grids.get(one, one) for one in self._facts[name]["channels"]]

    def groups(self) -> list[list[str]]:
        """What is read together, streams of one rate or a grid alone; first what is read by default."""
        streams = [name for name in self._facts if any(self._facts[name]["sensors"])]
        rates = sorted({self._facts[name]["rate_hz"] for name in streams}, reverse=True)
        of_rates = [[name for name in streams if self._facts[name]["rate_hz"] == rate] for rate in rates]
        fastest, slower = of_rates[:1], of_rates[1:]
        grids = [[name] for name in self._facts if name not in streams and name in self._sensors]
        first = [one for one in grids if fastest and set(fastest[0]) & set(one[0].split(GRID))]
        # A sensor that is on a grid is taken from there, as the detectors do.
        return [*first, *fastest, *(one for one in grids if one not in first), *slower]

    def names(self, group: Sequence[str]) -> list[str]:
        """The channels of streams: their sensors, or what they are called themselves."""
        return [name for stream in group for name in self._sensors[stream]]

    def _left_out(self, read: Sequence[str], names: Collection[str]) -> dict[str, str]:
        """Which sensors are not among the names that are read, and why."""
        return {
            sensor: self.why_not(group, read)
            for group in self.groups()
            for stream in group
            for sensor in self._facts[stream]["sensors"]
            if sensor and sensor not in names
        }

    def why_not(self, group: Sequence[str], read: Sequence[str]) -> str:
        """Why channels of a group are not read together with those of another."""
        own_hz, hz = (self._facts[one[0]]["rate_hz"] for one in (group, read))
        if read[0] in self._grids():
            instead = f"the grid {read[0]} is read"
        else:
            instead = f"the {'fastest' if hz > own_hz else 'slower'} streams are read"
        return f"sampled at {own_hz:g} Hz, and {instead}, at {hz:g} Hz; daqsvc replay judges all of them"

    def _grids(self) -> set[str]:
        return {name for name in self._facts if not any(self._facts[name]["sensors"])}

    def read(self, group: Sequence[str]) -> Contents:
        """The samples of a group, from where all its streams have begun to where the first one ends."""
        begin_ns = max(self._blocks[name][0].t_first_ns for name in group)
        entries: dict[str, NDArray[np.generic]] = {}
        for name in group:
            samples = _joined(self._blocks[name], begin_ns, self._budget)
            entries |= dict(zip(self._sensors[name], samples.T, strict=True))
        shortest = min(map(len, entries.values()))
        check_columns(len(entries))
        rate_hz = float(self._facts[group[0]]["rate_hz"])
        cut = {name: values[:shortest] for name, values in entries.items()} | {RATE: np.array(rate_hz)}
        if isinstance(self._wall_ns, int) and FIRST_NS <= self._wall_ns + begin_ns <= LAST_NS:
            cut[STATED_START] = np.array(iso_ns(self._wall_ns + begin_ns))
        units = {name: self._units[name] for name in entries if self._units.get(name)}
        of_other_rates = self._left_out(group, entries)
        return Contents(cut, units=units, notes=self._notes, of_other_rates=of_other_rates)


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
