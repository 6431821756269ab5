"""From the kernel's time stamps of arrivals to the service's monotonic time."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.acquisition.clock import Clock

_TRIES = 3
_GOOD_BRACKET_NS = 20_000
_STEP_NS = 50_000
_MOST_SLEW = 1e-3
"""Adjustment of the wall clock by which the kernel steers it without stepping; it allows half of this."""

_HARDWARE_WINDOW_NS = NS_PER_S


class KernelTime:
    """Converts stamps of CLOCK_REALTIME, and of a controller's own clock, to monotonic time.

    The offset between wall and monotonic time is measured again at each batch. When the wall clock has
    stepped since the last one, a stamp of the batch may have been taken before or after the step. The later
    of the two times that is not in the future is taken. For frames arrive late, never early, as the time
    base (`daqsvc.acquisition.timebase`) has it.

    A controller's clock is tied to the kernel's by the earliest kernel stamps of the last second: its stamps
    lack the delay of the interrupt. In that second the two clocks drift apart by 1 us per ppm at most.

    Args:
        clock: monotonic time and wall time of the service.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._offset_ns, _ = monotonic_minus_wall_ns(clock)
        self._before_step_ns: int | None = None
        self._measured_at_ns = clock.monotonic_ns()
        self._hardware_offsets: deque[tuple[int, int]] = deque()

    def monotonic(
        self, software_ns: NDArray[np.int64], hardware_ns: NDArray[np.int64], *, drained: bool
    ) -> NDArray[np.int64]:
        """When frames arrived.

        Args:
            software_ns: int64 ``[n]``, the kernel's stamps on CLOCK_REALTIME; 0 for none.
            hardware_ns: int64 ``[n]``, the controller's stamps on its own clock; 0 for none.
            drained: whether the socket held no more frames when these were taken.

        Returns:
            int64 ``[n]``, monotonic; the time of this call for frames without a stamp.
        """
        if not len(software_ns):
            return np.empty(0, np.int64)
        offset_ns, bracket_ns = monotonic_minus_wall_ns(self._clock)
        now_ns = self._clock.monotonic_ns()
        allowed = _STEP_NS + bracket_ns + _MOST_SLEW * (now_ns - self._measured_at_ns)
        if abs(offset_ns - self._offset_ns) > allowed:
            self._before_step_ns = self._offset_ns
        arrival = software_ns + offset_ns
        if self._before_step_ns is not None:
            earlier, later = sorted((offset_ns, self._before_step_ns))
            arrival = np.where(software_ns + later <= now_ns, software_ns + later, software_ns + earlier)
            if drained:
                self._before_step_ns = None
        self._offset_ns, self._measured_at_ns = offset_ns, now_ns
        arrival = np.where(software_ns > 0, np.minimum(arrival, now_ns), now_ns)
        stamped = hardware_ns > 0
        return self._by_hardware(arrival, hardware_ns, now_ns) if stamped.all() else arrival

    def _by_hardware(
        self, arrival_ns: NDArray[np.int64], hardware_ns: NDArray[np.int64], now_ns: int
    ) -> NDArray[np.int64]:
        offset_ns = int((arrival_ns - hardware_ns).min())
        # The window holds rising offsets only: its first one is the least of the last second.
        window = self._hardware_offsets
        if window and abs(offset_ns - window[-1][1]) > NS_PER_S:
            window.clear()  # the controller's clock began again, or was set
        while window and window[0][0] < now_ns - _HARDWARE_WINDOW_NS:
            window.popleft()
        while window and window[-1][1] >= offset_ns:
            window.pop()
        window.append((now_ns, offset_ns))
        return hardware_ns + window[0][1]


def monotonic_minus_wall_ns(clock: Clock) -> tuple[int, int]:
    """Monotonic minus wall time, and how long the closest of a few readings took."""
    best_ns, best_bracket_ns = 0, 1 << 62
    for _ in range(_TRIES):
        before_ns = clock.monotonic_ns()
        wall_ns = clock.wall_ns()
        bracket_ns = clock.monotonic_ns() - before_ns
        if bracket_ns < best_bracket_ns:
            best_ns, best_bracket_ns = before_ns + bracket_ns // 2 - wall_ns, bracket_ns
        if bracket_ns <= _GOOD_BRACKET_NS:
            break
    return best_ns, best_bracket_ns
