"""From the settings of a packed frame to what decodes it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.frames import FrameLayout

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.settings.packing import Channel, PackedFields
    from drivers.fields import Kind


def packed_layout(
    given: PackedFields,
    length: int,
    *,
    frame_id: int = 0,
    extended: bool = False,
    any_priority: bool = False,
) -> FrameLayout:
    """The layout of a frame with samples side by side, in the units of the wire.

    Args:
        given: where they lie.
        length: bytes of a frame.
        frame_id: what tells the frames of the stream from others.
        extended: whether that has 29 bits; of CAN frames.
        any_priority: see `FrameLayout`.
    """
    return FrameLayout.plain(
        frame_id=frame_id,
        extended=extended,
        any_priority=any_priority,
        length=length,
        channels=packed(given.channels),
        samples_per_frame=given.samples_per_frame,
        counter_byte=None if given.counter is None else given.counter.byte,
        counter_bits=32 if given.counter is None else given.counter.bits,
        counts="frames" if given.counter is None else given.counter.counts,
        first_byte=given.first_byte,
        crc_byte=given.crc_byte,
        byte_order=given.byte_order,
        valid_raw=raw_limits(given.channels),
    )


def packed(channels: Sequence[Channel]) -> list[tuple[str, int, Kind, float, float]]:
    """See `FrameLayout.plain`."""

    def kind(raw_type: str) -> Kind:
        return "float" if raw_type == "float32" else "unsigned" if raw_type.startswith("u") else "signed"

    return [(c.name, 8 * c.raw_bytes, kind(c.type), c.scale, c.offset) for c in channels]


def raw_limits(channels: Sequence[Channel]) -> dict[str, tuple[float, float]]:
    """By channel, the raw values that are measurements, where not all are."""
    return {c.name: c.valid_raw for c in channels if c.valid_raw is not None}
