"""Buses, the streams of samples on them, and how the samples lie in a frame."""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - keeps the signature of `_bus_kind` resolvable
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from daqsvc.settings.files import FilePath  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.modbus import (
    WAYS,
    FifoLayout,
    ModbusRtuBus,
    ModbusTcpBus,
    RegistersLayout,
    RingLayout,
    WaveformLayout,
)
from daqsvc.settings.packing import (
    VALID_RAW,
    Channel,
    Counter,
    Counts,
    StartPolicy,
    ValidRaw,
)
from daqsvc.settings.replay import ReplayBus, TableLayout
from daqsvc.settings.section import MOST_CHANNELS, Kinds, Name, Section, Text
from daqsvc.settings.serial import FRAMINGS, CobsBus, LineLayout, LinesBus, SerialLayout, SyncBus

CAN_FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Payload lengths in bytes that a CAN FD frame can have (ISO 11898-1); up to 8 also in classic CAN."""


NO_COUNTER = "says that the frames carry none: what is lost is then estimated from the times of arrival"


def _payload_length(length: int) -> int:
    if length not in CAN_FD_LENGTHS:
        raise PydanticCustomError(
            "payload_length",
            "is not a length that a CAN frame can have",
            {"remedy": "take 0 to 8 (classic CAN), or 12, 16, 20, 24, 32, 48 or 64 (CAN FD)"},
        )
    return length


class CanRecord(Section):
    """Files that every frame received on a CAN bus is recorded in."""

    folder: Annotated[
        FilePath,
        Field(
            description="holds the files, relative to the machine file; must be there",
            examples=["/var/lib/daqsvc/can"],
        ),
    ]
    format: Literal["blf", "asc", "candump"] = Field(default="blf", description="which kind of CAN log")
    file_mb: Annotated[int, Field(ge=1, le=4000)] = Field(
        default=64, description="a file that is this large is ended, and another one begun"
    )
    keep_mb: Annotated[int, Field(ge=2, le=100_000_000)] = Field(
        default=2048, description="what all files may take together; the oldest are taken away"
    )


class CanBus(Section):
    """A CAN or CAN FD bus: SocketCAN read directly, any other interface through python-can."""

    kind: ClassVar[str] = "a CAN bus"

    driver: Annotated[Literal["can"], Field(description="which driver reads the bus", examples=["can"])]
    interface: Annotated[Text, Field(description="the python-can interface", examples=["socketcan"])]
    channel: Annotated[Text, Field(description="the channel of that interface", examples=["can0"])]
    fd: Annotated[bool, Field(description="whether CAN FD frames are on the bus", examples=[True])] = False
    bitrate: Annotated[int, Field(ge=1000, le=1_000_000, description="bit/s")] | None = None
    data_bitrate: Annotated[int, Field(ge=1000, le=20_000_000, description="bit/s of FD data")] | None = None
    options: dict[str, Any] = Field(
        default={}, description="handed to python-can as they are; none with SocketCAN"
    )
    receive_buffer_bytes: Annotated[int, Field(ge=4096, le=1 << 30)] = Field(
        default=4 << 20, description="SocketCAN: what the kernel holds for us; a frame takes some 400 of it"
    )
    filter: bool | None = Field(
        default=None,
        description="SocketCAN: let the kernel leave out frames of no stream, uncounted; if left out, it "
        "does so unless the bus is recorded",
    )
    record: CanRecord | None = Field(default=None, description="record every frame received in files")
    start: StartPolicy = Field(default="retry", description="what to do if the device is absent at start")


class OtherBus(Section):
    """A bus read by a third-party driver, which checks its own options."""

    kind: ClassVar[str] = "a bus with a third-party driver"

    driver: Annotated[Name, Field(description="name of the driver's entry point")]
    options: dict[str, Any] = Field(default={}, description="handed to the driver as they are")
    start: StartPolicy = Field(default="retry", description="what to do if the device is absent at start")


class PlainLayout(Section):
    """Samples side by side in a frame, sample after sample: s0c0 s0c1 s0c2 s1c0 ..."""

    kind: ClassVar[str] = "a layout without a DBC file"

    id: Annotated[int, Field(ge=0, le=0x1FFF_FFFF, description="the frame's CAN id", examples=["0x101"])]
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
    ]
    byte_order: Literal["little", "big"] = Field(default="little", description="of counter and samples")
    counter: (
        Annotated[
            Counter,
            Field(
                description="the frame's counter", examples=['{ byte = 0, bits = 16, counts = "samples" }']
            ),
        ]
        | None
    ) = None
    no_counter: bool = Field(default=False, description=NO_COUNTER)
    crc_byte: Annotated[int, Field(ge=0, le=62, description="byte where a CRC-16 starts")] | None = None
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
    def sample_bytes(self) -> int:
        """Bytes of one sample of every channel."""
        return sum(channel.raw_bytes for channel in self.channels)

    @property
    def samples_end_byte(self) -> int:
        """One past the last byte of the samples."""
        return self.first_byte + self.samples_per_frame * self.sample_bytes

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in the order of a sample."""
        return tuple(channel.name for channel in self.channels)


