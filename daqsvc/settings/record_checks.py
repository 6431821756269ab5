"""Whether the recording of a bus has room for itself."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.settings.buses import CanBus
from daqsvc.settings.problems import Finding
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.models import MachineFile


def check_recorded_buses(draft: MachineFile) -> Iterator[Finding]:
    """What is kept holds the file that is being written and one before it."""
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            if isinstance(bus, CanBus) and bus.record and bus.record.keep_mb < 2 * bus.record.file_mb:
                yield Finding(
                    ("buses", name, "record", "keep_mb"),
                    f"keeps no finished file beside the one being written, of up to {bus.record.file_mb} MB",
                    f"keep {2 * bus.record.file_mb} MB or more, or write smaller files (file_mb)",
                )
