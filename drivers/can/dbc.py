"""Frame layouts from DBC files."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.errors.buses import DBC_FILE, DBC_SIGNAL, NOT_IN_ONE_FRAME, UNFIT_COUNTER
from daqsvc.errors.machine_file import NO_SUCH_NAME
from daqsvc.settings.files import UnreadableFileError, read_bounded, shortened
from daqsvc.settings.packing import LARGEST_SCALE, LEAST_SCALE
from daqsvc.settings.problems import Finding, choice
from drivers.can.settings import DbcMessage
from drivers.fields import j1939_valid_raw
from drivers.frames import ByteOrder, Counts, Field, FrameLayout, Kind, LayoutError, Selector

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

    from daqsvc.settings.problems import KeyPath
    from drivers.can.settings import DbcLayout


def layout_from_dbc(
    path: Path,
    message: str,
    *,
    counter: str | None,
    counts: Counts,
    channels: Mapping[str, Sequence[str]],
    valid_raw: Mapping[str, tuple[float, float]] | None = None,
    units: Mapping[str, tuple[float, float]] | None = None,
) -> FrameLayout:
    """The layout of one message of a DBC file.

    Multiplexed signals are those of some pages of the message: the layout then has only the frames with all
    of its signals, and the counter must count these alone.

    Args:
        path: the DBC file.
        message: name of the message.
        counter: name of the counter signal; None if there is none.
        counts: what it counts.
        channels: for each channel the signals of its consecutive samples.
        valid_raw: see `FrameLayout`.
        units: gain and shift from the unit of the signals, by channel; others stay as they are.

    Raises:
        LayoutError: the file, the message or a signal is not there, no frame has all of the signals, or
            cantools is not installed.
    """
    try:
        # An extra, and slow to import.
        from cantools.database import can, load_file  # noqa: PLC0415
        from cantools.database.errors import Error  # noqa: PLC0415
    except ImportError as error:
        raise LayoutError(
            f"reading {path} needs cantools; install it with: pip install 'daqsvc[dbc]'"
        ) from error
    try:
        database = load_file(path)
        if not isinstance(database, can.Database):
            raise LayoutError(f"{path} describes no CAN messages; give a DBC file")
        described = database.get_message_by_name(message)
    except (OSError, KeyError, UnicodeError, Error) as error:
        raise LayoutError(f"message {message!r} of {path} cannot be read: {error}") from error
    signals = {signal.name: signal for signal in described.signals}

    def field(name: str) -> Field:
        if name not in signals:
            raise LayoutError(f"message {message!r} of {path} has no signal {name!r}; it has {list(signals)}")
        return signal_field(signals[name])

    names = [] if counter is None else [counter]
    names += [name for column in channels.values() for name in column]
    cells = {name: field(name) for name in names}
    pages = selecting_values(signals, names)
    if not all(pages.values()):
        raise LayoutError(
            f"no frame of message {message!r} of {path} holds all of {names}: they are on different pages of "
            "its multiplexer; make a stream for each page"
        )
    rows = list(zip(*channels.values(), strict=True))
    gain, shift = np.array([(units or {}).get(name, (1.0, 0.0)) for name in channels]).reshape(-1, 2).T
    by_channel = {
        name: {j1939_valid(described, signals[one]) for one in column} for name, column in channels.items()
    }
    of_j1939 = {name: only for name, (only, *more) in by_channel.items() if only is not None and not more}
    return FrameLayout(
        frame_id=described.frame_id,
        extended=described.is_extended_frame,
        length=described.length,
        channels=tuple(channels),
        fields=tuple(tuple(cells[name] for name in row) for row in rows),
        scale=np.array([[float(signals[name].scale) for name in row] for row in rows]) * gain,
        offset=np.array([[float(signals[name].offset) for name in row] for row in rows]) * gain + shift,
        counter=None if counter is None else cells[counter],
        counts=counts,
        any_priority=described.protocol == "j1939",
        valid_raw={**of_j1939, **(valid_raw or {})},
        selectors=tuple(Selector(name, field(name), values) for name, values in pages.items()),
    )


def j1939_valid(message: Message, signal: Signal) -> tuple[float, float] | None:
    """Raw values of a signal that are a measurement by SAE J1939; None where all are.

    A file often leaves out which of its messages are those of J1939 (the attribute VFrameFormat). Then a
    signal of a 29-bit id is one if its stated range is exactly that of the standard, e.g. 0 to 0xFAFF raw.
    """
    valid = j1939_valid_raw(signal_field(signal))
    if valid is None or message.protocol == "j1939":
        return valid
    if not message.is_extended_frame or signal.choices or signal.minimum is None or signal.maximum is None:
        return None
    scale, offset = float(signal.scale), float(signal.offset)
    ends = sorted(raw * scale + offset for raw in valid)
    stated = (float(signal.minimum), float(signal.maximum))
    near = all(abs(one - other) < 0.5 * abs(scale) for one, other in zip(ends, stated, strict=True))
    return valid if near else None


def selecting_values(signals: Mapping[str, Signal], names: Iterable[str]) -> dict[str, frozenset[int]]:
    """Which values of which multiplexers the frames have that hold all of some signals.

    Args:
        signals: all signals of a message, by name.
        names: of the signals that are wanted.

    Returns:
        Raw values by multiplexer, as deep as they are nested; no values where no frame holds them all.
    """
    wanted: dict[str, frozenset[int]] = {}
    for name in names:
        signal = signals[name]
        while signal.multiplexer_signal is not None and signal.multiplexer_ids is not None:
            ids = frozenset(signal.multiplexer_ids)
            wanted[signal.multiplexer_signal] = wanted.get(signal.multiplexer_signal, ids) & ids
            signal = signals[signal.multiplexer_signal]
    return wanted


def never_negative(signal: Signal) -> bool:
    """Whether no value of a signal can be below 0: by its bits, or by what the DBC file states of it."""
    least, most = signal.minimum, signal.maximum
    if least is not None and most is not None and float(least) < float(most) and float(least) >= 0.0:
        return True
    bits = not signal.is_signed and not signal.is_float
    return bits and float(signal.offset) >= 0.0 and float(signal.scale) > 0.0


def signals_by_page(message: Message) -> dict[str, list[str]]:
    """Names of the signals on each page of a multiplexed message; no page if it is not multiplexed.

    A page is named by its selector and the value of it, e.g. ``Page 0``.
    """
    pages: dict[tuple[str, int], list[str]] = {}
    for signal in message.signals:
        for value in signal.multiplexer_ids or ():
            pages.setdefault((f"{signal.multiplexer_signal}", int(value)), []).append(signal.name)
    return {f"{selector} {value}": pages[selector, value] for selector, value in sorted(pages)}


MOST_DBC_BYTES = 4 << 20
"""A larger DBC file describes more messages than a car has; reading it takes minutes."""


# Start, length or page of a signal, or length of a message, of which the parser would make a list each.
_ENDLESS = re.compile(
    r"\bSG_\s[^:@]{0,200}:[^@(]{0,60}?\d{6}|\bBO_\s[^:]{0,200}:\s{0,20}\d{6}|\d\s{0,9}-\s{0,9}\d{6}"
)
_STRING = re.compile(r'"[^"]*"')
_MESSAGE = re.compile(r"^[ \t]*BO_\s", re.MULTILINE)


def check_dbc(layout: DbcLayout, file: Path, at: KeyPath) -> tuple[DbcMessage | None, list[Finding]]:
    """Read the message that ``layout`` names and look for its signals.

    Args:
        layout: names the message and its signals.
        file: the DBC file, as an absolute path.
        at: key path of the layout.

    Returns:
        The message, or None if it cannot be had; and what is wrong.
    """
    database = _database(file, at)
    if isinstance(database, Finding):
        return None, [database]
    messages = {message.name: message for message in database.messages}
    if layout.message not in messages:
        return None, [
            Finding(
                (*at, "message"),
                f"{file} has no such message",
                choice(layout.message, messages),
                code=NO_SUCH_NAME,
            )
        ]
    message = messages[layout.message]
    facts = DbcMessage(
        frame_id=message.frame_id,
        extended=message.is_extended_frame,
        length=message.length,
        signal_bits={signal.name: signal.length for signal in message.signals},
        signal_units={signal.name: signal.unit or "" for signal in message.signals},
        signal_ranges={signal.name: _range(signal) for signal in message.signals if not signal.is_float},
        signal_names={signal.name: _names(signal) for signal in message.signals if signal.choices},
        any_priority=message.protocol == "j1939",
        valid_raw={
            signal.name: valid
            for signal in message.signals
            if (valid := j1939_valid(message, signal)) is not None
        },
        pages=_pages(message, [name for _, name in _asked(layout, at)]),
    )
    return facts, list(_signal_findings(layout, message, at))


def _names(signal: Signal) -> dict[float, str]:
    """What values of a signal mean, by the value in its unit."""
    return {
        raw * float(signal.scale) + float(signal.offset): text
        for raw, choice in (signal.choices or {}).items()
        if (text := f"{choice}".strip()) and text.isprintable()
    }


def messages_of(file: Path) -> list[Message]:
    """Every message that a DBC file describes.

    Raises:
        LayoutError: the file cannot be read, or cantools is not installed.
    """
    database = _database(file, ())
    if isinstance(database, Finding):
        raise LayoutError(f"{database.message}. Remedy: {database.remedy}")
    return list(database.messages)


def signal_field(signal: Signal) -> Field:
    """Where a signal lies in a frame, and how its bits are read.

    Raises:
        LayoutError: it has a width that no number has.
    """
    kind: Kind = "float" if signal.is_float else "signed" if signal.is_signed else "unsigned"
    order: ByteOrder = "little" if signal.byte_order == "little_endian" else "big"
    return Field(signal.start, signal.length, kind, order)


def _database(file: Path, at: KeyPath) -> Database | Finding:
    """What the DBC file describes, or why it cannot be had."""
    here = (*at, "dbc")
    try:
        from cantools.database import can, load_string  # noqa: PLC0415 - an extra, and slow to import
    except ImportError:
        return Finding(
            here, "needs cantools, which is not installed", "pip install 'daqsvc[dbc]'", code=DBC_FILE
        )
    try:
        data = read_bounded(file, MOST_DBC_BYTES)
    except UnreadableFileError as error:
        remedy = error.remedy
        if isinstance(error.__cause__, FileNotFoundError):
            return Finding(
                here,
                f"there is no file {file}",
                "correct the path; a relative one starts at the directory of the machine file",
                code=DBC_FILE,
            )
        return Finding(here, f"{file} {error}", remedy, code=DBC_FILE)
    text = _text(data)
    try:
        _refuse_endless(text)
        database = load_string(text, "dbc")
    except Exception as error:  # noqa: BLE001 - the parser raises what it likes: of lookups, numbers, recursion
        statement, remedy = _why_unreadable(text, error)
        return Finding(here, f"{file} {statement}", remedy, code=DBC_FILE)
    if not isinstance(database, can.Database):
        return Finding(here, f"{file} describes no CAN messages", "give another DBC file", code=DBC_FILE)
    return database


def _why_unreadable(text: str, error: Exception) -> tuple[str, str]:
    """What is wrong with the text of a file that the parser refuses, and the remedy."""
    if not text.strip():
        return "is empty", "copy it again, or export it from its tool again"
    if not _MESSAGE.search(text):
        return "is no DBC file: no line begins with BO_, as messages do", "give the DBC file of the device"
    # Of all formats that it knows, the parser states what does not fit this one.
    words = f"{getattr(error, 'e_dbc', None) or error}".replace(">>!<<", "")
    reason = shortened(" ".join(words.split()) or type(error).__name__, 200)
    remedy = "open it in the tool it came from and export it as DBC again"
    if "overlapping" in reason or "does not fit" in reason:
        remedy = (
            "correct start bit, length or byte order of these signals in the tool it came from (@0: the "
            "start bit is the highest one, @1: the lowest)"
        )
    elif reason.startswith("Invalid syntax"):
        remedy = "correct that line in the tool it came from, or export it as DBC again"
    return f"cannot be read as a DBC file: {reason}", remedy


def _text(data: bytes) -> str:
    """The text of a DBC file: cp1252 by the format, UTF-8 where an editor has saved it so."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def _refuse_endless(text: str) -> None:
    """Refuse a file that the parser would need hours for.

    Raises:
        ValueError: a number of bits, bytes or pages is so large that the parser would list millions.
    """
    plain = _STRING.sub(lambda match: "\n" * match[0].count("\n"), text)
    if (match := _ENDLESS.search(plain)) is not None:
        line = plain.count("\n", 0, match.start()) + 1
        raise ValueError(f"line {line} has a number of bits, bytes or pages that no message has")


