"""The file of trends: what is written is read, packed or not, kept within bounds, and whole after a kill."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
import zlib

import numpy as np
import pytest
from support.waiting import PATIENCE_S

from daqsvc.history.file import (
    NAME,
    SETTLED_S,
    Event,
    HistoryFile,
    HistoryReader,
    Keeping,
    NewerHistoryError,
    Series,
    events_of,
)
from daqsvc.history.points import DAY_S, HOUR_S, RECORD, Step

RMS = Series("pump", "levels/shaft-x", "statistics", "rms", "um")
RUB = Series("pump", "rotor-bank", "probabilities", "F3", "")
BEGIN_S = 480_000 * HOUR_S
"""An hour of 2024 that begins a day and 30 days as well."""
EVERYTHING = Keeping(spans={Step.SECOND: 10_000, Step.MINUTE: 10_000, Step.HOUR: 10_000}, max_bytes=10**9)


def seconds(begin_s: int, means: np.ndarray, spread: float = 1.0) -> np.ndarray:
    found = np.zeros(len(means), RECORD)
    found["t_s"] = begin_s + np.arange(len(means))
    found["n"] = 2
    found["low"], found["mean"], found["high"] = means - spread, means, means + spread
    return found


def pack(file: HistoryFile, now_s: float) -> int:
    return sum(file.pack(now_s))


def test_what_is_written_is_read_at_every_step_packed_or_not(tmp_path) -> None:
    file = HistoryFile(tmp_path / NAME)
    means = 50 + 10 * np.sin(np.arange(3 * HOUR_S) / 700.0)
    for at in range(0, len(means), 977):
        file.write({RMS: seconds(BEGIN_S + at, means[at : at + 977])})
    end_s = BEGIN_S + 3 * HOUR_S
    before = {step: file.trend(RMS, step, BEGIN_S, end_s) for step in Step}
    assert pack(file, end_s) == 0
    after = {step: file.trend(RMS, step, BEGIN_S, end_s) for step in Step}
    for step in Step:
        assert after[step].t_s.tolist() == before[step].t_s.tolist() == list(range(BEGIN_S, end_s, step))
        np.testing.assert_allclose(after[step].mean, before[step].mean, rtol=1e-4)
    for step in (Step.MINUTE, Step.HOUR):
        grouped = means.reshape(-1, step)
        np.testing.assert_allclose(after[step].mean, grouped.mean(axis=1), rtol=1e-4)
        np.testing.assert_allclose(after[step].low, grouped.min(axis=1) - 1, rtol=1e-4)
        np.testing.assert_allclose(after[step].high, grouped.max(axis=1) + 1, rtol=1e-4)
    part = file.trend(RMS, Step.SECOND, BEGIN_S + 3000, BEGIN_S + 3700)
    assert part.t_s.tolist() == list(range(BEGIN_S + 3000, BEGIN_S + 3700))
    file.close()


def test_an_hour_is_packed_only_when_it_is_over_and_settled(tmp_path) -> None:
    file = HistoryFile(tmp_path / NAME)
    file.write({RMS: seconds(BEGIN_S, np.ones(2 * HOUR_S))})
    assert pack(file, BEGIN_S + HOUR_S + SETTLED_S - 1) == 0
    assert file.oldest_s(Step.SECOND) is None
    pack(file, BEGIN_S + HOUR_S + SETTLED_S)
    assert file.oldest_s(Step.SECOND) == BEGIN_S
    [left] = sqlite3.connect(tmp_path / NAME).execute("SELECT DISTINCT hour_s FROM piece").fetchall()
    assert left == (BEGIN_S + HOUR_S,)
    file.close()


def test_gaps_stay_gaps_and_late_seconds_find_their_place(tmp_path) -> None:
    file = HistoryFile(tmp_path / NAME)
    file.write({RMS: seconds(BEGIN_S, np.full(10, 3.0)), RUB: seconds(BEGIN_S + 5, np.full(2, 0.5), 0.0)})
    pack(file, BEGIN_S + 2 * HOUR_S)
    # The wall clock was set back: the hour is there already.
    file.write({RMS: seconds(BEGIN_S + 100, np.full(5, 9.0))})
    pack(file, BEGIN_S + 2 * HOUR_S)
    trend = file.trend(RMS, Step.SECOND, 0, 2 * BEGIN_S)
    assert trend.t_s.tolist() == [*range(BEGIN_S, BEGIN_S + 10), *range(BEGIN_S + 100, BEGIN_S + 105)]
    assert trend.mean.tolist() == [3.0] * 10 + [9.0] * 5
    assert file.trend(RUB, Step.MINUTE, 0, 2 * BEGIN_S).mean.tolist() == [0.5]
    assert file.series("pump") == [RMS, RUB]
    assert file.series("fan") == []
    file.close()


def test_old_chunks_go_by_their_number_whatever_the_clock_says(tmp_path) -> None:
    file = HistoryFile(tmp_path / NAME)
    for hour in range(10):
        file.write({RMS: seconds(BEGIN_S + hour * HOUR_S, np.ones(60))})
    file.write({RMS: seconds(BEGIN_S + 500 * DAY_S, np.ones(60))})  # the clock ran ahead for a while
    pack(file, BEGIN_S + 600 * DAY_S)
    file.keep(Keeping(spans={Step.SECOND: 4, Step.MINUTE: 100, Step.HOUR: 100}, max_bytes=10**9))
    kept = np.unique(file.trend(RMS, Step.SECOND, 0, 1e11).t_s // HOUR_S * HOUR_S)
    assert kept.tolist() == [*(BEGIN_S + h * HOUR_S for h in (7, 8, 9)), BEGIN_S + 500 * DAY_S]
    assert len(file.trend(RMS, Step.HOUR, 0, 1e11).t_s) == 11
    file.close()


def test_beyond_its_size_seconds_go_first_and_the_file_shrinks(tmp_path) -> None:
    rng = np.random.default_rng(3)
    file = HistoryFile(tmp_path / NAME)
    for hour in range(30):
        file.write({RMS: seconds(BEGIN_S + hour * HOUR_S, rng.normal(50, 5, HOUR_S))})
        pack(file, BEGIN_S + (hour + 2) * HOUR_S)
    file.keep(EVERYTHING)
    full = (tmp_path / NAME).stat().st_size
    file.keep(Keeping(spans=EVERYTHING.spans, max_bytes=full // 2))
    assert (tmp_path / NAME).stat().st_size <= full // 2
    seconds_left = file.trend(RMS, Step.SECOND, 0, 1e11).t_s
    assert 0 < len(seconds_left) < 20 * HOUR_S
    assert seconds_left[-1] == BEGIN_S + 30 * HOUR_S - 1
    assert len(file.trend(RMS, Step.MINUTE, 0, 1e11).t_s) == 30 * 60
    file.keep(Keeping(spans=EVERYTHING.spans, max_bytes=1))
    assert len(file.trend(RMS, Step.HOUR, 0, 1e11).t_s) > 0, "the newest of each step stay"
    file.close()


def test_a_damaged_chunk_costs_itself_alone(tmp_path) -> None:
    file = HistoryFile(tmp_path / NAME)
    file.write({RMS: seconds(BEGIN_S, np.ones(2 * HOUR_S))})
    pack(file, BEGIN_S + 3 * HOUR_S)
    other = sqlite3.connect(tmp_path / NAME)
    other.execute("UPDATE chunk SET data = x'01ffff' WHERE step_s = 1 AND begin_s = ?", (BEGIN_S,))
    other.commit()
    other.close()
    assert file.trend(RMS, Step.SECOND, 0, 1e11).t_s[0] == BEGIN_S + HOUR_S
    file.write({RMS: seconds(BEGIN_S + 50, np.ones(10))})
    assert pack(file, BEGIN_S + 3 * HOUR_S) == 1
    assert file.trend(RMS, Step.SECOND, 0, BEGIN_S + HOUR_S).t_s.tolist() == list(
        range(BEGIN_S + 50, BEGIN_S + 60)
    )
    file.close()


def test_a_store_of_old_without_numbers_is_read_and_goes_on(tmp_path) -> None:
    file = HistoryFile(tmp_path / NAME)
    file.write({RMS: seconds(BEGIN_S, np.full(120, 3.0))})
    pack(file, BEGIN_S + 2 * HOUR_S)
    other = sqlite3.connect(tmp_path / NAME)
    for row, data in other.execute("SELECT rowid, data FROM chunk").fetchall():
        values = zlib.decompressobj().decompress(data[1:])
        other.execute("UPDATE chunk SET data = ? WHERE rowid = ?", (data[:1] + zlib.compress(values), row))
    other.commit()
    other.close()
    assert file.trend(RMS, Step.MINUTE, 0, 1e11).n.tolist() == [1, 1], "all the same, as none is known"
    file.write({RMS: seconds(BEGIN_S + HOUR_S, np.full(60, 9.0))})
    assert pack(file, BEGIN_S + 3 * HOUR_S) == 0
    minutes = file.trend(RMS, Step.MINUTE, 0, 1e11)
    assert minutes.mean.tolist() == [3, 3, 9]
    assert minutes.n.tolist() == [120, 120, 120], "as many as the usual one"
    file.close()


def message(sequence: int, **more: object) -> tuple[int, bytes]:
    document = {"schema": "daqsvc.alarm/1", "machine": "pump", "wall_ns": sequence * 10**9, **more}
    return sequence, json.dumps(document).encode()


def test_alarm_events_are_there_once_and_the_oldest_make_room(tmp_path) -> None:
    file = HistoryFile(tmp_path / NAME)
    others = [
        (9, b"{"),
        (10, b"[]"),
        message(11, schema="daqsvc.status/1"),
        (12, b'{"schema": 1}'),
        message(13, wall_ns=1 << 63),
    ]
    events = events_of([message(7), message(8, machine="fan"), *others])
    assert [event.sequence for event in events] == [7, 8]
    file.write({}, events)
    file.write({}, events)
    assert file.last_sequence == 8
    assert [e.sequence for e in file.events(None, 0, 100)] == [7, 8]
    assert json.loads(file.events("fan", 0, 100)[0].payload)["machine"] == "fan"
    assert file.events("pump", 8, 100) == []
    noise = np.random.default_rng(1)
    file.write({}, [Event(n, n * 10**9, "pump", noise.bytes(1000)) for n in range(20, 1020)])
    file.keep(Keeping(spans=EVERYTHING.spans, max_bytes=2_000_000))
    left = [e.sequence for e in file.events(None, 0, 10**6)]
    assert left[-1] == 1019
    assert 400 <= len(left) <= 510
    file.close()


def test_a_file_of_a_newer_version_is_refused_and_stays(tmp_path) -> None:
    path = tmp_path / NAME
    HistoryFile(path).close()
    other = sqlite3.connect(path)
    other.execute("PRAGMA user_version = 99")
    other.close()
    for kind in (HistoryFile, HistoryReader):
        with pytest.raises(NewerHistoryError, match=r"newer version of daqsvc .* move the file away"):
            kind(path)


def test_it_is_read_while_it_is_written(tmp_path) -> None:
    file = HistoryFile(tmp_path / NAME)
    file.write({RMS: seconds(BEGIN_S, np.ones(5))})
    reader = HistoryReader(tmp_path / NAME)
    assert len(reader.trend(RMS, Step.SECOND, 0, 1e11).t_s) == 5
    file.write({RMS: seconds(BEGIN_S + 5, np.ones(5))})
    assert len(reader.trend(RMS, Step.SECOND, 0, 1e11).t_s) == 10
    with pytest.raises(sqlite3.OperationalError, match="readonly"):
        reader._sql.execute("DELETE FROM piece")
    reader.close()
    file.close()


WRITER = """
import sys
from pathlib import Path
import numpy as np
sys.path.insert(0, {tests!r})
from history.test_history_file import RMS, BEGIN_S, HOUR_S, seconds
from daqsvc.history.file import HistoryFile
file = HistoryFile(Path({path!r}))
for at in range(0, 10**9, 600):
    file.write({{RMS: seconds(BEGIN_S + at, np.full(600, at / 600.0))}})
    for _ in file.pack(BEGIN_S + at): pass
    print(at, flush=True)
