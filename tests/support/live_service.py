"""A service that runs, and a device on the virtual bus that it reads."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import can
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.box import Box
from daqsvc.service import Service
from drivers.can.plugin import frame_layout
from sim_hw.nodes.can_node import CanNode
from sim_hw.nodes.pacing import RealTimePacer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    import numpy as np

    from daqsvc.acquisition.clock import Clock
    from daqsvc.machine_watch import MachineWatch
    from daqsvc.settings import MachineFile


@contextlib.asynccontextmanager
async def running(machine: MachineFile, store: Path, clock: Clock | None = None) -> AsyncIterator[Service]:
    """A service that watches one machine and is ready; it is stopped at the end."""
    async with running_box(Box.single(machine), store, clock) as service:
        yield service


@contextlib.asynccontextmanager
async def running_box(
    box: Box, store: Path, clock: Clock | None = None, read_again: Callable[[], Box] | None = None
) -> AsyncIterator[Service]:
    """A service that is ready; it is stopped at the end."""
    service = Service(box, store, clock, read_again=read_again)
    stop = asyncio.Event()
    task = asyncio.create_task(service.run(stop))
    try:
        await service.ready.wait()
        yield service
    finally:
        stop.set()
        await task


def watch_of(service: Service) -> MachineWatch:
    """The one machine of a service."""
    [watch] = service.watches.values()
    return watch


async def play(service: Service, samples: np.ndarray[Any, Any], rate_hz: float) -> None:
    """Play samples ``[n, channels]`` on the bus that the first stream of a service comes over."""
    stream = next(iter(watch_of(service).machine.streams))
    layout = frame_layout(watch_of(service).machine, stream)
    channel = watch_of(service).machine.buses["can0"].model_dump()["channel"]
    await eventually(lambda: service.drivers[0].link.state == "up", "the bus is up")
    with can.Bus(interface="virtual", channel=channel, protocol=can.CanProtocol.CAN_FD) as bus:
        await CanNode(bus, layout, samples, rate_hz).play(RealTimePacer(SystemClock()))
