"""Modbus lines, and how devices on them hand out samples."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import AfterValidator, BeforeValidator, Field, WithJsonSchema
from pydantic_core import PydanticCustomError

from daqsvc.errors.buses import MANUALS_NUMBER, RING_DEPTH
from daqsvc.rounding import counted
from daqsvc.settings.addresses import DevicePath, Host, serial_port
from daqsvc.settings.buses import Block, Bus, Device, Layout, WireRange
from daqsvc.settings.packing import Scale  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.section import MOST_CHANNELS, InSchema, Name, Quantity, Section, WaitMs

if TYPE_CHECKING:
    from collections.abc import Sequence

_NS_PER_MS = 1_000_000
_POLL_MS = 100.0
_LOOKS_PER_FILL = 4
"""How often a store of samples in a device is read while it fills once."""

_REGISTER_BYTES = 2
_SAMPLE_BYTES = 4

MAX_REGISTERS = 125
"""Registers that a request can read (Modbus Application Protocol 1.1b3, 6.3)."""

FIFO_REGISTERS = 31
"""Registers that a FIFO reply can hold (6.18)."""

RegisterType = Literal["int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"]
Order = Literal["ABCD", "CDAB", "BADC", "DCBA"]
_LAST_ADDRESS = 65_535
_MANUALS_LONG = (300_001, 400_001)
"""What manuals with six digits call the first input register and the first holding register."""


def _on_the_line(address: Any) -> Any:
    """An address of six digits is one of a manual: there are none so large."""
    if isinstance(address, int):
        for first in _MANUALS_LONG:
            if first <= address <= first + _LAST_ADDRESS:
                raise PydanticCustomError(
                    "manuals_number",
                    f"looks like a number of the manual, where registers begin at {first}",
                    {
                        "remedy": f"write {address - first}, as registers begin at 0 here",
                        "code": MANUALS_NUMBER,
                    },
                )
    return address


Address = Annotated[int, Field(ge=0, le=_LAST_ADDRESS), BeforeValidator(_on_the_line)]
UnitAddress = Annotated[int, Field(ge=0, le=255)]
Table = Literal["holding", "input"]
CountBits = Literal[16, 32]
BitNumber = Annotated[int, Field(ge=0, le=64)]


def _one_or_several(value: Any) -> Any:
    """A number by itself is an array of one."""
    return [value] if isinstance(value, int) and not isinstance(value, bool) else value


_MOST_MARKS = 8
Marks = Annotated[
    tuple[Annotated[int, Field(ge=-(1 << 63), le=(1 << 63) - 1)], ...],
    BeforeValidator(_one_or_several),
    Field(strict=False, max_length=_MOST_MARKS),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "integer"},
                {"type": "array", "items": {"type": "integer"}, "maxItems": _MOST_MARKS},
            ]
        }
    ),
]
"""Raw values that are no measurement: one, or an array of several."""

_REGISTERS: dict[RegisterType, int] = {
    "int16": 1,
    "uint16": 1,
    "int32": 2,
    "uint32": 2,
    "int64": 4,
    "uint64": 4,
    "float32": 2,
    "float64": 4,
}


_LEAST_DEPTH, _MOST_DEPTH = 2, 32_768
"""Samples of a ring."""


def _power_of_two(depth: int) -> int:
    # Beyond its limits, these are what is to be corrected.
    if _LEAST_DEPTH <= depth <= _MOST_DEPTH and depth & (depth - 1):
        below = 2 ** (depth.bit_length() - 1)
        raise PydanticCustomError(
            "ring_depth",
            "is not a power of two: where a sample lies would not be known once the counter wraps",
            {"remedy": f"set the device to {below} or {2 * below} places", "code": RING_DEPTH},
        )
    return depth


class Writable(Section):
    """Holding registers of a unit that may be written."""

    unit: Annotated[UnitAddress, Field(description="address of the unit", examples=[1])]
    address: Annotated[Address, Field(description="first register, counted from 0", examples=[100])]
    count: Annotated[int, Field(ge=1, le=123)] = Field(
        default=1, description="how many registers from address on may be written"
    )


class _ModbusBus(Bus):
    """What all Modbus lines have."""

    driver: Annotated[Literal["modbus"], Field(description="which driver reads the bus", examples=["modbus"])]
    timeout_ms: WaitMs = Field(default=500.0, description="how long a unit may take to answer")
    demote_after: Annotated[int, Field(ge=1, le=30)] = Field(
        default=3,
        description="requests without reply, in a row, after which a unit or a request is set aside",
    )
    demotion_s: Annotated[float, Field(ge=0.1, le=3600)] = Field(
        default=10.0,
        description="how long a unit is set aside at first, before one request probes whether it is back; "
        "doubles up to 60 s",
    )
    writes: Annotated[tuple[Writable, ...], Field(strict=False, max_length=1024)] = Field(
        default=(), description="registers that may be written; nothing else ever is"
    )

    def may_write(self, unit: int, address: int, count: int = 1) -> bool:
        """Whether one entry of `writes` holds all these registers."""
        return any(
            entry.unit == unit and entry.address <= address and address + count <= entry.address + entry.count
            for entry in self.writes
        )


class ModbusTcpBus(_ModbusBus):
    """Units behind a Modbus TCP server or gateway."""

    kind: ClassVar[str] = "a Modbus TCP bus"

    transport: Annotated[
        Literal["tcp"],
        Field(description='how the units are reached: "tcp", or "rtu" for a serial port', examples=["tcp"]),
    ]
    host: Annotated[Host, Field(description="host name or IP address of the server", examples=["192.0.2.10"])]
    tcp_port: Annotated[int, Field(ge=1, le=65_535)] = Field(
        default=502, description="TCP port of the server"
    )

    @property
    def where(self) -> str:
        """What a person calls the other end."""
        return f"{self.host}:{self.tcp_port}"

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        return f"Modbus TCP, {self.where}, time-out {self.timeout_ms:g} ms"


class ModbusRtuBus(_ModbusBus):
    """Units on a serial line."""

    kind: ClassVar[str] = "a Modbus RTU bus"

    transport: Annotated[
        Literal["rtu"],
        Field(description='how the units are reached: "rtu" for a serial port, or "tcp"', examples=["rtu"]),
    ]
    serial_port: Annotated[
        DevicePath, Field(description="device file of the serial port", examples=["/dev/ttyUSB0"])
    ]
    baud: Annotated[int, Field(ge=300, le=4_000_000, description="bit rate of the line", examples=[19_200])]
    parity: Literal["none", "even", "odd"] = Field(default="even", description="parity bit of each character")
    stop_bits: Literal[1, 2] = Field(default=1, description="stop bits of each character")
    quiet_ms: WaitMs | None = Field(
        default=None,
        description="silence after a request without reply, at least timeout_ms; "
        "the wait after opening is longer by it",
        examples=[1000.0],
    )

    @property
    def where(self) -> str:
        """What a person calls the other end."""
        return self.serial_port

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        framing = f"8{self.parity[0].upper()}{self.stop_bits}"
        return f"Modbus RTU, {self.serial_port}, {self.baud} bit/s {framing}, time-out {self.timeout_ms:g} ms"

    @property
    def device(self) -> Device:
        """See `Bus.device`."""
        return serial_port("serial_port", self.serial_port)


class _Quantity(Section):
    """What all channels in registers have: wire value = raw * scale + offset."""

    name: Annotated[Name, Field(description="name of the channel", examples=["velocity-x"])]
    type: Annotated[RegisterType, Field(description="what the registers hold", examples=["uint16"])]
    order: Order = Field(
        default="ABCD",
        description="order of bytes and words: ABCD is big-endian, CDAB has its words exchanged",
    )
    bits: Annotated[tuple[BitNumber, BitNumber], Field(strict=False)] | None = Field(
        default=None,
        description="lowest bit and number of bits, for a part of an unsigned number",
        examples=["[0, 12]"],
    )
    scale: Scale = Field(
        default=1.0, description="what one count of the raw value is worth, in V or the unit of the sensor"
    )
    offset: Quantity = Field(
        default=0.0, description="what the raw value 0 is worth, in V or the unit of the sensor"
    )

    no_value: Marks = Field(
        default=(),
        description="raw value by which the device states that it has none, e.g. of a broken sensor; "
        "or several in brackets",
        examples=["0x7FFF"],
    )

    @property
    def registers(self) -> int:
        """Registers that hold it."""
        return _REGISTERS[self.type]

    @property
    def width(self) -> int:
        """Bits of its raw value."""
        return 16 * self.registers if self.bits is None else self.bits[1]

    @property
    def marks(self) -> tuple[int, ...]:
        """The raw values of `no_value` as its type has them: of an int16, 0x8000 is -32768."""
        if self.type.startswith("float"):
            return self.no_value
        # TOML has no number as large as the largest of 64 bits without sign: there -1 has the same bits.
        raw = [value % 2**self.width for value in self.no_value]
        if self.type.startswith("u"):
            return tuple(raw)
        return tuple(value - 2**self.width if value >= 2 ** (self.width - 1) else value for value in raw)


class RegisterChannel(_Quantity):
    """One quantity at an address."""

    address: Annotated[
        Address, Field(description="first register of the channel, counted from 0", examples=[0])
    ]

    @property
    def first(self) -> int:
        """Its first register."""
        return self.address


class SampleChannel(_Quantity):
    """One quantity in a sample of several registers."""

    place: Annotated[int, Field(ge=0, lt=MAX_REGISTERS)] = Field(
        description="first register of the channel within a sample, counted from 0", examples=[0]
    )

    @property
    def first(self) -> int:
        """Its first register within a sample."""
        return self.place


def _range(channels: Sequence[_Quantity], name: str) -> WireRange | None:
    number = next((item for item in channels if item.name == name), None)
    if number is None or number.type.startswith("float"):
        return None
    half = 2.0 ** (number.width - 1)
    raw = (0.0, 2 * half - 1) if number.type.startswith("u") else (-half, half - 1)
    return WireRange.scaled(raw, number.scale, number.offset)


class _ModbusLayout(Layout):
    """What all layouts in registers have."""

    mark: ClassVar[str] = "way"
    number_keys: ClassVar[str] = "order and type"

    unit: Annotated[UnitAddress, Field(description="address of the unit", examples=[1])]


class _Sampled(_ModbusLayout):
    """What layouts have in which samples lie one after another."""

    channels: Annotated[
        tuple[SampleChannel, ...],
        Field(
            strict=False,
            min_length=1,
            max_length=MOST_CHANNELS,
            description="the channels of each sample",
            examples=['[{ name = "x", place = 0, type = "int16", scale = 0.0005 }]'],
        ),
    ]
    poll_ms: WaitMs | None = Field(
        default=None,
        description="how often to look for more samples; by rate and room in the device if absent",
        examples=[50.0],
    )

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in the order of a sample."""
        return tuple(channel.name for channel in self.channels)

    @property
    def channels_in_words(self) -> str:
        """How many channels there are."""
        return counted(len(self.channels), "channel")

    @property
    def sample_registers(self) -> int:
        """Registers of one sample of every channel."""
        return max(channel.place + channel.registers for channel in self.channels)

    @property
    def room(self) -> int:
        """Samples after which the device, or a reply, can hold no more."""
        raise NotImplementedError

    def poll_ns(self, rate_hz: float) -> int:
        """How long to wait before looking again, once there was nothing more to read."""
        fill_s = self.room / rate_hz
        by_room_ms = min(1000.0 * fill_s / _LOOKS_PER_FILL, _POLL_MS)
        return max(round((by_room_ms if self.poll_ms is None else self.poll_ms) * _NS_PER_MS), _NS_PER_MS)

    def wire_range(self, channel: str, facts: Any) -> WireRange | None:
        """See `Layout.wire_range`."""
        del facts
        return _range(self.channels, channel)


