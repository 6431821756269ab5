"""What unpacks to far too much is refused in one sentence, at little cost, and the others are judged."""

from __future__ import annotations

import asyncio
import json
import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from can.io.blf import LOG_CONTAINER, LOG_CONTAINER_STRUCT, OBJ_HEADER_BASE_STRUCT, BLFWriter
from support import file_bombs
from support.bus_tables import replay_bus, table_layout
from support.given_codes import had
from support.orbit_files import OPTIONS, Orbit

from daqsvc.acquisition.clock import SystemClock
from daqsvc.cli import main
from daqsvc.confined.limits import ResourceLimits
from daqsvc.recording import RecordingError
from daqsvc.recording.recording import load_recording, set_limits, shared, stop_reading
from drivers.base import BusPort, StreamSpec
from drivers.replay.can_log import CanLog
from drivers.replay.driver import ReplayDriver
from drivers.replay.files import RecordedLogError as ReplayError
from drivers.replay.files import SampleTable

pytestmark = pytest.mark.integration
MOST_MB = 400
"""Of the process that reads, with NumPy, SciPy or Arrow in it."""


@pytest.fixture(autouse=True)
def _fresh_process():
    """So that its largest size is that of one file."""
    stop_reading()
    yield
    stop_reading()
    set_limits(ResourceLimits())


def largest_mb():
    status = Path(f"/proc/{shared._running.process.pid}/status").read_text()
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1e3


@pytest.mark.parametrize("name", file_bombs.BOMBS)
def test_a_bomb_is_refused(tmp_path, name):
    path = file_bombs.write(tmp_path, name)
    with pytest.raises(
        RecordingError, match=r"is too large: its .* unpacks? to .*, 200 times and more"
    ) as refused:
        load_recording(path, rate_hz=1000)
    assert str(refused.value).startswith(str(path))
    assert largest_mb() < MOST_MB


