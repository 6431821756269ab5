"""Serial ports, and how samples lie in the frames or lines that come over them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from daqsvc.errors.machine_file import BAD_TEXT
from daqsvc.rounding import counted
from daqsvc.settings.addresses import DevicePath, serial_port
from daqsvc.settings.buses import Bus, Device, Layout, WireRange
from daqsvc.settings.packing import (
    CRC_BYTES,
    Channel,
    Counter,
    Scale,
    packed_range,
    samples_in_words,
)
from daqsvc.settings.section import MOST_CHANNELS, Name, Quantity, Section

if TYPE_CHECKING:
    from collections.abc import Mapping

LONGEST_PAYLOAD = 4096
LONGEST_SYNC_WORD = 8
LONGEST_BESIDE = 32
"""Characters in front of a number, behind it, or of the first field of a line."""
UNITS_PER_S: Mapping[str, float] = {"s": 1.0, "ms": 1e3, "us": 1e6}
"""What the time of a line may be in, the coarsest first."""
_OF_NUMBERS = frozenset("0123456789+-., ")


def _sync_word(text: str) -> str:
    try:
        length = len(bytes.fromhex(text))
    except ValueError:
        length = 0
    if not 1 <= length <= LONGEST_SYNC_WORD:
        raise PydanticCustomError(
            "sync_word",
            f"is not 1 to {LONGEST_SYNC_WORD} bytes in hexadecimal",
            {"remedy": 'write the bytes that each frame begins with, e.g. "a55a"', "code": BAD_TEXT},
        )
    return text


def _separator(text: str) -> str:
    if not text.isascii() or text.isalnum() or text in "+-.*\r\n\0":
        raise PydanticCustomError(
            "separator",
            "cannot stand between numbers",
            {"remedy": 'write the character that the device puts there, e.g. "," or ";"', "code": BAD_TEXT},
        )
    return text


def _delimiter(text: str) -> str:
    if not text.isascii() or text.isalnum() or text in "+-.* ,":
        raise PydanticCustomError(
            "delimiter",
            "cannot be the end of a line",
            {"remedy": r'write the character that the device puts there, e.g. "\n" or ";"', "code": BAD_TEXT},
        )
    return text


def _first_field(text: str) -> str:
    if not text or not text.isprintable() or text != text.strip() or "*" in text:
        raise PydanticCustomError(
            "first_field",
            "cannot be the first field of a line",
            {
                "remedy": 'write what each line begins with up to the first separator, e.g. "$VIB"',
                "code": BAD_TEXT,
            },
        )
    return text


class SerialBus(Bus):
    """What all serial ports have."""

    driver: Annotated[Literal["serial"], Field(description="which driver reads the bus", examples=["serial"])]
    port: Annotated[
        DevicePath,
        Field(
            description="path of the port; those below /dev/serial/by-id stay the same when it is re-plugged",
            examples=["/dev/serial/by-id/usb-FTDI_FT232R_A1B2C3D4-if00-port0"],
        ),
    ]
    baud: Annotated[int, Field(ge=50, le=12_000_000, description="bit rate of the line", examples=[921_600])]
    data_bits: Literal[7, 8] = Field(default=8, description="data bits of each character")
    parity: Literal["none", "even", "odd"] = Field(default="none", description="parity bit of each character")
    stop_bits: Literal[1, 2] = Field(default=1, description="stop bits of each character")
    flow_control: Literal["none", "rts-cts", "xon-xoff"] = Field(
        default="none", description="whether and how the device is made to wait"
    )
    low_latency: bool = Field(default=False, description="have the port's driver pass bytes on at once")

    @property
    def device(self) -> Device:
        """See `Bus.device`."""
        return serial_port("port", self.port)

    @property
    def bits_per_character(self) -> int:
        """Bits that a character takes on the wire, start bit included."""
        return 1 + self.data_bits + (self.parity != "none") + self.stop_bits

    def _line(self) -> str:
        character = f"{self.data_bits}{self.parity[0].upper()}{self.stop_bits}"
        return f"serial {self.port}, {self.baud} bit/s {character}"


class _BinaryBus(SerialBus):
    """What serial ports with binary frames have."""

    crc: Literal["ibm-3740", "xmodem", "none"] = Field(
        default="ibm-3740", description="the CRC-16 at the end of each frame"
    )
    crc_order: Literal["big", "little"] = Field(default="big", description="byte order of the CRC")
    stream_ids: bool = Field(
        default=False, description="whether each frame begins with a byte that names its stream"
    )

    @property
    def crc_bytes(self) -> int:
        """Bytes that the CRC takes."""
        return 0 if self.crc == "none" else CRC_BYTES


class CobsBus(_BinaryBus):
    """A serial port with COBS frames, each followed by a zero byte."""

    kind: ClassVar[str] = 'a serial port with framing = "cobs"'

    framing: Annotated[Literal["cobs"], Field(description="what tells frames apart", examples=["cobs"])]

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        return f"{self._line()}, COBS frames, CRC {self.crc}"


class SyncBus(_BinaryBus):
    """A serial port with frames of fixed length behind sync words."""

    kind: ClassVar[str] = 'a serial port with framing = "sync"'

    framing: Annotated[Literal["sync"], Field(description="what tells frames apart", examples=["sync"])]
    sync_word: Annotated[
        str,
        AfterValidator(_sync_word),
        Field(
            max_length=64,
            description="the bytes that each frame begins with, in hexadecimal",
            examples=["a55a"],
        ),
    ]

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        return f"{self._line()}, frames behind {self.sync_word}, CRC {self.crc}"


class LinesBus(SerialBus):
    """A serial port with lines of text."""

    kind: ClassVar[str] = 'a serial port with framing = "lines"'

    framing: Annotated[Literal["lines"], Field(description="what tells frames apart", examples=["lines"])]
    checksum: Literal["none", "xor", "crc16"] = Field(
        default="none",
        description="checksum behind a * at the end of each line, in hexadecimal; xor as in NMEA 0183",
    )
    delimiter: Annotated[
        str,
        AfterValidator(_delimiter),
        Field(min_length=1, max_length=1),
    ] = Field(default="\n", description="character at the end of each line")

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        checksum = "no checksum" if self.checksum == "none" else f"checksum {self.checksum}"
        return f"{self._line()}, lines of text, {checksum}"


class SerialLayout(Layout):
    """Samples side by side in a binary frame, sample after sample: s0c0 s0c1 s0c2 s1c0 ..."""

    kind: ClassVar[str] = "a layout of a binary serial frame"
    mark: ClassVar[str] = "payload_length"
    number_keys: ClassVar[str] = "byte_order and type"

    payload_length: Annotated[
        int,
        Field(
            ge=1,
            le=LONGEST_PAYLOAD,
            description="bytes of a frame without sync word, stream id and CRC",
            examples=[124],
        ),
    ]
    stream_id: Annotated[int, Field(ge=0, le=255)] | None = Field(
        default=None, description="the byte that names the stream, on a port with stream_ids", examples=[1]
    )
    byte_order: Literal["little", "big"] = Field(
        default="little", description="byte order of counter and samples"
    )
    counter: Annotated[
        Counter,
        Field(
            description="the counter in each frame", examples=['{ byte = 0, bits = 32, counts = "samples" }']
        ),
    ]
    first_byte: Annotated[
        int, Field(ge=0, lt=LONGEST_PAYLOAD, description="where the samples start", examples=[4])
    ]
    samples_per_frame: Annotated[
        int, Field(ge=1, le=LONGEST_PAYLOAD, description="samples per channel", examples=[20])
    ]
    channels: Annotated[
        tuple[Channel, ...],
        Field(
            strict=False,
            min_length=1,
            max_length=MOST_CHANNELS,
            description="the channels of each sample",
            examples=['[{ name = "x", type = "int16", scale = 0.0005 }]'],
        ),
    ]

    @property
    def samples_end_byte(self) -> int:
        """One past the last byte of the samples."""
        return self.first_byte + self.samples_per_frame * sum(channel.raw_bytes for channel in self.channels)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in the order of a sample."""
        return tuple(channel.name for channel in self.channels)

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        named = "" if self.stream_id is None else f"id {self.stream_id}, "
        samples = samples_in_words(self.samples_per_frame, len(self.channels))
        return f"{named}{self.payload_length} bytes, {samples}, {self.counter.bits} bit count"

    def wire_range(self, channel: str, facts: Any) -> WireRange | None:
        """See `Layout.wire_range`."""
        del facts
        return packed_range(self.channels, channel)


