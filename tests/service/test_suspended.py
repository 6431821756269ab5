"""A process that is suspended and a wall clock that steps: neither raises, clears nor reorders anything."""

from __future__ import annotations

import asyncio
import contextlib
import signal
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.brokers import Consumer
from support.can_gateway import MACHINE, SAMPLES_PER_FRAME, CanGateway, daqsvc_run
from support.clocks import SteppedClock
from support.examples import first_of
from support.live_service import play
from support.ports import free_port
from support.waiting import eventually

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock
from daqsvc.acquisition.ring import SampleRing
from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.states import AlarmState
from daqsvc.box import Box
from daqsvc.diagnosis.pipeline import Pipeline
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.recording.recording import Recording
from daqsvc.service import Service
from sim_hw.demo.broker import EmbeddedBroker
from sim_hw.demo.machines import for_recording

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from support.brokers import Received

pytestmark = pytest.mark.integration
RATE_HZ = 2000.0
HOUR_NS = 3600 * NS_PER_S
SUSPENDED_S = 4.0
"""Longer than the silence that is told, shorter than 30 s: a suspended process cannot tell the difference."""
ALARMS = """
[[alarms]]
name = "shaking"
sensor = "accel"
measure = "rms"
alert = 0.5
latching = true
"""


@contextlib.asynccontextmanager
async def running(service: Service) -> AsyncIterator[None]:
    stop = asyncio.Event()
    task = asyncio.create_task(service.run(stop))
    try:
        await service.ready.wait()
        yield
    finally:
        stop.set()
        await task


def noise(rms: float) -> np.ndarray[Any, Any]:
    return rms * np.random.default_rng(0).normal(size=(round(RATE_HZ), 1))


async def shake(service: Service, rms: float) -> None:
    await play(service, noise(rms), RATE_HZ)


@pytest.mark.long
@pytest.mark.parametrize("step_ns", first_of(-HOUR_NS, HOUR_NS))
async def test_a_wall_clock_that_steps_moves_no_alarm(step_ns: int, tmp_path: Path) -> None:
    recording = Recording(("accel",), noise(1.0), RATE_HZ, __file__, 0)  # type: ignore[arg-type]
    clock = SteppedClock()
    async with EmbeddedBroker() as broker, Consumer(broker.port) as consumer:
        machine = for_recording(recording, "g", {"accel": (0.5, 5.0)}, broker.url)
        service = Service(Box.single(machine), tmp_path, clock)

        def state() -> AlarmState:
            return service.alarms.manager.alarms["vibration-accel"].state

        async with running(service):
            await shake(service, 1.0)
            await eventually(lambda: state().is_active, "the alarm is raised")
            shelve = AlarmCommand(verb=Verb.SHELVE, alarm="vibration-accel", by="ann", duration_s=1800.0)
            assert (await service.alarms.execute(shelve, "test")).accepted
            await eventually(lambda: len(consumer.on("/alarms/vibration-accel")) == 2, "both events are out")
            clock.ahead_ns = step_ns
            await shake(service, 1.0)
            assert state() is AlarmState.SHELVED, "half an hour is not over because a clock was set"
            unshelve = AlarmCommand(verb=Verb.UNSHELVE, alarm="vibration-accel", by="ann")
            assert (await service.alarms.execute(unshelve, "test")).accepted
            assert state() is AlarmState.ACTIVE_UNACKNOWLEDGED
            await shake(service, 0.1)
            await eventually(lambda: not state().is_active, "the alarm returns")
        told = [message.payload for message in consumer.on("/alarms/vibration-accel")]
    assert [event["kind"] for event in told] == ["raised", "shelved", "unshelved", "returned"]
    assert len({event["occurrence"] for event in told}) == 1
    for order in ("sequence", "monotonic_ns"):
        assert [event[order] for event in told] == sorted(event[order] for event in told)


