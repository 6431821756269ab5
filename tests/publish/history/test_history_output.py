"""What detectors say and alarms do is in the history, whatever the disk does; and nothing else waits."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import sqlite3
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.clocks import SettableClock
from support.formats import fits
from support.live_service import play, running
from support.machine_files import LAVAL, only_problem, parsed
from support.mqtt_publishing import output_port
from support.waiting import eventually

from daqsvc.acquisition.clock import NS_PER_S, SystemClock
from daqsvc.cli import main
from daqsvc.diagnosis.reading import Reading
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.history.file import NAME, HistoryFile, HistoryReader, Series
from daqsvc.history.points import HOUR_S, Step
from daqsvc.outbox.store import Outbox
from daqsvc.publish.history import output as module
from daqsvc.publish.history.output import HistoryOutput
from daqsvc.publish.history.settings import History
from daqsvc.publish.output import Watched

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

pytestmark = pytest.mark.integration
BEGIN_S = 480_000 * HOUR_S
RIG = Watched(
    "rig",
    readings=(
        Reading("levels/probe-x", "statistics", "rms", "um"),
        Reading("rotor-bank", "probabilities", "F1"),
    ),
)
RMS = Series("rig", "levels/probe-x", "statistics", "rms", "um")
F1 = Series("rig", "rotor-bank", "probabilities", "F1", "")


@pytest.fixture(autouse=True)
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "WRITE_EVERY_S", 0.02)
    monkeypatch.setattr(module, "LEAST_WAIT_S", 0.02)
    monkeypatch.setattr(module, "PAUSE_S", 0.0)


class Bench:
    """The output of the rig beside its outbox and clock."""

    def __init__(self, directory: Path, **more: Any) -> None:
        self.path = directory / NAME
        self.clock = SettableClock(wall_ns=BEGIN_S * NS_PER_S)
        self._more = {"reserve_mb": 0} | more

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[HistoryOutput]:
        self.outbox = Outbox(self.path.with_name("outbox.sqlite"), SystemClock())
        await self.outbox.open()
        self.output = HistoryOutput(History(), output_port(self.outbox, RIG, clock=self.clock), **self._more)
        work = asyncio.create_task(self.output.run())
        try:
            yield self.output
            await self.output.stop(5.0)
            assert work.done(), "stopped, it ends by itself"
            work.result()
        finally:
            work.cancel()
            await asyncio.wait({work})
            await self.outbox.close()

    def say(self, rms: float | None = None, f1: float | None = None, **more: Any) -> None:
        """Both detectors say something now."""
        common: dict[str, Any] = {"machine": "rig", "stream": "shaft", "decision": "normal", "first_index": 0}
        common |= {"end_index": 1, "t_ns": self.clock.monotonic_ns(), **more}
        if rms is not None:
            self.output.report(
                Diagnosis(detector="levels/probe-x", statistics={"rms": rms, "peak": 1}, **common)
            )
        if f1 is not None:
            self.output.report(Diagnosis(detector="rotor-bank", probabilities={"F1": f1}, **common))

    def trend(self, series: Series, step: Step = Step.SECOND) -> list[tuple[float, ...]]:
        reader = HistoryReader(self.path)
        try:
            trend = reader.trend(series, step, 0, 1e12)
        except KeyError:
            return []
        finally:
            reader.close()
        return [(t - BEGIN_S, *map(float, rest)) for t, *rest in zip(*trend[:4], strict=True)]


async def test_each_second_has_least_mean_and_greatest_of_what_was_said(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    async with bench.running():
        for rms in (1.0, 2.0, 6.0):
            bench.say(rms, f1=0.5)
            bench.clock.advance(0.25)
        bench.clock.advance(0.25)
        bench.say(8.0)
        bench.say(9.0, quality="missing")
        bench.say(float("nan"))
        bench.say(1e35)
        await eventually(lambda: bench.output.figures()["seconds_written"] >= 1)
    assert bench.trend(RMS) == [(0, 1, 3, 6), (1, 8, 8, 8)], "also the last second, when it stops"
    assert bench.trend(F1) == [(0, 0.5, 0.5, 0.5)]
    assert bench.output.figures()["seconds_lost"] == 0


async def test_a_detector_that_falls_silent_leaves_its_last_second(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    async with bench.running():
        bench.say(4.0)
        bench.clock.advance(5.0)
        await eventually(lambda: bench.output.figures()["seconds_written"] == 1)
        assert bench.trend(RMS) == [(0, 4, 4, 4)]


async def test_hours_that_are_over_are_packed_while_it_runs_and_by_the_next_run(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    packed = lambda: [t for t, *_ in bench.trend(RMS, Step.HOUR)] if _chunks(bench.path) else []  # noqa: E731
    async with bench.running():
        bench.say(4.0)
        bench.clock.advance(HOUR_S + 120)
        bench.say(5.0)
        bench.clock.advance(3.0)
        await eventually(lambda: packed() == [0, HOUR_S])
    assert _chunks(bench.path) == [(1, 1), (60, 1), (3600, 1)]
    bench.clock.advance(HOUR_S)
    async with bench.running():
        await eventually(lambda: _chunks(bench.path) == [(1, 2), (60, 1), (3600, 1)])


def _chunks(path: Path) -> list[tuple[int, int]]:
    if not path.exists():
        return []
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    try:
        return connection.execute("SELECT step_s, COUNT(*) FROM chunk GROUP BY step_s ORDER BY 1").fetchall()
    except sqlite3.OperationalError:
        return []  # it is just being made
    finally:
        connection.close()


def event(sequence: int) -> bytes:
    document = {"schema": "daqsvc.alarm/1", "sequence": sequence, "machine": "rig", "alarm": "a"}
    return json.dumps(document | {"wall_ns": BEGIN_S * NS_PER_S}).encode()


async def test_alarm_events_are_taken_over_once_also_over_restarts(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    told: list[int] = []
    for many in (5, 3):
        async with bench.running():
            before = bench.output.figures()["alarm_events"]
            for _ in range(many):
                sequence = await bench.outbox.append("daqsvc/lab/edge-1/rig/alarm/a", event, retain=True)
                told += [sequence]
            await eventually(lambda b=before, m=many: bench.output.figures()["alarm_events"] == b + m)
    reader = HistoryReader(bench.path)
    assert [e.sequence for e in reader.events("rig", 0, 1e12)] == told
    reader.close()


async def test_a_disk_without_room_is_said_once_and_nothing_is_lost_within_bounds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    free = [10**15]
    monkeypatch.setattr(module, "free_bytes", lambda _directory: free[0])
    bench = Bench(tmp_path, reserve_mb=64)
    async with bench.running() as output:
        output._most_waiting = 30
        await eventually(lambda: output._link.state == "up")
        free[0] = 60 * 2**20
        for second in range(20):
            bench.say(float(second))
            bench.clock.advance(1.0)
        await eventually(lambda: "less than 64 MB are free" in output.reason)
        assert bench.trend(RMS) == []
        free[0] = 10**15
        await eventually(lambda: len(bench.trend(RMS)) >= 19 and not output.reason)
        free[0] = 0
        for second in range(20, 80):
            bench.say(float(second))
            bench.clock.advance(1.0)
        await eventually(lambda: output.figures()["seconds_waiting"] == 30 and output.reason)
        free[0] = 10**15
    lost = output.figures()["seconds_lost"]
    means = [mean for _, _, mean, _ in bench.trend(RMS)]
    assert len(means) + lost == 80
    assert means == [*map(float, range(80 - lost - 30)), *map(float, range(50, 80))], "the oldest are lost"
    said = [record.message for record in caplog.records]
    assert len([line for line in said if "less than 64 MB" in line]) == 2, "once each time"
    assert "make room on the disk" in said[0]


@pytest.mark.gives("O18")
async def test_a_damaged_file_is_set_aside_and_another_begun(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench(tmp_path)
    bench.path.write_bytes(b"no database at all" * 1000)
    async with bench.running():
        bench.say(1.0)
        bench.clock.advance(3.0)
        await eventually(lambda: bench.output.figures()["seconds_written"] == 1)
    assert bench.trend(RMS) == [(0, 1, 1, 1)]
    [aside] = tmp_path.glob(f"{NAME}.corrupt-*")  # noqa: ASYNC240
    assert aside.name in caplog.text


async def test_a_file_of_a_newer_version_is_left_alone(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    HistoryFile(bench.path).close()
    connection = sqlite3.connect(bench.path)
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    before = bench.path.read_bytes()
    async with bench.running() as output:
        bench.say(1.0)
        await eventually(lambda: "newer version" in output.reason)
    assert bench.path.read_bytes() == before


async def test_a_disk_that_hangs_holds_up_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()
    write = HistoryFile.write

    def hang(file: HistoryFile, *rest: Any) -> None:
        release.wait(60)
        write(file, *rest)

    monkeypatch.setattr(HistoryFile, "write", hang)
    bench = Bench(tmp_path)
    outbox = Outbox(tmp_path / "outbox.sqlite", SystemClock())
    await outbox.open()
    output = HistoryOutput(History(), output_port(outbox, RIG, clock=bench.clock), reserve_mb=0)
    bench.output = output
    work = asyncio.create_task(output.run())
    await eventually(lambda: output._busy is not None and bench.path.exists())
    bench.say(1.0)
    await output.stop(0.05)
    work.cancel()
    async with asyncio.timeout(10):
        await asyncio.wait({work})
    release.set()
    await outbox.close()


async def test_what_a_thread_still_writes_when_the_task_is_cancelled_is_not_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs, release = threading.Event(), threading.Event()
    write = HistoryFile.write

    def hang(file: HistoryFile, trends: Any, events: Any) -> None:
        if trends and not release.is_set():
            hangs.set()
            release.wait(60)
        write(file, trends, events)

    monkeypatch.setattr(HistoryFile, "write", hang)
    bench = Bench(tmp_path)
    outbox = Outbox(tmp_path / "outbox.sqlite", SystemClock())
    await outbox.open()
    output = HistoryOutput(History(), output_port(outbox, RIG, clock=bench.clock), reserve_mb=0)
    bench.output = output
    bench.say(1.0)
    bench.clock.advance(5.0)
    first = asyncio.create_task(output.run())
    await eventually(hangs.is_set)
    first.cancel()
    await asyncio.wait({first})
    bench.say(4.0)
    release.set()
    again = asyncio.create_task(output.run())
    await output.stop(60.0)
    await again
    await outbox.close()
    assert bench.trend(RMS) == [(0, 1, 1, 1), (5, 4, 4, 4)]
    assert bench.trend(RMS, Step.MINUTE) == [(0, 1, 2.5, 4)], "each second counts once"


async def test_a_service_keeps_it_and_daqsvc_trend_shows_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    virtual = ('interface = "socketcan"', 'interface = "virtual"')
    machine = parsed(LAVAL, virtual, ("[mqtt]", "[history]\n\n[mqtt]"))
    rng = np.random.default_rng(4)
    async with running(machine, tmp_path) as service:
        figures = lambda: service.figures()["history"]  # noqa: E731
        await play(
            service, rng.normal(0, 5, (1600, len(machine.streams["shaft"].layout.channel_names))), 640.0
        )
        await eventually(lambda: figures()["seconds_written"] >= 2)
    assert await asyncio.to_thread(main, ["trend", "--store", str(tmp_path), "--since", "1h", "--json"]) == 0
    found = {one["reading"]: one for one in map(json.loads, capsys.readouterr().out.splitlines())}
    assert {"levels/probe-x.rms", "levels/probe-y.rms"} <= found.keys()
    rms = fits("daqsvc.trend/1", found["levels/probe-x.rms"])
    assert (rms["machine"], rms["unit"], rms["step_s"]) == (machine.machine.name, "um", 1)
    assert rms["low"] <= rms["mean"] <= rms["high"]


def test_how_long_and_how_much_is_stated_within_reason() -> None:
    problem, _ = only_problem(LAVAL, ("[mqtt]", "[history]\nminute_keep_days = 3\n\n[mqtt]"))
    assert "minutes_keep_days" in f"{problem}"