def test_a_header_that_lies_takes_no_memory(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(file_bombs.npz_that_says_too_much())
    with pytest.raises(RecordingError, match="claims to hold 8000000000000 bytes in"):
        load_recording(path, rate_hz=1000)
    assert largest_mb() < MOST_MB


def test_memory_is_bounded_where_nothing_says_how_much_is_needed(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("x,y\n" + "1,2\n" * 600_000)
    set_limits(ResourceLimits(12_000_000))
    with pytest.raises(
        RecordingError, match=r"more memory than it may; allow more \(--max-memory, or .*; it is 0.012 GB"
    ):
        load_recording(path, rate_hz=1000)
    set_limits(ResourceLimits())
    assert load_recording(path, rate_hz=1000).samples.shape == (600_000, 2)


def analyze(capsys, *arguments):
    code = main(["analyze", *map(str, arguments), "--json"])
    captured = capsys.readouterr()
    assert not captured.err
    return code, [json.loads(line) for line in captured.out.splitlines()]


def test_a_bomb_among_recordings_costs_its_own_line(tmp_path, capsys):
    bomb, run = file_bombs.write(tmp_path, "a.npz"), Orbit().save(tmp_path / "run.npz")
    code, said = analyze(capsys, bomb, run, *OPTIONS)
    assert code == 3
    assert ["too large" in (one["refused"] or "") for one in said] == [True, False]
    assert said[1]["verdict"] == "normal"


@pytest.mark.parametrize(("work", "why"), [("crash", "SIGSEGV"), ("spin", "more processor time than it may")])
def test_a_reader_that_crashes_or_never_ends_costs_its_own_line(tmp_path, capsys, monkeypatch, work, why):
    spoils, run = Orbit().save(tmp_path / "spoils.npz"), Orbit().save(tmp_path / "run.npz")
    call = shared.call

    def spoilt(function, arguments, **limits):
        if arguments["path"] != str(spoils):
            return call(function, arguments, **limits)
        return call(f"support.confined_work:{work}", {}, **{**limits, "cpu_s": 0.1})

    monkeypatch.setattr(shared, "call", spoilt)
    code, said = analyze(capsys, spoils, run, *OPTIONS, "--jobs", 1)
    assert code == 3
    assert why in said[0]["refused"]
    assert "copy or save it again" in said[0]["refused"]
    assert said[1]["verdict"] == "normal"


def test_memory_is_given_on_the_command_line(tmp_path, capsys):
    run = tmp_path / "run.npz"
    np.savez(run, **dict.fromkeys("xy", np.random.default_rng(1).normal(size=2_000_000)), fs=1000)
    code, (said,) = analyze(capsys, run, *OPTIONS, "--max-memory", "0.05")
    assert code == 3
    assert "32 MB claims to unpack to 32 MB, and 25 MB may be read; allow more memory" in said["refused"]
    with pytest.raises(SystemExit):
        main(["analyze", str(run), *OPTIONS, "--max-memory", "0.001"])
    assert "is not a number of GB from 0.05 to 1000" in capsys.readouterr().err


SPIN = "support.confined_work:spin_with"
COLUMNS = table_layout(("x", "x", 1.0, 0.0))


@pytest.mark.parametrize("name", ["a.npz", "said.npz"])
def test_a_replayed_table_is_refused_likewise(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(file_bombs.npz() if name == "a.npz" else file_bombs.npz_that_says_too_much())
    with pytest.raises(ReplayError, match=r"a.npz is too large: its .*|said.npz .*claims to hold"):
        SampleTable(path, [StreamSpec("s", COLUMNS, 1000.0)], {})


def test_a_replayed_table_may_take_what_the_bus_says(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, x=np.zeros(10_000_000))
    spec = [StreamSpec("s", COLUMNS, 1000.0)]
    with pytest.raises(ReplayError, match="may be read; allow more memory") as refused:
        SampleTable(path, spec, {}, ResourceLimits(100_000_000))
    assert isinstance(refused.value.__cause__, RecordingError)
    assert refused.value.__cause__.code.id == "R04"
    had("R04", refused.value.__cause__)
    SampleTable(path, spec, {}, ResourceLimits(400_000_000)).close()


def blf_of_containers(path, unpacked_bytes, count):
    """A BLF file of containers that hold an object which goes on in the next one."""
    with BLFWriter(path):
        pass
    endless = OBJ_HEADER_BASE_STRUCT.pack(b"LOBJ", OBJ_HEADER_BASE_STRUCT.size, 1, 2**31, 1)
    packed = zlib.compress(endless + bytes(unpacked_bytes), 9)
    body = LOG_CONTAINER_STRUCT.pack(2, unpacked_bytes) + packed
    size = OBJ_HEADER_BASE_STRUCT.size + len(body)
    header = OBJ_HEADER_BASE_STRUCT.pack(b"LOBJ", OBJ_HEADER_BASE_STRUCT.size, 1, size, LOG_CONTAINER)
    with path.open("ab") as file:
        for _ in range(count):
            file.write(header + body + bytes(size % 4))
    return path


def read_whole(path):
    log = CanLog(path, lambda *_: pytest.fail("there is no frame"))
    try:
        while log.read(10**9) is not None:
            pass
    finally:
        log.close()


@pytest.mark.parametrize(("unpacked_bytes", "count"), [(200_000_000, 1), (9_000_000, 20)])
def test_a_can_log_unpacks_within_bounds(tmp_path, unpacked_bytes, count):
    path = blf_of_containers(tmp_path / "a.blf", unpacked_bytes, count)
    assert path.stat().st_size < 2_000_000
    tracemalloc.start()
    try:
        with pytest.raises(ReplayError, match=r"unpacks to more than .*, 200 times and more"):
            read_whole(path)
        assert tracemalloc.get_traced_memory()[1] / 1e6 < MOST_MB
    finally:
        tracemalloc.stop()


def test_an_object_of_a_can_log_may_not_be_of_any_size(tmp_path):
    path = blf_of_containers(tmp_path / "a.blf", 1000, 1)
    content = bytearray(path.read_bytes())
    at = content.index(b"LOBJ")
    struct.pack_into("<I", content, at + 8, 2**31)
    path.write_bytes(content)
    with pytest.raises(ReplayError, match="an object claims to have 2,147,483,632 bytes"):
        read_whole(path)


def test_a_can_log_of_nothing_but_other_lines_is_given_up(tmp_path):
    path = tmp_path / "a.log.gz"
    path.write_bytes(file_bombs.text_log_gz())
    with pytest.raises(ReplayError, match="100,000 lines in a row are no frames"):
        read_whole(path)


async def test_a_table_that_takes_long_does_not_hold_up_the_end(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    np.savez(path, x=np.zeros(100))
    spec = StreamSpec("s", COLUMNS, 1000.0)
    port = BusPort("t", [spec], SystemClock(), lambda _block: None)
    driver = ReplayDriver(replay_bus(file=path), port)
    call = driver._reader.call
    monkeypatch.setattr(driver._reader, "call", lambda _, *args, **kw: call(SPIN, *args, **kw))
    running = asyncio.create_task(driver.run())
    while driver._reader._running is None:
        await asyncio.sleep(0.01)
    child = driver._reader._running.process
    running.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asyncio.wait_for(running, 60)
    assert child.returncode is not None
