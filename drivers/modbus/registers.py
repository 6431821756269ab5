"""Numbers in 16-bit registers: where they lie, in which order of words and bytes, and what they are worth.

A Modbus register travels high byte first, but a number of several registers travels in whatever order its
device was written for. The four orders that occur are named by the letters of a 32-bit number whose bytes
are A (highest) to D. ``ABCD`` is big-endian, ``CDAB`` has its words exchanged, ``BADC`` its bytes within
each word, ``DCBA`` is little-endian. The same two exchanges apply to numbers of 64 bits; a number of 16
bits knows only the one of bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from drivers.frames import LayoutError
from drivers.modbus.settings import RegisterChannel, RegistersLayout, SampleChannel

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import Samples
    from drivers.modbus.settings import ModbusLayout, RegisterType

RegisterNumber: TypeAlias = RegisterChannel | SampleChannel
"""One quantity in registers: physical = raw * scale + offset."""

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

    @property
    def in_words(self) -> str:
        """As a person names them, e.g. ``"registers 16 to 17"``."""
        one = self.count == 1
        return f"register {self.address}" if one else f"registers {self.address} to {self.end - 1}"


@dataclass(frozen=True, slots=True)
class RunLimits:
    """What requests may do.

    Attributes:
        max_gap: unwanted registers that one merge may read.
        max_count: registers in a request, at most; the protocol allows 125.
        forbidden: registers that must not be read.
    """

    max_gap: int = 0
    max_count: int = 125
    forbidden: tuple[RegisterRun, ...] = ()

    @classmethod
    def of(cls, layout: RegistersLayout) -> RunLimits:
        """What the requests for a layout may do."""
        forbidden = tuple(RegisterRun(first, last - first + 1) for first, last in layout.forbidden)
        return cls(layout.max_gap, layout.max_count, forbidden)

    def both(self, other: RunLimits) -> RunLimits:
        """What these and the other limits allow."""
        return RunLimits(
            min(self.max_gap, other.max_gap),
            min(self.max_count, other.max_count),
            self.forbidden + other.forbidden,
        )


ANY_RUN = RunLimits()


def run_of(channel: RegisterNumber) -> RegisterRun:
    """The registers of a quantity."""
    return RegisterRun(channel.first, channel.registers)


def dtype_of(channel: RegisterNumber) -> np.dtype[np.generic]:
    """Type of a number in registers, big-endian."""
    return np.dtype(_DTYPES[channel.type])


def byte_places(channel: RegisterNumber) -> NDArray[np.int64]:
    """Places of a number's bytes among those of its registers, highest byte of the number first."""
    places = np.arange(2 * channel.registers).reshape(-1, 2)
    if channel.order in {"CDAB", "DCBA"}:
        places = places[::-1]
    if channel.order in {"BADC", "DCBA"}:
        places = places[:, ::-1]
    return places.reshape(-1)


def raw_limits(channel: RegisterNumber) -> tuple[float, float]:
    """Smallest and greatest raw value."""
    if channel.bits is not None:
        return 0.0, float(2 ** channel.bits[1] - 1)
    if dtype_of(channel).kind == "f":
        most = float(np.finfo(channel.type).max)
        return -most, most
    info = np.iinfo(channel.type)
    # The greatest float that a cast still turns into the integer: 2**63 - 1 itself is not a float.
    most = float(info.max)
    return float(info.min), most if int(most) <= info.max else float(np.nextafter(most, 0.0))


class _Group(NamedTuple):
    """Fields of one type, taken out of all replies in one go."""

    channels: list[RegisterNumber]
    columns: list[int]
    places: NDArray[np.int64]
    dtype: np.dtype[np.generic]
    marks: list[NDArray[np.generic]]


