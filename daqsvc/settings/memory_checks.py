"""Whether this computer has the memory that the streams of a machine file take."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.settings.problems import Finding
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.models import MachineFile

SAMPLE_BYTES = 4
_MOST_SHARE = 0.5
"""Of the memory: the rest is for detectors, outbox, operating system and whoever else there is."""
_CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def memory_bytes() -> int:
    """The memory that this process may have: that of the computer, or less if its control group has less."""
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for file in _CGROUP_LIMITS:
        with suppress(OSError, ValueError):
            there = min(there, int(file.read_text(encoding="ascii")))
    return there


def needed_bytes(draft: MachineFile) -> dict[str, float]:
    """What each stream takes: its ring and those of grids that it is in, late frames, blocks on their way."""
    pipeline = draft.pipeline
    needed: dict[str, float] = {}
    rings = dict.fromkeys(draft.streams, 1)
    for together in draft.sampled_together:
        joined = {sensor.stream for sensor in draft.sensors if sensor.name in together}
        for name in joined & rings.keys() if len(joined) > 1 else ():
            rings[name] += 1
    for name, stream in draft.streams.items():
        with suppress(UnusableValueError):
            row_bytes = SAMPLE_BYTES * len(stream.layout.channel_names)
            kept_s = pipeline.ring_s * rings[name] + stream.reorder_window_ms / 1e3
            needed[name] = stream.rate_hz * kept_s * row_bytes
            if (block := stream.layout.block) is not None:
                needed[name] += block.buffer_bytes
    return needed


def check_memory(draft: MachineFile) -> Iterator[Finding]:
    """The rings of all streams fit the memory together."""
    needed = needed_bytes(draft)
    together, there = sum(needed.values()), memory_bytes()
    if together <= _MOST_SHARE * there:
        return
    most = max(needed, key=lambda name: needed[name])
    fitting_s = draft.pipeline.ring_s * _MOST_SHARE * there / together
    yield Finding(
        ("pipeline", "ring_s"),
        f"the rings of {draft.pipeline.ring_s:g} s would take {together / 1e9:.3g} GB, most of it for stream "
        f'"{most}" at {draft.streams[most].rate_hz:g} Hz, and this computer has {there / 1e9:.3g} GB',
        f"write ring_s = {fitting_s:.2g} or less in [pipeline], or correct rate_hz of the stream",
    )
