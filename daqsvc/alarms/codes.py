"""The code of what an alarm of the service itself reports, by the name of the alarm."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING

from daqsvc.alarms.events import EventKind
from daqsvc.errors.buses import BUFFER_FULL, BUS_ERRORS, FRAMES_UNRECORDED
from daqsvc.errors.detectors import NOT_JUDGED, SENSOR_NOT_OK
from daqsvc.errors.outputs import CERTIFICATE_ENDS, MESSAGE_DROPPED, TOPIC_REFUSED
from daqsvc.errors.service import DISK_REFUSES, JOURNAL_DAMAGED

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.errors.code import Code

OF_SERVICE: Mapping[str, Code] = MappingProxyType(
    {
        "sensor-ok/": SENSOR_NOT_OK,
        "detector-ok/": SENSOR_NOT_OK,
        "store/disk": DISK_REFUSES,
        "store/journal": DISK_REFUSES,
        "store/damage": JOURNAL_DAMAGED,
        "store/telemetry": MESSAGE_DROPPED,
        "store/audit-log": DISK_REFUSES,
        "broker/refused": TOPIC_REFUSED,
        "certificate/": CERTIFICATE_ENDS,
        "bus-overrun/": BUFFER_FULL,
        "bus-controller/": BUS_ERRORS,
        "bus-recording/": FRAMES_UNRECORDED,
    }
)
"""Each alarm that a service has by itself; behind a slash at the end stands the name of a thing."""

EASES = frozenset(
    {
        EventKind.ACKNOWLEDGED,
        EventKind.BYPASSED,
        EventKind.LOWERED,
        EventKind.QUIET,
        EventKind.RESET,
        EventKind.SHELVED,
    }
)
"""Events that call for nobody although the condition stands: a person has seen to it, or it is less bad."""

_OF_QUALITY: Mapping[str, Code] = MappingProxyType({"missing": NOT_JUDGED, "not_ok": SENSOR_NOT_OK})


def code_of_alarm(alarm: str, quality: str) -> Code | None:
    """The code of an alarm of the service; None for one of the machine file.

    Args:
        alarm: its name.
        quality: of the statement that has raised it.
    """
    code = OF_SERVICE.get(alarm) or OF_SERVICE.get(f"{alarm.partition('/')[0]}/")
    return code_of_quality(quality) or code if code is SENSOR_NOT_OK else code


def code_of_quality(quality: str) -> Code | None:
    """The code of samples of a quality; None for good ones."""
    return _OF_QUALITY.get(quality)
