"""Numbers in 16-bit registers: where they lie, in which order of words and bytes, and what they are worth.

A Modbus register travels high byte first, but a number of several registers travels in whatever order
its device was written for. The four orders that occur are named by the letters of a 32-bit number whose
bytes are A (highest) to D: ``ABCD`` is big-endian, ``CDAB`` has its words exchanged, ``BADC`` its bytes
within each word, ``DCBA`` is little-endian. The same two exchanges apply to numbers of 64 bits; a number
of 16 bits knows only the one of bytes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

import numpy as np

from drivers.frames import LayoutError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import Samples

RegisterType: TypeAlias = Literal[
    "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"
]
Order: TypeAlias = Literal["ABCD", "CDAB", "BADC", "DCBA"]

_DTYPES: dict[RegisterType, str] = {
    "int16": ">i2",
    "uint16": ">u2",
    "int32": ">i4",
    "uint32": ">u4",
    "int64": ">i8",
    "uint64": ">u8",
    "float32": ">f4",
    "float64": ">f8",
}


@dataclass(frozen=True, order=True, slots=True)
class RegisterRun:
    """Registers side by side: ``count`` of them from ``address`` on."""

    address: int
    count: int

    @property
    def end(self) -> int:
        """One past the address of the last register."""
        return self.address + self.count


@dataclass(frozen=True, slots=True)
class RunLimits:
    """What requests may do.

    Attributes:
        max_gap: registers nobody wants that one merge may read.
        max_count: registers in a request, at most; the protocol allows 125.
        forbidden: registers that must not be read.
    """

    max_gap: int = 0
    max_count: int = 125
    forbidden: tuple[RegisterRun, ...] = ()

    def both(self, other: RunLimits) -> RunLimits:
        """What these and the other limits allow."""
        return RunLimits(
            min(self.max_gap, other.max_gap),
            min(self.max_count, other.max_count),
            self.forbidden + other.forbidden,
        )


ANY_RUN = RunLimits()


@dataclass(frozen=True, slots=True)
class RegisterField:
    """One quantity in registers: physical = raw * scale + offset.

    Attributes:
        name: name of the channel.
        address: its first register, counted from 0 as on the wire.
        type: what the registers hold.
        order: how words and bytes are ordered; see the module.
        bits: lowest bit and number of bits, for a part of an unsigned number; all of it if None.
        scale: worth of one count.
        offset: physical value of the raw value 0.
    """

    name: str
    address: int
    type: RegisterType
    order: Order = "ABCD"
    bits: tuple[int, int] | None = None
    scale: float = 1.0
    offset: float = 0.0

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """Type of the number, big-endian."""
        return np.dtype(_DTYPES[self.type])

    @property
    def run(self) -> RegisterRun:
        """Its registers."""
        return RegisterRun(self.address, self.dtype.itemsize // 2)

    @property
    def byte_places(self) -> NDArray[np.int64]:
        """Places of its bytes among those of its registers, highest byte of the number first."""
        places = np.arange(self.dtype.itemsize).reshape(-1, 2)
        if self.order in {"CDAB", "DCBA"}:
            places = places[::-1]
        if self.order in {"BADC", "DCBA"}:
            places = places[:, ::-1]
        return places.reshape(-1)

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and greatest raw value."""
        if self.bits is not None:
            return 0.0, float(2 ** self.bits[1] - 1)
        if self.dtype.kind == "f":
            most = float(np.finfo(self.type).max)
            return -most, most
        info = np.iinfo(self.type)
        # The greatest float that a cast still turns into the integer: 2**63 - 1 itself is not a float.
        most = float(info.max)
        return float(info.min), most if int(most) <= info.max else float(np.nextafter(most, 0.0))


class _Group(NamedTuple):
    """Fields of one type, taken out of all replies in one go."""

    fields: list[RegisterField]
    columns: list[int]
    places: NDArray[np.int64]
    dtype: np.dtype[np.generic]


