"""Tables of samples are read by one reader: what `analyze` accepts is played, and what it refuses is not."""

from __future__ import annotations

import asyncio
import gzip
import logging
import re
import struct
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import scipy.io
from support.bus_tables import replay_bus, table_layout

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.confined.process import ConfinedProcess
from daqsvc.recording import RecordingError
from daqsvc.recording.recording import load_recording
from drivers.base import BusPort, StreamSpec
from drivers.replay.driver import ReplayDriver
from drivers.replay.files import RecordedLogError, SampleTable
from drivers.replay.settings import ReplayBus

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock

pytestmark = pytest.mark.integration
RATE_HZ = 1000.0
X, Y = np.arange(40.0), np.linspace(-1.0, 1.0, 40)
ROWS = [f"{x:g},{y:.9f}" for x, y in zip(X, Y, strict=True)]


def csv(*lines: str) -> bytes:
    return ("\n".join(lines) + "\n").encode()


def stamped(step_s: float, lacking: slice = slice(0, 0)) -> bytes:
    rows = [f"{k * step_s:.6f},{row}" for k, row in enumerate(ROWS)]
    del rows[lacking]
    return csv("time,x,y", *rows)


def npz(**arrays: Any) -> Callable[[Path], None]:
    return lambda path: np.savez(path, **arrays)


def wav(path: Path) -> None:
    data = np.column_stack([X, Y]).astype("<f4").tobytes()
    form = struct.pack("<4sIHHIIHH", b"fmt ", 16, 3, 2, 1000, 8000, 8, 32)
    body = b"WAVE" + form + struct.pack("<4sI", b"data", len(data)) + data
    path.write_bytes(struct.pack("<4sI", b"RIFF", len(body)) + body)


def parquet(path: Path) -> None:
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    pq.write_table(pa.table({"x": X, "y": Y}), path)


FILES: dict[str, tuple[str, bytes | Callable[[Path], Any]]] = {
    "arrays": ("a.npz", npz(x=X, y=Y)),
    "integers": ("a.npz", npz(x=X.astype(np.int16), y=Y)),
    "variables of MATLAB": ("a.mat", lambda path: scipy.io.savemat(path, {"x": X, "y": Y})),
    "columns": ("a.csv", csv("x,y", *ROWS)),
    "columns, zipped": ("a.csv.gz", gzip.compress(csv("x,y", *ROWS))),
    "columns of Parquet": ("a.parquet", parquet),
    "decimal commas": ("A.CSV", csv("x;y", *(row.replace(",", ";").replace(".", ",") for row in ROWS))),
    "UTF-16": ("a.csv", csv("x,y", *ROWS).decode().encode("utf-16")),
    "empty cells": ("a.csv", csv("x,y", *ROWS[:5], "7,", ",8", *ROWS[5:])),
    "a column of times": ("a.csv", stamped(1 / RATE_HZ)),
    "rows that are missing": ("a.csv", stamped(1 / RATE_HZ, slice(10, 14))),
    "channels of a WAV file": ("a.wav", wav),
    "Python objects": ("a.npz", npz(x=np.array([None, {}], object), y=Y)),
    "an empty array": ("a.npz", npz(x=X[:0], y=Y)),
    "a single number": ("a.npz", npz(x=3.0, y=Y)),
    "texts": ("a.npz", npz(x=np.array(["a", "b"]), y=Y)),
    "a matrix": ("a.npz", npz(x=np.ones((40, 2)), y=Y)),
    "different lengths": ("a.npz", npz(x=X, y=Y[1:])),
    "one sample": ("a.npz", npz(x=X[:1], y=Y[:1])),
    "no arrays": ("a.npz", npz()),
    "what no sensor measures": ("a.npz", npz(x=X * 1e20, y=Y)),
    "no archive": ("a.npz", b"no zip"),
    "nothing in MATLAB's file": ("a.mat", b""),
    "an empty file": ("a.csv", b""),
    "a header only": ("a.csv", csv("x,y")),
    "a word for a number": ("a.csv", csv("x,y", *ROWS[:3], "1,two", *ROWS[3:])),
    "words only": ("a.csv", csv("x,y", "one,two")),
    "short lines": ("a.csv", csv("x,y", *ROWS, "7")),
    "another column": ("a.csv", csv("p,q", *ROWS)),
    "most rows missing": ("a.csv", stamped(1 / RATE_HZ).replace(b"0.03", b"9.03")),
    "a folder": ("a.csv", lambda path: path.mkdir()),
    "no file": ("a.csv", lambda path: None),
}
REFUSED = 20
"""As many of them, from the end, are refused."""