class Listener:
    """A detector that says when nothing comes."""

    name, stream, block = "listener", "s", 10

    def warm(self) -> None: ...

    def process(self, window: Any) -> list[Diagnosis]:
        return []

    def silent(self, silence_s: float, t_ns: int) -> list[Diagnosis]:
        return [Diagnosis("m", self.name, t_ns, "s", 0, 0, "N", quality="missing", reason=f"{silence_s:g} s")]


async def test_whoever_was_suspended_has_not_heard_a_silence() -> None:
    clock, ring = DrivenClock(), SampleRing("s", ("a",), 50)
    said: list[Diagnosis] = []
    pipeline = Pipeline({"s": ring}, [Listener()], said.append, clock)
    task = asyncio.create_task(pipeline.run())

    async def pass_time(*steps_s: float) -> None:
        for step_s in steps_s:
            await asyncio.sleep(0.005)
            clock.advance_to(clock.monotonic_ns() + round(step_s * NS_PER_S))
        await asyncio.sleep(0.005)

    await pass_time(0.5, 0.5, 30.0)
    assert not said, "one and a half seconds were listened to"
    await pass_time(0.5)
    assert [diagnosis.reason for diagnosis in said] == ["2 s"]
    ring.close()
    await task


@pytest.mark.long
@pytest.mark.parametrize("lossy", [False, True], ids=["the socket keeps it", "the buffers overflow"])
async def test_a_suspended_process_raises_clears_and_reorders_nothing(lossy: bool, tmp_path: Path) -> None:  # noqa: FBT001
    file, store = tmp_path / "motor.toml", tmp_path / "store"
    port = free_port()
    async with EmbeddedBroker(port) as broker, Consumer(broker.port) as consumer, CanGateway() as gateway:
        file.write_text(MACHINE.format(gateway=gateway.port, broker=port, alarms=ALARMS))

        def heard() -> list[Received]:
            return consumer.on("/alarms/")

        def figures() -> dict[str, Any]:
            status = consumer.on("/status")
            return status[-1].payload["figures"] if status else {}

        def samples(what: str) -> int:
            return figures().get("streams", {}).get("shaking", {}).get(f"samples_{what}", 0)

        async with daqsvc_run(file, store) as process:
            gateway.rms_g = 1.0
            await eventually(lambda: consumer.on("/alarms/shaking"), "the alarm is raised")
            # What was raised while the process started is over.
            await eventually(lambda: samples("received") > 1500, "samples come")
            before = len(heard())
            process.send_signal(signal.SIGSTOP)
            async with gateway.losing() if lossy else contextlib.nullcontext():
                await asyncio.sleep(SUSPENDED_S)
            process.send_signal(signal.SIGCONT)
            said = len(consumer.on("/status"))
            await eventually(lambda: len(consumer.on("/status")) > said + 3, "it goes on")
            if lossy:  # good again is what has been good for some seconds
                await eventually(
                    lambda: heard()[-1].payload["kind"] == "returned", "the samples are good again"
                )
            after = [message.payload for message in heard()[before:]]
            lost = samples("lost")
            assert figures()["suspensions"] >= 1, "a busy test machine may make it more"
            assert [event["alarm"] for event in after if not event["alarm"].startswith("sensor-ok/")] == []
            if lossy:
                assert lost == gateway.frames_withheld * SAMPLES_PER_FRAME, "every lost sample is counted"
                assert [event["kind"] for event in after] == ["raised", "returned"], "what is missing is told"
            else:
                assert (lost, after) == (0, [])
            gateway.rms_g = 0.1
            await eventually(
                lambda: consumer.on("/alarms/shaking")[-1].payload["kind"] == "latched", "it still listens"
            )
        told = [message.payload for message in heard()]
    assert [event["kind"] for event in told if event["alarm"] == "shaking"] == ["raised", "latched"]
    for order in ("sequence", "monotonic_ns"):
        assert [event[order] for event in told] == sorted(event[order] for event in told)
    assert b"the process did not run for" in (tmp_path / "log").read_bytes()