class RegistersLayout(_ModbusLayout):
    """Registers that always show the present values, polled on a schedule."""

    usual_rate_hz: ClassVar[float] = 1.0

    kind: ClassVar[str] = 'a layout with way = "registers"'

    way: Annotated[
        Literal["registers"], Field(description="how samples are read from the unit", examples=["registers"])
    ]
    table: Table = Field(default="holding", description="which registers are read")
    channels: Annotated[
        tuple[RegisterChannel, ...],
        Field(
            strict=False,
            min_length=1,
            max_length=MOST_CHANNELS,
            description="the channels",
            examples=['[{ name = "velocity", address = 0, type = "uint16", scale = 0.01 }]'],
        ),
    ]
    max_gap: Annotated[int, Field(ge=0, lt=MAX_REGISTERS)] = Field(
        default=8, description="registers between two channels that may be read with them to save a request"
    )
    max_count: Annotated[int, Field(ge=1, le=MAX_REGISTERS)] = Field(
        default=MAX_REGISTERS, description="registers in a request, at most"
    )
    forbidden: Annotated[
        tuple[Annotated[tuple[Address, Address], Field(strict=False)], ...],
        Field(strict=False, max_length=1024),
    ] = Field(
        default=(),
        description="first and last register of ranges that must never be read",
        examples=["[[100, 120]]"],
    )

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in the order of a sample."""
        return tuple(channel.name for channel in self.channels)

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        return f"{counted(len(self.channels), 'value')} polled in {self.table} registers"

    @property
    def polled(self) -> bool:
        """See `Layout.polled`."""
        return True

    def wire_range(self, channel: str, facts: Any) -> WireRange | None:
        """See `Layout.wire_range`."""
        del facts
        return _range(self.channels, channel)


class FifoCount(Section):
    """The running count of samples at the head of a queue."""

    bits: CountBits = Field(default=16, description="width of the count")
    low_word_first: bool = Field(
        default=False, description="whether a count of 32 bits has its low word in the first register"
    )

    @property
    def registers(self) -> int:
        """Registers that hold it."""
        return self.bits // 16

    @property
    def modulus(self) -> int:
        """Counts after which it begins again."""
        return 65_536 if self.bits == 16 else 4_294_967_296

    def decode(self, raw: bytes) -> int:
        """The count in its registers, high byte of each first."""
        if self.low_word_first and self.bits == 32:
            raw = raw[2:4] + raw[:2]
        return int.from_bytes(raw[: self.bits // 8], "big")

    def encode(self, count: int) -> bytes:
        """The registers of a count, high byte of each first."""
        raw = (count % self.modulus).to_bytes(self.bits // 8, "big")
        return raw[2:] + raw[:2] if self.low_word_first and self.bits == 32 else raw


class RegisterCount(FifoCount):
    """A running count of samples in registers."""

    address: Annotated[
        Address, Field(description="first register of the count, counted from 0", examples=[0])
    ]


class FifoLayout(_Sampled):
    """A queue of samples read by function 24, with the count of its first sample at its head."""

    kind: ClassVar[str] = 'a layout with way = "fifo"'

    way: Annotated[
        Literal["fifo"], Field(description="how samples are read from the unit", examples=["fifo"])
    ]
    address: Annotated[Address, Field(description="pointer of the queue", examples=[0])]
    count: FifoCount = Field(
        default=FifoCount(),
        description="the count of samples at the head of the queue",
        examples=["{ bits = 32 }"],
    )
    acknowledge: Address | None = Field(
        default=None,
        description="holding register to which the read position of the queue is written",
        examples=[200],
    )

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        return f"{self.channels_in_words} from a FIFO, {self.count.bits} bit count"

    @property
    def samples_per_read(self) -> int:
        """Samples in a reply, at most."""
        return (FIFO_REGISTERS - self.count.registers) // self.sample_registers

    @property
    def room(self) -> int:
        """See `_Sampled.room`."""
        return self.samples_per_read


class RingLayout(_Sampled):
    """A ring of samples in registers, with a count of all samples written so far.

    Sample ``i`` is written to place ``i % depth``, and then the count becomes ``i + 1``.
    """

    kind: ClassVar[str] = 'a layout with way = "ring"'

    way: Annotated[
        Literal["ring"], Field(description="how samples are read from the unit", examples=["ring"])
    ]
    table: Table = Field(default="holding", description="which registers are read")
    count: Annotated[
        RegisterCount, Field(description="the count of samples written so far", examples=["{ address = 0 }"])
    ]
    address: Annotated[Address, Field(description="first register of the ring", examples=[16])]
    depth: Annotated[
        int,
        AfterValidator(_power_of_two),
        InSchema(enum=[1 << exponent for exponent in range(1, 16)]),
        Field(ge=_LEAST_DEPTH, le=_MOST_DEPTH, description="samples that the ring holds", examples=[256]),
    ]

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        return f"{self.channels_in_words} from a ring of {self.depth}, {self.count.bits} bit count"

    @property
    def samples_per_read(self) -> int:
        """Samples in a reply, at most."""
        return MAX_REGISTERS // self.sample_registers

    @property
    def room(self) -> int:
        """See `_Sampled.room`."""
        return self.depth


class BlockPage(Section):
    """A window on a block that is too long for the address space."""

    select: Annotated[
        Address, Field(description="register to which the page is written, from 0", examples=[99])
    ]
    registers: Annotated[int, Field(ge=1, le=65_535, description="registers in the window", examples=[100])]


class BlockTrigger(Section):
    """How to make the device take a block."""

    address: Annotated[Address, Field(description="holding register to write", examples=[98])]
    value: Annotated[int, Field(ge=0, le=65_535)] = Field(default=1, description="what to write there")
    every_s: Annotated[float, Field(ge=0.1, le=86_400)] = Field(
        default=60.0, description="how often to write it: each write shortens the life of a sensor's battery"
    )


class WaveformLayout(_Sampled):
    """A block of samples, taken at once and kept until the next one replaces it."""

    kind: ClassVar[str] = 'a layout with way = "waveform"'

    way: Annotated[
        Literal["waveform"], Field(description="how samples are read from the unit", examples=["waveform"])
    ]
    table: Table = Field(default="holding", description="which registers are read")
    block_id: Annotated[
        Address, Field(description="register that changes with every block, from 1 on", examples=[0])
    ]
    address: Annotated[Address, Field(description="first register of the block", examples=[100])]
    samples: Annotated[int, Field(ge=1, le=1_000_000, description="samples in a block", examples=[1024])]
    page: BlockPage | None = Field(
        default=None, description="the window on a block that is too long for the address space"
    )
    trigger: BlockTrigger | None = Field(
        default=None, description="how to make the device take a block; it takes them by itself if absent"
    )

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        return f"{self.channels_in_words} in blocks of {self.samples} samples"

    @property
    def room(self) -> int:
        """See `_Sampled.room`."""
        return self.samples

    @property
    def block(self) -> Block:
        """See `Layout.block`."""
        every_s = None if self.trigger is None else self.trigger.every_s
        registers = self.samples * self.sample_registers
        row_bytes = _SAMPLE_BYTES * len(self.channels)
        return Block(self.samples, every_s, registers * _REGISTER_BYTES + self.samples * row_bytes)


ModbusBus: TypeAlias = ModbusTcpBus | ModbusRtuBus
ModbusLayout: TypeAlias = RegistersLayout | FifoLayout | RingLayout | WaveformLayout

WAYS: dict[object, type[ModbusLayout]] = {
    "registers": RegistersLayout,
    "fifo": FifoLayout,
    "ring": RingLayout,
    "waveform": WaveformLayout,
}
