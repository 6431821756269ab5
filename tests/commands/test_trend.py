"""``daqsvc trend``: figures of the history as text, JSON, tables and a picture; and what it refuses."""

from __future__ import annotations

import csv
import importlib.util
import json
import os
import resource
import sys
import time
from contextlib import contextmanager, suppress
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.machine_files import MACHINES

from daqsvc.cli import main
from daqsvc.history.file import NAME, Event, HistoryFile, Series
from daqsvc.history.points import HOUR_S, RECORD

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

RMS = Series("pump", "levels/shaft-x", "statistics", "rms", "um")
FAN = Series("fan", "bearing", "probabilities", "outer", "")


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """The history of two machines, until now."""
    now_s = int(time.time())
    file = HistoryFile(tmp_path / NAME)
    for series, many in ((RMS, 3000), (FAN, 300)):
        records = np.zeros(many, RECORD)
        records["t_s"] = now_s - many + np.arange(many)
        records["n"] = 1
        records["mean"] = np.arange(many) / 100
        records["low"], records["high"] = records["mean"] - 1, records["mean"] + 1
        file.write({series: records})
    payload = json.dumps({"schema": "daqsvc.alarm/1", "sequence": 3, "machine": "pump"}).encode()
    file.write({}, [Event(3, now_s * 10**9 - 10**9, "pump", payload)])
    file.close()
    return tmp_path


