"""Where the speed of a machine is known while it runs: in statements of its detectors."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.settings.plugins import configured
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from daqsvc.settings.models import MachineFile

RPM = "rpm"
"""The unit that a statement gives a speed in."""


def speed_signals(draft: MachineFile) -> dict[str, tuple[str, ...]]:
    """By detector, the statistics that are the speed, also while that changes.

    Args:
        draft: the machine file, or what is valid of it.
    """
    trends = {f"levels/{one.name}" for one in draft.sensors if one.type == "trend" and one.unit == RPM}
    signals: dict[str, tuple[str, ...]] = {}
    for _, plugin, settings in configured(draft.pipeline, valid_only=True):
        with suppress(UnusableValueError):
            for detector, names in plugin.start_up_signals(draft, settings).items():
                speeds = tuple(name for name in names if name == "speed" or detector in trends)
                if speeds:
                    signals[detector] = speeds
    return signals
