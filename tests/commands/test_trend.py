"""``daqsvc trend``: figures of the history as text, JSON, tables and a picture; and what it refuses."""

from __future__ import annotations

import csv
import json
import time
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np
import pytest

from daqsvc.cli import main
from daqsvc.history.file import NAME, Event, HistoryFile, Series
from daqsvc.history.points import RECORD

if TYPE_CHECKING:
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
def test_a_picture(store) -> None:
    pytest.importorskip("matplotlib")
    target = store / "out.png"
    assert main(["trend", "--store", str(store), "--since", "1h", "--plot", str(target)]) == 0
    assert target.read_bytes().startswith(b"\x89PNG")
    assert main(["trend", "--store", str(store), "--since", "1h", "--plot", str(store / "out.xyz")]) == 1


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


def test_without_a_history_the_remedy_is_said(tmp_path, capsys) -> None:
    assert main(["trend", "--store", str(tmp_path)]) == 1
    assert "write [history] into the machine file" in capsys.readouterr().err


def test_a_damaged_history_is_said(tmp_path, capsys) -> None:
    (tmp_path / NAME).write_bytes(b"x" * 5000)
    assert main(["trend", "--store", str(tmp_path)]) == 1
    assert "cannot be read: file is not a database" in capsys.readouterr().err
