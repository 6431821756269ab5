"""A rotor whose probes come over two buses, with clocks of their own: what the operator sees is the same."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING

import can
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from support.live_service import watch_of
from support.machine_files import MACHINES
from support.waiting import eventually

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.box import Box
from daqsvc.service import Service
from daqsvc.settings import parse_machine_file
from drivers.can.plugin import frame_layout
from sim_hw.nodes.can_node import to_frames
from sim_hw.nodes.pacing import DrivenPacer
from sim_hw.scenario import Scenario

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.diagnosis.record import Diagnosis

pytestmark = pytest.mark.integration
SPEED_HZ = 25.0
CHANGED_REV, LAST_REV = 420.0, 500.0
NOISE_UM, NOISE_V = 1.0, 0.02
CHANNELS = {"x": "x_um", "y": "y_um", "kph": "keyphasor_v"}


@pytest.fixture(scope="module")
def shaft():
    """Motion and keyphasor as functions of time in s: an unbalance that grows by three quarters."""
    machine = Scenario.model_validate(
        {
            "title": "a pump",
            "revolutions": LAST_REV,
            "samples_per_rev": 128.0,
            "plant": {
                "kind": "rotor",
                "speed_rpm": 60.0 * SPEED_HZ,
                "rotor": {"speed_ratio": 0.8, "damping_ratio": 0.11, "eccentricity": 0.1},
            },
            "noise": {"snr_db": 80.0, "keyphasor_v": 0.0},
            "onset": [{"mode": "unbalance", "at_rev": CHANGED_REV, "change": {"eccentricity": 0.175}}],
        }
    ).simulate(4)
    t_s = np.arange(len(machine)) / machine.rate_hz
    return {name: CubicSpline(t_s, machine.channels[of]) for name, of in CHANNELS.items()}


def machine_file(name):
    text = (MACHINES / name).read_text(encoding="utf-8").replace('"socketcan"', '"virtual"')
    return parse_machine_file(text[: text.index("[mqtt]")], MACHINES / name)


def device_frames(service, stream, shaft, ppm, delay_ms, rng):
    """Frames of a device whose clock is ``ppm`` fast: when each arrives, and its bytes."""
    layout = frame_layout(watch_of(service).machine, stream)
    rate_hz = watch_of(service).machine.streams[stream].rate_hz * (1.0 + ppm * 1e-6)
    t_s = np.arange(math.floor((LAST_REV / SPEED_HZ - 0.1) * rate_hz)) / rate_hz
    noise = {"x": NOISE_UM, "y": NOISE_UM, "kph": NOISE_V}
    samples = [shaft[name](t_s) + noise[name] * rng.normal(size=len(t_s)) for name in layout.channels]
    frames = to_frames(np.column_stack(samples), layout, rate_hz, clip=True)
    late = frames.t_ns + rng.uniform(0.0, delay_ms * 1e6, len(frames.t_ns))
    bus = watch_of(service).machine.streams[stream].bus
    channel = watch_of(service).machine.buses[bus].model_dump()["channel"]
    arrival_ns = np.maximum.accumulate(late).astype(np.int64).tolist()
    return [
        (t_ns, channel, layout.frame_id, payload.tobytes())
        for t_ns, payload in zip(arrival_ns, frames.payloads, strict=True)
    ]


async def watch(machine, shaft, ppm, store: Path) -> tuple[Service, list[Diagnosis]]:
    """Play the shaft's motion to a service, in simulated time."""
    clock = DrivenClock()
    service = Service(Box.single(machine), store, clock)
    heard: list[Diagnosis] = []
    report = watch_of(service).pipeline._report
    watch_of(service).pipeline._report = lambda diagnosis: (heard.append(diagnosis), report(diagnosis))
    stop = asyncio.Event()
    running = asyncio.create_task(service.run(stop))
    sent = 0

    def backlog():
        counted = [counters for driver in service.drivers for counters, _ in driver.streams.values()]
        on_the_way = sent - sum(counters.frames_received for counters in counted)
        # What is on the way is stamped late; what detectors have not read yet is not.
        return 1_000_000 * on_the_way + watch_of(service).pipeline.behind_samples

    try:
        await service.ready.wait()
        await eventually(lambda: all(d.link.state == "up" for d in service.drivers), "the buses are up")
        rng = np.random.default_rng(7)
        frames = [
            frame
            for stream in machine.streams
            for frame in device_frames(service, stream, shaft, ppm[stream], 5.0, rng)
        ]
        buses = {
            channel: can.Bus(interface="virtual", channel=channel, protocol=can.CanProtocol.CAN_FD)
            for channel in {channel for _, channel, _, _ in frames}
        }
        pacer = DrivenPacer(clock, backlog, 10_000)
        try:
            for t_ns, channel, frame_id, payload in sorted(frames):
                await pacer.wait_until(t_ns)
                buses[channel].send(
                    can.Message(arbitration_id=frame_id, is_extended_id=False, is_fd=True, data=payload)
                )
                sent += 1
            await eventually(lambda: backlog() < 10_000, "the last frames are read")
        finally:
            for bus in buses.values():
                bus.shutdown()
    finally:
        stop.set()
        await running
    return service, heard


@pytest.mark.long
async def test_probes_on_two_buses_give_the_diagnosis_of_one(shaft, tmp_path: Path) -> None:
    one, heard_one = await watch(
        machine_file("rotor-synchronous.toml"), shaft, {"shaft": 50.0}, tmp_path / "one"
    )
    two, heard_two = await watch(
        machine_file("rotor-two-buses.toml"), shaft, {"shaft-y": 50.0, "shaft-x": -50.0}, tmp_path / "two"
    )
    said = [
        [d for d in heard if d.detector == "rotor-synchronous" and d.quality == "good"]
        for heard in (heard_one, heard_two)
    ]
    decisions = [[d.decision for d in those if d.changed] for those in said]
    assert decisions[0] == decisions[1]
    assert decisions[0][-2:] == ["departure", "unbalance"]
    assert {d.stream for d in said[1]} == {"shaft-y+shaft-x"}
    for service in (one, two):
        assert "unbalance" in service.alarms.manager.alarms["rotor-changed"].message
        # Nobody is alarmed because clocks must be learnt first.
        assert "detector-ok/rotor-synchronous" not in service.alarms.manager.alarms
    # The healthy state too: 1X forward and backward, and the mean position, in um.
    baselines = []
    for service in (one, two):
        (detector,) = (d for d in watch_of(service).pipeline.detectors if d.name == "rotor-synchronous")
        baselines.append(detector.watch.calibration.baseline)
    np.testing.assert_allclose(baselines[1], baselines[0], atol=0.5)
    grid = two.figures()["grids"]["shaft-y+shaft-x"]
    assert grid["shaft-x"]["error_us"] < 100.0
    assert grid["shaft-x"]["steps"] == 1
    assert grid["shaft-y"] == {"rows_missing": 0, "rows_withheld": 0, "steps": 0, "error_us": 0.0}
