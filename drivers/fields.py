"""Raw numbers inside a payload: where each lies, and which of its values are measurements.

Fields of one kind are moved between payloads and numbers in one array operation each way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np

from daqsvc.errors.buses import LAYOUT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Payloads: TypeAlias = NDArray[np.uint8]

    """Frames of one length: ``[n, length]``."""


Kind = Literal["signed", "unsigned", "float"]
ByteOrder = Literal["little", "big"]

J1939_WIDTHS = (8, 16, 24, 32)
"""Bits of the parameters whose highest values SAE J1939-71 (table 1) keeps for other uses."""


class LayoutError(ValueError):
    """A layout contradicts itself, its DBC file, or the values it should carry."""

    code = LAYOUT


@dataclass(frozen=True, slots=True)
class Field:
    """One raw number inside a payload.

    Attributes:
        start: bit number as DBC files count: bit ``8 * byte + b`` with ``b = 0`` the least significant
            bit of its byte. It is the field's least significant bit if ``order`` is little, its most
            significant bit if it is big.
        bits: width, 1 to 64 (32 or 64 for a float).
        kind: how the bits are read.
        order: byte order.
    """

    start: int
    bits: int
    kind: Kind = "unsigned"
    order: ByteOrder = "little"

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= 64 or (self.kind == "float" and self.bits not in {32, 64}):
            raise LayoutError(
                f"a {self.kind} field of {self.bits} bits cannot be; use 1 to 64 (float: 32, 64)"
            )

    @classmethod
    def at_byte(cls, byte: int, bits: int, kind: Kind = "unsigned", order: ByteOrder = "little") -> Field:
        """A field that begins on a byte boundary."""
        return cls(8 * byte + (0 if order == "little" else 7), bits, kind, order)

    @property
    def positions(self) -> list[int]:
        """The field's bits from most to least significant, counted from the payload's first bit.

        In this count bit 0 is the *most* significant bit of byte 0, as `numpy.unpackbits` orders them.
        """
        if self.order == "little":
            dbc_bits = range(self.start + self.bits - 1, self.start - 1, -1)
            return [8 * (bit // 8) + 7 - bit % 8 for bit in dbc_bits]
        first = 8 * (self.start // 8) + 7 - self.start % 8
        return list(range(first, first + self.bits))

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest value the field can carry."""
        if self.kind == "float":
            largest = float(np.finfo(np.float32 if self.bits == 32 else np.float64).max)
            return -largest, largest
        if self.kind == "signed":
            return -float(2 ** (self.bits - 1)), float(2 ** (self.bits - 1) - 1)
        return 0.0, float(2**self.bits - 1)


def j1939_valid_raw(cell: Field) -> tuple[float, float] | None:
    """Raw values of a field that are a measurement by SAE J1939-71, e.g. 0 to 0xFAFF of 16 bits.

    Those above mean "error" (0xFE..) or "not available" (0xFF..), or are kept back. None for a field to which
    the standard gives no such range: one that is signed, a float, or no whole number of bytes.
    """
    if cell.kind != "unsigned" or cell.bits not in J1939_WIDTHS:
        return None
    return 0.0, float((0xFB << (cell.bits - 8)) - 1)


class Fitted(NamedTuple):
    """Raw values as they go on the wire.

    Attributes:
        values: float64 ``[n, cells]``.
        refused: bool ``[n, cells]``, where there is no raw value for what was asked.
    """

    values: NDArray[np.float64]
    refused: NDArray[np.bool_]


class RawValues:
    """What the raw values of cells mean: a measurement, or that the device has none.

    Args:
        cells: the fields.
        valid: for each, the least and the largest raw value that is a measurement; None where all are.

    Attributes:
        all_measured: whether all raw values of all of them are measurements.
    """

    def __init__(self, cells: Sequence[Field], valid: Sequence[tuple[float, float] | None]) -> None:
        n = len(cells)
        self.all_measured = not any(valid)
        self._measured = (
            np.array([bounds or (-np.inf, np.inf) for bounds in valid], np.float64).reshape(n, 2).T
        )
        self._least, self._largest, self._no_value = np.empty(n), np.empty(n), np.full(n, np.nan)
        for k, (cell, (low, high)) in enumerate(zip(cells, self._measured.T.tolist(), strict=True)):
            least, largest = cell.limits
            self._least[k], self._largest[k] = max(low, least), min(high, largest)
            # The largest number if that is no measurement, as in SAE J1939, else the least; a float has NaN.
            if cell.kind != "float" and high < largest:
                self._no_value[k] = largest
            elif cell.kind != "float" and low > least:
                self._no_value[k] = least

    def leave_out_absent(self, raw: NDArray[np.float64]) -> None:
        """Put NaN in place of raw values ``[n, cells]`` that are no measurements."""
        if not self.all_measured:
            low, high = self._measured
            raw[(raw < low) | (raw > high)] = np.nan

    def fit(self, raw: NDArray[np.float64], columns: NDArray[np.intp], kind: Kind, *, clip: bool) -> Fitted:
        """Round what is to go on the wire, and report where there is no value (NaN).

        Args:
            raw: float64 ``[n, cells]`` of all cells.
            columns: the cells that are asked for.
            kind: what they are.
            clip: saturate what does not fit.
        """
        values = raw[:, columns] if kind == "float" else np.rint(raw[:, columns])
        low, high, no_value = self._least[columns], self._largest[columns], self._no_value[columns]
        absent = np.isnan(values)
        refused = absent & np.isnan(no_value) if kind != "float" else np.zeros_like(absent)
        if not clip:
            refused |= (values < low) | (values > high)
        return Fitted(np.where(absent, no_value, np.clip(values, low, high)), refused)


