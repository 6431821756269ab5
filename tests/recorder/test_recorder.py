"""When snapshots are made, how long they last, how many are kept, and what a bad disk does to them."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import threading
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.recorded_rig import recorded_rig
from support.waiting import PATIENCE_S, eventually

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock
from daqsvc.acquisition.samples import SampleBlock, Window
from daqsvc.acquisition.standing import StreamState
from daqsvc.alarms.events import AlarmEvent, Doubt, EventKind, Identity
from daqsvc.alarms.quality import Lacking, SensorHealth
from daqsvc.alarms.states import AlarmState, Level
from daqsvc.confined.limits import ResourceLimits
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.recorder import MOST_WAITING_BYTES, MachineRecorder, SnapshotRefusedError
from daqsvc.snapshots.contents import CAUSES, MACHINE_JSON
from daqsvc.snapshots.mcap import Attachment, Damage, McapWriter
from daqsvc.snapshots.reading import entries_of, read_snapshot
from daqsvc.snapshots.writing import SnapshotWriter
from daqsvc.supervision import Supervisor

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.snapshots.contents import Document, Entry

ROWS = 64


@pytest.fixture(autouse=True)
def slow_disks_are_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test of these depends on how fast the disk is."""
    monkeypatch.setattr("daqsvc.recorder.END_S", PATIENCE_S)


class Remembering:
    """A detector that does nothing but remember."""

    block = 1

    def __init__(self, name: str, stream: str, memory: NDArray[np.float64]) -> None:
        self.name, self.stream, self.memory = name, stream, memory

    def warm(self) -> None: ...

    def process(self, window: Window) -> Sequence[Diagnosis]:
        del window
        return ()

    def silent(self, silence_s: float, t_ns: int) -> Sequence[Diagnosis]:
        del silence_s, t_ns
        return ()