@dataclass(frozen=True)
class RegisterRecord:
    """Quantities in the registers of a few runs, which are given side by side.

    Attributes:
        channels: the quantities, one a channel.
        runs: the registers that a row holds, in its order.

    Raises:
        LayoutError: a quantity is not in the runs as a whole, or its bits are not in its number.
    """

    channels: tuple[RegisterNumber, ...]
    runs: tuple[RegisterRun, ...]

    def __post_init__(self) -> None:
        for channel in self.channels:
            self._place(channel)
            if channel.bits is None:
                continue
            lowest, width = channel.bits
            unsigned = dtype_of(channel).kind == "u"
            if not unsigned or lowest < 0 or width < 1 or lowest + width > 16 * channel.registers:
                raise LayoutError(
                    f"channel {channel.name!r}: bits {lowest} to {lowest + width - 1} are no part of "
                    f"{channel.type}; take bits of an unsigned type that holds them"
                )

    @classmethod
    def of(cls, layout: ModbusLayout) -> RegisterRecord:
        """What one sample of a layout holds; each of its runs is a request, or part of one.

        Raises:
            LayoutError: a channel's registers are forbidden, or what must stay together is too long.
        """
        if isinstance(layout, RegistersLayout):
            return cls(layout.channels, plan_runs(map(run_of, layout.channels), RunLimits.of(layout)))
        return cls(layout.channels, (RegisterRun(0, layout.sample_registers),))

    @property
    def registers(self) -> int:
        """Registers in a row."""
        return sum(run.count for run in self.runs)

    def decode(self, raw: NDArray[np.uint8]) -> Samples:
        """Decode rows of registers.

        Args:
            raw: uint8 ``[n, 2 * registers]``, as they travel: high byte of each register first.

        Returns:
            float32 ``[n, channels]`` in physical units.
        """
        values = np.empty((len(raw), len(self.channels)), np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # a device may send any float, NaN among them
            for group in self._groups:
                numbers = np.take(raw, group.places, axis=1).view(group.dtype)
                for k, (channel, column) in enumerate(zip(group.channels, group.columns, strict=True)):
                    number = numbers[:, k]
                    if channel.bits is not None:
                        lowest, width = channel.bits
                        wide = number.astype(np.uint64)
                        number = (wide >> np.uint64(lowest)) & np.uint64(2**width - 1)
                    values[:, column] = number
                    for mark in group.marks[k]:
                        values[number == mark, column] = np.nan
            return np.asarray(values * self._scale + self._offset, np.float32)

    def encode(
        self, samples: NDArray[np.float64] | NDArray[np.float32], *, clip: bool = False
    ) -> NDArray[np.uint8]:
        """Put samples into registers, as the device would; registers without a channel are 0.

        Args:
            samples: ``[n, channels]`` in physical units; NaN where there is no value, if ``no_value`` is set.
            clip: saturate what does not fit, as an analogue input does, instead of raising.

        Returns:
            uint8 ``[n, 2 * registers]``.

        Raises:
            LayoutError: a value does not fit its registers (and ``clip`` is False), or is NaN and the channel
                has no mark for that.
        """
        rows = np.zeros((len(samples), 2 * self.registers), np.uint8)
        raw = (np.asarray(samples, np.float64) - self._offset) / self._scale
        for group in self._groups:
            for k, (channel, column) in enumerate(zip(group.channels, group.columns, strict=True)):
                absent = np.isnan(raw[:, column]) & bool(channel.marks)
                fitting = _fit(channel, np.where(absent, 0.0, raw[:, column]), clip=clip)
                # Numbers of a few bits share their registers: those of the others stay.
                places = group.places[k * group.dtype.itemsize :][: group.dtype.itemsize]
                rows[:, places] |= _bytes_of(channel, fitting, absent)
        return rows

    @cached_property
    def _scale(self) -> NDArray[np.float64]:
        return np.array([channel.scale for channel in self.channels])

    @cached_property
    def _offset(self) -> NDArray[np.float64]:
        return np.array([channel.offset for channel in self.channels])

    @cached_property
    def _groups(self) -> list[_Group]:
        groups = []
        for name in dict.fromkeys(channel.type for channel in self.channels):
            columns = [k for k, channel in enumerate(self.channels) if channel.type == name]
            channels = [self.channels[k] for k in columns]
            places = np.concatenate([2 * self._place(channel) + byte_places(channel) for channel in channels])
            dtype = np.dtype(_DTYPES[name])
            # Of their own type: what is compared as a float is not exact beyond 53 bits.
            marks = [np.array(channel.marks, dtype.newbyteorder("=")) for channel in channels]
            groups.append(_Group(channels, columns, places, dtype, marks))
        return groups

    def _place(self, channel: RegisterNumber) -> int:
        """Where a channel's first register lies in a row."""
        before, own = 0, run_of(channel)
        for run in self.runs:
            if run.address <= own.address and own.end <= run.end:
                return before + own.address - run.address
            before += run.count
        raise LayoutError(
            f"channel {channel.name!r}: registers {own.address} to {own.end - 1} are not among those "
            f"that are read ({', '.join(f'{run.address} to {run.end - 1}' for run in self.runs)})"
        )


def _fit(channel: RegisterNumber, raw: NDArray[np.float64], *, clip: bool) -> NDArray[np.float64]:
    low, high = raw_limits(channel)
    values = raw if dtype_of(channel).kind == "f" else np.rint(raw)
    outside = ~((values >= low) & (values <= high))
    if np.isnan(values).any() or (outside.any() and not clip):
        value = float(raw[int(np.argmax(outside))]) * channel.scale + channel.offset
        what = channel.type if channel.bits is None else f"{channel.bits[1]} bits of {channel.type}"
        raise LayoutError(f"channel {channel.name!r}: {value:g} does not fit {what}; choose a larger scale")
    return np.clip(values, low, high)


def _bytes_of(
    channel: RegisterNumber, values: NDArray[np.float64], absent: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Bytes ``[n, bytes]`` of whole numbers or floats that fit, highest first; the mark of what is absent."""
    if channel.bits is not None:
        numbers = (values.astype(np.uint64) << np.uint64(channel.bits[0])).astype(dtype_of(channel))
    else:
        numbers = values.astype(dtype_of(channel))
    if absent.any():
        # As a whole number: a float has not all digits of a mark of 64 bits.
        numbers[absent] = channel.marks[0] << (0 if channel.bits is None else channel.bits[0])
    return np.ascontiguousarray(numbers).view(np.uint8).reshape(len(values), -1)


def inseparable(wanted: Iterable[RegisterRun]) -> list[RegisterRun]:
    """The runs by address; those that share registers are one."""
    together: list[RegisterRun] = []
    for run in sorted(wanted):
        if together and run.address < together[-1].end:
            last = together.pop()
            run = RegisterRun(last.address, max(last.end, run.end) - last.address)  # noqa: PLW2901 - it has grown
        together.append(run)
    return together


def plan_runs(wanted: Iterable[RegisterRun], limits: RunLimits = ANY_RUN) -> tuple[RegisterRun, ...]:
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
    together = inseparable(wanted)
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


def shared_runs(layouts: Sequence[RegistersLayout]) -> tuple[RegisterRun, ...] | None:
    """The requests that read the registers of several streams of one unit and table together.

    Args:
        layouts: of the streams; what one of them must not read is not read for the others either.

    Returns:
        None if that saves no request, or cannot be.
    """
    if len(layouts) < 2:
        return None
    wanted = [run_of(channel) for layout in layouts for channel in layout.channels]
    try:
        runs = plan_runs(wanted, reduce(RunLimits.both, map(RunLimits.of, layouts)))
    except LayoutError:  # one stream reads what another one must not, or together it is too much at once
        return None
    apart = sum(len(RegisterRecord.of(layout).runs) for layout in layouts)
    return runs if len(runs) < apart else None
