"""What a format cannot hold `daqsvc export` says; and it takes no more memory for many channels."""

from __future__ import annotations

import numpy as np
import pytest
import pyuff

from daqsvc.cli import main
from daqsvc.recording.recording import load_all
from daqsvc.recording.streams import RecordedStream
from daqsvc.recording.writers import WRITERS, write_all

pytestmark = pytest.mark.integration
SUFFIXES = list(WRITERS)


def export(*arguments):
    return main(["export", *map(str, arguments)])


def write_csv(path, channels, rows=50):
    """A table by the units of its channels."""
    units = [f"# unit of {name} = {unit}" for name, unit in channels.items() if unit]
    table = [",".join(channels), *[",".join([str(row)] * len(channels)) for row in range(rows)]]
    path.write_text("\n".join(["# fs_hz = 100", *units, *table]), encoding="utf-8")
    return path


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_suffixes_may_have_capital_letters(tmp_path, suffix):
    source = write_csv(tmp_path / "in.csv", {"x": "um"})
    target = tmp_path / f"RUN.B{suffix.upper()}"
    assert export(source, "--to", target) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [target.name, "in.csv"]
    (stream,), _ = load_all(target)
    assert (stream.names, stream.units, len(stream.samples)) == (("x",), ("um",), 50)


@pytest.mark.parametrize(("suffix", "format_name"), [(".wav", "WAV"), (".uff", "UFF")])
def test_infinite_values_that_become_0_are_counted(tmp_path, capsys, suffix, format_name):
    values = np.arange(1.0, 101.0)
    values[[3, 4, 5]] = np.inf, -np.inf, np.nan
    np.savez(tmp_path / "in.npz", x=values, y=np.where(np.arange(100) == 9, 1e300, 1.0), fs=100.0)
    target = tmp_path / f"out{suffix}"
    assert export(tmp_path / "in.npz", "--to", target) == 0
    lost = 3 if suffix == ".wav" else 2  # 1e300 is none of float32
    begin = f"daqsvc export: out{suffix}: "
    missing = f"stream in lacks 1 sample, 0 in the file, as a {format_name} file has no gaps"
    why = f"as a {format_name} file holds finite numbers only"
    infinite = f"stream in has 0 in place of {lost} values that cannot be written, {why}"
    assert capsys.readouterr().err == f"{begin}{missing}\n{begin}{infinite}\n"
    (stream,), _ = load_all(target)
    assert np.flatnonzero(stream.samples[:, 0] == 0.0).tolist() == [3, 4, 5]


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".mat", ".mf4"])
def test_infinite_values_stay_where_a_format_has_them(tmp_path, capsys, suffix):
    np.savez(tmp_path / "in.npz", x=np.where(np.arange(100) == 3, np.inf, 1.0), fs=100.0)
    assert export(tmp_path / "in.npz", "--to", tmp_path / f"out{suffix}") == 0
    assert "infinite" not in capsys.readouterr().err
    (stream,), _ = load_all(tmp_path / f"out{suffix}")
    assert np.isinf(stream.samples[3, 0])


def test_units_and_names_are_spelled_in_ascii(tmp_path, capsys):
    channels = {
        "temp": "\u00b0C",
        "accel": "m/s\u00b2",
        "\u00e9": "\u00b5m",
        "\u00e8": "\u03bcm",
        "Kr\u00e4fte": "kN\u00b7m",
        "NONE": "\u2126",
        "\u65e5": "\u65e5",
        "n" * 90: "u" * 30,
        "n" * 91: "s\u207b\u00b9",
    }
    source = write_csv(tmp_path / "in.csv", channels)
    assert export(source, "--to", tmp_path / "out.uff") == 0
    (stream,), _ = load_all(tmp_path / "out.uff")
    expected = {
        "temp": "degC",
        "accel": "m/s2",
        "e": "um",
        "e_2": "um",
        "Krafte": "kN.m",
        "channel": "Ohm",
        "?": "?",
        "n" * 74: "u" * 20,
        "n" * 74 + "_2": "s-1",
    }
    assert dict(zip(stream.names, stream.units, strict=True)) == expected
    err = capsys.readouterr().err
    notes = [line.removeprefix("daqsvc export: out.uff: ") for line in err.splitlines()]
    assert [note for note in notes if note.startswith("channel")] == [
        f"channel {old} is called {new} there, as a UFF file has ASCII names"
        for old, new in zip(channels, expected, strict=True)
        if old != new
    ]
    assert [note for note in notes if note.startswith("the unit")] == [
        f"the unit {unit} of channel {name} is {new} there, as a UFF file has ASCII units of 20 characters"
        for name, unit, new in (("\u65e5", "\u65e5", "?"), ("n" * 90, "u" * 30, "u" * 20))
    ]
    kinds = [one["ordinate_spec_data_type"] for one in pyuff.UFF(str(tmp_path / "out.uff")).read_sets()]
    assert kinds[:4] == [0, 12, 8, 8]  # acceleration, and displacement


@pytest.mark.long
@pytest.mark.parametrize(
    ("suffix", "channels", "rows", "most"),
    [
        (".csv", 600, 1000, 1 << 18),
        (".parquet", 500, 9000, 1 << 22),
        (".wav", 500, 9000, 1 << 22),
        (".mf4", 500, 9000, 1 << 22),
    ],
)
def test_many_channels_are_written_in_short_pieces(tmp_path, monkeypatch, suffix, channels, rows, most):
    sizes = []
    pieces = RecordedStream.pieces

    def watched(stream, count):
        found = pieces(stream, count)
        sizes.extend(piece.size for piece in found)
        return found

    monkeypatch.setattr(RecordedStream, "pieces", watched)
    samples = np.ones((rows, channels), np.float32)
    samples[-1] = 2.0
    names = tuple(f"c{number}" for number in range(channels))
    stream = RecordedStream("s", 100.0, names, ("",) * channels, samples)
    target = tmp_path / f"out{suffix}"
    write_all({target: [stream]}, {}, force=False)
    assert len(sizes) > 1
    assert max(sizes) <= most
    assert stream.missing() == 0
    assert max(sizes) <= 1 << 22
    (found,), _ = load_all(target)
    assert np.array_equal(found.samples, samples)
    assert stream.piece_rows(1) == 1
