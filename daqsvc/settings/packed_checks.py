"""Whether counter and samples fit the frames that they are packed in, on any kind of bus."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, Protocol

from daqsvc.settings.packing import CRC_BYTES
from daqsvc.settings.problems import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from daqsvc.settings.packing import Channel, PackedFields
    from daqsvc.settings.problems import KeyPath


class _Counted(Protocol):
    """A layout that says whether its frames have a counter."""

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
            )
    inside = [field for field in fields if field[3] <= layout.frame_length]
    for (_, first, start, end), (key, what, later_start, later_end) in combinations(inside, 2):
        if later_start < end:
            yield Finding(
                (*at, key),
                f"{what} (bytes {later_start} to {later_end - 1}) would overlap {first} "
                f"(bytes {start} to {end - 1})",
                _make_way(layout, key, what, end, later_end - later_start),
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
            )


def counted(layout: _Counted, at: KeyPath) -> Iterator[Finding]:
    """Whoever goes without a counter says so."""
    if layout.counter is None and not layout.no_counter:
        yield Finding(
            (*at, "counter"),
            "is missing: it tells what was lost, and what the time of a sample is",
            "say where the device's counter lies; if it sends none, write no_counter = true, and loss is "
            "estimated from the times of arrival",
        )
    elif layout.counter is not None and layout.no_counter:
        yield Finding(
            (*at, "no_counter"),
            "contradicts counter",
            "leave it out if the device counts, else remove counter",
        )
