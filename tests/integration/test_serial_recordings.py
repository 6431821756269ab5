"""Framed text as a real logger wrote it: the lines of the motor recordings against an independent parse."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from drivers.serial_lines import LineFraming, LineLayout

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.data

COLUMNS = ("mean-x", "mean-y", "mean-z", "x", "y", "z", "t")
START_OF_FILE = 999.0


def test_every_record_of_every_motor_is_read_as_it_is_written(data: Path) -> None:
    files = sorted((data / "mrecio_motors").rglob("*.dat"))
    assert len(files) > 5
    for file in files:
        raw = file.read_bytes()
        layout = LineLayout(COLUMNS, ("x", "y", "z"), np.ones(3), np.zeros(3), time="t", time_unit="ms")
        framing = LineFraming({"motor": layout}, {"motor": 30.0}, delimiter=b";")
        found = [framing.cut(raw[at : at + 777]) for at in range(0, len(raw), 777)]
        got = np.concatenate([part.frames["motor"].decoded.samples[:, 0] for part in found if part.frames])
        numbers = np.array(raw.decode("ascii").replace(";", ",").rstrip(",\r\n ").split(","), np.float64)
        records = numbers.reshape(-1, len(COLUMNS))
        assert (records[0] == START_OF_FILE).all()
        # The first record is left out: without a checksum nothing shows that its beginning is there.
        np.testing.assert_array_equal(got, records[1:, 3:6].astype(np.float32), err_msg=file.name)
        assert sum(part.malformed for part in found) == 0