class DbcCounter(Section):
    """The running count, as a signal of the DBC message."""

    signal: Annotated[Text, Field(description="the counter's signal", examples=["Sequence"])]
    counts: Annotated[
        Counts,
        Field(description="what it counts; of samples, the first one in the frame", examples=["frames"]),
    ]


class DbcChannel(Section):
    """One quantity in a DBC message: its consecutive samples are signals of their own."""

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


class DbcLayout(Section):
    """Samples as signals of a message in a DBC file."""

    kind: ClassVar[str] = "a layout from a DBC file"

    dbc: Annotated[FilePath, Field(description="the DBC file, relative to the machine file")]
    message: Annotated[
        Text,
        Field(description="the message that carries the samples", examples=["Acceleration"]),
    ]
    counter: (
        Annotated[
            DbcCounter,
            Field(description="the frame's counter", examples=['{ signal = "Sequence", counts = "frames" }']),
        ]
        | None
    ) = None
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


def _bus_kind(table: Mapping[str, Any]) -> type[Section]:
    driver = table.get("driver", "can")
    if driver == "modbus":
        return ModbusRtuBus if table.get("transport") == "rtu" else ModbusTcpBus
    if driver == "replay":
        return ReplayBus
    if driver == "serial":
        framing = table.get("framing")
        return FRAMINGS.get(framing, CobsBus) if isinstance(framing, str) else CobsBus
    return OtherBus if isinstance(driver, str) and driver != "can" else CanBus


def _layout_kind(table: Mapping[str, Any]) -> type[Section]:
    if "way" in table:
        way = table["way"]
        return WAYS.get(way, RegistersLayout) if isinstance(way, str) else RegistersLayout
    if "columns" in table:
        return TableLayout
    if "line" in table:
        return LineLayout
    if "payload_length" in table:
        return SerialLayout
    return DbcLayout if "dbc" in table else PlainLayout


Bus: TypeAlias = Annotated[
    CanBus | ModbusTcpBus | ModbusRtuBus | CobsBus | SyncBus | LinesBus | ReplayBus | OtherBus,
    Kinds(_bus_kind, (CanBus, ModbusTcpBus, ModbusRtuBus, CobsBus, SyncBus, LinesBus, ReplayBus, OtherBus)),
]
Layout: TypeAlias = Annotated[
    PlainLayout
    | DbcLayout
    | RegistersLayout
    | FifoLayout
    | RingLayout
    | WaveformLayout
    | SerialLayout
    | LineLayout
    | TableLayout,
    Kinds(
        _layout_kind,
        (
            PlainLayout,
            DbcLayout,
            RegistersLayout,
            FifoLayout,
            RingLayout,
            WaveformLayout,
            SerialLayout,
            LineLayout,
            TableLayout,
        ),
    ),
]


class Stream(Section):
    """Samples that one device takes together and sends under one id."""

    bus: Annotated[Name, Field(description="the bus it comes over", examples=["can0"])]
    rate_hz: Annotated[
        float,
        Field(ge=1e-4, le=10_000_000, description="samples per second and channel", examples=[640.0]),
    ]
    reorder_window_ms: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=10.0, description="how long a gap may wait for a late frame"
    )
    latency_ms: Annotated[float, Field(ge=-10_000, le=10_000)] = Field(
        default=0.0,
        description="constant delay from the taking of a sample to its arrival, which no clock shows; counts "
        "where streams are aligned",
    )
    layout: Annotated[Layout, Field(description="where counter and samples lie in a frame")]