"""


@pytest.mark.long
def test_killed_at_any_moment_it_has_all_that_was_written_once(tmp_path, pytestconfig) -> None:
    rng = np.random.default_rng(8)
    for k in range(12):
        path = tmp_path / f"{k}.sqlite"
        tests = str(pytestconfig.rootpath / "tests")
        writer = subprocess.Popen(
            [sys.executable, "-c", WRITER.format(path=str(path), tests=tests)],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert writer.stdout is not None
        for _ in range(int(rng.integers(1, 40))):
            line = writer.stdout.readline()
        time.sleep(float(rng.uniform(0, 0.02)))
        os.kill(writer.pid, signal.SIGKILL)
        rest = writer.stdout.read().split()
        writer.wait(PATIENCE_S)
        writer.stdout.close()
        told = int([line.strip(), *rest][-1])
        reader = HistoryReader(path)
        trend = reader.trend(RMS, Step.SECOND, 0, 1e12)
        reader.close()
        assert len(trend.t_s) >= told + 600, "what a write has told is there"
        assert trend.t_s.tolist() == list(range(BEGIN_S, BEGIN_S + len(trend.t_s)))
        assert (trend.mean == (trend.t_s - BEGIN_S) // 600).all()


@pytest.mark.long
def test_thirteen_months_of_ten_channels_fit_into_a_gigabyte(tmp_path) -> None:
    """Three days are written by the second; what each step takes is multiplied by what is kept of it."""
    rng = np.random.default_rng(5)
    file = HistoryFile(tmp_path / NAME)
    # Of ten channels three levels each, ten modes of the bank, speed, and what bearings say.
    figures = [Series("pump", f"detector-{k}", "statistics", "value", "um") for k in range(46)]
    days = 3
    for hour in range(24 * days):
        file.write({one: seconds(BEGIN_S + hour * HOUR_S, rng.normal(50, 5, HOUR_S)) for one in figures})
        pack(file, BEGIN_S + (hour + 2) * HOUR_S)
    pack(file, BEGIN_S + (24 * days + 2) * HOUR_S)
    connection = sqlite3.connect(tmp_path / NAME)
    per_day = {
        step: connection.execute(
            "SELECT SUM(LENGTH(data)) FROM chunk WHERE step_s = ?", (int(step),)
        ).fetchone()[0] / days
        for step in Step
    }  # fmt: skip
    packed = sum(per_day.values()) * days
    size = connection.execute("SELECT page_count * 4096 FROM pragma_page_count").fetchone()[0]
    free = connection.execute("SELECT freelist_count * 4096 FROM pragma_freelist_count").fetchone()[0]
    connection.close()
    file.close()
    overhead = (size - free) / packed
    total = overhead * (14 * per_day[Step.SECOND] + 400 * (per_day[Step.MINUTE] + per_day[Step.HOUR]))
    # Noise all over, which no machine that runs well has: the worst there is.
    assert total <= 0.75e9, f"{total / 1e6:.0f} MB, which leaves no quarter for alarm events"
