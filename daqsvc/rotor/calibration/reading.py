"""Reading the tables of a calibration file: every mistake is one message with file, key, value and remedy."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

_REMEDY = "restore the file, or calibrate again"


class CalibrationFileError(ValueError):
    """A calibration file cannot be read, used or written; the message says why and what to do."""


class Table:
    """A table of a calibration file.

    Args:
        values: what it holds.
        path: the file.
        name: keys that lead to it.
    """

    def __init__(self, values: Mapping[str, Any], path: Path, name: str = "") -> None:
        self._values = values
        self._path = path
        self._name = name
        self._read: set[str] = set()

    def wrong(self, key: str, value: object, remedy: str) -> CalibrationFileError:
        """The error about a value."""
        return CalibrationFileError(f"{self._path}: {self._place(key)} = {value!r}: {remedy}")

    def number(
        self,
        key: str,
        *,
        above: float = -math.inf,
        least: float = -math.inf,
        below: float = math.inf,
    ) -> float:
        """A finite number.

        Raises:
            CalibrationFileError: it is not there, no number, or outside of its bounds.
        """
        value = self._number(key, self._get(key))
        if not (value > above and value >= least and value < below):
            bounds = [
                f"{word} {bound:g}"
                for word, bound in (("above", above), ("at least", least), ("below", below))
                if math.isfinite(bound)
            ]
            raise self.wrong(key, value, f"it must be {' and '.join(bounds)}; {_REMEDY}")
        return value

    def optional_number(self, key: str, **bounds: float) -> float | None:
        """The same, or None if it is not there."""
        return self.number(key, **bounds) if key in self._values else None

    def numbers(self, key: str, count: int) -> list[float]:
        """So many finite numbers."""
        value = self._get(key)
        if not isinstance(value, list) or len(value) != count:
            raise self.wrong(key, value, f"it must be {count} numbers; {_REMEDY}")
        return [self._number(key, part) for part in value]

    def matrix(self, key: str, size: int) -> NDArray[np.float64]:
        """A square of finite numbers."""
        value = self._get(key)
        if not isinstance(value, list) or len(value) != size:
            raise self.wrong(key, value, f"it must be {size} rows of {size} numbers; {_REMEDY}")
        rows = [Table({key: row}, self._path, self._name).numbers(key, size) for row in value]
        return np.array(rows, dtype=np.float64)

    def complex_number(self, key: str) -> complex:
        """A table of ``re`` and ``im``."""
        part = self.table(key)
        value = complex(part.number("re"), part.number("im"))
        part.nothing_else()
        return value

    def whole(self, key: str, *, least: int = 0) -> int:
        """A whole number."""
        value = self._get(key)
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise self.wrong(key, value, f"it must be a whole number from {least} on; {_REMEDY}")
        return value

    def text(self, key: str, *, default: str) -> str:
        """A text, or the default if it is not there."""
        self._read.add(key)
        value = self._values.get(key, default)
        if not isinstance(value, str):
            raise self.wrong(key, value, f"it must be a text in quotes; {_REMEDY}")
        return value

    def table(self, key: str) -> Table:
        """A table inside."""
        value = self._get(key)
        if not isinstance(value, dict):
            raise self.wrong(key, value, f"it must be a table; {_REMEDY}")
        return Table(value, self._path, self._place(key))

    def optional_table(self, key: str) -> Table | None:
        """The same, or None if it is not there."""
        return self.table(key) if key in self._values else None

    def tables(self, key: str) -> list[Table]:
        """Tables in a row, none if the key is not there."""
        self._read.add(key)
        value = self._values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(part, dict) for part in value):
            raise self.wrong(key, value, f"it must be [[{key}]] tables; {_REMEDY}")
        return [Table(part, self._path, f"{self._place(key)}[{i}]") for i, part in enumerate(value)]

    def nothing_else(self) -> None:
        """Refuse keys that nobody has read.

        Raises:
            CalibrationFileError: there is one.
        """
        for key, value in self._values.items():
            if key not in self._read:
                raise self.wrong(key, value, "there is no such key; remove it, or calibrate again")

    def _get(self, key: str) -> Any:
        self._read.add(key)
        if key not in self._values:
            raise CalibrationFileError(f"{self._path}: {self._place(key)} is missing; {_REMEDY}")
        return self._values[key]

    def _number(self, key: str, value: object) -> float:
        number = math.nan
        if isinstance(value, int | float) and not isinstance(value, bool):
            # A whole number may be too large for a float.
            number = float(value) if abs(value) <= sys.float_info.max else math.inf
        if not math.isfinite(number):
            raise self.wrong(key, value, f"it must be a finite number; {_REMEDY}")
        return number

    def _place(self, key: str) -> str:
        return f"{self._name}.{key}" if self._name else key
