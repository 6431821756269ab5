"""Samples as lines of text: ``seq,x,y,z`` with a counter, or a time stamp of the device's own clock.

One line carries one sample of every channel. The loss of lines shows in the counter; a device that sends
none may send the time at which it sampled instead. Of one that sends neither, the times of arrival count.
Two optional parts, as NMEA 0183 has them: a first field that names the stream, and a checksum behind a ``*``.
"""

from __future__ import annotations

import binascii
import json
import math
from functools import reduce
from operator import xor
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.rounding import counted
from drivers.frames import DecodedFrames, LayoutError
from drivers.serial.framing import DelimitedFraming, NoFrame
from drivers.serial.line_kernels import (
    CLASSES,
    HARD,
    KNOWN,
    OTHER,
    READ,
    check_lines,
    count_stamps,
    read_lines,
)
from drivers.serial.line_numbers import (
    ABSENT,
    NUMBER,
    encoded,
    fields_of,
    is_text,
    number_within,
    parts_of,
    text_of,
)
from drivers.serial.settings import UNITS_PER_S

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from drivers.frames import DecodedBatch
    from drivers.serial.framing import ArrivalsOf, Pieces
    from drivers.serial.settings import LineLayout

Checksum = Literal["none", "xor", "crc16"]

NEWLINE = b"\n"
RETURN = b"\r"
LONGEST_LINE = 1024
"""Bytes; a line that is longer is garbage."""

TIME_COUNTER_BITS = 32
LATEST_S = 1e12
"""A device's time in s that is later than this is no time."""

_NAMES_OF_ENDS = {NEWLINE: "line feed", RETURN: "carriage return"}

