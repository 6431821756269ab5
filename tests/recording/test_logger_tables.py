"""Text tables as loggers of several makers and countries write them."""

from __future__ import annotations

from datetime import datetime, timedelta

import numpy as np
import pytest

from daqsvc.recording import RecordingError
from daqsvc.recording.formats.written_times import format_of, times_of
from daqsvc.recording.recording import load_recording

RATE_HZ = 1_000
SAMPLES = np.round(np.random.default_rng(6).normal(size=300), 4)
START = datetime(2026, 1, 31, 23, 59, 59, 900_000)  # noqa: DTZ001 - as loggers write it; over midnight
EPOCH_OF_EXCEL = datetime(1899, 12, 30)  # noqa: DTZ001
MOMENTS = [START + timedelta(milliseconds=k) for k in range(300)]


def number(value, comma):
    return f"{value:.4f}".replace(".", ",") if comma else f"{value:.4f}"


def table(tmp_path, cells, *, delimiter=";", comma=True, head=("Zeit", "x"), above="", encoding="utf-8"):
    rows = [delimiter.join((cell, number(x, comma))) for cell, x in zip(cells, SAMPLES, strict=True)]
    path = tmp_path / "rig.csv"
    path.write_text(above + "\r\n".join([delimiter.join(head), *rows, ""]), encoding)
    return path


WAYS = {
    "ISO 8601": lambda t, _: t.isoformat(timespec="milliseconds"),
    "ISO 8601 as Python writes it": lambda t, _: t.isoformat(" "),
    "with a zone": lambda t, _: t.isoformat(timespec="microseconds") + "+01:00",
    "German": lambda t, _: t.strftime("%d.%m.%Y %H:%M:%S,%f")[:-3],
    "German without zeros": lambda t, _: f"{t.day}.{t.month}.{t.year} {t:%H:%M:%S,%f}"[:-3],
    "British": lambda t, _: t.strftime("%d/%m/%Y %H:%M:%S.%f"),
    "American": lambda t, _: t.strftime("%m/%d/%Y %I:%M:%S.%f %p"),
    "Japanese": lambda t, _: t.strftime("%Y/%m/%d %H:%M:%S.%f")[:-3],
    "clock alone": lambda t, _: t.strftime("%H:%M:%S,%f")[:-3],
    "seconds since the start": lambda _, k: f"{k / RATE_HZ:.3f}".replace(".", ","),
    "days of Excel": lambda t, _: f"{(t - EPOCH_OF_EXCEL) / timedelta(days=1):.11f}".replace(".", ","),
    "milliseconds since 1970": lambda _, k: f"{1_769_900_000_000 + k}",
}


@pytest.mark.parametrize("way", WAYS)
def test_times_are_read_however_they_are_written(tmp_path, way):
    path = table(tmp_path, [WAYS[way](moment, k) for k, moment in enumerate(MOMENTS)])
    recording = load_recording(path)
    assert recording.names == ("x",)
    assert np.array_equal(recording.samples[:, 0], SAMPLES)
    assert recording.rate_hz == pytest.approx(RATE_HZ, rel=2e-4)
    assert "derived from time column 'Zeit'" in recording.rate_source
    with pytest.raises(RecordingError, match="by the file and 700 Hz as given: leave --fs out"):
        load_recording(path, rate_hz=700.0)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1", "utf-16"])
@pytest.mark.parametrize("units", ["[s];[m/s²]", ";m/s²", "dd.MM.yyyy HH:mm:ss,fff;m/s²"])
def test_preamble_units_and_encodings(tmp_path, encoding, units):
    cells = [WAYS["German"](moment, 0) for moment in MOMENTS]
    above = "Gerät;Prüfstand 3\r\nDatum;31.01.2026\r\nKanäle;1\r\n\r\n"
    path = table(tmp_path, cells, above=above, head=("Zeit", f"Gehäuse\r\n{units}"), encoding=encoding)
    recording = load_recording(path)
    assert recording.names == ("Gehäuse",)
    assert np.array_equal(recording.samples[:, 0], SAMPLES)
    assert recording.rate_hz == pytest.approx(RATE_HZ)


@pytest.mark.parametrize("delimiter", ["\t", ";", " "])
def test_a_date_and_a_time_in_columns_of_their_own(tmp_path, delimiter):
    cells = [f"{moment:%Y-%m-%d}{delimiter}{moment:%H:%M:%S.%f}" for moment in MOMENTS]
    path = table(tmp_path, cells, delimiter=delimiter, comma=False, head=("Day", "Clock", "x"))
    recording = load_recording(path)
    assert recording.names == ("x",)
    assert recording.rate_hz == pytest.approx(RATE_HZ)


def test_rows_that_are_missing_by_times_in_words_are_gaps(tmp_path):
    path = table(tmp_path, [WAYS["German"](moment, 0) for moment in MOMENTS])
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:101], *lines[104:]]))
    recording = load_recording(path)
    assert np.flatnonzero(np.isnan(recording.samples[:, 0])).tolist() == [100, 101, 102]


def test_a_cell_without_a_time_is_one_that_is_not_known():
    cells = ["31.01.2026 12:00:00", "", "31.13.2026 12:00:00", "31.01.2026 12:00:01", "x"]
    form = format_of(cells[:1])
    assert form is not None
    assert np.isnat(times_of(cells, form)).tolist() == [False, True, True, False, True]


@pytest.mark.parametrize("cells", [["12:61:00"], ["1.2"], ["31.13.2026"], ["", ""], ["10:00:00", "later"]])
def test_words_are_no_times(cells):
    assert format_of(cells) is None
