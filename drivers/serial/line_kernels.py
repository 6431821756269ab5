"""Compiled loops over lines of text: checksums, numbers, and counts from time stamps.

A number is read as Python's `float` and `int` read it, to the last bit, but for the decimal mark, which may
be a comma. Where that takes more than the arithmetic of doubles (more than 15 digits or so, an exponent
beyond 22), the line is left to them. An empty field, one of dashes only, and a word for it are no value, NaN.

Read by `re` and `float`, by the same grammar, the data of a UART at 12 Mbit/s take 6 % of a core in lines
of 34 bytes. In lines of 9 they take 12 to 16 %. All this is under the interpreter's lock. Here it takes
0.7 and 1.3 %; with a unit behind each of three numbers 1.1 %.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.kernels import njit
from drivers.serial.kernels import crc16
from drivers.serial.line_numbers import ABSENT_WORDS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Bytes = NDArray[np.uint8]
    Texts = NDArray[np.uint8]
    Places = NDArray[np.int64]
    Values = NDArray[np.float64]
    Far = tuple[int, bool, int, int, int, bool]
    """State; whether it is negative; mantissa; exponents by decimal mark and by letter; whether that is."""

OTHER, BAD, READ, HARD = range(4)
"""A line of another stream; no line; numbers that have been read; numbers to be read by Python."""

ZERO, MINUS, SPACE = b"0- "
_WORDS = np.array(
    [list(word.encode().ljust(max(map(len, ABSENT_WORDS)), b"\0")) for word in ABSENT_WORDS], np.uint8
)
"""Words for no value, uint8 ``[words, letters]``, with zeros behind them."""
STAR, DOLLAR, EXCLAMATION = b"*$!"
EXACT = 2**53
"""Integers up to this are doubles."""
_POWERS = np.array([10.0**k for k in range(23)])
"""All powers of ten that are doubles: one multiplication or division by them rounds correctly.