def _beside(text: str, where: str, example: str) -> str:
    if not text.isprintable() or text != text.strip() or not set(text) - _OF_NUMBERS:
        raise PydanticCustomError(
            "beside_number",
            f"cannot be the text {where} a number",
            {
                "remedy": f'write what the device puts there, without blanks around it, e.g. "{example}"',
                "code": BAD_TEXT,
            },
        )
    return text


def _in_front(text: str) -> str:
    return _beside(text, "in front of", "V=")


def _behind(text: str) -> str:
    return _beside(text, "behind", "mm/s")


_InFront = Annotated[str, AfterValidator(_in_front), Field(min_length=1, max_length=LONGEST_BESIDE)]
_Behind = Annotated[str, AfterValidator(_behind), Field(min_length=1, max_length=LONGEST_BESIDE)]
_IN_FRONT = "text in front of the number, such as its name; a line with another text there is not read"
_BEHIND = "text behind the number, such as its unit; a line with another text there is not read"


class LineCounter(Section):
    """The column that counts lines, and so samples."""

    column: Annotated[Name, Field(description="name of the column that counts", examples=["seq"])]
    bits: Literal[8, 16, 32] = Field(
        default=32, description="width of the counter: it begins again at 0 after 2**bits"
    )
    prefix: _InFront | None = Field(default=None, description=_IN_FRONT, examples=["n="])
    suffix: _Behind | None = Field(default=None, description=_BEHIND, examples=["#"])


