"""What ``daqsvc sniff serial --json`` prints."""

from __future__ import annotations

from typing import Annotated, Any, NotRequired, TypedDict

from drivers.counter_search import FrameCounter


class TriedBaud(TypedDict):
    """A baud rate that was tried.

    Attributes:
        baud: the baud rate.
        score: how much the bytes look like lines or frames.
    """

    baud: int
    score: float


class ColumnFigures(TypedDict):
    """A column of lines.

    Attributes:
        name: as the header has it, else `c1`, `c2`, ...
        numeric: whether it is a number in all lines that are not damaged.
        prefix: text in front of the number that is the same in all of them, such as a name; null without one.
        unit: text behind the number that is the same in all of them, such as a unit; null without one.
        min: the least value.
        max: the greatest value.
        counts: whether it counts the lines.
        turns_at: the power of ten at which it begins again at 0; null if it does not.
        time_unit: unit of the time in it; null if it is no time.
        last: what was in it last.
        swings: whether it swings about 0, as a vibration does.
        absent: in how many lines it has no value, such as `---`.
        absent_text: its text in the last one of these; null if there are none.
        bits: width of a counter that was seen to begin again at 0; null if that was not seen.
    """

    name: str
    numeric: bool
    prefix: str | None
    unit: str | None
    min: float
    max: float
    counts: bool
    turns_at: int | None
    time_unit: str | None
    last: str
    swings: bool
    absent: int
    absent_text: str | None
    bits: int | None


class SerialFigures(TypedDict):
    """What is on a serial port; keys after `framing` are there if lines or frames were found.

    Attributes:
        bus: kind of the bus.
        port: name of the port.
        baud: the baud rate that fits best.
        overrun_baud: baud rate at which more bytes came than it carries; `baud` then carries them; else null.
        any_baud: whether the port brings the same at every baud rate.
        character: bits of a character, e.g. `8N1`.
        bytes: bytes that were heard.
        framing_errors: characters that were damaged.
        score: how much the bytes look like lines or frames.
        tried: baud rates that were tried.
        first_bytes: the first bytes, in hexadecimal digits.
        rate_hz: samples per second; null if they are not known.
        framing: `lines`, `sync` or `cobs`; null if none was found.
        delimiter: of lines: what ends one.
        separator: of lines: what is between columns; empty if there is one column.
        decimal: of lines: decimal mark of the numbers.
        prefix: of lines: first field, where it is the same word in all; else empty.
        checksum: of lines: `xor`, `crc16`, `unknown` or `none`.
        header: of lines: whether the first line names the columns.
        columns: of lines: the columns.
        lines: of lines: the first ones.
        other_prefixes: of lines: first fields of lines of other kinds.
        lines_heard: of lines: how many whole ones there were.
        lines_damaged: of lines: how many of them are not like most.
        damaged_line: of lines: one that is not; null if there are none.
        sync_word: of frames: the bytes that each begins with, in hexadecimal digits; empty with COBS.
        frame_length: of frames: bytes of one.
        payload_length: of frames: bytes between sync word and CRC.
        crc: of frames: name of the check; empty if none was found.
        crc_order: of frames: byte order of the check.
        crc_bytes: of frames: bytes of the check.
        crc_from: of frames: the first byte that the check covers.
        frames_passing: of frames: share of those that are not damaged.
        counter: of frames: what looks like a counter; null if nothing does.
        counter_bits: of frames: bits that the counter is taken to have; null without one.
        counter_byte: of frames: the first byte of these; null without one.
        counter_order: of frames: byte order of these; null without one.
        counter_guess: of frames: whether bits of the counter are a guess, as its upper bytes did not change.
    """

    bus: str
    port: str
    baud: int
    overrun_baud: int | None
    any_baud: bool
    character: str
    bytes: int
    framing_errors: int
    score: float
    tried: list[TriedBaud]
    first_bytes: str
    rate_hz: float | None
    framing: str | None
    delimiter: NotRequired[str]
    separator: NotRequired[str]
    decimal: NotRequired[str]
    prefix: NotRequired[str]
    checksum: NotRequired[str]
    header: NotRequired[bool]
    columns: NotRequired[list[ColumnFigures]]
    lines: NotRequired[list[str]]
    other_prefixes: NotRequired[list[str]]
    lines_heard: NotRequired[int]
    lines_damaged: NotRequired[int]
    damaged_line: NotRequired[str | None]
    sync_word: NotRequired[str]
    frame_length: NotRequired[int]
    payload_length: NotRequired[int]
    crc: NotRequired[str]
    crc_order: NotRequired[str]
    crc_bytes: NotRequired[int]
    crc_from: NotRequired[int]
    frames_passing: NotRequired[float]
    counter: NotRequired[Annotated[dict[str, Any], FrameCounter] | None]
    counter_bits: NotRequired[int | None]
    counter_byte: NotRequired[int | None]
    counter_order: NotRequired[str | None]
    counter_guess: NotRequired[bool]
