"""What was lost or went wrong, by cause, out of the figures of the status."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Integral
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator

_SOUND = {
    "streams": {"frames_received", "samples_received", "time_settled", "end_index"},
    "buses": {
        *("up", "requests", "replies", "bytes_received", "frames_recorded", "passes", "probes", "restarts"),
        *("frames_remote", "units_back", "requests_back", "idle_closes", "tx_errors", "rx_errors"),
        "unknown_ids",  # of frames that frames_unknown has
    },
    "detectors": {"windows", "samples", "busy_ns"},
}
"""Whole numbers of the status that are no faults, or no counts; all others are."""
_OUTBOX = ("write_errors", "read_errors", "quarantined", "vanished", "refused", "lost", "unjournalled")
_TELEMETRY = ("dropped_full", "dropped_old", "dropped_disk")


class FaultCount(NamedTuple):
    """How often one thing went wrong.

    Attributes:
        kind: of what: ``"streams"``, ``"buses"``, ``"detectors"``, ``"outbox"`` or ``"telemetry"``.
        name: of which; that of the kind where there is only one.
        cause: as the counter in the status is called.
        times: since the service has started.
    """

    kind: str
    name: str
    cause: str
    times: int


def fault_counts(figures: Mapping[str, Any]) -> Iterator[FaultCount]:
    """Every count of the status that is about a loss or a fault, those that are 0 too.

    Args:
        figures: as in `StatusPayload`.
    """
    for kind, sound in _SOUND.items():
        for name, counted in figures[kind].items():
            for cause, count in counted.items():
                if cause not in sound and (total := _total(count)) is not None:
                    yield FaultCount(kind, name, cause, total)
    outbox = figures["outbox"]
    for cause in _OUTBOX:
        yield FaultCount("outbox", "outbox", cause, int(outbox[cause]))
    for cause in _TELEMETRY:
        yield FaultCount("telemetry", "telemetry", cause, int(outbox["telemetry"][cause]))


def _total(count: object) -> int | None:
    """A count, or all of those that one is parted into, e.g. refusals by what the unit states; else None."""
    parts = list(count.values()) if isinstance(count, Mapping) else [count]
    whole = [int(part) for part in parts if isinstance(part, Integral)]
    return sum(whole) if len(whole) == len(parts) else None
