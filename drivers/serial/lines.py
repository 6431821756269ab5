"""Samples as lines of text: ``seq,x,y,z`` with a counter, or a time stamp of the device's own clock.

One line carries one sample of every channel. The loss of lines shows in the counter; a device that sends
none may send the time at which it sampled instead. Two optional parts, as NMEA 0183 has them: a first
field that names the stream, and a checksum behind a ``*``.
"""

from __future__ import annotations

import binascii
import math
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from operator import xor
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from drivers.frames import Decoded, LayoutError
from drivers.serial.framing import DelimitedFraming, Frames
from drivers.serial.line_kernels import HARD, KNOWN, OTHER, READ, check_lines, count_stamps, read_lines

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from drivers.serial.framing import Found, Pieces
    from drivers.serial.settings import LineLayout

Checksum = Literal["none", "xor", "crc16"]
TimeUnit = Literal["s", "ms", "us"]

NEWLINE = b"\n"
RETURN = b"\r"
LONGEST_LINE = 1024
"""Bytes; a line that is longer is garbage."""

UNITS_PER_S: Mapping[TimeUnit, float] = {"s": 1.0, "ms": 1e3, "us": 1e6}
TIME_COUNTER_BITS = 32
LATEST_S = 1e12
"""A device's time in s that is later than this is no time."""

DIGITS: Mapping[Checksum, int] = {"xor": 2, "crc16": 4}
_SUMS: Mapping[Checksum, Callable[[bytes], int]] = {
    "xor": lambda text: reduce(xor, text, 0),
    "crc16": lambda text: binascii.crc_hqx(text, 0xFFFF),
}
_TRACKING = 0.05
"""Share of a stamp's deviation by which the device's sampling instants are corrected."""
REORDER_WINDOW_NS = 10_000_000
LEAP_S, LEAP_PERIODS = 1.0, 16
"""A stamp farther ahead than either may be damaged: the next one shows."""


class Lines(NamedTuple):
    """What lines say to one stream.

    Attributes:
        mine: bool ``[n]``, which of them are of the stream.
        good: bool ``[n]``, which of those can be read.
        places: float64 ``[good]``, their counters, or times in s.
        samples: float32 ``[good, 1, channels]`` in physical units.
    """

    mine: NDArray[np.bool_]
    good: NDArray[np.bool_]
    places: NDArray[np.float64]
    samples: NDArray[np.float32]


