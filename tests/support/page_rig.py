"""A rotor that turns for as long as a page is open."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import can
import numpy as np
from pydantic import TypeAdapter
from support.live_service import running, watch_of
from support.recorded_rig import RATE_HZ, recorded_rig
from support.waiting import eventually

from daqsvc.settings.models import machine_file_model
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
async def live_rig(
    store: Path, channel: str, *, faulty: bool, mqtt: dict[str, Any] | None = None
) -> AsyncIterator[Service]:
    """A service that watches the paper's rotor, which turns for as long as the test lasts.

    Args:
        store: its store.
        channel: name of the virtual bus.
        faulty: whether the rotor's faults come on; else it stays healthy.
        mqtt: its table ``[mqtt]``; None for no broker.
    """
    machine, samples = recorded_rig(channel)
    table = mqtt and machine_file_model().model_fields["mqtt"].annotation
    broker = table and TypeAdapter(table).validate_python(mqtt)
    machine = machine.model_copy(update={"recorder": None, "mqtt": broker})
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
