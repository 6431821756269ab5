"""Text tables as loggers of several makers and countries write them."""

from __future__ import annotations

from datetime import datetime, timedelta

import numpy as np
import pytest

from daqsvc.recording import RecordingError
from daqsvc.recording.formats.column_units import spelt_alike
from daqsvc.recording.formats.written_times import format_of, times_of
from daqsvc.recording.recording import load_all, load_recording

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
    assert np.isnat(times_of(cells, form).times).tolist() == [False, True, True, False, True]


@pytest.mark.parametrize("cells", [["12:61:00"], ["1.2"], ["31.13.2026"], ["", ""], ["10:00:00", "later"]])
def test_words_are_no_times(cells):
    assert format_of(cells) is None


# Units.


def units_table(
    tmp_path, head, *, per_s=1.0, delimiter=",", comma=False, quoted=False, end="", encoding="utf-8"
):
    """Samples with a time whose unit is so many times as short as a second."""
    rows = []
    for k, x in enumerate(SAMPLES):
        cells = [f"{k / RATE_HZ * per_s:.12f}", f"{x:.4f}"]
        cells = [cell.replace(".", ",") for cell in cells] if comma else cells
        rows.append(delimiter.join(f'"{cell}"' for cell in cells) if quoted else delimiter.join(cells))
    path = tmp_path / "rig.csv"
    path.write_bytes("\r\n".join([head, *[row + end for row in rows], ""]).encode(encoding))
    return path


GERMAN = {"delimiter": ";", "comma": True}


@pytest.mark.parametrize(
    ("head", "per_s", "unit", "how"),
    [
        ("time,x\ns,m/s2", 1.0, "m/s2", {}),
        ("time,x\nms,g", 1e3, "g", {}),
        ("time,x\n[us],[g]", 1e6, "g", {}),
        ("Time,x\n(ms),(mV)\n", 1e3, "mV", {}),
        ("time,x\nmin,mm/s RMS", 1 / 60, "mm/s RMS", {}),
        ("Zeit;x\nStd.;µm", 1 / 3600, "µm", GERMAN),
        ("Zeit;x\nSekunden;m/s²", 1.0, "m/s²", GERMAN),
        ("Zeit;x\nms;m/s²", 1e3, "m/s²", GERMAN | {"encoding": "latin-1"}),
        ("Zeit;x\nμs;m/s²", 1e6, "m/s²", GERMAN | {"encoding": "utf-16"}),
        ("Zeit;x\nms;m/s²", 1e3, "m/s²", GERMAN | {"encoding": "utf-8-sig"}),
        ("Messung;Pumpe 1\nZeit;x\nms;m/s²", 1e3, "m/s²", GERMAN),
        ("sep=;\nZeit;x\nms;m/s²", 1e3, "m/s²", GERMAN),
        ('"Zeit";"x"\n"ms";"m/s²"', 1e3, "m/s²", GERMAN | {"quoted": True}),
        ("Zeit;x\n;m/s²", 1.0, "m/s²", GERMAN),
        ("time;x\nms;g", 1e3, "g", {"delimiter": ";", "end": ";"}),
        ("time,x\ns,gE", 1.0, "gE", {}),
        ("ms,g\ntime,x", 1e3, "g", {}),
        ("# unit of x = m/s2\n# unit of time = ms\ntime,x", 1e3, "m/s2", {}),
        ("Zeit [min];x [m/s²]", 1 / 60, "m/s²", GERMAN),
        ("time (ms),x (g)", 1e3, "g", {}),
        ("Zeit in ms;x (mm/s)", 1e3, "mm/s", GERMAN),
        ("t/ms,x [g]\nms,g", 1e3, "g", {}),
        ("time_ms,x\n,", 1e3, None, {}),
        ("time,x (radial)", 1.0, None, {}),
        ("Zeit;x\n;", 1.0, None, GERMAN),
    ],
)
def test_units_are_those_of_their_row_or_in_brackets(tmp_path, head, per_s, unit, how):
    path = units_table(tmp_path, head, per_s=per_s, **how)
    (name,) = load_recording(path).names
    assert name.split(" ")[0] == "x"
    recording = load_recording(path, {"x": "x" if unit else name})
    assert recording.units == ({} if unit is None else {"x": unit})
    assert np.array_equal(recording.samples[:, 0], SAMPLES)
    assert recording.rate_hz == pytest.approx(RATE_HZ)
    streams, _ = load_all(path)
    assert [(one.names, one.units) for one in streams] == [((name,), (unit or "",))]


