"""What authors of drivers build upon: `StreamDriver` as its help describes it."""

from __future__ import annotations

import pydoc

import pytest

from daqsvc.acquisition.clock import DrivenClock
from drivers.base import BusPort, DeviceAbsentError
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