class Bench:
    """A recorder and what drives it: a block every tenth of a second."""

    def __init__(self, store: Path, **table: Any) -> None:
        machine, _ = recorded_rig("unused", **{"before_s": 1.0, "after_s": 1.0, **table})
        assert machine.recorder is not None
        self.clock = DrivenClock(wall_start_ns=1_800_000_000 * NS_PER_S)
        self.is_judging = False
        self.recorder = MachineRecorder(
            machine, machine.recorder, store, self.clock, Supervisor(), lambda: self.is_judging
        )
        self._index = 0
        self.rows = ROWS

    def comes(self) -> None:
        """A block comes, and nobody else gets round to anything."""
        self.clock.advance_to(self.clock.monotonic_ns() + NS_PER_S // 10)
        samples = np.full((self.rows, 3), self._index, np.float32)
        now_ns = self.clock.monotonic_ns()
        self.recorder.block(SampleBlock("shaft", self._index, samples, now_ns, 1.5e6))
        self._index += self.rows

    def processes(self, detector: str, *, stream: str, memory: NDArray[np.float64]) -> None:
        """A detector has processed all that has come of a stream."""
        window = Window(self._index - 1, np.zeros((1, 3), np.float32), self.clock.monotonic_ns(), 1.5e6)
        self.recorder.processed(Remembering(detector, stream, memory), window)

    async def passes(self, seconds: float, *, silent: bool = False) -> None:
        for _ in range(round(10 * seconds)):
            if silent:
                self.clock.advance_to(self.clock.monotonic_ns() + NS_PER_S // 10)
            else:
                self.comes()
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            await eventually(lambda: not self.recorder.is_writing, "what has come is written")

    def states_speed(self, speed_rpm: float, detector: str = "rotor-bank") -> None:
        now_ns = self.clock.monotonic_ns()
        told = Diagnosis("laval-rig", detector, now_ns, "shaft", 0, 1, "N")
        self.recorder.diagnosis(replace(told, statistics={"speed": speed_rpm}, units={"speed": "rpm"}))

    def alarm(self, name: str = "rotor-fault", kind: EventKind = EventKind.RAISED) -> None:
        self.recorder.alarm(self.event(name, kind))

    def event(
        self, name: str, kind: EventKind = EventKind.RAISED, doubts: tuple[Doubt, ...] = ()
    ) -> AlarmEvent:
        now_ns = self.clock.monotonic_ns()
        cause = Diagnosis("laval-rig", "rotor-bank", now_ns, "shaft", 0, 1, "F1")
        states = AlarmState.NORMAL, AlarmState.ACTIVE_UNACKNOWLEDGED
        levels = Level.NORMAL, Level.ALERT
        identity = Identity("demo", "virtual", "laval-rig")
        event = AlarmEvent(identity, name, "1", kind, *states, *levels, now_ns, 0, cause, "bad")
        return replace(event, doubts=doubts)

    @property
    def files(self) -> list[Path]:
        folder = self.recorder.folder.directory
        return sorted(folder.glob("*")) if folder.exists() else []


@contextlib.asynccontextmanager
async def bench(store: Path, **table: Any) -> AsyncIterator[Bench]:
    made = Bench(store, **table)
    task = asyncio.create_task(made.recorder.run())
    await asyncio.sleep(0)
    try:
        yield made
    finally:
        task.cancel()
        await asyncio.wait({task})


def held(path: Path) -> tuple[Document, float, float, Damage]:
    """What a snapshot is about, from when to when it has samples in s, and what is wrong with it."""
    damage = Damage()
    read = [
        one for one in entries_of(memoryview(path.read_bytes()), damage) if not isinstance(one, Attachment)
    ]
    times = [one.at_ns / NS_PER_S for one in read if isinstance(one.what, SampleBlock)]
    assert not isinstance(read[0].what, SampleBlock)
    noted = [one.what for one in read if not isinstance(one.what, SampleBlock)]
    later = [one.document["cause"] for one in noted if one.topic == CAUSES]
    about = {**noted[0].document, "causes": [*noted[0].document["causes"], *later]}
    return about, min(times), max(times), damage


def values_in(path: Path) -> str:
    """The machine file of a snapshot, by its values."""
    read = entries_of(memoryview(path.read_bytes()), Damage())
    return next(bytes(e.data).decode() for e in read if isinstance(e, Attachment) and e.name == MACHINE_JSON)


def firsts_in(path: Path) -> list[int]:
    """Where each block of a snapshot begins."""
    read = [e for e in entries_of(memoryview(path.read_bytes()), Damage()) if not isinstance(e, Attachment)]
    return [e.what.first_index for e in read if isinstance(e.what, SampleBlock)]


async def test_a_snapshot_is_from_before_to_after_its_cause(tmp_path: Path) -> None:
    async with bench(tmp_path) as one:
        await one.passes(30.0)
        at_s = one.clock.monotonic_ns() / NS_PER_S
        one.alarm()
        await one.passes(2.0)
        [path] = one.files
    assert path.name == "20270115T080030.000000Z-alarm.mcap"
    about, begin_s, end_s, damage = held(path)
    assert about["causes"] == ["rotor-fault: raised"]
    assert damage == Damage()
    assert at_s - 1.0 == pytest.approx(begin_s, abs=0.11)
    assert at_s + 1.0 == pytest.approx(end_s, abs=0.3)
    assert one.recorder.counters.snapshots == 1
    assert path.stat().st_mode & 0o777 == 0o640
    assert path.parent.stat().st_mode & 0o777 == 0o750


@pytest.mark.parametrize(("busy_s", "lasts_s"), [(3.0, 3.0), (60.0, 6.0)])
async def test_a_snapshot_lasts_until_detectors_have_judged_it(
    tmp_path: Path, busy_s: float, lasts_s: float
) -> None:
    async with bench(tmp_path) as one:
        await one.passes(10.0)
        at_s = one.clock.monotonic_ns() / NS_PER_S
        one.is_judging = True
        one.alarm()
        await one.passes(busy_s)
        one.is_judging = False
        await one.passes(1.0)
        [path] = one.files
    assert one.recorder.counters.snapshots == 1
    _, _, end_s, _ = held(path)
    assert at_s + lasts_s == pytest.approx(end_s, abs=0.3)


async def test_causes_that_overlap_make_one_snapshot_up_to_a_length(tmp_path: Path) -> None:
    async with bench(tmp_path, longest_s=5.0) as one:
        await one.passes(10.0)
        begun_s = one.clock.monotonic_ns() / NS_PER_S
        asked = asyncio.create_task(one.recorder.snapshot("somebody"))
        await asyncio.sleep(0)
        for _ in range(8):
            one.alarm()
            await one.passes(0.8)
        await one.passes(2.0)
        assert (await asked).name.endswith("-alarm.mcap")
        first, second = one.files
    about, begin_s, end_s, _ = held(first)
    assert about["causes"][0] == "somebody"
    assert 3.9 <= end_s - begin_s <= 5.3
    # The alarm that has no room for a second after it is the cause of another one, which has what it needs.
    other, other_begin_s, other_end_s, _ = held(second)
    assert other_begin_s == pytest.approx(end_s - 1.15, abs=0.3)
    assert other_end_s == pytest.approx(begun_s + 7 * 0.8 + 1.0, abs=0.3)
    assert other["causes"] == 4 * ["rotor-fault: raised"]


async def test_alarms_whose_snapshots_would_overlap_make_one(tmp_path: Path) -> None:
    async with bench(tmp_path, before_s=4.0, after_s=4.0) as one:
        await one.passes(37.3)
        begun_s = one.clock.monotonic_ns() / NS_PER_S
        one.alarm()
        await one.passes(5.3)
        assert not one.recorder.figures()["recording"], "it has what comes after the first one"
        [path] = one.files
        assert held(path)[2] == pytest.approx(begun_s + 4.0, abs=0.3)
        assert held(path)[3].ends_early
        one.alarm("shaft-vibration-x")
        one.recorder.stand("shaft", StreamState("its rate is odd"))
        await one.passes(40.0)
        one.alarm()
        await one.passes(15.0)
        first, second = one.files
    about, begin_s, end_s, damage = held(first)
    assert damage == Damage()
    assert about["causes"] == ["rotor-fault: raised", "shaft-vibration-x: raised"]
    assert begin_s == pytest.approx(begun_s - 4.0, abs=0.2)
    assert end_s == pytest.approx(begun_s + 5.3 + 4.0, abs=0.3)
    firsts = firsts_in(first)
    assert firsts == list(range(firsts[0], firsts[-1] + 1, ROWS)), "nothing is missing, or there twice"
    assert held(second)[1] > end_s
    assert one.recorder.counters.snapshots == 2
    assert one.recorder.counters.blocks_dropped == 0


async def test_alarms_make_one_snapshot_though_the_stream_stops_with_them(tmp_path: Path) -> None:
    async with bench(tmp_path, before_s=4.0) as one:
        await one.passes(30.0)
        one.alarm()
        await one.passes(0.5)
        one.alarm("shaft-vibration-x")
        await one.passes(1.5, silent=True)
        assert not one.recorder.figures()["recording"], "it has what comes after them"
        one.alarm("rotor-rub")
        await one.passes(12.0)
        [path] = one.files
    assert held(path)[0]["causes"] == [
        "rotor-fault: raised",
        "shaft-vibration-x: raised",
        "rotor-rub: raised",
    ]
    firsts = firsts_in(path)
    assert firsts == list(range(firsts[0], firsts[-1] + 1, ROWS)), "nothing is there twice"


async def test_a_snapshot_that_has_ended_goes_on_within_its_longest_time_only(tmp_path: Path) -> None:
    async with bench(tmp_path, before_s=4.0, after_s=4.0, longest_s=15.0) as one:
        await one.passes(30.0)
        for _ in range(4):
            one.alarm()
            await one.passes(5.3)
        await one.passes(15.0)
        files = one.files
    assert [len(held(path)[0]["causes"]) for path in files] == [2, 2]
    assert all(held(path)[2] - held(path)[1] < 15.5 for path in files)


async def test_who_asks_does_not_wait_for_causes_that_may_come(tmp_path: Path) -> None:
    async with bench(tmp_path, before_s=4.0) as one:
        await one.passes(30.0)
        one.alarm()
        asked = asyncio.create_task(one.recorder.snapshot("somebody"))
        await one.passes(1.5)
        assert asked.done()
        assert held(await asked)[3] == Damage()
        one.alarm("shaft-vibration-x")
        await one.passes(15.0)
        assert (await asked).exists(), "nobody takes it away or goes on in it"
        assert held(await asked)[0]["causes"] == ["rotor-fault: raised", "somebody"]
        _, second = one.files
        assert held(second)[0]["causes"] == ["shaft-vibration-x: raised"]
        # Who asks just after an alarm's snapshot has ended gets that, with what has happened since.
        one.alarm()
        await one.passes(2.0)
        asked = asyncio.create_task(one.recorder.snapshot("somebody else"))
        await one.passes(1.5)
        assert asked.done()
        assert held(await asked)[0]["causes"] == ["rotor-fault: raised", "somebody else"]
        assert (await asked).name.endswith("-alarm.mcap")


async def test_a_snapshot_by_the_clock_lengthens_no_other(tmp_path: Path) -> None:
    async with bench(tmp_path, before_s=1.0, after_s=9.0, every_s=10.0) as one:
        await one.passes(14.0)
        asked = asyncio.create_task(one.recorder.snapshot("somebody"))
        await one.passes(9.5)
        assert asked.done(), "the clock has struck meanwhile"
        assert held(await asked)[0]["causes"] == ["scheduled", "somebody", "scheduled"]
        await one.passes(17.0)
    assert [held(path)[0]["causes"] for path in one.files][1:] == [["scheduled"]]


async def test_a_cause_that_came_later_is_there_after_a_cut(tmp_path: Path) -> None:
    async with bench(tmp_path, after_s=5.0) as one:
        await one.passes(10.0)
        one.alarm()
        await one.passes(2.0)
        one.alarm("shaft-vibration-x", EventKind.ESCALATED)
        await one.passes(1.0)
        [path] = one.files
        assert held(path)[3].ends_early
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(path.read_bytes())
    expected = ["rotor-fault: raised", "shaft-vibration-x: escalated"]
    assert [held(file)[0]["causes"] for file in (cut, path)] == [expected, expected]
    for file in (cut, path):
        assert read_snapshot(file, ResourceLimits()).about["causes"] == expected


async def test_what_calls_for_nobody_is_no_cause(tmp_path: Path) -> None:
    async with bench(tmp_path) as one:
        one.alarm(kind=EventKind.RETURNED)
        await one.passes(3.0)
        assert not one.files


async def test_snapshots_come_by_the_clock(tmp_path: Path) -> None:
    async with bench(tmp_path, every_s=10.0) as one:
        await one.passes(32.0)
        assert [path.name.rpartition("-")[2] for path in one.files] == 3 * ["scheduled.mcap"]


@pytest.mark.parametrize(("before_s", "judging"), [(0.0, False), (4.0, False), (1.0, True), (4.0, True)])
async def test_snapshots_by_the_clock_join_where_they_are_as_long_as_they_are_apart(
    tmp_path: Path, before_s: float, *, judging: bool
) -> None:
    async with bench(tmp_path, before_s=before_s, after_s=10.0 - before_s, every_s=10.0) as one:
        one.is_judging = judging
        await one.passes(42.0)
        files = one.files
    assert [held(path)[0]["causes"] for path in files] == 4 * [["scheduled"]]
    assert one.recorder.counters.snapshots == 4
    seen = {first for path in files for first in firsts_in(path)}
    assert seen == set(range(min(seen), max(seen) + 1, ROWS)), "no sample is missing"


async def test_a_snapshot_is_made_at_each_step_of_the_speed(tmp_path: Path) -> None:
    async with bench(tmp_path, every_rpm=100.0, before_s=0.0, after_s=0.5) as one:
        for speed_rpm in [0.0, *np.arange(10.0, 400.0, 5.0), *np.arange(400.0, 130.0, -5.0)]:
            one.states_speed(speed_rpm)
            await one.passes(0.2)
        one.states_speed(float("nan"))
        await one.passes(1.0)
        files = one.files
    causes = [held(path)[0]["causes"] for path in files]
    # A quarter of a step beyond each boundary, up and down.
    assert causes == [[f"rotor-bank: speed {rpm} rpm"] for rpm in (125, 225, 325, 270, 170)]
    assert {path.name.rpartition("-")[2] for path in files} == {"speed.mcap"}


async def test_a_speed_that_wanders_about_a_step_makes_no_snapshots(tmp_path: Path) -> None:
    async with bench(tmp_path, every_rpm=100.0, before_s=0.0, after_s=0.2) as one:
        for speed_rpm in 1000.0 + 20.0 * np.sin(np.arange(100.0)):
            one.states_speed(-speed_rpm)
            await one.passes(0.2)
        assert not one.files
        one.states_speed(1130.0, "levels/probe-x")
        await one.passes(1.0)
        assert not one.files, "that is no detector that knows the speed"


async def test_files_of_a_continuous_recording_join_over_an_alarm(tmp_path: Path) -> None:
    async with bench(tmp_path, continuous=True, continuous_s=5.0) as one:
        await one.passes(12.0)
        one.alarm()
        await one.passes(10.0)
    kinds = [path.name.rpartition("-")[2] for path in one.files]
    assert kinds == [*3 * ["continuous.mcap"], "alarm.mcap", *2 * ["continuous.mcap"]]
    files = [path for path in one.files if path.name.endswith("-continuous.mcap")]
    assert [index for path in files for index in firsts_in(path)] == [ROWS * k for k in range(220)]
    assert [held(path)[0]["from_start"] for path in files] == [True, *4 * [False]]
    begins = [held(path)[0]["begin_ns"] / NS_PER_S for path in files]
    assert np.diff(begins) == pytest.approx(5.0, abs=0.4)


@pytest.mark.gives("S15")
async def test_a_continuous_recording_goes_on_when_the_disk_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with bench(tmp_path, continuous=True, continuous_s=5.0) as one:
        await one.passes(3.0)
        with monkeypatch.context() as patched:

            def refuse(*_: object) -> None:
                raise OSError(errno.ENOSPC, "No space left on device")

            patched.setattr("daqsvc.snapshots.writing.SnapshotWriter.write", refuse)
            await one.passes(6.0)
        assert one.recorder.counters.write_failures == 1, "it is not tried at every turn"
        await one.passes(10.0)
        assert one.recorder.figures()["recording"]
    broken, *whole = one.files
    assert held(broken)[3].ends_early
    assert [held(path)[3] for path in whole] == [Damage()] * len(whole)
    assert whole
    assert [record.levelname for record in caplog.records] == ["ERROR", "NOTICE"]


async def test_continuous_files_are_deleted_before_those_of_alarms(tmp_path: Path) -> None:
    async with bench(tmp_path, continuous=True, continuous_s=2.0, max_mb=1) as one:
        one.alarm()
        await one.passes(3.0)
        [alarm] = [path for path in one.files if path.name.endswith("-alarm.mcap")]
        one.rows = 6_000
        await one.passes(6.0)
        assert one.recorder.folder.deleted >= 1
        assert alarm in one.files


async def test_the_oldest_go_first_and_those_of_alarms_last(tmp_path: Path) -> None:
    folder = tmp_path / "snapshots"
    folder.mkdir()
    names = [f"2026010{day}T000000.000000Z-{kind}.mcap" for day, kind in enumerate(("alarm", "asked") * 2)]
    for name in names:
        (folder / name).write_bytes(bytes(600_000))
        os.utime(folder / name, (1_800_000_000 - 60, 1_800_000_000 - 60))
    old = folder / "20250101T000000.000000Z-alarm.mcap"
    old.write_bytes(b"old")
    os.utime(old, (1_700_000_000, 1_700_000_000))
    (folder / "notes.txt").write_text("of somebody")
    async with bench(tmp_path, max_mb=1, keep_days=100.0) as one:
        one.alarm()
        await one.passes(2.0)
        kept = [path.name for path in one.files]
    assert kept[0] == names[2]
    assert kept[1].startswith("2027")
    assert kept[2:] == ["notes.txt"]
    assert one.recorder.folder.deleted == 4


async def test_a_disk_that_is_full_costs_the_snapshot_only(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with bench(tmp_path, reserve_mb=1_000_000) as one:
        asked = asyncio.create_task(one.recorder.snapshot("somebody"))
        await asyncio.sleep(0)
        await one.passes(1.0)
        with pytest.raises(SnapshotRefusedError, match="reserve_mb"):
            await asked
        for _ in range(3):
            one.alarm()
            await one.passes(2.0)
        assert one.recorder.counters.snapshots_failed == 4
        assert [record.levelname for record in caplog.records] == ["ERROR"], "said once"


async def test_a_disk_that_fails_amid_a_snapshot_leaves_what_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with bench(tmp_path) as one:
        one.alarm()
        await one.passes(0.8)
        with monkeypatch.context() as patched:

            def refuse(*_: object) -> None:
                raise OSError(errno.EIO, "Input/output error")

            patched.setattr("daqsvc.snapshots.writing.SnapshotWriter.write", refuse)
            await one.passes(0.5)
        assert one.recorder.counters.write_failures == 1
        await one.passes(2.0)
        one.alarm()
        await one.passes(2.0)
        broken, whole = one.files
    assert held(broken)[3].ends_early
    assert not held(whole)[3].ends_early


def once_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk takes half of the next chunk, and all after that."""
    flush = McapWriter.flush

    def half(self: McapWriter) -> None:
        monkeypatch.setattr(McapWriter, "flush", flush)
        self._file.write(b"half of a chunk")
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(McapWriter, "flush", half)


@pytest.mark.parametrize("later_s", [0.0, 0.5])
async def test_an_alarm_that_the_disk_refuses_costs_no_file_that_was_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, later_s: float
) -> None:
    async with bench(tmp_path, before_s=4.0) as one:
        await one.passes(30.0)
        asked = asyncio.create_task(one.recorder.snapshot("before"))
        await one.passes(12.0)
        one.alarm()
        await one.passes(2.5)
        one.alarm("shaft-vibration-x")
        at_s = one.clock.monotonic_ns() / NS_PER_S
        also = asyncio.create_task(one.recorder.snapshot("somebody"))
        await asyncio.sleep(0)
        await one.passes(later_s)
        once_refused(monkeypatch)
        await one.passes(2.0)
        assert one.recorder.counters.write_failures == 1
        assert one.recorder.counters.snapshots_failed == 0
        assert one.recorder.counters.snapshots == 3
        before, first, second = one.files
        assert (await asked, await also) == (before, second)
    about, _, first_end_s, damage = held(first)
    assert damage == Damage()
    assert about["causes"][0] == "rotor-fault: raised"
    assert first_end_s >= at_s - 1.5, "all that it had when it was over"
    about, begin_s, end_s, damage = held(second)
    assert damage == Damage()
    assert about["causes"] == ["shaft-vibration-x: raised", "somebody"]
    assert second.name.endswith("-alarm.mcap")
    assert begin_s == pytest.approx(at_s - 4.0, abs=0.3)
    assert end_s == pytest.approx(at_s + 1.0, abs=0.3)
    said = [(record.levelname, "another one begun" in record.message) for record in caplog.records]
    assert said == [("ERROR", True), ("NOTICE", False)]


async def test_a_file_that_goes_on_stays_as_it_is_on_a_disk_that_takes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    async with bench(tmp_path, before_s=4.0) as one:
        await one.passes(30.0)
        one.alarm()
        await one.passes(2.5)
        [path] = one.files
        whole = path.read_bytes()
        one.alarm("shaft-vibration-x")
        asked = asyncio.create_task(one.recorder.snapshot("somebody"))
        with monkeypatch.context() as patched:
            patched.setattr(SnapshotWriter, "write", refuse)
            patched.setattr(McapWriter, "finish", refuse)
            await one.passes(2.0)
        with pytest.raises(SnapshotRefusedError, match="Input/output error"):
            await asked
        assert one.recorder.counters.snapshots_failed == 2
        assert path.read_bytes() == whole
        one.alarm("rotor-rub")
        await one.passes(12.0)
        assert one.recorder.counters.snapshots == 1


@contextlib.contextmanager
def hanging_disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Whoever looks at the disk waits until this is over."""
    over = threading.Event()
    with monkeypatch.context() as patched:
        patched.setattr("daqsvc.snapshots.folder.SnapshotFolder.see_space", lambda _: over.wait())
        try:
            yield
        finally:
            over.set()


async def test_a_disk_that_hangs_holds_up_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with bench(tmp_path) as one:
        with hanging_disk(monkeypatch):
            one.alarm()
            one.clock.advance_to(one.clock.monotonic_ns() + NS_PER_S // 2)
            await eventually(lambda: one.recorder.is_writing, "it hangs")
            rows = np.zeros((MOST_WAITING_BYTES // 12 // 4, 3), np.float32)
            for number in range(8):
                one.recorder.block(SampleBlock("shaft", number * len(rows), rows, 0, 1.0))
            assert one.recorder.figures()["waiting_bytes"] <= MOST_WAITING_BYTES
            assert one.recorder.counters.blocks_dropped >= 4
        await eventually(lambda: not one.recorder.is_writing, "it is over")


@pytest.mark.parametrize("continuous", [False, True])
async def test_a_disk_that_hangs_for_an_hour_costs_no_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, continuous: bool
) -> None:
    async with bench(tmp_path, continuous=continuous, continuous_s=5.0) as one:
        await one.passes(2.0)
        with hanging_disk(monkeypatch):
            one.alarm()
            one.clock.advance_to(one.clock.monotonic_ns() + NS_PER_S)
            await eventually(lambda: one.recorder.is_writing, "it hangs")
            for _ in range(36_000):
                one.comes()
            assert one.clock.monotonic_ns() - one.recorder._history[0].at_ns < 40 * NS_PER_S
        await eventually(lambda: not one.recorder.is_writing, "it is over")
        await one.passes(20.0)
        before = one.recorder.counters.snapshots
        one.alarm()
        await one.passes(9.0)
        assert one.recorder.counters.snapshots > before


async def test_an_alarm_while_a_snapshot_is_being_closed_leaves_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_go_on, finish = threading.Event(), SnapshotWriter.finish

    def slow(self: SnapshotWriter) -> None:
        may_go_on.wait()
        finish(self)

    async with bench(tmp_path) as one:
        await one.passes(5.0)
        one.alarm()
        asked_first = asyncio.create_task(one.recorder.snapshot("somebody"))
        await asyncio.sleep(0)
        with monkeypatch.context() as patched:
            patched.setattr(SnapshotWriter, "finish", slow)
            for _ in range(12):
                one.comes()
                await asyncio.sleep(0.01)
            await eventually(lambda: not one.recorder.figures()["recording"], "it is being closed")
            asked = asyncio.create_task(one.recorder.snapshot("somebody"))
            one.alarm("shaft-vibration-x")
            await asyncio.sleep(0)
            may_go_on.set()
        await one.passes(3.0)
        path = await asked
        first, second = one.files
        assert (await asked_first, path) == (first, second)
    assert held(first)[0]["causes"] == ["rotor-fault: raised", "somebody"]
    assert held(second)[0]["causes"] == ["shaft-vibration-x: raised", "somebody"]
    assert held(second)[2] > held(first)[2]
    assert second.name.endswith("-alarm.mcap")


async def test_a_detector_that_cannot_be_asked_ends_no_recording(tmp_path: Path) -> None:
    async with bench(tmp_path, continuous=True, continuous_s=5.0) as one:
        for _ in range(20):
            one.processes("rotor-bank", stream="shaft", memory=np.zeros(2_000_000))
            one.processes("levels", stream="shaft", memory=np.zeros(3))
            await one.passes(1.0)
        assert one.recorder.counters.memories_not_taken > 0
    files = one.files
    assert [index for path in files for index in firsts_in(path)] == [ROWS * k for k in range(200)]
    assert [held(path)[3] for path in files] == [Damage()] * len(files)
    assert list(held(files[1])[0]["remembered"]) == ["levels"]


async def test_a_silent_stream_does_not_hold_up_a_continuous_recording(tmp_path: Path) -> None:
    async with bench(tmp_path, continuous=True, continuous_s=5.0) as one:
        one.processes("trend", stream="slow", memory=np.zeros(3))
        for _ in range(20):
            one.processes("levels", stream="shaft", memory=np.zeros(3))
            await one.passes(1.0)
    begins = [held(path)[0]["begin_ns"] / NS_PER_S for path in one.files]
    assert np.diff(begins) == pytest.approx(5.0, abs=1.3)
    assert [sorted(held(path)[0]["remembered"]) for path in one.files[1:]] == 3 * [["levels", "trend"]]


async def test_a_long_time_before_the_cause_costs_nothing_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daqsvc.recorder.MOST_WAITING_BYTES", 20 * ROWS * 3 * 4)
    async with bench(tmp_path, before_s=10.0) as one:
        await one.passes(12.0)
        one.alarm()
        one.alarm("shaft-vibration-x")
        await one.passes(2.0)
        assert one.recorder.counters.blocks_dropped == 0
    [path] = one.files
    firsts = firsts_in(path)
    assert np.diff(firsts).tolist() == [ROWS] * (len(firsts) - 1)
    assert held(path)[0]["causes"] == ["rotor-fault: raised", "shaft-vibration-x: raised"]


async def test_two_shafts_have_steps_of_their_own(tmp_path: Path) -> None:
    async with bench(tmp_path, every_rpm=100.0, before_s=0.0, after_s=0.2) as one:
        one.recorder._speeds["levels/gear"] = ("speed",)
        for _ in range(30):
            one.states_speed(1510.0)
            one.states_speed(310.0, "levels/gear")
            await one.passes(0.2)
        assert not one.files
        one.states_speed(440.0, "levels/gear")
        await one.passes(1.0)
        [path] = one.files
    assert held(path)[0]["causes"] == ["levels/gear: speed 440 rpm"]


async def test_large_files_keep_within_the_size_of_all(tmp_path: Path) -> None:
    most = 0
    async with bench(tmp_path, continuous=True, continuous_s=600.0, max_mb=2) as one:
        one.rows = 2_000
        for _ in range(60):
            await one.passes(0.5)
            most = max(most, sum(path.stat().st_size for path in one.files))
        files = one.files
    assert one.recorder.folder.deleted > 5
    assert len(files) >= 3, "not one file that is deleted when it is finished"
    assert most < 2.6e6


async def test_a_snapshot_larger_than_all_may_be_is_there_when_it_is_answered(tmp_path: Path) -> None:
    async with bench(tmp_path, max_mb=1, after_s=3.0) as one:
        one.rows = 6_000
        asked = asyncio.create_task(one.recorder.snapshot("somebody"))
        await asyncio.sleep(0)
        one.alarm()
        await one.passes(5.0)
        assert (await asked).exists()


async def test_a_file_holds_the_limits_that_were_in_force(tmp_path: Path) -> None:
    async with bench(tmp_path, continuous=True) as one:
        await one.passes(10.0)
        raised_s = one.clock.monotonic_ns() / NS_PER_S
        one.alarm()
        await one.passes(0.5)
        machine = one.recorder._machine
        alarms = tuple(alarm.model_copy(update={"on_delay_s": 1.75}) for alarm in machine.alarms)
        one.recorder.change_machine(machine.model_copy(update={"alarms": alarms}))
        await one.passes(2.0)
        changed_ns = one.recorder._changed_ns
        assert changed_ns is not None
    before, after = (
        [path for path in one.files if ("1.75" in values_in(path)) == is_after] for is_after in (False, True)
    )
    assert [path.name.rpartition("-")[2] for path in before] == ["continuous.mcap", "alarm.mcap"]
    assert sorted(path.name.rpartition("-")[2] for path in after) == ["alarm.mcap", "continuous.mcap"]
    [alarm] = [path for path in after if path.name.endswith("-alarm.mcap")]
    about, begin_s, end_s, _ = held(alarm)
    assert about["changed_ns"] == changed_ns
    assert begin_s == pytest.approx(raised_s - 0.5, abs=0.2)
    assert end_s == pytest.approx(raised_s + 1.0, abs=0.3), "as long as it would have been"
    assert all(held(path)[2] < changed_ns / NS_PER_S + 0.6 for path in before)


async def test_nobody_waits_for_a_recorder_that_is_over(tmp_path: Path) -> None:
    async with bench(tmp_path) as one:
        asked = asyncio.create_task(one.recorder.snapshot("somebody"))
        await one.passes(0.5)
    assert (await asked).exists(), "it was finished, so that is the answer"
    with pytest.raises(SnapshotRefusedError, match="nothing more is recorded"):
        await one.recorder.snapshot("somebody else")


async def test_the_end_of_the_service_waits_for_what_a_thread_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_go_on = threading.Event()
    write = SnapshotWriter.write

    def slow(self: SnapshotWriter, entries: Iterable[Entry]) -> None:
        entries = iter(entries)
        write(self, [next(entries)])
        may_go_on.wait()
        write(self, entries)

    async with bench(tmp_path) as one:
        await one.passes(3.0)
        monkeypatch.setattr(SnapshotWriter, "write", slow)
        one.alarm()
        one.clock.advance_to(one.clock.monotonic_ns() + NS_PER_S // 2)
        await eventually(lambda: one.recorder.is_writing, "a thread writes")
        one.recorder.block(SampleBlock("shaft", 30 * ROWS, np.zeros((ROWS, 3), np.float32), 0, 1.5e6))
        asyncio.get_running_loop().call_later(0.05, may_go_on.set)
    [path] = one.files
    assert held(path)[3] == Damage()
    assert firsts_in(path) == [ROWS * k for k in range(31)]
    assert one.recorder.counters.snapshots == 1


async def test_an_alarm_at_the_very_end_leaves_its_snapshot(tmp_path: Path) -> None:
    async with bench(tmp_path) as one:
        await one.passes(3.0)
        one.alarm()
    [path] = one.files
    assert held(path)[3] == Damage()


async def test_the_end_of_the_service_closes_what_is_open(tmp_path: Path) -> None:
    async with bench(tmp_path) as one:
        one.recorder.stand("shaft", StreamState("its rate is odd"))
        one.alarm()
        await one.passes(0.6)
    [path] = one.files
    assert held(path)[3] == Damage()


async def test_a_snapshot_has_the_first_samples_of_a_stream_that_has_just_come(tmp_path: Path) -> None:
    async with bench(tmp_path, before_s=0.2) as one:
        one.recorder.stand("shaft", StreamState("nothing has come"))
        one.clock.advance_to(one.clock.monotonic_ns() + 30 * NS_PER_S)
        await one.passes(1.0)
        one.alarm()
        await one.passes(30.0)
        one.alarm()
        await one.passes(2.0)
        first, second = one.files
    assert (firsts_in(first)[0], firsts_in(second)[0] > 0) == (0, True)
    abouts = [held(path)[0] for path in (first, second)]
    assert [about["streams_from_start"] for about in abouts] == [["shaft"], []]
    assert [about["from_start"] for about in abouts] == [False, False]


@pytest.mark.parametrize("since_s", [0.8, 9.0])
async def test_a_snapshot_states_what_detectors_had_lacked_when_it_begins(
    tmp_path: Path, since_s: float
) -> None:
    """Also if that is so long ago that the history of the recorder does not have it any more."""
    until_then, blind_ns = SensorHealth(), 0
    async with bench(tmp_path, before_s=0.5) as one:
        await one.passes(20.0)
        for share in (1.0, 0.25, 0.0, 0.5, 0.0, 0.0):
            await one.passes(0.1)
            quality = "missing" if share == 1.0 else "good"
            said = Diagnosis("laval-rig", "levels/x", one.clock.monotonic_ns(), "shaft", 0, 1, "normal")
            said = replace(said, quality=quality, missing_share=share, sensors=("probe-x",))
            one.recorder.diagnosis(said)
            until_then.update(said, said.t_ns)
            blind_ns = said.t_ns if share == 1.0 else blind_ns
        await one.passes(since_s)
        one.alarm()
        await one.passes(2.0)
        [path] = one.files
    about, _, _, _ = held(path)
    assert {name: Lacking.of(told) for name, told in about["lacking"].items()} == until_then.lacking()
    assert about["lacking"]["levels/x"]["shares"] == [1.0, 0.25, 0.0, 0.5, 0.0, 0.0]
    assert about["lacking"]["levels/x"]["blind_ns"] == blind_ns


async def test_a_snapshot_soon_after_a_restart_states_what_was_lacking_before(tmp_path: Path) -> None:
    async with bench(tmp_path, before_s=0.5) as one:
        await one.passes(20.0)
        doubt = Doubt("levels/x", "missing", False, "lost", ("probe-x",))
        one.recorder.take_over([one.event("sensor-ok/probe-x", doubts=(doubt,))])
        restarted_ns = one.clock.monotonic_ns()
        await one.passes(0.1)
        said = Diagnosis("laval-rig", "levels/x", one.clock.monotonic_ns(), "shaft", 0, 1, "normal")
        one.recorder.diagnosis(replace(said, missing_share=0.0, sensors=("probe-x",)))
        await one.passes(0.8)
        one.alarm()
        await one.passes(2.0)
        [path] = one.files
    about, _, _, _ = held(path)
    assert about["lacking"]["levels/x"]["blind_ns"] == restarted_ns