@pytest.mark.parametrize(
    ("head", "why"),
    [
        (
            "time,x [g]\ns,m/s2",
            r"column 2 \(x \[g\]\) of .* is in g by its name and in m/s2 by the row of units",
        ),
        (
            "# unit of x = g\ntime,x\ns,mg",
            "is in mg by the row of units and in g by a comment; correct the one",
        ),
        ("time_ms,x\ns,g", "is in ms by its name and in s by the row of units"),
    ],
)
def test_units_that_contradict_each_other_are_refused(tmp_path, head, why):
    with pytest.raises(RecordingError, match=why):
        load_recording(units_table(tmp_path, head))


@pytest.mark.parametrize(
    ("head", "units"),
    [
        ("ms,m/s2", ("ms", "m/s2")),
        ("m/s2,m/s2", ("m/s2", "m/s2")),
        ("mV rms,V", ("mV rms", "V")),
        ("[A],[V]", ("A", "V")),
        ("%,A", ("%", "A")),
        ("T,m/s2", ("", "m/s2")),
        ("A,V", ("", "")),
        ("T,D", ("", "")),
        ("s,v", ("", "")),
        ("V_rms,V_peak", ("", "")),
        ("min,IN", ("", "")),
        ("M,rpm", ("", "")),
    ],
)
def test_names_that_are_units_are_both_but_for_letters_and_words(tmp_path, head, units):
    """A and V are channels, s and v a way and a speed, T and D anything."""
    (stream,), _ = load_all(units_table(tmp_path, head), rate_hz=RATE_HZ)
    assert stream.units == units


@pytest.mark.parametrize(
    ("head", "units"),
    [
        ("time,flow,B\ns,t/h,T", {"f": "t/h", "b": "T"}),
        ("time,flow,B\n,t/h,T", {"f": "t/h", "b": "T"}),
        ("time,flow,B\ns,t/h,t", {"f": "t/h", "b": "t"}),
        ("time,flow,B\ntt.mm.jj,t/h,V", {"f": "t/h", "b": "V"}),
    ],
)
def test_units_that_look_like_the_mask_of_a_date_are_units(tmp_path, head, units):
    path = tmp_path / "rig.csv"
    path.write_text(head + "\n" + "".join(f"{k / RATE_HZ},1,2\n" for k in range(9)))
    assert load_recording(path, {"f": "flow", "b": "B"}).units == units


def test_a_unit_behind_a_name_may_look_like_the_mask_of_a_date(tmp_path):
    path = units_table(tmp_path, "time,flow [t/h]")
    assert load_recording(path, {"x": "flow"}).units == {"x": "t/h"}
    (stream,), _ = load_all(units_table(tmp_path, "time,current (T)"))  # of three phases R, S, T
    assert (stream.names, stream.units) == (("current (T)",), ("",))


@pytest.mark.parametrize(
    ("one", "other", "alike"),
    [
        ("mN", "MN", False),
        ("mPa", "MPa", False),
        ("mV RMS", "MV rms", False),
        ("mV/g", "MV/g", False),
        ("mHz", "MHz", False),
        ("mNm", "MN·m", False),
        ("mΩ", "MΩ", False),
        ("Nm", "nm", False),
        ("N·m", "NM", True),
        ("MPa", "MPA", True),
        ("mV rms", "mV RMS", True),
        ("mm/s", "MM/S", True),
        ("m/s²", "M/S2", True),
        ("kHz", "KHZ", True),
        ("g", "G", True),
    ],
)
def test_milli_is_not_mega(one, other, alike):
    assert spelt_alike(one, other) is alike
    assert spelt_alike(other, one) is alike


def test_a_unit_that_is_written_in_two_ways_is_one(tmp_path):
    path = units_table(tmp_path, "Zeit [sec],x [m/s²]\ns,m/s^2")
    assert load_recording(path, {"x": "x"}).units == {"x": "m/s²"}


def test_a_name_without_its_unit_means_a_column_only_if_it_is_the_only_one(tmp_path):
    path = tmp_path / "rig.csv"
    path.write_text("x [g],x [mm],y [V],y\n" + "1,2,3,4\n" * 5)
    assert load_recording(path, {"a": "y"}, 10.0).samples[0, 0] == 4.0
    with pytest.raises(RecordingError, match=r"has no channel 'x'; it holds x \[g\] \(5\), x \[mm\] \(5\)"):
        load_recording(path, {"a": "x"}, 10.0)
    assert load_recording(path, {"a": "x [mm]"}, 10.0).units == {"a": "mm"}


