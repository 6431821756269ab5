"""The service as a whole: sensors that fail, brokers that are away, restarts."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.brokers import Consumer
from support.live_service import play, running, watch_of
from support.ports import free_port
from support.waiting import eventually

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.box import Box
from daqsvc.recording.recording import Recording
from daqsvc.service import Service
from daqsvc.settings import load_machine_file
from sim_hw.demo.broker import EmbeddedBroker
from sim_hw.demo.machines import for_recording, laval_rig
from sim_hw.demo.session import DemoSession, Script
from sim_hw.scenario import load_scenario

if TYPE_CHECKING:
    from pathlib import Path

    from sim_hw.demo.session import Received

pytestmark = pytest.mark.integration
RATE_HZ = 2000.0
REPLAYED = """
schema_version = 1
site = "lab"
box = "edge-1"

[machine]
name = "replayed"
speed_rpm = 1500.0

[buses.tape]
driver = "replay"
file = "run.npz"

[streams.housing]
bus = "tape"
rate_hz = 2000.0
layout = { columns = [{ name = "accel", column = "accel" }] }

[[sensors]]
name = "accel"
type = "accelerometer"
stream = "housing"
channel = "accel"
unit = "g"

[pipeline.levels]
window_s = 0.1
velocity_band_hz = [10.0, 800.0]