@dataclass(frozen=True)
class TextLayout:
    """Which column of a line is what.

    Attributes:
        columns: names in their order, without the prefix; those named nowhere else are left out.
        channels: names, in the order of the sample columns; each is a column.
        scale: physical value of a written 1, float64 ``[channels]``.
        offset: physical value of a written 0, same shape.
        counter: the column that counts lines (and so samples); None if there is a time.
        counter_bits: its width: 8, 16 or 32.
        time: the column with the device's time; None if there is a counter.
        time_unit: its unit.
        prefix: the first field of every line of this stream; None if there is no such field.
        separator: between fields, one character.
        decimals: digits behind the point when lines are written.
    """

    columns: tuple[str, ...]
    channels: tuple[str, ...]
    scale: NDArray[np.float64]
    offset: NDArray[np.float64]
    counter: str | None = None
    counter_bits: int = 32
    time: str | None = None
    time_unit: TimeUnit = "ms"
    prefix: str | None = None
    separator: str = ","
    decimals: int = 6

    def __post_init__(self) -> None:
        if (self.counter is None) == (self.time is None):
            raise LayoutError(
                "a line needs a counter or a time, and not both: without it loss cannot be told"
            )
        for name in (self._place, *self.channels):
            if self.columns.count(name) != 1:
                raise LayoutError(
                    f"column {name!r} is there {self.columns.count(name)} times among "
                    f"{', '.join(self.columns)}; name it once"
                )

    @property
    def _place(self) -> str:
        """The column that tells where a sample belongs."""
        name = self.counter if self.time is None else self.time
        assert name is not None  # noqa: S101 - `__post_init__` has seen to it
        return name

    @property
    def samples_per_frame(self) -> int:
        """One line, one sample."""
        return 1

    @property
    def counts_per_frame(self) -> int:
        """One line, one count."""
        return 1

    def in_units(self, conversion: Mapping[str, tuple[float, float]]) -> TextLayout:
        """The same layout with each channel's value ``v`` turned into ``gain * v + shift``.

        Args:
            conversion: ``(gain, shift)`` by channel name; channels not named stay as they are.
        """
        pairs = [conversion.get(name, (1.0, 0.0)) for name in self.channels]
        gain = np.array([g for g, _ in pairs])
        shift = np.array([s for _, s in pairs])
        return replace(self, scale=self.scale * gain, offset=self.offset * gain + shift)

    @cached_property
    def _picks(self) -> NDArray[np.int64]:
        return np.array([self.columns.index(name) for name in (self._place, *self.channels)], np.int64)

    def read(self, lines: Pieces) -> Lines:
        """Read lines of any streams."""
        buffer, starts, stops, _ = lines
        prefix = np.frombuffer((self.prefix or "").encode("ascii"), np.uint8).copy()
        states, values = read_lines(
            buffer,
            starts,
            stops,
            prefix,
            ord(self.separator),
            len(self.columns),
            self._picks,
            self.time is None,
        )
        for k in np.flatnonzero(states == HARD).tolist():
            fields = buffer[starts[k] : stops[k]].tobytes().split(self.separator.encode("ascii"))
            values[k] = [float(fields[pick + bool(self.prefix)]) for pick in self._picks.tolist()]
        places = values[:, 0]
        if self.time is None:
            fits = (places >= 0) & (places < 2**self.counter_bits)
        else:
            places = places / UNITS_PER_S[self.time_unit]
            fits = abs(places) <= LATEST_S
        good = (states >= READ) & fits
        with np.errstate(over="ignore"):
            samples = (values[good, 1:] * self.scale + self.offset).astype(np.float32)[:, None, :]
        return Lines(states != OTHER, good, places[good], samples)

    def write(self, place: float, sample: NDArray[np.float64]) -> bytes:
        """One line without its checksum and end.

        Args:
            place: the counter, or the device's time in s.
            sample: float64 ``[channels]`` in physical units.
        """
        values = dict(zip(self.channels, ((sample - self.offset) / self.scale).tolist(), strict=True))
        fields = [] if self.prefix is None else [self.prefix]
        for name in self.columns:
            if name == self.time:
                fields.append(f"{place * UNITS_PER_S[self.time_unit]:.4f}")
            elif name == self.counter:
                fields.append(str(int(place) % 2**self.counter_bits))
            else:
                fields.append(f"{values.get(name, 0.0):.{self.decimals}f}")
        return self.separator.join(fields).encode("ascii")


class DeviceTime:
    """Sample counts from a device's time stamps.

    Each stamp is compared with the one expected after the stamp before it, so that a device whose rate is
    not quite the nominal one gains or loses no sample over the hours. Stamps may be rounded to a quarter
    of a sampling period for every gap to be told exactly. Coarser ones, which several lines share, tell of
    gaps that are longer than their grain; a line is a sample all the same, so without a counter a repeated
    line cannot be told.

    A line that was overtaken goes back to its place within the reorder window. Time that goes back farther
    means that the device was restarted: the count begins at 0 again. One damaged stamp moves no other.

    Args:
        rate_hz: nominal samples per second.
        reorder_window_ns: how long a line may be overtaken on its way.
    """

    def __init__(self, rate_hz: float, reorder_window_ns: int = REORDER_WINDOW_NS) -> None:
        self._period_s = 1.0 / rate_hz
        # As wide as where the counters of frames are followed: what comes too late is known as late.
        self._back_s = (4 * reorder_window_ns) / NS_PER_S + 2.0 * self._period_s
        self._leap_s = max(LEAP_S, LEAP_PERIODS * self._period_s)
        self._states = np.full((2, KNOWN), math.nan)

    def count(self, times_s: NDArray[np.float64]) -> NDArray[np.int64]:
        """The count of each sample, modulo ``2**TIME_COUNTER_BITS``; both ``[n]``."""
        return count_stamps(times_s, self._period_s, _TRACKING, self._back_s, self._leap_s, self._states)