# Lines about the measurement.


@pytest.mark.parametrize(
    ("head", "how"),
    [
        ("Messung;Pumpe 1\nZeit;x", GERMAN),
        ("Logger,Pump 1\ntime,x", {}),
        ("Measured on Pump 1\ntime,x", {}),
        ("sep=;\nZeit;x", GERMAN),
        ('"sep=;"\nZeit;x', GERMAN),
        ("Datum;31.01.2026\nZeit;x", GERMAN),
        ("Serial,4711\ntime,x", {}),
        ("Logger,Pump 1\nt,g\n", {}),
        ("time,x\nrelative,housing", {}),
    ],
)
def test_a_line_about_the_measurement_does_not_hide_the_names(tmp_path, head, how):
    recording = load_recording(units_table(tmp_path, head, **how))
    assert recording.names in {("x",), ("g",)}
    assert recording.rate_hz == pytest.approx(RATE_HZ)


def test_a_line_for_excel_is_no_header(tmp_path):
    path = tmp_path / "rig.csv"
    path.write_text("sep=;\n1,5;2\n3;4\n")  # the last line does not show that commas are decimal
    assert load_recording(path, rate_hz=10.0).names == ("0", "1")


def test_a_rate_in_the_only_line_above_the_names_is_taken(tmp_path):
    path = tmp_path / "rig.csv"
    path.write_text("Sample rate: 0.5 kHz\nx,y\n" + "1,2\n" * 5)
    recording = load_recording(path)
    assert (recording.names, recording.rate_hz) == (("x", "y"), 500.0)


# Dates.


def dated(tmp_path, moments, form, **more):
    return table(tmp_path, [moment.strftime(form) for moment in moments], comma=False, delimiter=",", **more)


def around(*date, step=timedelta(milliseconds=1), gap=timedelta(0)):
    """300 moments of which the second half is on the next day."""
    midnight = datetime(*date) + timedelta(days=1)  # noqa: DTZ001
    return [midnight + (k - 150) * step + (gap if k >= 150 else timedelta(0)) for k in range(300)]


WAYS_OF_DATES = [
    "%m/%d/%Y %I:%M:%S.%f %p",
    "%m/%d/%Y %H:%M:%S.%f",
    "%d/%m/%Y %H:%M:%S.%f",
    "%d/%m/%Y %I:%M:%S.%f %p",
]


@pytest.mark.parametrize("date", [(2026, 2, 1), (2026, 1, 31), (2026, 4, 30), (2026, 12, 31), (2026, 1, 12)])
@pytest.mark.parametrize("form", WAYS_OF_DATES)
def test_over_midnight_the_rows_tell_the_day_from_the_month(tmp_path, form, date):
    moments = around(*date)
    (stream,), notes = load_all(dated(tmp_path, moments, form))
    assert (stream.rate_hz, len(stream.samples), notes) == (pytest.approx(RATE_HZ), 300, [])
    assert stream.start.startswith(moments[0].isoformat())


@pytest.mark.parametrize("form", ["%m/%d/%Y,%I:%M:%S.%f %p", "%d/%m/%Y,%H:%M:%S.%f"])
def test_over_midnight_a_date_of_its_own_too(tmp_path, form):
    moments = around(2026, 2, 1)
    (stream,), _ = load_all(dated(tmp_path, moments, form, head=("Date", "Time", "x")))
    assert (stream.rate_hz, len(stream.samples)) == (pytest.approx(RATE_HZ), 300)
    assert stream.start.startswith(moments[0].isoformat())


def test_the_rows_are_looked_at_to_the_end(tmp_path):
    """The lines that the layout is found by are all of one day."""
    moments = around(2026, 2, 1)
    moments = [moments[0] - timedelta(milliseconds=k) for k in range(70_000, 0, -1)] + moments
    path = tmp_path / "rig.csv"
    path.write_text("time,x\n" + "".join(f"{one:%m/%d/%Y %H:%M:%S.%f},1\n" for one in moments))
    assert load_recording(path).samples.shape == (70_300, 1)


def test_am_and_pm_say_that_the_month_is_first(tmp_path):
    moments = [datetime(2026, 2, 1, 13) + timedelta(milliseconds=k) for k in range(300)]  # noqa: DTZ001
    (stream,), _ = load_all(dated(tmp_path, moments, WAYS_OF_DATES[0]))
    assert stream.start.startswith("2026-02-01T13:00:00.000")