(W. Clinger, How to Read Floating Point Numbers Accurately, PLDI 1990.)
"""
_LARGEST = 10**17
_COUNTS = 2.0**32


@njit(cache=True, nogil=True, error_model="numpy")
def _hex_value(byte: int) -> int:
    """Value of a hexadecimal digit; far below zero if it is none."""
    if ZERO <= byte < ZERO + 10:
        return byte - ZERO
    letter = (byte | 0x20) - 0x61
    return letter + 10 if 0 <= letter < 6 else -0x10000000


@njit(cache=True, nogil=True, error_model="numpy")
def check_lines(
    buffer: Bytes, starts: Places, stops: Places, digits: int
) -> tuple[Places, NDArray[np.bool_]]:
    """Take the checksums off lines, and check them.

    Args:
        buffer: uint8, with the lines in it.
        starts: int64 ``[n]``, where each begins.
        stops: int64 ``[n]``, one past its last byte.
        digits: of the checksum in hexadecimal, behind a star: 2 for all bytes combined by XOR, 4 for their
            CRC-16/IBM-3740. An opening ``$`` or ``!`` does not count.

    Returns:
        int64 ``[n]``, where the text of each ends, at its start if there is no star; bool ``[n]``, whether
        its checksum matches.
    """
    ends = starts.copy()
    intact = np.zeros(len(starts), np.bool_)
    for k in range(len(starts)):
        star = stops[k] - 1
        while star >= starts[k] and buffer[star] != STAR:
            star -= 1
        if star < starts[k]:
            continue
        ends[k] = star
        start = starts[k]
        if buffer[start] == DOLLAR or buffer[start] == EXCLAMATION:
            start += 1
        right = 0
        if digits == 4:
            right = crc16(buffer, start, star, 0xFFFF)
        else:
            for at in range(start, star):
                right ^= buffer[at]
        sent = 0
        for at in range(star + 1, stops[k]):
            sent = sent * 16 + _hex_value(buffer[at])
        intact[k] = stops[k] - star - 1 == digits and sent == right
    return ends, intact


START, SIGNED, POINT, EXPONENT, EXPONENT_SIGNED, WRONG = range(6)
WHOLE, AFTER_WHOLE, FRACTION, POWER, AFTER = range(6, 11)
"""How far a number has been read; only with the last five it may end."""
_DIGIT, _SIGN, _POINT, _E, _SPACE, _ALIEN = range(6)


def _classes(decimal: bytes) -> NDArray[np.uint8]:
    """What each byte means in a number with that decimal mark, uint8 ``[256]``."""
    classes = np.full(256, _ALIEN, np.uint8)
    for kind, bytes_ in (
        (_DIGIT, b"0123456789"),
        (_SIGN, b"+-"),
        (_POINT, decimal),
        (_E, b"eE"),
        (_SPACE, b" "),
    ):
        classes[list(bytes_)] = kind
    return classes


def _grammar() -> NDArray[np.uint8]:
    """What follows at each byte of a number, uint8 ``[state, kind of byte]``."""
    follows = np.full((AFTER + 1, _ALIEN + 1), WRONG, np.uint8)
    for state, kind, then in (
        (START, _SPACE, START), (START, _SIGN, SIGNED), (START, _DIGIT, WHOLE), (START, _POINT, POINT),
        (SIGNED, _DIGIT, WHOLE), (SIGNED, _POINT, POINT),
        (WHOLE, _DIGIT, WHOLE), (WHOLE, _POINT, FRACTION), (WHOLE, _E, EXPONENT),
        (WHOLE, _SPACE, AFTER_WHOLE),
        (POINT, _DIGIT, FRACTION),
        (FRACTION, _DIGIT, FRACTION), (FRACTION, _E, EXPONENT), (FRACTION, _SPACE, AFTER),
        (EXPONENT, _SIGN, EXPONENT_SIGNED), (EXPONENT, _DIGIT, POWER), (EXPONENT_SIGNED, _DIGIT, POWER),
        (POWER, _DIGIT, POWER), (POWER, _SPACE, AFTER),
        (AFTER_WHOLE, _SPACE, AFTER_WHOLE), (AFTER, _SPACE, AFTER),
    ):  # fmt: skip
        follows[state, kind] = then
    return follows


CLASSES: Mapping[str, NDArray[np.uint8]] = {mark: _classes(mark.encode()) for mark in (".", ",")}
"""What each byte means in a number, uint8 ``[256]``, by decimal mark."""
_GRAMMAR = _grammar()


@njit(cache=True, nogil=True, error_model="numpy")
def _number(far: Far) -> tuple[float, int]:
    """The number that has been read; and `BAD`, `READ` or `HARD`."""
    state, negative, mantissa, exponent, power, down = far
    if state <= WRONG:
        return 0.0, BAD
    exponent += -power if down else power
    if abs(mantissa) > EXACT or abs(exponent) >= len(_POWERS):
        return 0.0, HARD
    value = mantissa / _POWERS[-exponent] if exponent < 0 else mantissa * _POWERS[exponent]
    return -value if negative else value, READ


@njit(cache=True, nogil=True, error_model="numpy")
def _next(byte: int, kind: int, far: Far) -> Far:
    """How far a number has been read when its next byte is read, too."""
    state, negative, mantissa, exponent, power, down = far
    state = _GRAMMAR[state, kind]
    if kind != _DIGIT:
        negative |= byte == MINUS and state == SIGNED
        down |= byte == MINUS and state == EXPONENT_SIGNED
    elif state == POWER:
        power = min(power * 10 + byte - ZERO, _LARGEST)
    elif mantissa < _LARGEST:
        mantissa = mantissa * 10 + byte - ZERO
        exponent -= state == FRACTION
    return state, negative, mantissa, exponent, power, down


@njit(cache=True, nogil=True, error_model="numpy")
def _length_there(buffer: Bytes, start: int, stop: int, text: Bytes, at_end: bool) -> int:  # noqa: FBT001 - numba
    """The length of a text if a field begins with it, or ends; -1 if it does not."""
    length = 0
    while length < len(text) and text[length]:
        length += 1
    if length > stop - start:
        return -1
    begin = stop - length if at_end else start
    for k in range(length):
        if buffer[begin + k] != text[k]:
            return -1
    return length


@njit(cache=True, nogil=True, error_model="numpy")
def _within(buffer: Bytes, start: int, stop: int, texts: Texts, classes: Bytes) -> tuple[Far, int, int]:
    """A number with texts around it: how far it has been read, not at all without them; where it is."""
    far = (START, False, 0, 0, 0, False)
    if texts[0, 0]:
        while start < stop and buffer[start] == SPACE:
            start += 1
        length = _length_there(buffer, start, stop, texts[0], False)
        if length < 0:
            length = _length_there(buffer, start, stop, texts[1], False)
        if length < 0:
            return far, start, stop
        start += length
    if texts[2, 0]:
        while start < stop and buffer[stop - 1] == SPACE:
            stop -= 1
        length = _length_there(buffer, start, stop, texts[2], True)
        if length < 0:
            length = _length_there(buffer, start, stop, texts[3], True)
        if length < 0:
            return far, start, stop
        stop -= length
    for at in range(start, stop):
        far = _next(buffer[at], classes[buffer[at]], far)
    return far, start, stop


@njit(cache=True, nogil=True, error_model="numpy")
def _is_absent(buffer: Bytes, start: int, stop: int) -> bool:
    """Whether a field states that there is no value: it is empty, of dashes only, or a word for it."""
    while start < stop and buffer[start] == SPACE:
        start += 1
    while start < stop and buffer[stop - 1] == SPACE:
        stop -= 1
    dashes = True
    for at in range(start, stop):
        dashes &= buffer[at] == MINUS
    if dashes:
        return True
    length = stop - start
    for k in range(len(_WORDS)):
        if length > len(_WORDS[k]) or (length < len(_WORDS[k]) and _WORDS[k, length]):
            continue
        letters = True
        for at in range(length):
            byte = buffer[start + at]
            letters &= (byte | 0x20 if byte >= 0x40 else byte) == _WORDS[k, at]
        if letters:
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _text_begins(buffer: Bytes, start: int, stop: int, prefix: Texts, separator: int) -> int:
    """Where the fields behind the prefix begin; -1 if it is different, or the first if there is none."""
    if not prefix.shape[1]:
        return start
    while separator == SPACE and start < stop and buffer[start] == SPACE:
        start += 1
    for k in range(len(prefix)):
        length = _length_there(buffer, start, stop, prefix[k], False)
        if length >= 0 and (start + length == stop or buffer[start + length] == separator):
            return start + length + 1
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def _line(
    buffer: Bytes,
    start: int,
    stop: int,
    separator: int,
    classes: Bytes,
    columns: int,
    picks: Places,
    texts: Texts,
    values: Values,
) -> tuple[int, bool]:
    """Read the picked fields of one line.

    A run of blanks that separate is one separator, and none at the ends: see
    `drivers.serial.line_numbers.fields_of`.

    Returns:
        `BAD`, `READ` or `HARD`; and whether its first picked field is an integer. A later one may be absent.
    """
    line, counts, column, begin = READ, False, 0, start
    far = (START, False, 0, 0, 0, False)
    for at in range(start, stop + 1):
        if at < stop and buffer[at] != separator:
            far = _next(buffer[at], classes[buffer[at]], far)
            continue
        padding = separator == SPACE and begin == at
        for k in range(len(picks)):
            if picks[k] == column and not padding:
                first, end = begin, at
                if texts[k, 0, 0] or texts[k, 2, 0]:
                    # Without the texts it is another unit, or quantity: then it must not be read.
                    far, first, end = _within(buffer, begin, at, texts[k], classes)
                value, outcome = _number(far)
                if outcome == BAD:
                    if k == 0 or not _is_absent(buffer, first, end):
                        return BAD, False
                    value, outcome = np.nan, READ
                values[k] = value
                line = max(line, outcome)
                counts |= k == 0 and WHOLE <= far[0] <= AFTER_WHOLE
        column, begin = column + (not padding), at + 1
        far = (START, False, 0, 0, 0, False)
    return (line if column == columns else BAD), counts


@njit(cache=True, nogil=True, error_model="numpy")
def read_lines(
    buffer: Bytes,
    starts: Places,
    stops: Places,
    prefix: Texts,
    separator: int,
    classes: Bytes,
    columns: int,
    picks: Places,
    texts: Texts,
    counted: bool,  # noqa: FBT001 - numba
) -> tuple[NDArray[np.int8], NDArray[np.float64]]:
    """Read the numbers of the lines of one stream.

    Args:
        buffer: uint8, with the lines in it.
        starts: int64 ``[n]``, where each begins.
        stops: int64 ``[n]``, one past its last byte.
        prefix: uint8 ``[2, m]``, the first field of each line of the stream in two encodings, either of which
            may be there, with zeros behind them; m is 0 if it has none.
        separator: the byte between fields; if it is a blank, there may be several.
        classes: one of `CLASSES`, by the decimal mark of the stream.
        columns: how many fields there are, without the prefix.
        picks: int64 ``[p]``, which of them are read.
        texts: uint8 ``[p, 4, m]``, the texts around the number of each, with zeros behind them. The first
            two are those in front, of which either may be there, in two encodings. The others are behind it.
        counted: whether the first of those must be an integer.

    Returns:
        int8 ``[n]``, `OTHER`, `BAD`, `READ` or `HARD`; float64 ``[n, p]``, the numbers where it is `READ`;
        NaN where the device has none. The first of them must be there.
    """
    states = np.empty(len(starts), np.int8)
    values = np.zeros((len(starts), len(picks)), np.float64)
    for k in range(len(starts)):
        start = _text_begins(buffer, starts[k], stops[k], prefix, separator)
        if start < 0:
            states[k] = OTHER
            continue
        state, integer = _line(buffer, start, stops[k], separator, classes, columns, picks, texts, values[k])
        states[k] = BAD if counted and not integer else state
    return states, values


COUNT, STAMP, DUE, GRAIN, SHARED, TICKS, LOSING, CREDIT = range(8)
"""What is known of a device's time stamps: count, stamp and instant of its newest sample in s, how coarse the
stamps are in s, and whether several samples share one. Of such stamps also: how many there were, which share
of the last samples was missing, and how late in s a sample may be without any missing before it."""
KNOWN = CREDIT + 1
_SETTLING_TICKS = 32
"""Stamps that samples share until it is known where in its grain the device samples."""
_SLACK_AT_FIRST, _SLACK = 0.6, 0.25
"""How many periods late, beside the half one, a sample must be for a shared stamp to show missing ones."""
_NOT_BEFORE_STAMP = 0.5
"""In place of `tracking`, for samples that are due before the stamp that they share, at first."""
_DRIFT, _MOST_DRIFT = 0.0125, 0.5
"""By how much slower than stated a device may be, as a share of its rate, without any sample missing. How
many periods of that may be unseen, until a sample falls to the next stamp."""
_MOST_JITTER = 4.0
"""Periods by which samples may be late at times, after which others are too early for their stamp."""
_LOSING = 0.015
"""Share of missing samples from which what is late is no drift: no device is slow at times."""
_PART_OF_SHARE, _MOST_AT_ONCE = 1.0 / 200.0, 2.0
"""In samples; and how many of a gap count for that share, which is of losses that go on."""


@njit(cache=True, nogil=True, error_model="numpy")
def _next_stamp(state: Values, time_s: float, period_s: float, tracking: float) -> None:
    """Take in the stamp of the sample after the newest one; no earlier than that one's."""
    passed_s = time_s - state[STAMP]
    if passed_s == 0.0:
        state[SHARED] = 1.0
    else:
        state[GRAIN] = min(state[GRAIN], passed_s)
        state[TICKS] += state[SHARED]
    state[STAMP] = time_s
    settled = state[TICKS] > _SETTLING_TICKS
    # It was taken when it is due, or some samples are missing before it.
    slack = _SLACK + state[CREDIT] / period_s if settled else _SLACK_AT_FIRST * state[SHARED]
    steps = max(np.rint((time_s - state[DUE]) / period_s - slack), 1.0)
    state[COUNT] = (state[COUNT] + steps % _COUNTS) % _COUNTS
    state[DUE] += steps * period_s
    ahead_s = time_s - state[DUE]
    if not state[SHARED]:
        state[DUE] += tracking * ahead_s
    elif ahead_s <= 0.0:
        # The samples that share a stamp were taken within its grain.
        back_s = tracking * max(-ahead_s - state[GRAIN], 0.0)
        state[DUE] -= back_s
        if state[CREDIT] < _MOST_JITTER * period_s:
            state[CREDIT] += back_s
    elif settled:
        drift_s = min(ahead_s, state[CREDIT])
        state[DUE] += drift_s
        state[CREDIT] -= drift_s
    else:
        state[DUE] += _NOT_BEFORE_STAMP * ahead_s
    if settled:
        state[LOSING] += _PART_OF_SHARE * (min(steps - 1.0, _MOST_AT_ONCE) - state[LOSING])
        # Towards what drift may be unseen: of a faster device samples are too early all the time.
        unseen_s = _MOST_DRIFT * period_s if state[LOSING] < _LOSING else 0.0
        step_s = _DRIFT * passed_s
        state[CREDIT] += min(max(unseen_s - state[CREDIT], -step_s), step_s)


