"""Framed text as a real logger wrote it: the lines of the motor recordings against an independent parse."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.bus_tables import line_layout, serial_bus

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock
from drivers.base import BusPort, StreamSpec
from drivers.serial.driver import SerialDriver, framing_of
from drivers.serial.lines import LineFraming

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.acquisition.samples import SampleBlock

pytestmark = [pytest.mark.integration, pytest.mark.data]

COLUMNS = ("mean-x", "mean-y", "mean-z", "x", "y", "z", "t")
START_OF_FILE, END_OF_FILE = 999.0, 111.0
MOTOR = line_layout(COLUMNS, ("x", "y", "z"), time="t", unit="ms")
RATE_HZ = 100.0


def records_of(raw: bytes) -> np.ndarray:
    """The records as numbers, float64 ``[n, columns]``."""
    numbers = raw.decode("ascii").replace(";", ",").rstrip(",\r\n ").split(",")
    return np.array(numbers, np.float64).reshape(-1, len(COLUMNS))


def test_every_record_of_every_motor_is_read_as_it_is_written(data: Path) -> None:
    files = sorted((data / "mrecio_motors").rglob("*.dat"))
    assert len(files) > 5
    for file in files:
        raw = file.read_bytes()
        framing = LineFraming({"motor": MOTOR}, {"motor": RATE_HZ}, delimiter=b";")
        found = [framing.cut(raw[at : at + 777]) for at in range(0, len(raw), 777)]
        got = np.concatenate([part.frames["motor"].samples[:, 0] for part in found if part.frames])
        records = records_of(raw)
        assert (records[0] == START_OF_FILE).all()
        # The first record is left out: without a checksum nothing shows that its beginning is there.
        np.testing.assert_array_equal(got, records[1:, 3:6].astype(np.float32), err_msg=file.name)
        assert sum(part.notes["frames_malformed"] for part in found) == 0


@pytest.mark.long
def test_every_record_of_every_motor_comes_through_the_driver_in_its_place(data: Path) -> None:
    """Up to four records share a stamp, which is from a clock of 16.8 or 33.6 ms."""
    for file in sorted((data / "mrecio_motors").rglob("*.dat")):
        raw = file.read_bytes()
        records = records_of(raw)
        taken = records[1:-1]
        assert (records[-1] == END_OF_FILE).all()
        blocks: list[SampleBlock] = []
        bus = serial_bus(port="/dev/null", framing="lines", delimiter=";")
        specs = [StreamSpec("motor", MOTOR, RATE_HZ)]
        driver = SerialDriver(bus, BusPort("ser0", specs, DrivenClock(), blocks.append))
        framing = framing_of(bus, specs)
        stamps_ns = NS_PER_S + np.rint(records[:, -1] * 1e6).astype(np.int64)
        stamps_ns[[0, -1]] = stamps_ns[[1, -2]]
        lines = [line + b";" for line in raw.split(b";")[: len(records)]]
        for at in range(0, len(lines), 3):
            chunk = b"".join(lines[at : at + 3])
            stamps = stamps_ns[at : at + 3]
            driver.accept(framing.cut(chunk, lambda ends, stamps=stamps: stamps[-len(ends) :]))
        driver._assemblers["motor"].flush()
        got = np.concatenate([block.samples for block in blocks])
        np.testing.assert_array_equal(got, taken[:, 3:6].astype(np.float32), err_msg=file.name)
        counters, time_base = driver.streams["motor"]
        assert counters.frames_duplicate == counters.frames_late == counters.frames_reordered == 0
        assert counters.frames_rejected == 1, "the mark at the end"
        assert time_base.restarts == 0
        index = np.concatenate([block.first_index + np.arange(len(block.samples)) for block in blocks])
        assert (np.diff(index) >= 1).all()
        # But for the device's rate, samples lie where their stamps say, as far as those can say.
        off_ms = index / RATE_HZ * 1e3 - taken[:, -1]
        drift_ms = np.polyval(np.polyfit(taken[:, -1], off_ms, 1), taken[:, -1])
        assert np.ptp(off_ms - drift_ms) < 100.0