class LineFraming(DelimitedFraming):
    """Lines of text, each one sample; a line that cannot be read costs itself only.

    Args:
        layouts: by stream; if there are several, each has a prefix.
        rates_hz: nominal samples per second, by stream.
        checksum: behind a ``*`` at the end of each line, in hexadecimal, over what stands between an opening
            ``$`` or ``!`` (if there is one) and the ``*``: all characters combined by XOR, as in NMEA 0183,
            or their CRC-16/IBM-3740.
        delimiter: the byte at the end of each line; a carriage return before it is no part of the line.
        reorder_windows_ns: how long a line may be overtaken on its way, by stream.

    Raises:
        LayoutError: the streams cannot be told apart.
    """

    def __init__(
        self,
        layouts: Mapping[str, TextLayout],
        rates_hz: Mapping[str, float],
        checksum: Checksum = "none",
        delimiter: bytes = NEWLINE,
        reorder_windows_ns: Mapping[str, int] | None = None,
    ) -> None:
        self._layouts = dict(layouts)
        self._rates_hz = dict(rates_hz)
        self._checksum: Checksum = checksum
        self._by_prefix: dict[bytes | None, str] = {}
        for name, layout in layouts.items():
            key = None if layout.prefix is None else layout.prefix.encode("ascii")
            other = self._by_prefix.setdefault(key, name)
            if other != name or (None in self._by_prefix and len(layouts) > 1):
                raise LayoutError(f"streams {other!r} and {name!r} cannot be told apart; give each a prefix")
        self._separators = {layout.separator.encode("ascii") for layout in layouts.values()}
        if len(self._separators) != 1:
            raise LayoutError(
                "the streams of one port have different separators; they must have the same one"
            )
        self._separator = next(iter(self._separators))
        self._times = {
            name: DeviceTime(rates_hz[name], (reorder_windows_ns or {}).get(name, REORDER_WINDOW_NS))
            for name, layout in layouts.items()
            if layout.time is not None
        }
        self._end = RETURN + NEWLINE if delimiter == NEWLINE else delimiter
        # Without a checksum nothing shows whether the beginning of a line is missing, e.g. a digit.
        super().__init__(delimiter, LONGEST_LINE, RETURN, whole=checksum != "none")

    def encode(
        self,
        stream: str,
        first_index: NDArray[np.int64],
        samples: NDArray[np.float64] | NDArray[np.float32],
        *,
        clip: bool = False,  # noqa: ARG002 - any finite number can be written
    ) -> list[bytes]:
        """See `drivers.serial.framing.Framing.encode`; a device that sends its time began at index 0."""
        layout = self._layouts[stream]
        places = first_index / self._rates_hz[stream] if stream in self._times else first_index
        rows = np.asarray(samples, np.float64)[:, 0, :]
        if not np.isfinite(rows).all():
            raise LayoutError("a sample to be written is not finite; a line carries finite numbers only")
        lines = [layout.write(place, row) for place, row in zip(places.tolist(), rows, strict=True)]
        if self._checksum == "none":
            return [line + self._end for line in lines]
        sums = map(_SUMS[self._checksum], [line[line[:1] in {b"$", b"!"} :] for line in lines])
        digits = DIGITS[self._checksum]
        ends = [b"*%0*X" % (digits, value) + self._end for value in sums]
        return [line + end for line, end in zip(lines, ends, strict=True)]

    def _sort(self, pieces: Pieces, found: Found) -> NDArray[np.bool_]:
        intact = np.ones(len(pieces.ends), np.bool_)
        if self._checksum != "none":
            digits = DIGITS[self._checksum]
            texts, intact = check_lines(pieces.buffer, pieces.starts, pieces.stops, digits)
            pieces = pieces._replace(stops=texts)
        in_step = np.zeros(len(pieces.ends), np.bool_)
        strays = intact.copy()
        for name, layout in self._layouts.items():
            mine, good, places, samples = layout.read(pieces)
            strays &= ~mine
            in_step |= good
            if not good.any():
                continue
            sound = intact[good]
            if name in self._times:
                # A stamp that is not to be trusted must not move the time of those behind it.
                counter = np.zeros(len(sound), np.int64)
                counter[sound] = self._times[name].count(places[sound])
            else:
                counter = places.astype(np.int64)
            found.frames[name] = Frames(Decoded(counter, samples, sound), pieces.ends[good])
        for k in np.flatnonzero(strays).tolist():
            text = pieces.buffer[pieces.starts[k] : pieces.stops[k]].tobytes()
            prefix = text.partition(self._separator)[0]
            if prefix.isascii() and prefix.decode("ascii").isprintable():
                found.note_unknown(prefix.decode("ascii"))
                in_step[k] = True
        return in_step


def text_layout(given: LineLayout) -> TextLayout:
    """The columns of a line as the machine file names them, in the units that are written."""
    return TextLayout(
        columns=given.line,
        channels=given.channel_names,
        scale=np.array([channel.scale for channel in given.channels]),
        offset=np.array([channel.offset for channel in given.channels]),
        counter=None if given.counter is None else given.counter.column,
        counter_bits=32 if given.counter is None else given.counter.bits,
        time=None if given.time is None else given.time.column,
        time_unit="ms" if given.time is None else given.time.unit,
        prefix=given.prefix,
        separator=given.separator,
    )
