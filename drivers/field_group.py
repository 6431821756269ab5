"""Fields of one kind, moved between payloads and numbers in one array operation each way."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from drivers.fields import Field, Payloads


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