[[alarms]]
name = "vibration"
sensor = "accel"
measure = "rms"
alert = 0.5
"""


def shaking(seconds: float) -> Recording:
    """One loud channel, far over its limits."""
    samples = np.random.default_rng(0).normal(size=(round(seconds * RATE_HZ), 1))
    return Recording(("accel",), samples, RATE_HZ, __file__, 0)  # type: ignore[arg-type]


async def shake(service: Service, seconds: float) -> None:
    await play(service, shaking(seconds).samples, RATE_HZ)


async def test_alarms_raised_without_a_broker_go_out_after_a_restart(tmp_path: Path) -> None:
    port = free_port()
    machine = for_recording(shaking(1), "g", {"accel": (0.5, 5.0)}, f"mqtt://127.0.0.1:{port}")
    async with running(machine, tmp_path) as service:
        await shake(service, 1.0)
        await eventually(lambda: service.alarms.outbox.counters.appended == 1, "the alarm is on disk")
    async with EmbeddedBroker(port) as broker, Consumer(broker.port) as consumer:
        async with running(machine, tmp_path) as service:
            await eventually(lambda: consumer.on("/alarms/"), "the alarm arrives")
            await eventually(
                lambda: service.alarms.outbox.counters.depth == 0, "the broker has acknowledged it"
            )
        async with running(machine, tmp_path):
            pass
        alarms = consumer.on("/alarms/vibration-accel")
    assert alarms[0].payload["kind"] == "raised"
    assert alarms[0].payload["cause"]["statistics"]["rms"] == pytest.approx(1.0, rel=0.2)
    assert {alarm.payload["id"] for alarm in alarms} == {alarms[0].payload["id"]}, "repeats keep their id"


async def test_a_probe_out_of_its_ok_limits_suppresses_its_alarm_and_is_told() -> None:
    scenario = load_scenario("healthy")
    machine = scenario.simulate(0)
    samples = np.column_stack([machine.channels[name] for name in ("x_um", "y_um", "keyphasor_v")])
    samples = samples[: 30 * 64]
    third = len(samples) // 3
    # The cable comes loose: the gap voltage leaves its limits, and the reading shakes enough for an alarm.
    loose = slice(third, 2 * third)
    samples[loose, 0] = 800.0 + 200.0 * np.random.default_rng(1).normal(size=third)
    heard: list[Received] = []
    script = Script(
        title="loose cable",
        machine=lambda url: laval_rig(scenario, machine.noise_um, url),
        stream="shaft",
        samples=samples,
        rate_hz=machine.rate_hz,
        samples_per_rev=64,
    )
    outcome = await DemoSession(script, speed=1000, broker_url=None, on_message=heard.append).run()
    assert outcome.complete
    alarms = [(m.payload["alarm"], m.payload["kind"]) for m in heard if m.kind == "alarm"]
    assert ("sensor-ok/probe-x", "raised") in alarms
    assert ("sensor-ok/probe-x", "returned") in alarms
    assert ("shaft-vibration-x", "suppressed") in alarms
    assert ("shaft-vibration-x", "unsuppressed") in alarms
    assert ("shaft-vibration-x", "raised") not in alarms
    assert not [name for name, _ in alarms if name.startswith("shaft-vibration-y")]
    told = next(m.payload for m in heard if m.kind == "alarm" and m.payload["alarm"] == "sensor-ok/probe-x")
    assert "outside its OK limits -14 to -6 V" in told["message"]
    assert told["cause"]["quality"] == "not_ok"


@pytest.mark.long
async def test_a_bus_that_falls_silent_holds_the_alarm_and_is_told(tmp_path: Path) -> None:
    async with EmbeddedBroker() as broker, Consumer(broker.port) as consumer:
        machine = for_recording(shaking(1), "g", {"accel": (0.5, 5.0)}, broker.url)
        async with running(machine, tmp_path) as service:
            await eventually(lambda: consumer.on("/availability"), "the box is online")
            await shake(service, 1.0)
            await eventually(lambda: consumer.on("/alarms/vibration-accel"), "the alarm is raised")
            await eventually(lambda: consumer.on("/alarms/sensor-ok/accel"), "the silence is told")
            assert service.alarms.manager.alarms["vibration-accel"].level.label == "alert"
            told = consumer.on("/alarms/sensor-ok/accel")[0].payload
            assert "no samples of stream 'recording' for more than" in told["message"]
            assert told["cause"]["decision"] == "alert"
            # Good again is what has been good for some seconds.
            await shake(service, 8.0)
            await eventually(
                lambda: consumer.on("/alarms/sensor-ok/accel")[-1].payload["kind"] == "returned",
                "the samples are back",
            )
            quality = [m.payload for m in consumer.on("/alarms/sensor-ok/accel")]
            assert [payload["kind"] for payload in quality] == ["raised", "returned"], "one outage, one alarm"
            times_ns = [payload["monotonic_ns"] for payload in quality]
            assert times_ns == sorted(times_ns)
        assert [m.payload["kind"] for m in consumer.on("/alarms/vibration-accel")] == ["raised"]


async def test_a_stop_does_not_wait_for_kernels_that_compile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = threading.Event()
    machine = for_recording(shaking(1), "g", {}, f"mqtt://127.0.0.1:{free_port()}")
    service = Service(Box.single(machine), tmp_path)
    monkeypatch.setattr(watch_of(service).pipeline.detectors[0], "warm", lambda: compiled.wait(120))
    stop = asyncio.Event()
    task = asyncio.create_task(service.run(stop))
    await asyncio.sleep(0.1)
    assert not service.ready.is_set()
    stop.set()
    async with asyncio.timeout(30):
        await task
    assert not service.ready.is_set()
    assert not compiled.is_set()
    compiled.set()


async def test_a_recording_that_has_been_played_holds_the_alarm_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daqsvc.dsp.quality.missing.SILENCE_NS", NS_PER_S // 10)
    np.savez(tmp_path / "run.npz", accel=shaking(0.5).samples[:, 0])
    path = tmp_path / "machine.toml"
    path.write_text(REPLAYED, encoding="utf-8")
    async with running(load_machine_file(path), tmp_path / "store") as service:
        alarms = service.alarms.manager.alarms
        message = (
            "sensor-ok/accel alert: accel cannot be judged: no more samples of stream 'housing': "
            f"replayed bus 'tape' ({tmp_path / 'run.npz'}) has ended: end of file"
        )
        # A busy machine may be silent for long before the recording begins, too, and says so.
        await eventually(
            lambda: "sensor-ok/accel" in alarms and alarms["sensor-ok/accel"].message == message,
            "the end of the recording is an alarm",
        )
        assert alarms["vibration"].level.label == "alert", "the end of a recording clears nothing"
