"""What the frames of every kind of bus are made of: raw numbers, a counter, channels; whether they fit."""

from __future__ import annotations

import math
from itertools import combinations
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Protocol

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from daqsvc.errors.buses import FIELD_OUTSIDE, FIELDS_OVERLAP, LOSS_UNNOTICED, RAW_VALUES
from daqsvc.errors.machine_file import CONTRADICTION, WRONG_ORDER, WRONG_SCALE
from daqsvc.settings.buses import Layout, WireRange
from daqsvc.settings.problems import Finding
from daqsvc.settings.section import MOST, MOST_CHANNELS, NOT_ZERO, Name, Quantity, Section

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from daqsvc.settings.problems import KeyPath


CRC_BYTES = 2
LONGEST_FRAME = 65_536
NO_COUNTER = "true if the frames carry none: losses are then estimated from the times of arrival"
LEAST_SCALE = 1 / MOST
LARGEST_SCALE = MOST
VALID_RAW = "least and largest raw value that is a measurement; any other means that there is none"

RawType = Literal["int8", "int16", "int24", "int32", "uint8", "uint16", "uint24", "uint32", "float32"]
Counts = Literal["samples", "frames"]

_RAW_BYTES: dict[RawType, int] = {
    "int8": 1,
    "int16": 2,
    "int24": 3,
    "int32": 4,
    "uint8": 1,
    "uint16": 2,
    "uint24": 3,
    "uint32": 4,
    "float32": 4,
}


def _not_zero(scale: float) -> float:
    """A scale that tells samples apart.

    Raises:
        PydanticCustomError: it does not.
    """
    if scale == 0:
        raise PydanticCustomError(
            "zero_scale",
            "would make every sample the same",
            {"remedy": "write what one count of the raw value is worth, e.g. 0.0005", "code": WRONG_SCALE},
        )
    if not LEAST_SCALE <= abs(scale) <= LARGEST_SCALE:
        raise PydanticCustomError(
            "scale_size",
            "is what no count of a raw value is worth",
            {"remedy": "write what one count of the raw value is worth, e.g. 0.0005", "code": WRONG_SCALE},
        )
    return scale


Scale = Annotated[float, Field(ge=-LARGEST_SCALE, le=LARGEST_SCALE), AfterValidator(_not_zero), NOT_ZERO]
"""What one count of a raw value is worth."""

RawLimit = Annotated[float, Field(ge=-3.4028235e38, le=3.4028235e38)]
"""A raw value: at most what a float of 32 bits carries."""


def _ordered_raw(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] >= limits[1]:
        raise PydanticCustomError(
            "valid_raw_order",
            "the least raw value that is a measurement must come first, and the largest be another",
            {
                "remedy": "write e.g. [-32767, 32767] if -32768 means that there is no value",
                "code": WRONG_ORDER,
            },
        )
    return limits


ValidRaw = Annotated[
    tuple[RawLimit, RawLimit],
    AfterValidator(_ordered_raw),
    Field(strict=False),
]
"""Raw values that are measurements; any other states that the device has none."""


class PackedCounter(Section):
    """The running count in each frame that tells loss and gives a sample its place in time."""

    byte: Annotated[
        int,
        Field(ge=0, lt=LONGEST_FRAME, description="first byte of the counter in the payload", examples=[0]),
    ]
    bits: Annotated[Literal[8, 16, 32], Field(description="width of the counter", examples=[16])]
    counts: Annotated[
        Counts,
        Field(
            description="what the counter counts; of samples, the first one in the frame",
            examples=["samples"],
        ),
    ]

    @property
    def end_byte(self) -> int:
        """One past its last byte."""
        return self.byte + self.bits // 8


class Counter(PackedCounter):
    """The counter of a frame that is short, or has it at its beginning."""

    byte: Annotated[
        int, Field(ge=0, le=63, description="first byte of the counter in the payload", examples=[0])
    ]