@pytest.mark.parametrize("form", [*WAYS_OF_DATES[1:3], "%H:%M:%S.%f"])
def test_of_one_day_the_rate_is_known_and_the_date_is_not(tmp_path, form):
    moments = [datetime(2026, 2, 1, 13) + timedelta(milliseconds=k) for k in range(300)]  # noqa: DTZ001
    (stream,), _ = load_all(dated(tmp_path, moments, form))
    assert (stream.rate_hz, stream.start) == (pytest.approx(RATE_HZ), "")


@pytest.mark.parametrize("head", [("Time", "x"), ("Date", "Time", "x")])
def test_of_one_day_the_date_is_not_known_where_zones_carry_it_over_midnight(tmp_path, head):
    """The clock is one o'clock, and UTC midnight."""
    moments = [datetime(2026, 2, 1, 0, 59, 59, 900_000) + timedelta(milliseconds=k) for k in range(300)]  # noqa: DTZ001
    form = f"%d/%m/%Y{' ' if len(head) == 2 else ','}%H:%M:%S.%f+01:00"
    (stream,), _ = load_all(dated(tmp_path, moments, form, head=head))
    assert (stream.rate_hz, stream.start) == (pytest.approx(RATE_HZ), "")


def test_a_clock_is_a_day_later_behind_midnight_though_that_is_not_known(tmp_path):
    cells = [f"{one:%H:%M:%S.%f}" for one in around(2026, 2, 1)]
    cells[149:152] = [""] * 3
    path = table(tmp_path, cells, comma=False)
    assert load_recording(path, rate_hz=RATE_HZ).notes == ()
    with pytest.raises(RecordingError, match=r"is 1000 Hz \(time column 'Zeit'.* and 700 Hz as given"):
        load_recording(path, rate_hz=700.0)


def test_dates_that_leap_either_way_are_refused(tmp_path):
    path = dated(tmp_path, around(2026, 2, 5, gap=timedelta(days=3)), WAYS_OF_DATES[1])
    with pytest.raises(RecordingError) as refused:
        load_recording(path)
    assert str(refused.value) == (
        f"the dates in column 1 (Zeit) of {path} may have the day first or the month, and the rows leap "
        "either way; write them as 2026-01-31"
    )


def test_dates_without_a_time_of_the_day_may_be_anything(tmp_path):
    path = tmp_path / "rig.csv"
    path.write_text("calibrated,x\n" + "02/05/2026,1\n02/08/2026,2\n" * 5)
    assert load_recording(path, rate_hz=10.0).names == ("x",)


def test_dates_and_times_without_zeros_are_read(tmp_path):
    cells = [f"{one.month}/{one.day}/{one.year} {one:%I:%M:%S.%f %p}" for one in around(2026, 2, 9)]
    (stream,), _ = load_all(table(tmp_path, cells, comma=False, delimiter=","))
    assert (len(stream.samples), stream.start[:10]) == (300, "2026-02-09")


# Zones.


def zoned(tmp_path, before, after, ahead_h):
    """Times in ISO 8601 over a change of the clock by an hour."""
    begin = datetime(2026, 3, 29, 0, 59, 59, 900_000)  # noqa: DTZ001
    cells = []
    for k in range(300):
        moment = begin + timedelta(milliseconds=k)
        late = k >= 100
        cells.append(
            (moment + timedelta(hours=ahead_h[late])).isoformat(timespec="milliseconds")
            + (before, after)[late]
        )
    return table(tmp_path, cells, comma=False, delimiter=",")


@pytest.mark.parametrize(
    ("before", "after", "ahead_h"),
    [
        ("+01:00", "+02:00", (1, 2)),
        ("+0100", "+0200", (1, 2)),
        ("+02", "+01", (2, 1)),
        ("-05:00", "-04:00", (-5, -4)),
        ("-01:00", "+00:00", (-1, 0)),
        ("Z", "+01:00", (0, 1)),
        (" UTC", " UTC", (0, 0)),
    ],
)
def test_zones_count_where_all_times_have_one(tmp_path, before, after, ahead_h):
    path = zoned(tmp_path, before, after, ahead_h)
    (stream,), notes = load_all(path)
    assert (len(stream.samples), stream.rate_hz, notes) == (300, pytest.approx(RATE_HZ), [])
    assert stream.start == "2026-03-29T00:59:59.900000000Z"


def test_zones_that_some_times_lack_do_not_count(tmp_path):
    (stream,), _ = load_all(zoned(tmp_path, "+02:00", "", (0, 0)))
    assert (len(stream.samples), stream.start) == (300, "2026-03-29T00:59:59.900000000Z")
