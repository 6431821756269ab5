"""A rotor that turns for as long as a page is looked at."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import can
import numpy as np
from support.live_service import running, watch_of
from support.recorded_rig import RATE_HZ, recorded_rig
from support.waiting import eventually

from drivers.can.plugin import frame_layout
from sim_hw.nodes.can_node import CanNode
from sim_hw.nodes.pacing import RealTimePacer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from daqsvc.service import Service

HEALTHY_S = 2.7
"""The paper's rotor is healthy for so long; then its damping goes."""


@contextlib.asynccontextmanager
async def live_rig(store: Path, channel: str, *, faulty: bool) -> AsyncIterator[Service]:
    """A service that watches the paper's rotor, which turns for as long as the test lasts."""
    machine, samples = recorded_rig(channel)
    machine = machine.model_copy(update={"recorder": None})
    whole = round(HEALTHY_S * 10) * 64
    healthy = samples[64 : whole // 3 * 3]
    played = np.concatenate([healthy, samples[len(healthy) :]] if faulty else [healthy] * 200)
    async with running(machine, store) as service:
        await eventually(lambda: service.drivers[0].link.state == "up", "the bus is up")
        layout = frame_layout(watch_of(service).machine, "shaft")
        with can.Bus(interface="virtual", channel=channel, protocol=can.CanProtocol.CAN_FD) as bus:
            node = CanNode(bus, layout, played[: len(played) // 3 * 3], RATE_HZ)
            playing = asyncio.create_task(node.play(RealTimePacer(service.clock)))
            try:
                yield service
            finally:
                playing.cancel()
                await asyncio.wait({playing})
