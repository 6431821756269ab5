"""CAN buses, and how samples lie in the frames on them."""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - a field of a dataclass
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from daqsvc.errors.buses import FRAME_LENGTH
from daqsvc.settings.buses import Bus, Device, Layout, WireRange
from daqsvc.settings.files import FilePath  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.packing import NO_COUNTER, VALID_RAW, Channel, Counter, Counts, PackedFields, ValidRaw
from daqsvc.settings.section import MOST_CHANNELS, InSchema, Name, Section, Text

CAN_FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Payload lengths in bytes that a CAN FD frame can have (ISO 11898-1); up to 8 also in classic CAN."""
PRIORITY = 0x1C00_0000
"""Bits of a J1939 id that state how urgent it is, and nothing else (SAE J1939-21, 5.2)."""


def _payload_length(length: int) -> int:
    if length not in CAN_FD_LENGTHS:
        raise PydanticCustomError(
            "payload_length",
            "is not a length that a CAN frame can have",
            {
                "remedy": "take 0 to 8 (classic CAN), or 12, 16, 20, 24, 32, 48 or 64 (CAN FD)",
                "code": FRAME_LENGTH,
            },
        )
    return length


class CanRecord(Section):
    """Files that every frame received on a CAN bus is recorded in."""

    folder: Annotated[
        FilePath,
        Field(
            description="folder of the files, relative to the machine file; it must exist",
            examples=["/var/lib/daqsvc/can"],
        ),
    ]
    format: Literal["blf", "asc", "candump"] = Field(default="blf", description="which kind of CAN log")
    file_mb: Annotated[int, Field(ge=1, le=4000)] = Field(
        default=64, description="size of a file, at which another one is begun"
    )
    keep_mb: Annotated[int, Field(ge=2, le=100_000_000)] = Field(
        default=2048, description="size of all files together, beyond which the oldest are deleted"
    )


class CanBus(Bus):
    """A CAN or CAN FD bus: SocketCAN read directly, any other interface through python-can."""

    kind: ClassVar[str] = "a CAN bus"

    driver: Annotated[Literal["can"], Field(description="which driver reads the bus", examples=["can"])]
    interface: Annotated[Text, Field(description="the python-can interface", examples=["socketcan"])]
    channel: Annotated[Text, Field(description="the channel of that interface", examples=["can0"])]
    fd: Annotated[bool, Field(description="whether CAN FD frames are on the bus", examples=[True])] = False
    bitrate: Annotated[int, Field(ge=1000, le=1_000_000)] | None = Field(
        default=None, description="bit rate of the bus", examples=[500_000]
    )
    data_bitrate: Annotated[int, Field(ge=1000, le=20_000_000)] | None = Field(
        default=None, description="bit rate of the data of CAN FD frames", examples=[2_000_000]
    )
    options: dict[str, Any] = Field(
        default={},
        description="further options, given to python-can as they are; none with SocketCAN",
        examples=["{ receive_own_messages = false }"],
    )
    receive_buffer_bytes: Annotated[int, Field(ge=4096, le=1 << 30)] = Field(
        default=4 << 20,
        description="SocketCAN: receive buffer in the kernel; a frame takes some 400 bytes of it",
    )
    filter: bool | None = Field(
        default=None,
        description="SocketCAN: let the kernel leave out frames of no stream, uncounted; if left out, it "
        "does so unless the bus is recorded",
        examples=[True],
    )
    record: CanRecord | None = Field(default=None, description="record every frame received in files")

    @property
    def device(self) -> Device:
        """See `Bus.device`: each of two buses would take the other's frames for foreign ones."""
        remedy = "put all streams of the interface on one bus, or correct the channel"
        return Device("channel", ("can", self.interface, self.channel), remedy)


class PlainLayout(PackedFields):
    """Samples side by side in a frame, sample after sample: s0c0 s0c1 s0c2 s1c0 ..."""

    kind: ClassVar[str] = "a layout without a DBC file"

    id: Annotated[int, Field(ge=0, le=0x1FFF_FFFF, description="CAN id of the frames", examples=["0x101"])]
    extended: bool = Field(default=False, description="whether the id has 29 bits rather than 11")
    any_priority: bool = Field(
        default=False,
        description="SAE J1939: frames with another priority than the id's are the same, and unsigned raw "
        "values from 0xfb.. on are no measurements",
    )
    length: Annotated[
        int,
        Field(ge=0, le=64, description="payload length in bytes", examples=[64]),
        AfterValidator(_payload_length),
        InSchema(enum=list(CAN_FD_LENGTHS)),
    ]
    byte_order: Literal["little", "big"] = Field(
        default="little", description="byte order of counter and samples"
    )
    counter: Counter | None = Field(
        default=None,
        description="the counter in each frame",
        examples=['{ byte = 0, bits = 16, counts = "samples" }'],
    )
    no_counter: bool = Field(default=False, description=NO_COUNTER)
    crc_byte: Annotated[int, Field(ge=0, le=62)] | None = Field(
        default=None, description="byte where a CRC-16 starts", examples=[62]
    )
    first_byte: Annotated[int, Field(ge=0, le=63, description="where the samples start", examples=[2])]
    samples_per_frame: Annotated[int, Field(ge=1, le=64, description="samples per channel", examples=[10])]
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
    def frame_length(self) -> int:
        """See `PackedFields.frame_length`."""
        return self.length


