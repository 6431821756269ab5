"""The paper's rotor on a virtual bus with a service that records it, in driven time."""

from __future__ import annotations

import asyncio
import contextlib
from functools import cache
from typing import TYPE_CHECKING

import can
import numpy as np
from support.live_service import running, watch_of
from support.waiting import eventually

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock
from daqsvc.settings.recorder import Recorder as RecorderTable
from drivers.can.plugin import frame_layout
from sim_hw.demo.machines import laval_rig
from sim_hw.nodes.can_node import CanNode
from sim_hw.nodes.pacing import DrivenPacer
from sim_hw.scenario import load_scenario

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from daqsvc.acquisition.samples import Samples
    from daqsvc.recorder import MachineRecorder
    from daqsvc.service import Service
    from daqsvc.settings import MachineFile

RATE_HZ = 640.0


def recorded_rig(bus: str, **recorder: float) -> tuple[MachineFile, Samples]:
    """The machine file, without a broker, and what its probes see: faults come on one after the other.

    Args:
        bus: name of the virtual bus, one of its own for each test.
        recorder: its table ``[recorder]``.
    """
    machine, samples = _rig()
    can0 = machine.buses["can0"].model_copy(update={"channel": bus})
    table = RecorderTable.model_validate({"reserve_mb": 0, **recorder})
    update = {"mqtt": None, "recorder": table, "buses": {"can0": can0}}
    return machine.model_copy(update=update), samples


@cache
def _rig() -> tuple[MachineFile, Samples]:
    scenario = load_scenario("paper")
    run = scenario.simulate(3)
    samples = np.column_stack([run.channels[name] for name in ("x_um", "y_um", "keyphasor_v")])
    return laval_rig(scenario, run.noise_um, "mqtt://localhost"), samples.astype(np.float32)


@contextlib.asynccontextmanager
async def recording(machine: MachineFile, store: Path) -> AsyncIterator[tuple[Service, DrivenClock]]:
    """A service on a driven clock; its bus is up."""
    clock = DrivenClock()
    async with running(machine, store, clock) as service:
        await eventually(lambda: service.drivers[0].link.state == "up", "the bus is up")
        yield service, clock


def recorder_of(service: Service) -> MachineRecorder:
    """The recorder of the one machine of a service."""
    recorder = watch_of(service).recorder
    assert recorder is not None
    return recorder


async def play(service: Service, clock: DrivenClock, samples: Samples, first_index: int = 0) -> None:
    """Play samples of the one stream of a service on its bus, as fast as it goes.

    Args:
        service: that watches the machine.
        clock: of the service.
        samples: ``[n, channels]``.
        first_index: what the device has counted before.
    """
    machine = watch_of(service).machine
    [(name, stream)] = machine.streams.items()
    channel = machine.buses["can0"].model_dump()["channel"]
    with can.Bus(interface="virtual", channel=channel, protocol=can.CanProtocol.CAN_FD) as bus:
        layout = frame_layout(machine, name)
        node = CanNode(bus, layout, samples, stream.rate_hz, first_index=first_index)
        counters = service.drivers[0].streams[name][0]
        frames_before = counters.frames_received
        recorder = recorder_of(service)

        def backlog() -> int:
            if recorder.is_writing:
                return len(samples)  # driven time waits for the disk, as real time has no need to
            on_the_way = node.frames_sent + frames_before - counters.frames_received
            return on_the_way * node.samples_per_frame + watch_of(service).pipeline.behind_samples

        blocks = [detector.block for detector in watch_of(service).pipeline.detectors]
        await node.play(DrivenPacer(clock, backlog, 2 * max(blocks) + 64))
        await eventually(lambda: backlog() <= max(blocks), "the last frames have been judged")


async def let_time_pass(service: Service, clock: DrivenClock, seconds: float) -> None:
    """Let driven time pass, in steps that leave everybody a turn, and the recorder the time to write."""
    recorder = recorder_of(service)
    for _ in range(round(seconds / 0.05)):
        clock.advance_to(clock.monotonic_ns() + NS_PER_S // 20)
        await asyncio.sleep(0.001)
        await eventually(lambda: not recorder.is_writing, "what has come is written")
