"""Frame layouts: where the counter and the samples lie in a payload, for encoding and decoding alike.

A `FrameLayout` is compiled once into NumPy gather indices; a batch of frames is then decoded or
encoded by a handful of array operations, however many samples it holds. The virtual bus encodes with
the same object that the driver decodes with.
"""

from __future__ import annotations

import binascii
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np

from drivers.fields import ByteOrder, Field, FieldGroup, Kind, LayoutError, RawValues, j1939_valid_raw

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from drivers.fields import Payloads

    Floats: TypeAlias = NDArray[np.float64]
    Scaling: TypeAlias = Callable[[NDArray[Any], Floats, Floats], NDArray[np.float32]]

__all__ = [
    "ByteOrder",
    "Counts",
    "DecodedBatch",
    "DecodedFrames",
    "Field",
    "FrameLayout",
    "Kind",
    "LayoutError",
    "Selector",
]

Counts = Literal["samples", "frames"]

CRC_BYTES = 2


class DecodedFrames(NamedTuple):
    """Decoded frames of one stream, in their order of arrival; what `StreamAssembler.accept` takes.

    Attributes:
        counter: int64 ``[n]``, the device's counter as sent (wrapped); zeros if it sends none.
        samples: float32 ``[n, samples_per_frame, channels]`` in physical units.
        intact: bool ``[n]``, False where the frame's CRC does not match (all True without a CRC).
        arrival_ns: int64 ``[n]``, host monotonic; zeros where it is not known.
    """

    counter: NDArray[np.int64]
    samples: NDArray[np.float32]
    intact: NDArray[np.bool_]
    arrival_ns: NDArray[np.int64]


def joined(*parts: DecodedFrames) -> DecodedFrames:
    """Frames of one stream, part after part."""
    return DecodedFrames(*map(np.concatenate, zip(*parts, strict=True)))


@dataclass(slots=True)
class DecodedBatch:
    """What a batch of a bus held.

    Attributes:
        frames: decoded frames by stream.
        notes: what to add to which of the bus's counters.
        unknown: frames by unknown id, in words, or by page where streams read other pages of a message.
        pages_of: of those that are a page of a multiplexer, which streams read other pages of that message.
        wrong_length: frames by stream, and the length of the last of them.
        malformed: what the first piece was that should have been a frame, and why it is none; the last one
            where all of them are none. Empty if there was none, or it was reported before.
        remedy: what to do if all pieces are like that one; empty if nothing special.
        errors: what error frames report, of a bus that has such; see `drivers.can.errors.ErrorCounts`.
        data_frames: frames that carry data, of any stream or none.
        drained_ns: when the bus was last known to hold no frame that was sent before; None if there may be
            more.
    """

    frames: dict[str, DecodedFrames] = field(default_factory=dict)
    notes: Counter[str] = field(default_factory=Counter)
    unknown: Counter[str] = field(default_factory=Counter)
    pages_of: dict[str, Sequence[str]] = field(default_factory=dict)
    wrong_length: dict[str, tuple[int, int]] = field(default_factory=dict)
    malformed: str = ""
    remedy: str = ""
    errors: Any = None
    data_frames: int = 0
    drained_ns: int | None = None

    def note(self, counter: str, count: int = 1) -> None:
        """Add to a counter of the bus."""
        if count:
            self.notes[counter] += count


@dataclass(frozen=True, slots=True)
class Selector:
    """A multiplexer: which values of it the frames of a layout have.

    Attributes:
        name: of the signal.
        field: where it lies.
        values: raw values with which all fields of the layout are in the frame; encoded is the least.
    """

    name: str
    field: Field
    values: frozenset[int]


