"""A replay goes as fast as it is asked to."""

from __future__ import annotations

import pytest

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.offline.replay import Pace


@pytest.mark.parametrize(("speed", "takes_s"), [(1.0, 10.0), (4.0, 2.5), (0.5, 20.0)])
async def test_time_goes_by_at_the_speed_that_is_asked_for(speed: float, takes_s: float) -> None:
    now_s = 1000.0
    slept: list[float] = []

    async def sleep(seconds: float) -> None:
        nonlocal now_s
        slept.append(seconds)
        now_s += seconds

    pace = Pace(speed, lambda: now_s, sleep)
    for tenth in range(101):
        await pace(tenth * NS_PER_S // 10)
        now_s += 0.01 if tenth < 50 else 0.0  # what the detectors take, which is no reason to be late
    assert now_s - 1000.0 == pytest.approx(takes_s)
    assert min(slept) > 0.0


async def test_what_is_late_is_not_held_up() -> None:
    now_s = 0.0

    async def sleep(_: float) -> None:
        pytest.fail("it is late already")

    pace = Pace(1.0, lambda: now_s, sleep)
    await pace(0)
    now_s = 3.0
    await pace(2 * NS_PER_S)
