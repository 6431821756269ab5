"""Error frames of a CAN controller, read as the health of the bus."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.can.batches import ERROR
from drivers.can.errors import CanCounters, ErrorCounts


def read(*frames: tuple[int, bytes]) -> ErrorCounts:
    data = np.zeros((len(frames), 8), np.uint8)
    for row, (_, payload) in enumerate(frames):
        data[row, : len(payload)] = np.frombuffer(payload, np.uint8)
    return ErrorCounts.of(np.array([ERROR | c for c, _ in frames], np.uint32), data)


@pytest.mark.parametrize(
    ("classes", "payload", "counts", "state"),
    [
        (0x001, b"", {"tx_timeouts": 1}, None),
        (0x002, b"\x05", {"arbitration_lost": 1}, None),
        (0x004, b"\x00\x01", {"rx_overflows": 1}, None),
        (0x004, b"\x00\x02", {"tx_overflows": 1}, None),
        (0x004, b"\x00\x04", {"error_warnings": 1}, "error-warning"),
        (0x004, b"\x00\x08", {"error_warnings": 1}, "error-warning"),
        (0x004, b"\x00\x10", {"error_passives": 1}, "error-passive"),
        (0x004, b"\x00\x20", {"error_passives": 1}, "error-passive"),
        (0x004, b"\x00\x40", {}, "error-active"),
        (0x088, b"\x00\x00\x04", {"protocol_violations": 1, "bus_errors": 1}, None),
        (0x010, b"\x00\x00\x00\x00\x04", {"transceiver_faults": 1}, None),
        (0x020, b"", {"no_acknowledge": 1}, None),
        (0x040, b"", {"bus_off": 1}, "bus-off"),
        (0x100, b"", {"restarts": 1}, "error-active"),
        (0x008, b"\x00\x3d", {"protocol_violations": 1}, None),
    ],
)
def test_each_class_is_read(classes: int, payload: bytes, counts: dict[str, int], state: str | None) -> None:
    found = read((classes, payload))
    assert found.counts == counts
    assert found.state == state


def test_the_last_state_counts_and_the_error_counters_are_kept() -> None:
    counters = CanCounters()
    counters.add(read((0x204, b"\x00\x20\x00\x00\x00\x00\x80\x07"), (0x040, b"")))
    assert (counters.controller_state, counters.tx_errors, counters.rx_errors) == ("bus-off", 128, 7)
    counters.add(read((0x020, b"")))
    assert counters.controller_state == "bus-off", "a frame that tells no state changes none"
    counters.add(read((0x100, b""), (0x004, b"\x00\x08")))
    assert counters.controller_state == "error-warning"
    assert (counters.bus_off, counters.restarts, counters.no_acknowledge) == (1, 1, 1)


def test_runs_of_error_frames_add_up() -> None:
    both = read((0x040, b"")).followed_by(read((0x040, b""), (0x002, b"")))
    assert both.counts == {"bus_off": 2, "arbitration_lost": 1}
    assert both.followed_by(read((0x002, b""))).state == "bus-off"