@njit(cache=True, nogil=True, error_model="numpy")
def count_stamps(
    times_s: Values, period_s: float, tracking: float, back_s: float, leap_s: float, states: Values
) -> Places:
    """Sample counts from time stamps, modulo 2^32; see `drivers.serial.lines.DeviceTime`.

    Args:
        times_s: float64 ``[n]``.
        period_s: nominal time between samples.
        tracking: share of a stamp's deviation by which the sampling instants are corrected.
        back_s: how far behind the newest one the stamp of a line may be that was overtaken.
        leap_s: how far ahead of it a stamp may be, for others to be believed to go on from there.
        states: float64 ``[2, KNOWN]``, what is known; and what was known before the newest stamp if that is
            far from the one before, and may be damaged. Their stamp is NaN if there is none. Changed.

    Returns:
        int64 ``[n]``.
    """
    counts = np.empty(len(times_s), np.int64)
    now, before = states[0], states[1]
    for k in range(len(times_s)):
        time_s = times_s[k]
        if not now[STAMP] - back_s <= time_s <= now[STAMP] + leap_s:
            if before[STAMP] - back_s <= time_s <= before[STAMP] + leap_s:
                now[:] = before
                before[STAMP] = np.nan
            elif np.isnan(before[STAMP]):
                before[:] = now
        else:
            before[STAMP] = np.nan
        if time_s >= now[STAMP]:
            _next_stamp(now, time_s, period_s, tracking)
            counts[k] = np.int64(now[COUNT])
        elif time_s >= now[STAMP] - back_s:
            earlier = max(np.rint((now[DUE] - time_s) / period_s), 1.0)
            counts[k] = np.int64((now[COUNT] - earlier) % _COUNTS)
        else:
            now[:] = np.array([0.0, time_s, time_s, np.inf, 0.0, 0.0, 0.0, 0.0])
            counts[k] = 0
    return counts