class LineTime(Section):
    """The column with the time of the device's own clock, of a device that does not count its lines."""

    column: Annotated[Name, Field(description="name of the column with the time", examples=["t"])]
    unit: Annotated[Literal["s", "ms", "us"], Field(description="unit of that time", examples=["ms"])]
    prefix: _InFront | None = Field(default=None, description=_IN_FRONT, examples=["t="])
    suffix: _Behind | None = Field(default=None, description=_BEHIND, examples=["ms"])


class LineChannel(Section):
    """One quantity of a line: wire value = value * scale + offset, as for a channel of a frame."""

    name: Annotated[Name, Field(description="name of the channel, and of its column", examples=["x"])]
    scale: Scale = Field(
        default=1.0, description="what a 1 in the line is worth, in V or the unit of the sensor"
    )
    offset: Quantity = Field(
        default=0.0, description="what a 0 in the line is worth, in V or the unit of the sensor"
    )
    prefix: _InFront | None = Field(default=None, description=_IN_FRONT, examples=["V="])
    suffix: _Behind | None = Field(default=None, description=_BEHIND, examples=["mm/s"])


class LineLayout(Layout):
    """A sample of every channel as the columns of a line."""

    kind: ClassVar[str] = "a layout of a line of text"
    mark: ClassVar[str] = "line"

    line: Annotated[
        tuple[Name, ...],
        Field(
            strict=False,
            min_length=1,
            max_length=MOST_CHANNELS,
            description="names of the columns; those named nowhere else are left out",
            examples=['["seq", "x", "y"]'],
        ),
    ]
    separator: Annotated[str, AfterValidator(_separator), Field(min_length=1, max_length=1)] = Field(
        default=",",
        description="character between two columns; of blanks there may be several, also in front",
    )
    decimal: Literal[".", ","] = Field(default=".", description="decimal mark of the numbers")
    prefix: Annotated[str, AfterValidator(_first_field), Field(max_length=LONGEST_BESIDE)] | None = Field(
        default=None,
        description="first field of each line of this stream, in UTF-8 or Latin-1 if it has letters beyond "
        "ASCII; lines with another one are not of it",
        examples=["$VIB"],
    )
    counter: LineCounter | None = Field(default=None, description="the column that counts lines")
    time: LineTime | None = Field(
        default=None,
        description="the column with the device's time, of a device that does not count its lines",
    )
    no_counter: bool = Field(
        default=False,
        description="true if lines carry neither: losses are then estimated from the times of arrival",
    )
    channels: Annotated[
        tuple[LineChannel, ...],
        Field(
            strict=False,
            min_length=1,
            max_length=MOST_CHANNELS,
            description="the channels of each sample",
            examples=['[{ name = "x" }]'],
        ),
    ]

    @property
    def beside(self) -> dict[str, tuple[str, str]]:
        """The texts in front of and behind the number of each column that is read; empty where none is."""
        read = {one.name: one for one in self.channels}
        texts = {name: (one.prefix or "", one.suffix or "") for name, one in read.items()}
        place = self.counter or self.time
        return texts if place is None else {place.column: (place.prefix or "", place.suffix or ""), **texts}

    @property
    def samples_per_frame(self) -> int:
        """One line, one sample of each channel."""
        return 1

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in the order of a sample."""
        return tuple(channel.name for channel in self.channels)

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        named = "" if self.prefix is None else f"{self.prefix}, "
        place = "no count" if self.time is None else "device's time"
        if self.counter is not None:
            place = f"{self.counter.bits} bit count"
        return f"{named}{len(self.channels)} of {counted(len(self.line), 'column')}, {place}"


FRAMINGS: dict[str, type[SerialBus]] = {"cobs": CobsBus, "sync": SyncBus, "lines": LinesBus}