class FieldGroup:
    """Fields of one width and kind, moved between payloads and numbers in one gather.

    Each field is copied left-aligned into a container of 1, 2, 4 or 8 bytes; one shift to the right
    then extends the sign of any width. Whole bytes are gathered as bytes, anything else as bits.
    """

    def __init__(self, fields: Sequence[Field], columns: Sequence[int], length: int) -> None:
        bits, kind = fields[0].bits, fields[0].kind
        self.columns = np.asarray(columns, np.intp)
        width = next(w for w in (1, 2, 4, 8) if 8 * w >= bits)
        self._shift = 8 * width - bits
        code = "f" if kind == "float" else "i" if kind == "signed" else "u"
        self._dtype = np.dtype(f">{code}{width}")
        self._kind = kind
        spare = 8 * length  # one position past the payload: a zero
        rows = [[*field.positions, *[spare] * self._shift] for field in fields]
        self._by_byte = bits % 8 == 0 and all(
            row[i] % 8 == 0 and row[i : i + 8] == list(range(row[i], row[i] + 8))
            for row in rows
            for i in range(0, bits, 8)
        )
        picks = [row[::8] for row in rows] if self._by_byte else rows
        self._index = np.asarray(picks, np.intp) // (8 if self._by_byte else 1)
        self._used = self._index.shape[1] - self._shift // (8 if self._by_byte else 1)
        self._run, self._run_dtype = self._find_run(width) if self._by_byte else (None, self._dtype)

    def _find_run(self, width: int) -> tuple[slice | None, np.dtype[Any]]:
        """The bytes of fields that lie side by side in machine words, and the dtype of the words."""
        side_by_side = np.arange(self._index.size).reshape(-1, width)
        for dtype, ordered in (
            (self._dtype, self._index),
            (self._dtype.newbyteorder("<"), self._index[:, ::-1]),
        ):
            start = int(ordered[0, 0])
            if self._shift == 0 and (ordered - start == side_by_side).all():
                return slice(start, start + ordered.size), dtype
        return None, self._dtype

    def read(self, payloads: Payloads) -> NDArray[Any]:
        """Raw numbers ``[n, fields]`` of payloads ``[n, length]``, as wide as the fields' containers."""
        n = len(payloads)
        if self._run is not None:
            return np.ascontiguousarray(payloads[:, self._run]).view(self._run_dtype)
        cells = payloads if self._by_byte else np.unpackbits(payloads, axis=1)
        padded = np.concatenate([cells, np.zeros((n, 1), np.uint8)], axis=1)
        gathered = padded[:, self._index]
        if not self._by_byte:
            gathered = np.packbits(gathered, axis=2)
        values = np.ascontiguousarray(gathered).view(self._dtype)[:, :, 0]
        if self._kind == "float":
            return values
        native = values.astype(self._dtype.newbyteorder("="))
        raw: NDArray[Any] = native >> native.dtype.type(self._shift)
        return raw

    def write(self, payloads: Payloads, values: NDArray[np.float64] | NDArray[np.int64]) -> None:
        """Put raw numbers ``[n, fields]`` into payloads ``[n, length]``."""
        native = values.astype(self._dtype.newbyteorder("="))
        if self._shift:
            native <<= native.dtype.type(self._shift)
        cells = np.ascontiguousarray(native.astype(self._dtype)[:, :, None]).view(np.uint8)
        if self._by_byte:
            payloads[:, self._index[:, : self._used]] = cells[:, :, : self._used]
            return
        spread = np.unpackbits(payloads, axis=1)
        spread[:, self._index[:, : self._used]] = np.unpackbits(cells, axis=2)[:, :, : self._used]
        payloads[:] = np.packbits(spread, axis=1)