@dataclass(frozen=True)
class RegisterRecord:
    """Quantities in the registers of a few runs, which are given side by side.

    Attributes:
        fields: the quantities, one a channel.
        runs: the registers that a row holds, in its order.

    Raises:
        LayoutError: a field is not in the runs as a whole, or its bits are not in its number.
    """

    fields: tuple[RegisterField, ...]
    runs: tuple[RegisterRun, ...]

    def __post_init__(self) -> None:
        for field in self.fields:
            self._place(field)
            if field.bits is None:
                continue
            lowest, width = field.bits
            if (
                field.dtype.kind != "u"
                or lowest < 0
                or width < 1
                or lowest + width > 8 * field.dtype.itemsize
            ):
                raise LayoutError(
                    f"channel {field.name!r}: bits {lowest} to {lowest + width - 1} are no part of "
                    f"{field.type}; take bits of an unsigned type that holds them"
                )

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(field.name for field in self.fields)

    @property
    def registers(self) -> int:
        """Registers in a row."""
        return sum(run.count for run in self.runs)

    def in_units(self, conversion: Mapping[str, tuple[float, float]]) -> RegisterRecord:
        """The same record with each channel's value ``v`` turned into ``gain * v + shift``.

        Args:
            conversion: ``(gain, shift)`` by channel name; channels not named stay as they are.
        """
        pairs = [conversion.get(field.name, (1.0, 0.0)) for field in self.fields]
        turned = tuple(
            replace(field, scale=field.scale * gain, offset=field.offset * gain + shift)
            for field, (gain, shift) in zip(self.fields, pairs, strict=True)
        )
        return replace(self, fields=turned)

    def decode(self, raw: NDArray[np.uint8]) -> Samples:
        """Decode rows of registers.

        Args:
            raw: uint8 ``[n, 2 * registers]``, as they travel: high byte of each register first.

        Returns:
            float32 ``[n, channels]`` in physical units.
        """
        values = np.empty((len(raw), len(self.fields)), np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # a device may send any float, NaN among them
            for group in self._groups:
                numbers = np.take(raw, group.places, axis=1).view(group.dtype)
                for k, (field, column) in enumerate(zip(group.fields, group.columns, strict=True)):
                    number = numbers[:, k]
                    if field.bits is not None:
                        lowest, width = field.bits
                        wide = number.astype(np.uint64)
                        number = (wide >> np.uint64(lowest)) & np.uint64(2**width - 1)
                    values[:, column] = number
            return np.asarray(values * self._scale + self._offset, np.float32)

    def encode(
        self, samples: NDArray[np.float64] | NDArray[np.float32], *, clip: bool = False
    ) -> NDArray[np.uint8]:
        """Put samples into registers, as the device would; registers without a field are 0.

        Args:
            samples: ``[n, channels]`` in physical units.
            clip: saturate what does not fit, as an analogue input does, instead of raising.

        Returns:
            uint8 ``[n, 2 * registers]``.

        Raises:
            LayoutError: a value does not fit its registers (and ``clip`` is False), or is NaN.
        """
        rows = np.zeros((len(samples), 2 * self.registers), np.uint8)
        raw = (np.asarray(samples, np.float64) - self._offset) / self._scale
        for group in self._groups:
            for k, (field, column) in enumerate(zip(group.fields, group.columns, strict=True)):
                fitting = _fit(field, raw[:, column], clip=clip)
                # Fields of a few bits share their registers: those of the others stay.
                places = group.places[k * field.dtype.itemsize :][: field.dtype.itemsize]
                rows[:, places] |= _bytes_of(field, fitting)
        return rows

    @cached_property
    def _scale(self) -> NDArray[np.float64]:
        return np.array([field.scale for field in self.fields])

    @cached_property
    def _offset(self) -> NDArray[np.float64]:
        return np.array([field.offset for field in self.fields])

    @cached_property
    def _groups(self) -> list[_Group]:
        groups = []
        for name in dict.fromkeys(field.type for field in self.fields):
            columns = [k for k, field in enumerate(self.fields) if field.type == name]
            fields = [self.fields[k] for k in columns]
            places = np.concatenate([2 * self._place(field) + field.byte_places for field in fields])
            groups.append(_Group(fields, columns, places, fields[0].dtype))
        return groups

    def _place(self, field: RegisterField) -> int:
        """Where a field's first register lies in a row."""
        before = 0
        for run in self.runs:
            if run.address <= field.address and field.run.end <= run.end:
                return before + field.address - run.address
            before += run.count
        raise LayoutError(
            f"channel {field.name!r}: registers {field.address} to {field.run.end - 1} are not among those "
            f"that are read ({', '.join(f'{run.address} to {run.end - 1}' for run in self.runs)})"
        )


def _fit(field: RegisterField, raw: NDArray[np.float64], *, clip: bool) -> NDArray[np.float64]:
    low, high = field.limits
    values = raw if field.dtype.kind == "f" else np.rint(raw)
    outside = ~((values >= low) & (values <= high))
    if np.isnan(values).any() or (outside.any() and not clip):
        value = float(raw[int(np.argmax(outside))]) * field.scale + field.offset
        what = field.type if field.bits is None else f"{field.bits[1]} bits of {field.type}"
        raise LayoutError(f"channel {field.name!r}: {value:g} does not fit {what}; choose a larger scale")
    return np.clip(values, low, high)


def _bytes_of(field: RegisterField, values: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Bytes ``[n, bytes]`` of whole numbers or floats that fit, highest first."""
    if field.bits is not None:
        numbers = (values.astype(np.uint64) << np.uint64(field.bits[0])).astype(field.dtype)
    else:
        numbers = values.astype(field.dtype)
    return np.ascontiguousarray(numbers).view(np.uint8).reshape(len(values), -1)


def plan_runs(wanted: Sequence[RegisterRun], limits: RunLimits = ANY_RUN) -> tuple[RegisterRun, ...]:
    """Few requests that read every wanted register exactly once.

    Neighbours are merged where the limits allow it. What lies together (registers of one number, or of
    numbers that share one) stays together.

    Args:
        wanted: registers to read, in any order; they may overlap.
        limits: what the requests may do.

    Returns:
        The requests, by address.

    Raises:
        LayoutError: a wanted register is forbidden, or what must stay together exceeds ``max_count``.
    """
    together: list[RegisterRun] = []
    for run in sorted(wanted):
        if together and run.address < together[-1].end:
            last = together.pop()
            run = RegisterRun(last.address, max(last.end, run.end) - last.address)  # noqa: PLW2901 - it has grown
        together.append(run)
    for run in together:
        if run.count > limits.max_count:
            raise LayoutError(
                f"registers {run.address} to {run.end - 1} belong together, and a request takes "
                f"{limits.max_count}; raise max_count (up to 125)"
            )
        _refuse_forbidden(run, limits.forbidden)
    runs: list[RegisterRun] = together[:1]
    for before, run in pairwise(together):
        gap = RegisterRun(before.end, run.address - before.end)
        merged = RegisterRun(runs[-1].address, run.end - runs[-1].address)
        if (
            gap.count <= limits.max_gap
            and merged.count <= limits.max_count
            and not any(_overlap(gap, f) for f in limits.forbidden)
        ):
            runs[-1] = merged
        else:
            runs.append(run)
    return tuple(runs)


def _overlap(a: RegisterRun, b: RegisterRun) -> bool:
    return max(a.address, b.address) < min(a.end, b.end)


def _refuse_forbidden(run: RegisterRun, forbidden: Sequence[RegisterRun]) -> None:
    for other in forbidden:
        if _overlap(run, other):
            raise LayoutError(
                f"registers {run.address} to {run.end - 1} are wanted, but {other.address} to "
                f"{other.end - 1} are forbidden; drop the channel, or allow the registers"
            )