class Channel(Section):
    """One quantity in the frame: wire value = raw * scale + offset.

    The wire value is in V if the channel's sensor has a sensitivity, else in the sensor's unit.
    """

    name: Annotated[Name, Field(description="name of the channel", examples=["x"])]
    type: Annotated[RawType, Field(description="raw type of a sample", examples=["int16"])]
    scale: Annotated[
        Scale,
        Field(
            description="what one count of the raw value is worth, in V or the unit of the sensor",
            examples=[0.0005],
        ),
    ]
    offset: Quantity = Field(
        default=0.0, description="what the raw value 0 is worth, in V or the unit of the sensor"
    )
    valid_raw: ValidRaw | None = Field(default=None, description=VALID_RAW, examples=["[-32767, 32767]"])

    @property
    def raw_bytes(self) -> int:
        """Bytes of one raw sample."""
        return _RAW_BYTES[self.type]

    @property
    def raw_limits(self) -> tuple[float, float]:
        """Least and largest value that the raw type can carry."""
        if self.type == "float32":
            return -math.inf, math.inf
        bits = 8 * self.raw_bytes
        return (
            (0.0, 2.0**bits - 1.0)
            if self.type.startswith("u")
            else (-(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1.0)
        )


class PackedFields(Layout):
    """Samples side by side in a frame, sample after sample: s0c0 s0c1 s0c2 s1c0 ..."""

    number_keys: ClassVar[str] = "byte_order and type"

    byte_order: Literal["little", "big"] = Field(default="little", description="of counter and samples")
    counter: (
        Annotated[
            PackedCounter,
            Field(
                description="the frame's counter", examples=['{ byte = 0, bits = 16, counts = "samples" }']
            ),
        ]
        | None
    ) = None
    no_counter: bool = Field(default=False, description=NO_COUNTER)
    crc_byte: (
        Annotated[int, Field(ge=0, lt=LONGEST_FRAME, description="byte where a CRC-16 starts")] | None
    ) = None
    first_byte: Annotated[
        int, Field(ge=0, lt=LONGEST_FRAME, description="where the samples start", examples=[2])
    ]
    samples_per_frame: Annotated[
        int, Field(ge=1, le=LONGEST_FRAME, description="samples per channel", examples=[10])
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
    def frame_length(self) -> int:
        """Bytes of a frame."""
        raise NotImplementedError

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

    def wire_range(self, channel: str, facts: Any) -> WireRange | None:
        """See `Layout.wire_range`."""
        del facts
        return packed_range(self.channels, channel)


class PackedLayout(PackedFields):
    """A frame of any length, for drivers whose frames carry nothing but a counter and samples.

    The CRC is CRC-16/IBM-3740, big endian, over all other bytes.
    """

    kind: ClassVar[str] = "a layout of a packed frame"
    mark: ClassVar[str] = "frame_bytes"

    frame_bytes: Annotated[int, Field(ge=1, le=LONGEST_FRAME, description="bytes of a frame", examples=[128])]

    @property
    def frame_length(self) -> int:
        """See `PackedFields.frame_length`."""
        return self.frame_bytes

    @property
    def summary(self) -> str:
        """See `Layout.summary`."""
        count = "no count" if self.counter is None else f"{self.counter.bits} bit count"
        samples = samples_in_words(self.samples_per_frame, len(self.channels))
        return f"{self.frame_bytes} bytes, {samples}, {count}"


def samples_in_words(samples_per_frame: int, channels: int) -> str:
    """What a frame holds: ``10 x 3 channels``."""
    return f"{samples_per_frame} x {channels} channel{'s' * (channels != 1)}"


def packed_range(channels: tuple[Channel, ...], name: str) -> WireRange | None:
    """What one of these channels can carry; see `Layout.wire_range`."""
    channel = next((item for item in channels if item.name == name), None)
    if channel is None or channel.type == "float32":
        return None
    return WireRange.scaled(channel.valid_raw or channel.raw_limits, channel.scale, channel.offset)


class _Counted(Protocol):
    """A layout that states whether its frames have a counter."""

    @property
    def counter(self) -> object | None:
        """Where the counter lies."""

    @property
    def no_counter(self) -> bool:
        """Whether the device sends none."""


def packed_room(layout: PackedFields, at: KeyPath) -> Iterator[Finding]:
    """Counter, CRC and samples lie within the frame and beside each other."""
    fields = [("first_byte", "the samples", layout.first_byte, layout.samples_end_byte)]
    if layout.counter is not None:
        fields.append(("counter", "the counter", layout.counter.byte, layout.counter.end_byte))
    if layout.crc_byte is not None:
        fields.append(("crc_byte", "the CRC", layout.crc_byte, layout.crc_byte + CRC_BYTES))
    fields.sort(key=lambda field: field[2])
    for key, what, start, end in fields:
        if end > layout.frame_length:
            yield Finding(
                (*at, key),
                f"{what} would take bytes {start} to {end - 1} of a frame of {layout.frame_length} bytes",
                _make_room(layout, key, end - start),
                code=FIELD_OUTSIDE,
            )
    inside = [field for field in fields if field[3] <= layout.frame_length]
    for (_, first, start, end), (key, what, later_start, later_end) in combinations(inside, 2):
        if later_start < end:
            yield Finding(
                (*at, key),
                f"{what} (bytes {later_start} to {later_end - 1}) would overlap {first} "
                f"(bytes {start} to {end - 1})",
                _make_way(layout, key, what, end, later_end - later_start),
                code=FIELDS_OVERLAP,
            )


def _make_way(layout: PackedFields, key: str, what: str, end: int, needed_bytes: int) -> str:
    """What to do about a field that lies within another which ends before byte ``end``."""
    if end + needed_bytes <= layout.frame_length:
        return f"move {what} to byte {end} or behind, as the device sends it"
    if end != layout.samples_end_byte or key == "first_byte":
        return f"correct {key}: from byte {end} on is no room for {what}"
    begin = layout.frame_length - needed_bytes if key != "crc_byte" else layout.crc_byte or 0
    fitting_samples = (begin - layout.first_byte) // layout.sample_bytes
    if fitting_samples < 1:
        return "make the frame longer"
    fewer = f"write samples_per_frame = {fitting_samples}"
    to = layout.first_byte + fitting_samples * layout.sample_bytes
    return fewer if key == "crc_byte" else f"{fewer} and move {what} to byte {to}, as the device sends it"


def _make_room(layout: PackedFields, key: str, needed_bytes: int) -> str:
    """What to do about a field that reaches past the end of the frame."""
    fitting_samples = (layout.frame_length - layout.first_byte) // layout.sample_bytes
    if key == "first_byte" and fitting_samples > 0:
        return f"write samples_per_frame = {fitting_samples}, or make the frame longer"
    if key != "first_byte" and layout.frame_length >= needed_bytes:
        return f"move it to byte {layout.frame_length - needed_bytes} or before, or make the frame longer"
    return "make the frame longer"


def valid_raw(channels: Sequence[Channel], at: KeyPath) -> Iterator[Finding]:
    """What is to be a measurement can be sent."""
    for index, channel in enumerate(channels):
        least, largest = channel.raw_limits
        if channel.valid_raw is not None and not (
            least <= channel.valid_raw[0] and channel.valid_raw[1] <= largest
        ):
            yield Finding(
                (*at, index, "valid_raw"),
                f"does not lie within what {channel.type} can carry, {least:g} to {largest:g}",
                "write the raw values as the device sends them, before scale and offset",
                code=RAW_VALUES,
            )
        elif (
            channel.valid_raw is not None
            and channel.type != "float32"
            and any(v % 1 for v in channel.valid_raw)
        ):
            yield Finding(
                (*at, index, "valid_raw"),
                f"has a fraction, which no {channel.type} can carry",
                "write whole numbers: raw values as the device sends them, before scale and offset",
                code=RAW_VALUES,
            )


def counted(layout: _Counted, at: KeyPath) -> Iterator[Finding]:
    """Whoever goes without a counter states it."""
    if layout.counter is None and not layout.no_counter:
        yield Finding(
            (*at, "counter"),
            "is missing: it tells what was lost, and what the time of a sample is",
            "state where the device's counter lies; if it sends none, write no_counter = true, and loss is "
            "estimated from the times of arrival",
            code=LOSS_UNNOTICED,
        )
    elif layout.counter is not None and layout.no_counter:
        yield Finding(
            (*at, "no_counter"),
            "contradicts counter",
            "leave it out if the device counts, else remove counter",
            code=CONTRADICTION,
        )
