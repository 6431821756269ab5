"""How long nothing may come of a stream before it counts as silent."""

from __future__ import annotations

from collections import deque

from daqsvc.acquisition.clock import NS_PER_S

BRIDGED = 2
"""So many values in a row may be missing: until then the last one stands. A lost poll is no lost sensor."""

SILENCE_NS = 2 * NS_PER_S
"""A stream from which nothing has come for so long is silent, ..."""

SILENT_PERIODS = BRIDGED + 1.5
"""... but not before so many of its sampling periods: a value that is polled once a minute is no silence."""

UNKNOWN_NS = 60 * NS_PER_S
"""How often a device takes snapshots that nobody has said it of, until it has been seen."""

_REMEMBERED = 8


class Patience:
    """How long a stream may be silent, by how often something comes of it.

    Args:
        period_ns: time between its samples; 0 for a fast stream.
        snapshots: whether it comes in snapshots.
        every_ns: how often one is asked for; None if the device takes them by itself: that is seen then.
    """

    def __init__(
        self, period_ns: float = 0.0, *, snapshots: bool = False, every_ns: int | None = None
    ) -> None:
        self._period_ns = period_ns
        self._snapshots = snapshots
        self._every_ns = every_ns
        self._seen_ns: deque[int] = deque(maxlen=_REMEMBERED)

    @property
    def ns(self) -> int:
        """After so long with nothing the stream is silent."""
        period_ns = self._period_ns
        if self._snapshots:
            stated_ns = [] if self._every_ns is None else [self._every_ns]
            period_ns = max([*stated_ns, *self._seen_ns], default=UNKNOWN_NS)
        return max(SILENCE_NS, round(SILENT_PERIODS * period_ns))

    def heard_after(self, duration_ns: int) -> None:
        """Something has come, so long after the last that came (at first: after the start)."""
        self._seen_ns.append(duration_ns)
