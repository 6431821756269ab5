"""A service that runs, and a device on the virtual bus that it reads."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import can
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.service import Service
from drivers.can.plugin import frame_layout
from sim_hw.nodes.can_node import CanNode
from sim_hw.nodes.pacing import RealTimePacer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    import numpy as np

    from daqsvc.acquisition.clock import Clock
    from daqsvc.settings import MachineFile


@contextlib.asynccontextmanager
async def running(machine: MachineFile, store: Path, clock: Clock | None = None) -> AsyncIterator[Service]:
    """A service that is ready; it is stopped at the end."""
    service = Service(machine, store, clock)
    stop = asyncio.Event()
    task = asyncio.create_task(service.run(stop))
    try:
        await service.ready.wait()
        yield service
    finally:
        stop.set()
        await task


async def play(service: Service, samples: np.ndarray[Any, Any], rate_hz: float) -> None:
    """Play samples ``[n, channels]`` on the bus that the first stream of a service comes over."""
    stream = next(iter(service.machine.streams))
    layout = frame_layout(service.machine, stream)
    channel = service.machine.buses["can0"].model_dump()["channel"]
    await eventually(lambda: service.drivers[0].link.state == "up", "the bus is up")
    with can.Bus(interface="virtual", channel=channel, protocol=can.CanProtocol.CAN_FD) as bus:
        await CanNode(bus, layout, samples, rate_hz).play(RealTimePacer(SystemClock()))