def test_people_see_a_table_with_bars(store, capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    assert main(["trend", "--store", str(store), "--since", "1h"]) == 0
    fan, pump = capsys.readouterr().out.split("\n\n")
    assert fan.startswith("fan, ")
    assert fan.splitlines()[0].endswith("by the second")
    row = pump.splitlines()[2]
    assert row.split()[:6] == ["levels/shaft-x.rms", "29.99", "-1", "14.99", "30.99", "um"]
    bars = row.split(maxsplit=6)[6]
    assert bars == "".join(sorted(bars)), "it rises"
    assert bars[0] == "▁"
    assert bars[-1] == "█"


@pytest.mark.parametrize("is_packed", [False, True])
def test_the_mean_is_that_of_all_statements_at_every_step(tmp_path, capsys, monkeypatch, is_packed) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    begin_s = 480_000 * HOUR_S
    records = np.zeros(15, RECORD)
    records["t_s"] = begin_s + 47 + np.arange(15)  # 13 s of one minute, and 2 s of the next
    records["n"] = [5] * 14 + [1]
    records["mean"] = records["low"] = records["high"] = [100.0] * 13 + [203.0] * 2
    file = HistoryFile(tmp_path / NAME)
    file.write({RMS: records})
    if is_packed:
        assert list(file.pack(begin_s + 2 * HOUR_S)) == [0]
    file.close()
    span = ["--since", f"{datetime.fromtimestamp(begin_s).astimezone().isoformat()}"]
    span += ["--until", f"{datetime.fromtimestamp(begin_s + HOUR_S).astimezone().isoformat()}"]
    bars = {}
    for step in ("second", "minute", "hour"):
        assert main(["trend", "--store", str(tmp_path), *span, "--step", step]) == 0
        row = capsys.readouterr().out.splitlines()[2]
        assert row.split()[3] == "108.7", f"(13 * 5 * 100 + 6 * 203) / 71, by the {step}"
        bars[step] = row[row.index("um") :]
    assert bars["second"] == bars["minute"], "also within a bar"


def test_a_table_for_others_has_a_row_a_point(store, capsys) -> None:
    target = store / "out.csv"
    assert main(["trend", "--store", str(store), "--since", "1h", "--csv", str(target)]) == 0
    assert capsys.readouterr().out == ""
    rows = list(csv.DictReader(target.read_text().splitlines()))
    assert len(rows) == 3300
    assert rows[0].keys() == {"time", "machine", "reading", "unit", "low", "mean", "high"}
    times = [datetime.fromisoformat(row["time"]) for row in rows if row["machine"] == "pump"]
    assert (times[-1] - times[0]).total_seconds() == 2999
    assert main(["trend", "--store", str(store), "--since", "1h", "--step", "hour", "--csv", "-"]) == 0
    assert 2 < len(capsys.readouterr().out.splitlines()) <= 6


def test_columns_for_others(store) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    target = store / "out.parquet"
    assert (
        main(
            [
                "trend",
                "--store",
                str(store),
                "--machine",
                "pump",
                "--step",
                "minute",
                "--parquet",
                str(target),
            ]
        )
        == 0
    )
    table = pq.read_table(target)
    assert table.column_names == ["time", "machine", "reading", "unit", "low", "mean", "high"]
    assert str(table.schema.field("time").type) == "timestamp[ms, tz=UTC]"
    assert 50 <= table.num_rows <= 52
    assert set(table["reading"].to_pylist()) == {"levels/shaft-x.rms"}


@pytest.mark.long
def test_a_picture(store, capsys, monkeypatch) -> None:
    plt = pytest.importorskip("matplotlib.pyplot")
    target = store / "out.png"
    figures = []
    close = plt.close
    monkeypatch.setattr(plt, "close", figures.append)
    assert main(["trend", "--store", str(store), "--since", "1h", "--plot", str(target)]) == 0
    assert target.read_bytes().startswith(b"\x89PNG")
    [figure] = figures
    assert not any(axis.yaxis.get_major_formatter().get_useOffset() for axis in figure.axes), "plain figures"
    close(figure)
    assert main(["trend", "--store", str(store), "--since", "1h", "--plot", str(target)]) == 2
    assert "out.png is there already" in capsys.readouterr().err


def test_alarm_events_as_they_were_told(store, capsys) -> None:
    assert main(["trend", "--store", str(store), "--since", "1h", "--events"]) == 0
    assert json.loads(capsys.readouterr().out)["sequence"] == 3
    assert main(["trend", "--store", str(store), "--machine", "fan", "--since", "1h", "--events"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--since", "yesterday"], 2, "'yesterday' is no time; write e.g. 8h, 30d"),
        (["--since", "1h", "--until", "2h"], 2, "--since is not before --until"),
        (["--machine", "pmp"], 1, "no machine 'pmp' in the history; there is fan, pump"),
        (
            ["--reading", "*.peak"],
            1,
            "no figure '*.peak' in the history; there is bearing.outer, levels/shaft-x.rms",
        ),
        (["--since", "2020-01-01", "--until", "2020-02-01"], 1, "ask for another time with --since"),
        (["--csv", "/nowhere/x.csv", "--since", "1h"], 1, "/nowhere/x.csv: No such file or directory"),
        (["--csv", "-", "--json"], 2, "not allowed with argument"),
        (["--csv", "/"], 2, "/ is a folder; name a file in it"),
        (["--csv", f"/{'x' * 300}"], 2, "File name too long; give another name"),
        (["--parquet", "-"], 2, "--csv - writes to standard output"),
        (["--plot", "/nowhere/x.bmp"], 2, "x.bmp: write a name that ends in one of .png, .svg, .pdf"),
    ],
)
def test_what_cannot_be_shown_is_said(store, capsys, arguments, code, words) -> None:
    try:
        found = main(["trend", "--store", str(store), *arguments])
    except SystemExit as ended:
        found = ended.code
    said = capsys.readouterr()
    assert (found, said.out) == (code, "")
    assert words in said.err
    assert said.err.count("\n") == 1


def test_without_a_history_the_remedy_is_said(tmp_path, capsys, monkeypatch) -> None:
    assert main(["trend", "--store", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "write [history] into the machine file" in said
    assert "; or give the machine file in place of --store, as it names the store [C13]" in said
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path}")
    assert main(["trend", f"{MACHINES / 'laval-rig.toml'}"]) == 1
    words = "; or if the service was started with --store, give the same --store in place of FILE [C13]"
    assert words in capsys.readouterr().err
    (tmp_path / NAME).touch()
    assert main(["trend", "--store", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert f"{NAME} holds nothing yet; start the service with [history] in the machine file" in said
    assert said.count("\n") == 1


def test_a_damaged_history_is_said(tmp_path, capsys) -> None:
    (tmp_path / NAME).write_bytes(b"x" * 5000)
    assert main(["trend", "--store", str(tmp_path)]) == 1
    assert "cannot be read: file is not a database" in capsys.readouterr().err


@pytest.mark.parametrize(("option", "replace"), [("--csv", "--overwrite"), ("--parquet", "--force")])
def test_a_file_that_is_there_is_replaced_only_on_purpose(store, capsys, option, replace) -> None:
    pytest.importorskip("pyarrow")
    target = store / "mine"
    target.write_text("dear to me")
    command = ["trend", "--store", str(store), "--since", "1h", option, str(target)]
    assert main(command) == 2
    assert f"{target} is there already; give another name, or --overwrite" in capsys.readouterr().err
    assert target.read_text() == "dear to me"
    link = store / "link"
    link.symlink_to(target)
    assert main([*command[:-1], str(link), replace]) == 0
    assert link.is_symlink()
    assert len(target.read_bytes()) > 10_000
    assert not list(store.glob(".daqsvc*"))


@pytest.mark.parametrize("option", ["--csv", "--parquet"])
@pytest.mark.parametrize("force", [False, True])
def test_a_full_disk_leaves_no_cut_file_and_keeps_what_was_there(store, capsys, option, force) -> None:
    pytest.importorskip("pyarrow")
    target = store / "out"
    if force:
        target.write_text("dear to me")
    command = ["trend", "--store", str(store), "--since", "1h", option, str(target), *["--overwrite"] * force]
    with files_of_at_most(34_000):
        assert main(command) == 1
    assert capsys.readouterr().err == f"daqsvc trend: {target}: File too large [C09]\n"
    assert (target.read_text() if force else target.exists()) == ("dear to me" if force else False)
    assert not list(store.glob(".daqsvc*"))


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """No file can grow beyond: what a full disk is like. SQLite needs 32 KiB to read."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("force", [[], ["--overwrite"]])
def test_what_is_no_regular_file_stays_and_takes_a_table_only(store, capsys, force) -> None:
    pipe = store / "pipe.png"
    os.mkfifo(pipe)
    common = ["trend", "--store", str(store), "--since", "1h", "--step", "hour", *force]
    for option, library in (("--parquet", "pyarrow"), ("--plot", "matplotlib")):
        if importlib.util.find_spec(library) is not None:
            assert main([*common, option, str(pipe)]) == 2
            assert f"{pipe} is no regular file" in capsys.readouterr().err
    reader = os.open(pipe, os.O_RDWR)  # so that neither end waits for the other
    assert main([*common, "--csv", str(pipe)]) == 0
    assert os.read(reader, 10_000).startswith(b"time,machine,reading,unit,low,mean,high\n")
    os.close(reader)
    assert pipe.is_fifo()


def test_a_device_that_is_full_and_a_pipe_whose_reader_is_gone(store, capsys) -> None:
    common = ["trend", "--store", str(store), "--since", "1h", "--csv"]
    assert main([*common, "/dev/full"]) == 1
    assert capsys.readouterr().err == "daqsvc trend: /dev/full: No space left on device [C09]\n"
    file = os.open(store / "out", os.O_CREAT | os.O_WRONLY)  # standard output is given up then
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(file, "w") as stdout, pytest.MonkeyPatch.context() as patched:
        patched.setattr(sys, "stdout", stdout)
        assert main([*common, f"/dev/fd/{writer}"]) == 0
    os.close(writer)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("form", [["--csv", "-"], ["--json"], ["--events"], []])
@pytest.mark.parametrize(("kind", "code", "words"), [("head", 0, ""), ("full", 1, "No space left on device")])
def test_a_reader_that_has_had_enough_and_a_full_disk(
    store, capsys, monkeypatch, form, kind, code, words
) -> None:
    if kind == "head":
        reader, writer = os.pipe()
        os.close(reader)
    else:
        writer = os.open("/dev/full", os.O_WRONLY)
    file = os.fdopen(writer, "w", 1)
    with monkeypatch.context() as patched:
        patched.setattr(sys, "stdout", file)
        found = main(["trend", "--store", str(store), "--since", "1h", *form])
    with suppress(OSError):
        file.close()
    said = capsys.readouterr().err
    assert found == code
    assert words in said
    assert "None" not in said
    assert bool(said) == bool(words)