def _range(signal: Signal) -> tuple[float, float]:
    """What the raw bits can carry, in the unit of the signal."""
    bits = signal.length
    least, largest = (
        (-(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1) if signal.is_signed else (0.0, 2.0**bits - 1)
    )
    ends = [float(raw * float(signal.scale) + float(signal.offset)) for raw in (least, largest)]
    return min(ends), max(ends)


def _asked(layout: DbcLayout, at: KeyPath) -> list[tuple[KeyPath, str]]:
    """The signals that a layout names, and where."""
    asked: list[tuple[KeyPath, str]] = []
    if layout.counter is not None:
        asked.append(((*at, "counter", "signal"), layout.counter.signal))
    for index, channel in enumerate(layout.channels):
        asked += [
            ((*at, "channels", index, "signals", place), name) for place, name in enumerate(channel.signals)
        ]
    return asked


def _pages(message: Message, names: Iterable[str]) -> dict[str, frozenset[int]]:
    """As the driver reads the signals; no values of a multiplexer where no frame holds them all."""
    signals = {signal.name: signal for signal in message.signals}
    pages: dict[str, frozenset[int]] = {}
    for name in names:
        signal = signals.get(name)
        while signal is not None and signal.multiplexer_signal is not None:
            ids = frozenset(signal.multiplexer_ids or ())
            pages[signal.multiplexer_signal] = pages.get(signal.multiplexer_signal, ids) & ids
            signal = signals.get(signal.multiplexer_signal)
    return pages


def _signal_findings(layout: DbcLayout, message: Message, at: KeyPath) -> Iterator[Finding]:
    signals = {signal.name: signal for signal in message.signals}
    asked = _asked(layout, at)
    for path, name in asked:
        if name not in signals:
            yield Finding(
                path, f'message "{message.name}" has no such signal', choice(name, signals), code=NO_SUCH_NAME
            )
    names = [name for _, name in asked]
    if not all(_pages(message, names).values()):
        yield Finding(
            (*at, "channels"),
            f'no frame of message "{message.name}" holds all of {", ".join(names)}: they are on different '
            "pages of its multiplexer",
            "make a stream for each page, with a counter that is on it",
            code=NOT_IN_ONE_FRAME,
        )
    if layout.counter is not None and layout.counter.signal in signals:
        counter = signals[layout.counter.signal]
        yield from _counter(counter, (*at, "counter", "signal"))
        measured = [name for channel in layout.channels for name in channel.signals]
        if _on_more_pages(message, counter.name, measured):
            yield Finding(
                (*at, "counter", "signal"),
                f'is on more pages of message "{message.name}" than the samples: where it '
                "counts the frames of all pages, those of the others count as lost samples",
                "write no_counter = true in place of counter; keep it if the device counts each page alone",
                fatal=False,
                code=UNFIT_COUNTER,
            )
    for path, name in asked:
        signal = signals.get(name)
        if signal is not None:
            yield from _place(signal, message.length, path)


def values_of(message: Message, selector: str) -> frozenset[int]:
    """All values of a multiplexer that have a page."""
    return frozenset(
        value
        for one in message.signals
        if one.multiplexer_signal == selector
        for value in one.multiplexer_ids or ()
    )


def _on_more_pages(message: Message, counter: str, measured: Iterable[str]) -> bool:
    """Whether frames come that hold the counter, and not these signals."""
    of_counter = _pages(message, [counter])
    return any(
        of_counter.get(selector, values_of(message, selector)) - values
        for selector, values in _pages(message, measured).items()
    )


def _counter(counter: Signal, at: KeyPath) -> Iterator[Finding]:
    """The counter counts from 0 upwards, by 1, over all of its bits."""
    if counter.is_signed or counter.is_float:
        yield Finding(
            at,
            "is signed or a float; a counter runs from 0 upwards and wraps",
            "name the signal that counts, or declare it unsigned (@1+) in the DBC file",
            code=UNFIT_COUNTER,
        )
    elif counter.scale != 1:
        yield Finding(
            at,
            f"has the scale {counter.scale:g} in the DBC file: a counter counts frames or samples one by "
            "one, so its scale must be 1",
            "name a signal that grows by 1; if this one does, write (1,0) in the DBC file",
            code=UNFIT_COUNTER,
        )
    elif counter.maximum is not None:
        largest, all_ones = float(counter.maximum) - float(counter.offset), 2**counter.length - 1
        if largest != all_ones:
            yield Finding(
                at,
                f"ends at {largest:g} by the DBC file, not at {all_ones}: if so, samples are counted as lost "
                "each time it wraps, although none is",
                "see what the device sends: if it ends there, write no_counter = true in place of counter, "
                "else correct the range in the DBC file",
                fatal=False,
                code=UNFIT_COUNTER,
            )


def _place(signal: Signal, length: int, at: KeyPath) -> Iterator[Finding]:
    """The signal lies within its message."""
    if signal.start < 0 or _end_bit(signal) > 8 * length:
        yield Finding(
            at,
            f"does not lie within the {length} bytes of its message in the DBC file",
            "correct the signal, or the length of the message, in the DBC file",
            code=DBC_SIGNAL,
        )
    if at[-2] == "signals":
        yield from _scale(signal, at)


def _end_bit(signal: Signal) -> int:
    """One past the last bit of a signal, as they go over the bus."""
    if signal.byte_order == "little_endian":
        return int(signal.start + signal.length)
    return int(8 * (signal.start // 8) + 7 - signal.start % 8 + signal.length)


def _scale(signal: Signal, at: KeyPath) -> Iterator[Finding]:
    """Samples can be told apart, and are numbers."""
    scale, offset = float(signal.scale), float(signal.offset)
    if scale == 0:
        yield Finding(
            at,
            "has the scale 0 in the DBC file, which would make every sample the same",
            "write in the DBC file what one count of the raw value is worth, e.g. (0.0005,0)",
            code=DBC_SIGNAL,
        )
    elif not LEAST_SCALE <= abs(scale) <= LARGEST_SCALE or not abs(offset) <= LARGEST_SCALE:
        yield Finding(
            at,
            f"has the scale {scale:g} and the offset {offset:g} in the DBC file, which no quantity has",
            "write in the DBC file what one count of the raw value is worth, e.g. (0.0005,0)",
            code=DBC_SIGNAL,
        )
    if signal.is_float and signal.length not in {32, 64}:
        yield Finding(
            at,
            f"is a float of {signal.length} bits in the DBC file, and there is none",
            "correct its length to 32 or 64, or its type (SIG_VALTYPE_), in the DBC file",
            code=DBC_SIGNAL,
        )
    elif not 1 <= signal.length <= 64:
        yield Finding(
            at,
            f"has {signal.length} bits in the DBC file",
            "correct its length there: a number has 1 to 64",
            code=DBC_SIGNAL,
        )