class Kept(ConfinedProcess):
    """A process that reads one file after the other."""

    def __exit__(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def reader() -> Iterator[ConfinedProcess]:
    kept = Kept()
    yield kept
    kept.close()


def analysed(path: Path, columns: Sequence[str]) -> NDArray[np.float64] | str:
    """What is analysed of a file, or why it cannot be."""
    try:
        return load_recording(path, dict(zip("xy", columns, strict=True)), RATE_HZ).samples
    except RecordingError as error:
        return str(error)


@pytest.mark.parametrize("kind", FILES)
def test_a_table_is_played_as_it_is_analysed(tmp_path: Path, kind: str, reader: ConfinedProcess) -> None:
    name, content = FILES[kind]
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        content(path)
    assert ReplayBus(driver="replay", file=path).is_table
    columns = ("0", "1") if path.suffix == ".wav" else ("x", "y")
    layout = table_layout(("x", columns[0], 2.0, 1.0), ("y", columns[1], 1.0, 0.0))
    stream = StreamSpec("s", layout, RATE_HZ)
    wanted = analysed(path, columns)
    assert isinstance(wanted, str) == (kind in list(FILES)[-REFUSED:])
    if isinstance(wanted, str):
        with pytest.raises(RecordedLogError, match=f"^{re.escape(wanted)}$"):
            SampleTable(path, [stream], {}, reader=reader)
        return
    table = SampleTable(path, [stream], {}, reader=reader)
    piece = table.read(10**9)
    assert piece is not None
    played = piece.frames["s"].samples[:, 0]
    np.testing.assert_array_equal(played, (wanted * [2.0, 1.0] + [1.0, 0.0]).astype(np.float32))
    assert not table.notes
    table.close()


async def play(path: Path, streams: list[StreamSpec[Any]]) -> tuple[ReplayDriver, list[SampleBlock]]:
    blocks: list[SampleBlock] = []
    bus = replay_bus(file=path, at_end="stop", pace="unpaced")
    driver = ReplayDriver(bus, BusPort("tape", streams, DrivenClock(), blocks.append))
    async with asyncio.timeout(60):
        await driver.run()
    return driver, blocks


async def test_a_table_that_tells_another_rate_is_played_at_that_of_its_stream_and_it_is_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(stamped(1 / RATE_HZ, slice(10, 14)))
    layout = table_layout(("x", "x", 1.0, 0.0))
    with caplog.at_level(logging.WARNING):
        driver, blocks = await play(path, [StreamSpec("s", layout, 400.0), StreamSpec("t", layout, RATE_HZ)])
    assert driver.link.reason == "end of file"
    said = [record.getMessage() for record in caplog.records]
    (note,) = [one for one in said if "replayed bus" in one]
    assert note == (
        f"replayed bus 'tape': the sampling rate of {path} is 1000 Hz (time column 'time', read as seconds) "
        "by the file and 400 Hz by the machine file, which is taken: correct the one that is wrong"
    )
    # Rows are missing only by times that are believed.
    played = {name: [b.samples[:, 0] for b in blocks if b.stream == name] for name in "st"}
    there = np.delete(X, slice(10, 14))
    np.testing.assert_array_equal(np.concatenate(played["s"]), there)
    with_gap = X.copy()
    with_gap[10:14] = np.nan
    np.testing.assert_array_equal(np.concatenate(played["t"]), with_gap)


async def test_a_table_whose_times_go_backwards_is_played_as_it_stands_and_it_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, x=X, t=np.arange(len(X))[::-1] / RATE_HZ)
    with caplog.at_level(logging.WARNING):
        _, blocks = await play(path, [StreamSpec("s", table_layout(("x", "x", 1.0, 0.0)), RATE_HZ)])
    words = "the times of its column 't' go backwards, row by row: the samples are taken in the order"
    assert words in caplog.text
    np.testing.assert_array_equal(np.concatenate([block.samples[:, 0] for block in blocks]), X)
    assert load_recording(path, rate_hz=RATE_HZ).notes[0].startswith(words)


async def test_streams_of_one_table_may_last_for_different_times(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=X, y=Y[:20])
    streams = [
        StreamSpec(name, table_layout((name, name, 1.0, 0.0)), RATE_HZ * (0.5 if name == "y" else 1.0))
        for name in "xy"
    ]
    driver, blocks = await play(tmp_path / "a.npz", streams)
    assert driver.link.reason == "end of file"
    for name, wanted in (("x", X), ("y", Y[:20])):
        played = np.concatenate([block.samples[:, 0] for block in blocks if block.stream == name])
        np.testing.assert_array_equal(played, wanted.astype(np.float32))