SHOWN_CHARACTERS = 80
"""Characters that are shown of what is no line."""

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
    """What lines contain for one stream.

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


class LineCodec:
    """The numbers of a line, read and written as the layout of its stream states.

    Args:
        layout: which column is what; its scale and offset lead to the physical units.

    Raises:
        LayoutError: the line has no counter and no time without stating so, or both; or a named column is not
            there once.
    """

    def __init__(self, layout: LineLayout) -> None:
        place = layout.counter or layout.time
        if [layout.counter is None, layout.time is None, not layout.no_counter].count(False) != 1:
            raise LayoutError(
                "a line needs a counter or a time, and not both: without it lost lines cannot be found; "
                "no_counter = true states that it has neither"
            )
        for name in (*([] if place is None else [place.column]), *layout.channel_names):
            if layout.line.count(name) != 1:
                raise LayoutError(
                    f"column {name!r} is there {counted(layout.line.count(name), 'time')} among "
                    f"{', '.join(layout.line)}; name it once"
                )
        self._layout = layout
        self._place = None if place is None else place.column
        self._counts = 2.0 ** (TIME_COUNTER_BITS if layout.counter is None else layout.counter.bits)
        self._units_per_s = None if layout.time is None else UNITS_PER_S[layout.time.unit]
        self._is_counted = layout.counter is not None
        self._scale = np.array([channel.scale for channel in layout.channels])
        self._offset = np.array([channel.offset for channel in layout.channels])
        # No column is at -1: without a counter and a time, the place of every line reads 0.
        place_at = -1 if place is None else layout.line.index(place.column)
        self._picks = np.array([place_at, *map(layout.line.index, layout.channel_names)], np.int64)
        self._beside = layout.beside
        read = [*([] if place is None else [place.column]), *layout.channel_names]
        around = [("", "")] * (place is None) + [self._beside[name] for name in read]
        texts = [one for pair in around for text in pair for one in encoded(text)]
        self._texts = _side_by_side(texts, least=1).reshape(len(around), 4, -1)
        self._around = around
        self._prefix = _side_by_side(encoded(layout.prefix or ""))

    def read(self, lines: Pieces) -> Lines:
        """Read lines of any streams."""
        buffer, starts, stops, _ = lines
        layout = self._layout
        states, values = read_lines(
            buffer,
            starts,
            stops,
            self._prefix,
            ord(layout.separator),
            CLASSES[layout.decimal],
            len(layout.line),
            self._picks,
            self._texts,
            self._is_counted,
        )
        for k in np.flatnonzero(states == HARD).tolist():
            text = text_of(buffer[starts[k] : stops[k]].tobytes())
            fields = fields_of(text, layout.separator)[bool(layout.prefix) :]
            values[k] = [
                _value((number_within(fields[pick], *beside) or "").replace(layout.decimal, "."))
                if pick >= 0
                else 0.0
                for pick, beside in zip(self._picks.tolist(), self._around, strict=True)
            ]
        places = values[:, 0]
        if self._units_per_s is None:
            fits = (places >= 0) & (places < self._counts)
        else:
            places = places / self._units_per_s
            fits = abs(places) <= LATEST_S
        good = (states >= READ) & fits
        with np.errstate(over="ignore"):
            samples = (values[good, 1:] * self._scale + self._offset).astype(np.float32)[:, None, :]
        return Lines(states != OTHER, good, places[good], samples)

    def why_not(self, fields: Sequence[str]) -> NoFrame:
        """Why the fields of a line, its prefix left out, are no sample."""
        columns = self._layout.line
        if len(fields) != len(columns):
            many = counted(len(fields), "column")
            why = f"{many}, the file lists {len(columns)} ({', '.join(columns)})"
            return NoFrame(why, self._other_columns(len(fields) - len(columns)))
        for name in filter(None, (self._place, *self._layout.channel_names)):
            why_no_number = self._why_no_number(name, fields)
            if why_no_number is not None:
                return why_no_number
        return NoFrame("it cannot be read") if self._place is None else self._why_no_place(fields)

    def _why_no_place(self, fields: Sequence[str]) -> NoFrame:
        """Why a line whose columns are numbers has no place among the others."""
        columns = self._layout.line
        assert self._place is not None  # noqa: S101 - else it needs none
        text = number_within(fields[columns.index(self._place)], *self._beside[self._place]) or ""
        place = text.replace(self._layout.decimal, ".")
        if self._units_per_s is not None:
            return NoFrame(
                f"time {self._place} is {place}, later than any", "correct column and unit of time"
            )
        if not place.strip().isdigit():
            why = f"counter {self._place} is {place}, no whole number from 0 up"
            return NoFrame(why, "name the column that counts lines, or write time in place of counter")
        if float(place) >= self._counts:
            most = f"by its bits in the file {self._counts - 1:.0f} at most"
            return NoFrame(f"counter {self._place} is {place}, {most}", "correct bits of counter")
        return NoFrame("it cannot be read")

    def _why_no_number(self, name: str, fields: Sequence[str]) -> NoFrame | None:
        """Why a column has no number; None if it has one, or none need be there."""
        text = fields[self._layout.line.index(name)]
        prefix, suffix = self._beside[name]
        number = number_within(text, prefix, suffix)
        if number is None and number_within(text, prefix, "") is None:
            why = f"column {name} is {text!r}, without {prefix!r} in front of the number"
            return NoFrame(why, f"correct prefix of {self._table(name)}")
        if number is None:
            return NoFrame(f"column {name} is {text!r}, without {suffix!r} at its end", _other_unit(text))
        if name != self._place and ABSENT.fullmatch(number):
            return None
        if NUMBER[self._layout.decimal].fullmatch(number):
            return None
        return NoFrame(f"column {name} is {text!r}, no number", self._other_number(name, text, fields))

    def _other_number(self, name: str, text: str, fields: Sequence[str]) -> str:
        """What to do if all lines have such a text where a number should be."""
        named, unit = parts_of(text, self._layout.decimal) or ("", "")
        texts = {"prefix": named, "suffix": unit}
        keys = [f"{key} = {json.dumps(one, ensure_ascii=False)}" for key, one in texts.items() if one]
        if keys:
            return f"write {' and '.join(keys)} in {self._table(name)} of the layout"
        other = "." if self._layout.decimal == "," else ","
        if other != self._layout.separator and NUMBER[other].fullmatch(text):
            if self._needs_mark(fields) and name != self._place:
                return (
                    "have the device write one decimal mark, and none between thousands; or leave "
                    f"{name} out of channels of the layout, and its sensor out of the file"
                )
            return f"write decimal = {json.dumps(other)} in the layout"
        order = "put the names in line in the order in which the device sends its columns"
        if name == self._place or any(map(str.isdigit, text)):
            return order
        change = f"leave {name} out of channels of the layout, and its sensor out of the file"
        return f"{change}, if the device sends words there; else {order}"

    def _needs_mark(self, fields: Sequence[str]) -> bool:
        """Whether a column that is read is a number with the decimal mark of the layout only."""
        columns = self._layout.line
        texts = [
            number_within(fields[columns.index(name)], *self._beside[name]) or ""
            for name in self._layout.channel_names
        ]
        mark = self._layout.decimal
        return any(mark in text and NUMBER[mark].fullmatch(text) for text in texts)

    def _table(self, name: str) -> str:
        """The table of the layout that a column has."""
        if name != self._place:
            return f"the channel {name}"
        return "counter" if self._units_per_s is None else "time"

    def _other_columns(self, more: int) -> str:
        """What to do if lines have so many columns more than the file lists; fewer if it is negative."""
        many = counted(abs(more), "column")
        if more > 0:
            change = f"list {many} more in line of the layout: all that the device sends, in their order"
        else:
            change = f"remove the {many} that the device does not send from line of the layout"
        return f"{change}, or correct separator = {json.dumps(self._layout.separator)}"

    def write(self, place: float, sample: NDArray[np.float64]) -> bytes:
        """One line without its checksum and end.

        Args:
            place: the counter, or the device's time in s.
            sample: float64 ``[channels]`` in physical units.
        """
        layout = self._layout
        raw = ((sample - self._offset) / self._scale).tolist()
        values = dict(zip(layout.channel_names, raw, strict=True))
        fields = [] if layout.prefix is None else [layout.prefix]
        for name in layout.line:
            if name != self._place:
                number = f"{values.get(name, 0.0):.6f}"
            elif self._units_per_s is None:
                number = str(int(place) % int(self._counts))
            else:
                number = f"{place * self._units_per_s:.4f}"
            prefix, suffix = self._beside.get(name, ("", ""))
            fields.append(f"{prefix}{number.replace('.', layout.decimal)}{suffix}")
        return layout.separator.join(fields).encode()


def _names_stream(prefix: str) -> bool:
    """Whether a first field may be the prefix of a stream that the file does not have, and no noise."""
    ascii_letters = sum(map(str.isascii, prefix))
    return prefix.isprintable() and (ascii_letters == len(prefix) or 2 * ascii_letters > len(prefix) > 2)


def _side_by_side(texts: Sequence[bytes], least: int = 0) -> NDArray[np.uint8]:
    """Texts with zeros behind them, uint8 ``[n, m]``; m is that of the longest, and ``least`` at least."""
    length = max(least, *map(len, texts))
    return np.array([list(text.ljust(length, b"\0")) for text in texts], np.uint8).reshape(len(texts), length)


def _other_unit(text: str) -> str:
    """What to do if all lines have such a text where a number and another text should be."""
    if any(number.fullmatch(text) for number in NUMBER.values()):
        return "remove suffix of the channel"
    return "correct suffix of the channel, and unit of its sensor, if the device has another unit now"


def _value(field: str) -> float:
    """The number of a field that the kernels have found to be one, or absent."""
    return math.nan if ABSENT.fullmatch(field) else float(field)


class DeviceTime:
    """Sample counts from a device's time stamps.

    Each stamp is compared with the one expected after the stamp before it, so that a device whose rate is
    not quite the nominal one gains or loses no sample over the hours. Stamps may be rounded to a quarter
    of a sampling period for every gap to be known exactly. Coarser ones, which several lines share, show
    gaps that are longer than their grain; a line is a sample all the same, so without a counter a repeated
    line cannot be known. Where lines go missing again and again, they fall behind the stamps by more than a
    device that is slower than stated by up to 1.25 %: all of these are counted then.

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
        layouts: Mapping[str, LineLayout],
        rates_hz: Mapping[str, float],
        checksum: Checksum = "none",
        delimiter: bytes = NEWLINE,
        reorder_windows_ns: Mapping[str, int] | None = None,
    ) -> None:
        self._codecs = {name: LineCodec(layout) for name, layout in layouts.items()}
        self._rates_hz = dict(rates_hz)
        self._checksum: Checksum = checksum
        self._by_prefix: dict[str | None, str] = {}
        for name, layout in layouts.items():
            other = self._by_prefix.setdefault(layout.prefix, name)
            if other != name or (None in self._by_prefix and len(layouts) > 1):
                raise LayoutError(f"streams {other!r} and {name!r} cannot be told apart; give each a prefix")
        separators = {layout.separator for layout in layouts.values()}
        if len(separators) != 1:
            raise LayoutError(
                "the streams of one port have different separators; they must have the same one"
            )
        self._separator = separators.pop()
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
        codec = self._codecs[stream]
        places = first_index / self._rates_hz[stream] if stream in self._times else first_index
        rows = np.asarray(samples, np.float64)[:, 0, :]
        if not np.isfinite(rows).all():
            raise LayoutError("a sample to be written is not finite; a line carries finite numbers only")
        lines = [codec.write(place, row) for place, row in zip(places.tolist(), rows, strict=True)]
        if self._checksum == "none":
            return [line + self._end for line in lines]
        sums = map(_SUMS[self._checksum], [line[line[:1] in {b"$", b"!"} :] for line in lines])
        digits = DIGITS[self._checksum]
        ends = [b"*%0*X" % (digits, value) + self._end for value in sums]
        return [line + end for line, end in zip(lines, ends, strict=True)]

    def _why_no_frame(self, piece: bytes, which: str = "the first") -> NoFrame:
        line = text_of(piece)
        shown = piece[:SHOWN_CHARACTERS].decode("ascii", "backslashreplace")
        shown = line[:SHOWN_CHARACTERS] if is_text(line) else shown
        quote = f'{which} line is "{shown}{"..." if len(piece) > SHOWN_CHARACTERS else ""}"'
        if not is_text(line):
            why = "no text, as at another baud rate or parity, or of a device that sends no lines"
            return NoFrame(f"{quote}: {why}")
        if self._checksum != "none":
            text, star, sent = piece.rpartition(b"*")
            if not star:
                remedy = 'write checksum = "none" in the table of the bus'
                return NoFrame(f"{quote}: no checksum behind a *", remedy)
            made = b"%0*X" % (DIGITS[self._checksum], _SUMS[self._checksum](text[text[:1] in {b"$", b"!"} :]))
            if made != sent.upper():
                why = f"checksum {text_of(sent)}, its text makes {made.decode()}"
                return NoFrame(f"{quote}: {why}", "compare checksum with the device's")
            piece = text
        fields = fields_of(text_of(piece), self._separator)
        if None in self._by_prefix:
            why, remedy = self._codecs[self._by_prefix[None]].why_not(fields)
            return NoFrame(f"{quote}: {why}", remedy)
        name = self._by_prefix.get(fields[0])
        if name is None:
            return NoFrame(f"{quote}: of no stream", "correct prefix and separator of the layout")
        why, remedy = self._codecs[name].why_not(fields[1:])
        return NoFrame(f"{quote}: {why}", remedy)

    def _why_no_end(self, begin: bytes) -> NoFrame:
        shown = begin[:SHOWN_CHARACTERS].decode("ascii", "backslashreplace")
        here = _NAMES_OF_ENDS.get(self._end[-1:], self._end.decode())
        why = f'no {here}, which ends a line, in {LONGEST_LINE} bytes, which begin with "{shown}..."'
        other = next((end for end in (NEWLINE, RETURN) if end in begin), None)
        if other is None:
            return NoFrame(why)
        return NoFrame(why, f"write delimiter = {json.dumps(other.decode())} in the table of the bus")

    def _sort(self, pieces: Pieces, batch: DecodedBatch, arrivals_of: ArrivalsOf) -> NDArray[np.bool_]:
        intact = np.ones(len(pieces.ends), np.bool_)
        if self._checksum != "none":
            digits = DIGITS[self._checksum]
            texts, intact = check_lines(pieces.buffer, pieces.starts, pieces.stops, digits)
            pieces = pieces._replace(stops=texts)
        in_step = np.zeros(len(pieces.ends), np.bool_)
        strays = intact.copy()
        for name, codec in self._codecs.items():
            mine, good, places, samples = codec.read(pieces)
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
            arrival_ns = arrivals_of(pieces.ends[good])
            batch.frames[name] = DecodedFrames(counter, samples, sound, arrival_ns)
        for k in np.flatnonzero(strays).tolist():
            text = text_of(pieces.buffer[pieces.starts[k] : pieces.stops[k]].tobytes())
            prefix = fields_of(text, self._separator)[0]
            if _names_stream(prefix):
                batch.unknown[prefix] += 1
                in_step[k] = True
        return in_step
