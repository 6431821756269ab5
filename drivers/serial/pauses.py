"""When the reader of a serial port leaves it alone for a moment: many bytes then cost it one wake.

What comes during a pause is stamped when that is over. The time base goes by the earliest arrival of each
tenth of a second, so in each of them the reader listens first, until it has stamped a frame as it ended.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable

    from drivers.serial.framing import Framing

LONGEST_S = 1.0 / 30.0
SHORTEST_S = 0.001
"""A pause that would have to be shorter is none: it costs more than it saves."""
PAUSE_BYTES = 1024
"""What may gather in a pause, of the 4096 bytes that a port of Linux holds until its driver has to wait
(N_TTY_BUF_SIZE); a UART without flow control loses what comes then."""
WRAP_SHARE = 1.0 / 16.0
"""Of the time in which a counter begins again: frames are placed by when they come, to a quarter of that."""
SELDOM_SHARE = 1.0 / 4.0
"""Of a pause: bytes that come less often are read one by one."""


def longest_pause_s(bits_per_character: int, baud: int, wraps_s: Iterable[float]) -> float:
    """How long a port may be left alone.

    Args:
        bits_per_character: on the wire.
        baud: bit/s.
        wraps_s: by stream, in what time its counter begins again.
    """
    filled_s = PAUSE_BYTES * bits_per_character / baud
    return min(LONGEST_S, filled_s, *(WRAP_SHARE * wrap_s for wrap_s in wraps_s))


class Pauses:
    """Decides when the reader of one port pauses, and for how long.

    A port that is filled faster than its baud states, as a pseudo-terminal or a USB device may be, is read at
    once: pauses become shorter, and longer again.

    Args:
        framing: of the port.
        longest_s: see `longest_pause_s`.
    """

    def __init__(self, framing: Framing, longest_s: float) -> None:
        self._framing = framing
        self._longest_s = longest_s
        self._pause_s = min(2.0 * SHORTEST_S, longest_s)
        self._heard = 0
        self._listening = self._paused = False
        self._read_ns = 0

    def listen(self) -> None:
        """Do not pause until a frame has ended from now on."""
        self._heard, self._listening = 0, True

    def after(self, chunk: bytes, now_ns: int) -> float:
        """For how many seconds to leave the port alone now; 0.0 to wait for what comes next.

        Args:
            chunk: what has just been read.
            now_ns: when, of any monotonic clock.
        """
        paused, self._paused = self._paused, False
        since_ns, self._read_ns = now_ns - self._read_ns, now_ns
        if len(chunk) > PAUSE_BYTES:
            self._pause_s = max(self._pause_s / 2.0, SHORTEST_S)
        elif paused and len(chunk) < PAUSE_BYTES // 2:
            self._pause_s = min(2.0 * self._pause_s, self._longest_s)
        if self._listening:
            self._heard += len(chunk)
            self._listening = not self._framing.ends_in(chunk, self._heard)
        seldom = not paused and since_ns > SELDOM_SHARE * self._longest_s * NS_PER_S
        if self._listening or seldom or len(chunk) > PAUSE_BYTES or self._pause_s < SHORTEST_S:
            return 0.0
        self._paused = True
        return self._pause_s