@dataclass(frozen=True)
class FrameLayout:
    """Several samples of several channels, as a rule with a counter, in every frame of one id.

    Attributes:
        frame_id: arbitration id.
        extended: whether the id has 29 bits.
        length: payload length in bytes; longer than 8 makes it a CAN FD frame.
        channels: names, in the order of the columns.
        fields: one field per sample and channel, ``[samples_per_frame][channels]``.
        scale: physical value of one count, float64 ``[samples_per_frame, channels]``.
        offset: physical value of count zero, same shape.
        counter: where the counter lies; None if the frames carry none.
        counts: whether the counter counts samples or frames.
        crc_byte: where a CRC-16/IBM-3740 (big endian) over all other bytes lies; None without one.
        selectors: which frames of the id have this layout, where not all of them do.
        any_priority: whether the id is one of SAE J1939, whose three highest bits are only a priority.
        valid_raw: by channel, the least and the largest raw value that is a measurement; with any other the
            device shows that it has none. Channels that are not named have `j1939_valid_raw` if the id is one
            of SAE J1939, else nothing but measurements.
    """

    frame_id: int
    extended: bool
    length: int
    channels: tuple[str, ...]
    fields: tuple[tuple[Field, ...], ...]
    scale: NDArray[np.float64]
    offset: NDArray[np.float64]
    counter: Field | None
    counts: Counts
    crc_byte: int | None = None
    selectors: tuple[Selector, ...] = ()
    any_priority: bool = False
    valid_raw: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        taken: dict[int, str] = {}
        named = [] if self.counter is None else [("counter", self.counter)]
        for i, row in enumerate(self.fields):
            named += [(f"sample {i} of {name}", cell) for name, cell in zip(self.channels, row, strict=True)]
        named += [(selector.name, selector.field) for selector in self.selectors]
        if self.crc_byte is not None:
            named.append(("crc", Field.at_byte(self.crc_byte, 8 * CRC_BYTES, order="big")))
        for what, cell in named:
            for position in cell.positions:
                if not 0 <= position < 8 * self.length:
                    raise LayoutError(
                        f"{what} of frame {self.frame_id:#x} reaches past its {self.length} bytes; "
                        "make the frame longer or the fields fewer"
                    )
                if position in taken:
                    raise LayoutError(f"{what} of frame {self.frame_id:#x} overlaps {taken[position]}")
                taken[position] = what

    @classmethod
    def plain(
        cls,
        *,
        frame_id: int,
        length: int,
        channels: Sequence[tuple[str, int, Kind, float, float]],
        samples_per_frame: int,
        counter_byte: int | None,
        counter_bits: int = 32,
        counts: Counts = "samples",
        first_byte: int,
        crc_byte: int | None = None,
        byte_order: ByteOrder = "little",
        extended: bool = False,
        any_priority: bool = False,
        valid_raw: Mapping[str, tuple[float, float]] | None = None,
    ) -> FrameLayout:
        """Samples packed one after another: all channels of sample 0, all of sample 1, and so on.

        Args:
            frame_id: arbitration id.
            length: payload length in bytes.
            channels: name, bits (8, 16, 24, 32), kind, scale and offset of each channel.
            samples_per_frame: samples of every channel in a frame.
            counter_byte: first byte of the counter; None if there is none.
            counter_bits: 8, 16 or 32.
            counts: what the counter counts.
            first_byte: first byte of the samples.
            crc_byte: first byte of the CRC, or None.
            byte_order: of the counter and of the samples.
            extended: whether the id has 29 bits.
            any_priority: whether the three highest of them are a priority, as in SAE J1939.
            valid_raw: see `FrameLayout`.

        Raises:
            LayoutError: something does not fit into ``length`` or overlaps.
        """
        fields: list[tuple[Field, ...]] = []
        byte = first_byte
        for _ in range(samples_per_frame):
            row: list[Field] = []
            for _, bits, kind, _, _ in channels:
                row.append(Field.at_byte(byte, bits, kind, byte_order))
                byte += bits // 8
            fields.append(tuple(row))
        return cls(
            frame_id=frame_id,
            extended=extended,
            length=length,
            channels=tuple(name for name, *_ in channels),
            fields=tuple(fields),
            scale=np.tile([scale for *_, scale, _ in channels], (samples_per_frame, 1)),
            offset=np.tile([offset for *_, offset in channels], (samples_per_frame, 1)),
            counter=None
            if counter_byte is None
            else Field.at_byte(counter_byte, counter_bits, "unsigned", byte_order),
            counts=counts,
            crc_byte=crc_byte,
            any_priority=any_priority,
            valid_raw=valid_raw or {},
        )

    @property
    def samples_per_frame(self) -> int:
        """Samples of every channel in one frame."""
        return len(self.fields)

    @property
    def fd(self) -> bool:
        """Whether only CAN FD can carry the payload."""
        return self.length > 8

    @property
    def counter_bits(self) -> int | None:
        """Width of the counter; None without one."""
        return None if self.counter is None else self.counter.bits

    @property
    def counts_per_frame(self) -> int:
        """By how much the counter grows from one frame to the next."""
        return self.samples_per_frame if self.counts == "samples" else 1

    @cached_property
    def _cells(self) -> list[Field]:
        return [cell for row in self.fields for cell in row]

    @cached_property
    def _raw_values(self) -> RawValues:
        valid = [
            self.valid_raw.get(name, j1939_valid_raw(cell) if self.any_priority else None)
            for row in self.fields
            for name, cell in zip(self.channels, row, strict=True)
        ]
        return RawValues(self._cells, valid)

    @cached_property
    def _counter_group(self) -> FieldGroup | None:
        return None if self.counter is None else FieldGroup([self.counter], [0], self.length)

    @cached_property
    def _sample_groups(self) -> list[FieldGroup]:
        flat = self._cells
        kinds = dict.fromkeys((cell.bits, cell.kind) for cell in flat)
        return [
            FieldGroup(
                [cell for cell in flat if (cell.bits, cell.kind) == kind],
                [i for i, cell in enumerate(flat) if (cell.bits, cell.kind) == kind],
                self.length,
            )
            for kind in kinds
        ]

    @cached_property
    def _selector_groups(self) -> list[tuple[FieldGroup, NDArray[np.int64]]]:
        return [
            (FieldGroup([selector.field], [0], self.length), np.array(sorted(selector.values), np.int64))
            for selector in self.selectors
        ]

    def selects(self, payloads: Payloads) -> NDArray[np.bool_]:
        """Which frames have this layout, by their multiplexers.

        Args:
            payloads: uint8 ``[n, length]``.

        Returns:
            bool ``[n]``.
        """
        chosen = np.ones(len(payloads), np.bool_)
        for group, values in self._selector_groups:
            chosen &= np.isin(group.read(payloads)[:, 0], values)
        return chosen

    def pages(self, payloads: Payloads) -> Counter[str]:
        """How many frames have each page, in words such as ``Page 1``; of a page within a page, both.

        Args:
            payloads: uint8 ``[n, length]``, of a layout with `selectors`.
        """
        values = np.stack([group.read(payloads)[:, 0] for group, _ in self._selector_groups], axis=1)
        pages: Counter[str] = Counter()
        for row, count in zip(*np.unique(values, axis=0, return_counts=True), strict=True):
            pages[self._page_in_words(row.tolist())] += int(count)
        return pages

    def _page_in_words(self, values: Sequence[float]) -> str:
        parts = []
        # The innermost comes first, and means something only on the pages of those around it.
        for selector, value in reversed(list(zip(self.selectors, values, strict=True))):
            parts.append(f"{selector.name} {int(value)}")
            if value not in selector.values:
                break
        return ", ".join(parts)

    def _crc(self, payloads: Payloads) -> NDArray[np.uint16]:
        assert self.crc_byte is not None  # noqa: S101 - callers ask only where there is one
        parts = payloads[:, : self.crc_byte], payloads[:, self.crc_byte + CRC_BYTES :]
        covered = np.concatenate(parts, axis=1).tobytes()
        step = self.length - CRC_BYTES
        crcs = (binascii.crc_hqx(covered[i : i + step], 0xFFFF) for i in range(0, len(covered), step))
        return np.fromiter(crcs, np.uint16, len(payloads))

    def decode(
        self,
        payloads: Payloads,
        arrival_ns: NDArray[np.int64] | None = None,
        *,
        scaling: Scaling | None = None,
    ) -> DecodedFrames:
        """Decode a batch of frames.

        Args:
            payloads: uint8 ``[n, length]``.
            arrival_ns: int64 ``[n]``, when each arrived.
            scaling: turns raw numbers ``[n, fields]`` of one kind, with scale and offset ``[fields]``, into
                physical units in one pass, where NumPy takes four; None to leave it to NumPy.

        Returns:
            Samples that are NaN where the device states that it has no value (`valid_raw`).
        """
        n = len(payloads)
        if scaling is not None and len(self._sample_groups) == 1 and self._raw_values.all_measured:
            raw = self._sample_groups[0].read(payloads)
            native = np.ascontiguousarray(raw, raw.dtype.newbyteorder("="))
            samples = scaling(native, self.scale.reshape(-1), self.offset.reshape(-1))
            samples = samples.reshape(n, *self.scale.shape)
        else:
            samples = self._samples(payloads)
        group_of_counter = self._counter_group
        counter = (
            np.zeros(n, np.int64)
            if group_of_counter is None
            else group_of_counter.read(payloads)[:, 0].astype(np.int64)
        )
        if self.crc_byte is None:
            intact = np.ones(n, np.bool_)
        else:
            sent = payloads[:, self.crc_byte].astype(np.uint16) << 8 | payloads[:, self.crc_byte + 1]
            intact = sent == self._crc(payloads)
        if arrival_ns is None:
            arrival_ns = np.zeros(n, np.int64)
        return DecodedFrames(counter, samples, intact, arrival_ns)

    def _samples(self, payloads: Payloads) -> NDArray[np.float32]:
        n = len(payloads)
        raw = np.empty((n, self.scale.size), np.float64)
        # Floats on the wire may be anything: beyond float32 they become infinite, signalling NaNs quiet.
        with np.errstate(over="ignore", invalid="ignore"):
            for group in self._sample_groups:
                raw[:, slice(None) if len(self._sample_groups) == 1 else group.columns] = group.read(payloads)
            self._raw_values.leave_out_absent(raw)
            scaled = raw.reshape(n, *self.scale.shape)
            scaled *= self.scale
            scaled += self.offset
            return scaled.astype(np.float32)

    def encode(
        self,
        first_index: NDArray[np.int64],
        samples: NDArray[np.float64] | NDArray[np.float32],
        *,
        clip: bool = False,
    ) -> Payloads:
        """Encode a batch of frames, as the device would send them.

        Args:
            first_index: int64 ``[n]``, absolute index of each frame's first sample; the counter wraps
                it to its width.
            samples: ``[n, samples_per_frame, channels]`` in physical units; NaN for a value that the device
                does not have.
            clip: saturate what does not fit, as an analogue input does, instead of raising.

        Returns:
            uint8 ``[n, length]``.

        Raises:
            LayoutError: a value does not fit its field (and ``clip`` is False), or is NaN and no raw value of
                the field states it.
        """
        n = len(first_index)
        raw = ((np.asarray(samples, np.float64) - self.offset) / self.scale).reshape(n, -1)
        payloads = np.zeros((n, self.length), np.uint8)
        for group in self._sample_groups:
            kind = self._cells[group.columns[0]].kind
            values, refused = self._raw_values.fit(raw, group.columns, kind, clip=clip)
            if refused.any():
                row, place = np.argwhere(refused)[0]
                raise self._refusal(raw[row], int(group.columns[place]))
            group.write(payloads, values)
        for multiplexer, pages in self._selector_groups:
            multiplexer.write(payloads, np.full((n, 1), pages[0]))
        if self.counter is not None and self._counter_group is not None:
            counts = first_index if self.counts == "samples" else first_index // self.samples_per_frame
            self._counter_group.write(payloads, (counts % 2**self.counter.bits).astype(np.int64)[:, None])
        if self.crc_byte is not None:
            crc = self._crc(payloads)
            payloads[:, self.crc_byte] = crc >> 8
            payloads[:, self.crc_byte + 1] = crc & 0xFF
        return payloads

    def _refusal(self, raw: NDArray[np.float64], column: int) -> LayoutError:
        """Why one cell of a frame cannot be encoded."""
        at, channel = divmod(column, len(self.channels))
        cell, name = self._cells[column], self.channels[channel]
        value = raw[column] * self.scale[at, channel] + self.offset[at, channel]
        remedy = "state in valid_raw which raw value means none"
        return LayoutError(
            f"channel {name!r}: {value:g} does not fit a {cell.bits}-bit {cell.kind} field of frame "
            f"{self.frame_id:#x}; {remedy if np.isnan(value) else 'choose a larger scale'}"
        )
