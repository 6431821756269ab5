"""A device that does its worst on any bus moves counters and is said; it costs no other bus a sample."""

from __future__ import annotations

import asyncio
import collections
import logging
import tracemalloc
from typing import TYPE_CHECKING

import pytest
from support.machine_files import LAVAL
from support.rogue_buses import LAYOUT, machine_text
from support.rogue_devices import WORST, RogueDevices, recording
from support.waiting import eventually

from daqsvc.box import Box
from daqsvc.service import Service
from daqsvc.settings import parse_machine_file
from drivers.can.plugin import frame_layout

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration
SEED = 19
KINDS = ("can", "cobs", "sync", "lines", "tcp", "rtu", "replay")
STOP_S = 60.0
"""The service promises two seconds; a busy machine may take many more."""
TURNS_WAITING = 1000
IN_HAND_FRAMES = 20_000
GROWTH_BYTES = 8_000_000
LINES_EACH = 4


class Watch:
    """Looks at how much a service has in hand."""

    def __init__(self, service: Service) -> None:
        self.frames = self.turns = 0
        self._service = service

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            for driver in self._service.drivers:
                for unit in getattr(driver, "_assemblers", {}).values():
                    held = sum(len(counter) for counter, _, _ in unit._unplaced) + len(unit._held_index)
                    self.frames = max(self.frames, held)
            self.turns = max(self.turns, len(loop._ready))  # type: ignore[attr-defined]
            await asyncio.sleep(0.02)


async def all_do_their_worst(kinds: tuple[str, ...], folder: Path, phase_s: float, rounds: int = 1) -> None:
    """Run a service beside rogues for some rounds of all they do, and look at what it has cost."""
    with RogueDevices(folder, SEED) as devices:
        machine = parse_machine_file(machine_text(kinds, devices), LAVAL)
        if "replay" in kinds:
            layout = frame_layout(machine, "replay")
            recording(folder / "rogue.log", layout, WORST, phase_s, SEED)
        service = Service(Box.single(machine), folder / "store")
        stop = asyncio.Event()
        running = asyncio.create_task(service.run(stop))
        watch = Watch(service)
        watching = asyncio.create_task(watch.run())
        try:
            await service.ready.wait()
            of = {driver.name: driver for driver in service.drivers}
            frames = [name for name in ("sound", "can", "cobs", "sync", "lines") if name in of]
            await eventually(lambda: all(of[name].link.state == "up" for name in frames), "all are up")
            devices.play(machine, {kind: WORST for kind in kinds if kind != "replay"}, phase_s)
            used: list[int] = []
            for turn in range(1, rounds + 1):
                await asyncio.sleep(phase_s * len(WORST))  # so long a recording takes
                await eventually(lambda n=turn: all(x.rounds >= n for x in devices.nodes), "all is played")
                used.append(tracemalloc.get_traced_memory()[0])
            counters = of["sound"].streams["sound"][0]
            sent = devices.sound_samples
            await eventually(lambda: counters.samples_received >= sent, "the sound bus has everything")
            assert not running.done()
            figures = service.figures()
        finally:
            # The rogues go on meanwhile.
            stop.set()
            async with asyncio.timeout(STOP_S):
                await running
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)
    sound = figures["streams"]["sound"]
    assert sound["samples_lost"] == sound["gaps"] == sound["frames_rejected"] == 0, sound
    assert sound["doubt"] == ""
    assert figures["failures"] == {}
    assert {name: bus["reader_failures"] for name, bus in figures["buses"].items()} == dict.fromkeys(of, 0)
    assert watch.frames < IN_HAND_FRAMES
    assert watch.turns < TURNS_WAITING
    for kind in kinds:
        received = sum(
            figures["streams"][n]["frames_received"] for n in LAYOUT if n.partition("-")[0] == kind
        )
        assert received or figures["buses"][kind].get("requests"), f"{kind} has been played"
    if tracemalloc.is_tracing():
        assert used[-1] - used[-2] < GROWTH_BYTES, used


def check_said(records: list[logging.LogRecord], minutes: int = 1) -> None:
    """Nothing has failed in a way that nobody foresaw, and nothing is said again and again."""
    warned = [record for record in records if record.levelno >= logging.WARNING]
    assert [record.getMessage() for record in warned if record.exc_info] == []
    # How often an alarm speaks is bounded by its chatter, which is tested there.
    said = collections.Counter(
        (record.msg, str(record.args[:1]))
        for record in warned
        if record.args and record.name != "daqsvc.alarm_log"
    )
    assert {what: count for what, count in said.items() if count > minutes * LINES_EACH} == {}
    assert said, "something was said"


@pytest.mark.long
async def test_the_worst_on_all_buses_at_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    await all_do_their_worst(KINDS, tmp_path, 0.4)
    check_said(caplog.records)


@pytest.mark.long
@pytest.mark.timeout(300)
async def test_the_worst_on_all_buses_for_long(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    tracemalloc.start()
    try:
        await all_do_their_worst(KINDS, tmp_path, 2.0, rounds=3)
    finally:
        tracemalloc.stop()
    check_said(caplog.records, minutes=2)


@pytest.mark.long
@pytest.mark.timeout(300)
@pytest.mark.parametrize("kind", KINDS)
async def test_the_worst_on_one_bus(kind: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    await all_do_their_worst((kind,), tmp_path, 1.5)
    check_said(caplog.records)