@dataclass(frozen=True, slots=True)
class DbcMessage:
    """What the checks of a machine file need to know of a message in a DBC file.

    Attributes:
        frame_id: CAN id.
        extended: whether the id has 29 bits.
        length: payload bytes.
        signal_bits: width of each signal in bits, by name.
        signal_units: unit of each signal, by name; empty if the DBC gives none.
        signal_ranges: least and largest value that each signal can carry, in its unit; none of a float.
        signal_names: what values of each signal mean, where the DBC file names some.
        any_priority: whether it is one of SAE J1939, whatever the priority in its id.
        valid_raw: least and largest raw value that is a measurement, by signal, where SAE J1939 has others.
        pages: which values of which multiplexers the frames have that hold the layout's signals.
    """

    frame_id: int
    extended: bool
    length: int
    signal_bits: Mapping[str, int]
    signal_units: Mapping[str, str]
    signal_ranges: Mapping[str, tuple[float, float]]
    signal_names: Mapping[str, Mapping[float, str]]
    any_priority: bool
    valid_raw: Mapping[str, tuple[float, float]]
    pages: Mapping[str, frozenset[int]]


class DbcCounter(Section):
    """The running count, as a signal of the DBC message."""

    signal: Annotated[Text, Field(description="the counter's signal", examples=["Sequence"])]
    counts: Annotated[
        Counts,
        Field(
            description="what the counter counts; of samples, the first one in the frame",
            examples=["frames"],
        ),
    ]


class DbcChannel(Section):
    """One quantity in a DBC message: its consecutive samples are their own signals."""

    name: Annotated[Name, Field(description="name of the channel", examples=["x"])]
    signals: Annotated[
        tuple[Text, ...],
        Field(
            strict=False,
            min_length=1,
            max_length=512,
            description="signals that hold its samples, oldest first",
            examples=['["AccelX"]'],
        ),
    ]
    valid_raw: ValidRaw | None = Field(default=None, description=VALID_RAW, examples=["[-32767, 32767]"])


class DbcLayout(Layout):
    """Samples as signals of a message in a DBC file."""

    kind: ClassVar[str] = "a layout from a DBC file"
    mark: ClassVar[str] = "dbc"

    dbc: Annotated[
        FilePath, Field(description="the DBC file, relative to the machine file", examples=["triaxial.dbc"])
    ]
    message: Annotated[
        Text,
        Field(description="the message that carries the samples", examples=["Acceleration"]),
    ]
    counter: DbcCounter | None = Field(
        default=None,
        description="the counter in each frame",
        examples=['{ signal = "Sequence", counts = "frames" }'],
    )
    no_counter: bool = Field(default=False, description=NO_COUNTER)
    channels: Annotated[
        tuple[DbcChannel, ...],
        Field(
            strict=False,
            min_length=1,
            max_length=MOST_CHANNELS,
            description="the channels of each sample",
            examples=['[{ name = "x", signals = ["AccelX"] }]'],
        ),
    ]

    @property
    def samples_per_frame(self) -> int:
        """Samples of each channel in a frame."""
        return len(self.channels[0].signals)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in the order of a sample."""
        return tuple(channel.name for channel in self.channels)

    def wire_range(self, channel: str, facts: Any) -> WireRange | None:
        """See `Layout.wire_range`."""
        signals = next((item.signals for item in self.channels if item.name == channel), ())
        ranges = facts.signal_ranges if isinstance(facts, DbcMessage) else {}
        known = [ranges[signal] for signal in signals if signal in ranges]
        if not known or len(known) < len(signals):
            return None
        return WireRange(min(low for low, _ in known), max(high for _, high in known), 0.0)

    def value_names(self, channel: str, facts: Any) -> Mapping[float, str]:
        """See `Layout.value_names`: by the value table of the DBC file."""
        signals = next((item.signals for item in self.channels if item.name == channel), ())
        names = facts.signal_names if isinstance(facts, DbcMessage) else {}
        return names.get(signals[0], {}) if len(signals) == 1 else {}
