"""What authors of drivers build upon: `StreamDriver` as its help describes it."""

from __future__ import annotations

import pydoc
from typing import Any

import numpy as np
import pytest

from daqsvc.acquisition.clock import DrivenClock
from drivers.base import BusPort, DeviceAbsentError, StreamSpec
from drivers.frames import FrameLayout
from drivers.reconnect import CannotOpenError
from drivers.stream_driver import StreamDriver


class _Absent(StreamDriver):
    async def read(self) -> str:
        raise CannotOpenError("nothing has come for 5 s")


def _driver() -> _Absent:
    return _Absent(BusPort("eth", [], DrivenClock(), lambda _: None, start="error"), "UDP port 5005")


def test_help_names_everything_that_a_driver_of_ones_own_has() -> None:
    helped = pydoc.render_doc(StreamDriver)
    for name in vars(_driver()):
        assert name.startswith("_") or f" {name}: " in helped, name


async def test_a_device_that_is_absent_in_words_of_the_driver_counts_as_a_failure_to_open() -> None:
    driver = _driver()
    with pytest.raises(DeviceAbsentError, match="UDP port 5005: nothing has come for 5 s"):
        await driver.run()
    assert driver.counters.open_failures == 1


@pytest.mark.parametrize(
    ("stream", "payloads", "said"),
    [
        (
            "shaft",
            np.zeros((1, 8), np.uint8),
            "is given the stream 'shaft'; give it one of self.port.streams",
        ),
        (None, np.zeros((3, 8)), r"is given float64 \[3, 8\]; give it an array of uint8 \[n, 8\] of shaft"),
        (None, np.zeros((3, 7), np.uint8), r"is given uint8 \[3, 7\]; give it an array of uint8 \[n, 8\]"),
        (None, [[0] * 8], r"is given \[\[0, 0, .*; give it an array of uint8 \[n, 8\] of shaft"),
        (None, b"12345678", "is given b'12345678'; give it an array"),
    ],
)
def test_what_are_no_frames_of_a_stream_is_refused_with_what_to_give(
    stream: Any, payloads: Any, said: str
) -> None:
    layout = FrameLayout.plain(
        frame_id=1,
        length=8,
        channels=[("x", 16, "signed", 1.0, 0.0)],
        samples_per_frame=1,
        counter_byte=0,
        first_byte=4,
    )
    spec = StreamSpec("shaft", layout, 100.0)
    driver = _Absent(BusPort("eth", [spec], DrivenClock(), lambda _: None), "UDP port 5005")
    driver.take(spec, np.zeros((1, 8), np.uint8))
    with pytest.raises(ValueError, match=said):
        driver.take(stream or spec, payloads)
