"""WAV and Parquet recordings, text tables as loggers write them, and what a file says beside its channels."""

from __future__ import annotations

import struct
import sys
import wave

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat, wavfile

from daqsvc.confined.limits import Budget, ResourceLimits
from daqsvc.recording import RecordingError
from daqsvc.recording.formats.parquet import read_parquet
from daqsvc.recording.recording import list_channels, load_recording

RATE_HZ = 8_000
X = np.linspace(-0.9, 0.9, 400)
Y = np.sin(np.arange(400) / 7)


def write_text(tmp_path, text):
    path = tmp_path / "rig.csv"
    path.write_text(text, "utf-8")
    return path


# WAV: written by SciPy and by the standard library, read by us.


@pytest.mark.parametrize(
    ("dtype", "full_scale", "zero"),
    [("u1", 128, 128), ("<i2", 2**15, 0), ("<i4", 2**31, 0), ("<f4", 1, 0), ("<f8", 1, 0)],
)
@pytest.mark.parametrize("channels", [1, 2])
def test_wav(tmp_path, dtype, full_scale, zero, channels):
    path = tmp_path / "rig.WAV"
    written = (np.column_stack([X, Y])[:, :channels] * full_scale * 0.99 + zero).astype(dtype)
    wavfile.write(path, RATE_HZ, written)
    recording = load_recording(path)
    assert recording.names == ("0", "1")[:channels]
    assert np.array_equal(recording.samples, (written.astype(float) - zero) / full_scale)
    assert (recording.rate_hz, recording.rate_source) == (RATE_HZ, "stated as rate_hz")


def wav_of_24_bits(path, counts):
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(3)
        file.setframerate(RATE_HZ)
        file.writeframes(b"".join(int(count).to_bytes(3, "little", signed=True) for count in counts))


def test_wav_of_24_bits(tmp_path):
    path = tmp_path / "rig.wav"
    counts = np.array([0, 1, -1, 2**23 - 1, -(2**23), 123_456])
    wav_of_24_bits(path, counts)
    assert np.array_equal(load_recording(path).samples[:, 0], counts / 2**23)


def riff(*chunks):
    body = b"WAVE" + b"".join(tag + struct.pack("<I", len(data)) + data for tag, data in chunks)
    return b"RIFF" + struct.pack("<I", len(body)) + body


def wav_format(encoding=1, channels=1, bits=16, frame_bytes=None, extension=b""):
    frame_bytes = channels * bits // 8 if frame_bytes is None else frame_bytes
    return struct.pack("<HHIIHH", encoding, channels, RATE_HZ, 0, frame_bytes, bits) + extension


SAMPLES = (b"data", struct.pack("<4h", 0, 16_384, -32_768, 1))


def test_wav_extensible_with_chunks_of_others(tmp_path):
    path = tmp_path / "rig.wav"
    guid = struct.pack("<H", 1) + b"\x00\x00\x00\x00\x10\x00\x80\x00\x00\xaa\x00\x38\x9b\x71"
    extension = struct.pack("<HHI", 22, 16, 4) + guid
    path.write_bytes(
        riff((b"bext", b"any"), (b"\0", b"fmt "), (b"fmt ", wav_format(0xFFFE, extension=extension)), SAMPLES)
    )
    # An odd chunk is padded to an even length.
    content = path.read_bytes().replace(b"\0\x04\0\0\0fmt ", b"\0")
    path.write_bytes(content)
    assert load_recording(path).samples[:, 0].tolist() == [0, 0.5, -1, 1 / 2**15]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "begins with nothing, not with RIFF"),
        (b"RF64" + bytes(40), "begins with b'RF64', not with RIFF; save it as WAV"),
        (riff(SAMPLES), "has no 'fmt' chunk"),
        (riff((b"fmt ", wav_format())), "has no 'data' chunk"),
        (riff((b"fmt ", wav_format()), SAMPLES)[:-3], "'data' chunk should have 8 bytes and has 5"),
        (riff((b"fmt ", wav_format(6, bits=8)), SAMPLES), "8-bit samples of WAV format 6; save it as PCM"),
        (riff((b"fmt ", wav_format(bits=12)), SAMPLES), "12-bit samples"),
        (riff((b"fmt ", wav_format(channels=0)), SAMPLES), "0 channels of 16 bits do not make frames"),
        (riff((b"fmt ", wav_format(frame_bytes=4)), SAMPLES), "do not make frames of 4 bytes"),
        (
            riff((b"fmt ", wav_format(channels=3)), SAMPLES),
            "8 bytes of samples are no whole number of frames",
        ),
        (riff((b"fmt ", b"\1\0"), SAMPLES), "cannot be read"),
        (riff((b"fmt ", wav_format()), (b"data", b"")), "too short"),
    ],
)
def test_wav_that_cannot_be_read(tmp_path, content, message):
    path = tmp_path / "rig.wav"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        load_recording(path)


# Parquet.


def write_parquet(tmp_path, metadata=None, **columns):
    path = tmp_path / "rig.parquet"
    pq.write_table(pa.table(columns).replace_schema_metadata(metadata), path)
    return path


def test_parquet(tmp_path):
    with_null = [None, *Y[1:].tolist()]
    path = write_parquet(
        tmp_path, {"fs": "2000", "site": "hall 3"}, x=X, y=with_null, n=np.arange(400), state=["ok"] * 400
    )
    recording = load_recording(path)
    assert recording.names == ("x", "y", "n")
    assert np.array_equal(recording.samples[:, 0], X)
    assert np.array_equal(recording.samples[1:, 1], Y[1:])
    assert recording.nan_count == 1
    assert (recording.rate_hz, recording.rate_source) == (2_000, "stated as fs")
    assert (recording.scalars, recording.texts) == ({"fs": 2_000.0}, {"site": "hall 3"})
    assert np.array_equal(load_recording(path, {"a": "2"}).samples[:, 0], np.arange(400))
    with pytest.raises(RecordingError, match=r"'state' of .* is not numeric; it holds .*state"):
        load_recording(path, {"a": "state"})


def test_parquet_with_dates(tmp_path):
    first = np.datetime64("2026-01-31T12:00:00", "us")
    path = write_parquet(tmp_path, at=first + np.arange(400) * np.timedelta64(500, "us"), x=X)
    recording = load_recording(path)
    assert (recording.names, recording.rate_source) == (
        ("x",),
        "derived from time column 'at', read as dates",
    )
    assert recording.rate_hz == pytest.approx(2_000)


def test_parquet_needs_its_extra(tmp_path, monkeypatch):
    path = write_parquet(tmp_path, x=X)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(
        RecordingError, match=r"needs pyarrow; install it with: pip install 'daqsvc\[parquet\]'"
    ):
        read_parquet(path, Budget.of(path, ResourceLimits()))


# Text tables.


def test_csv_with_names_and_units_in_two_lines(tmp_path):
    path = write_text(tmp_path, "x;y\nmm;g\n1;2\n3;4\n")
    assert list_channels(path) == {"x": 2, "y": 2}
    assert load_recording(path, rate_hz=1).samples.tolist() == [[1, 2], [3, 4]]


def test_csv_with_a_delimiter_at_the_end_of_each_line(tmp_path):
    path = write_text(tmp_path, "x;y;\n1;2;\n3;4;\n")
    assert list_channels(path) == {"x": 2, "y": 2}


def test_columns_that_share_a_header_stay_apart(tmp_path):
    path = write_text(tmp_path, "x,x,,4,x\n1,2,3,4,5\n6,7,8,9,10\n")
    recording = load_recording(path, rate_hz=1)
    assert recording.names == ("x", "1", "2", "4", "column 4")
    assert recording.samples.tolist() == [[1, 2, 3, 4, 5], [6, 7, 8, 9, 10]]
    path = tmp_path / "rig.parquet"
    pq.write_table(pa.Table.from_arrays([pa.array(X), pa.array(Y)], names=["x", "x"]), path)
    assert np.array_equal(load_recording(path, {"b": "1"}, 1).samples[:, 0], Y)


def test_csv_with_quotes(tmp_path):
    path = write_text(tmp_path, '"x, radial",y\n"1","2"\n"",4\n')
    recording = load_recording(path, rate_hz=1)
    assert recording.names == ("x, radial", "y")
    assert np.array_equal(recording.samples, [[1, 2], [np.nan, 4]], equal_nan=True)


def test_csv_empty_cells_among_decimal_commas(tmp_path):
    path = write_text(tmp_path, "x;y;z\n1,5;2;1\n;  ;2,5\n3;;3\n4;5;6,5\n")
    expected = [[1.5, 2, 1], [np.nan, np.nan, 2.5], [3, np.nan, 3], [4, 5, 6.5]]
    assert np.array_equal(load_recording(path, rate_hz=1).samples, expected, equal_nan=True)


def test_csv_first_row_of_samples_is_damaged(tmp_path):
    path = write_text(tmp_path, "x,y\n1,?\n3,4\n5,6\n")
    with pytest.raises(RecordingError, match=r"rig\.csv, line 2, column 2 \(y\): '\?' is not a number"):
        load_recording(path, rate_hz=1)


LOGGER = (
    "Datenlogger;XY-100\r\nSeriennummer;4711\r\nAbtastrate [Hz];500\r\nSampling rate;500\r\n\r\n"
    "Messung vom;12.03.2026;14:00\r\nZeit [s];Kanal 1;Kanal 2\r\ns;µm;m/s²\r\n"
) + "".join(f"{i / 500:.3f};{i % 7},5;-{i},25\r\n".replace(".", ",") for i in range(300))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
def test_csv_behind_a_preamble(tmp_path, encoding):
    path = tmp_path / "rig.csv"
    path.write_bytes(LOGGER.encode(encoding))
    recording = load_recording(path)
    assert recording.names == ("Kanal 1", "Kanal 2")
    assert recording.rate_hz == 500
    assert recording.scalars["sampling_rate"] == 500
    assert recording.samples[[0, 299]].tolist() == [[0.5, -0.25], [5.5, -299.25]]


@pytest.mark.parametrize(
    "preamble",
    [
        "Instrument: Scope 7\nSerial: 1\n\n",
        "".join(f"Setting {i},{i}\n" for i in range(40)),  # looks like a table of two columns
        "Sample Rate: 0.5 kHz\nComment, with, commas, and 1, 2\n",
    ],
)
def test_csv_with_commas_behind_a_preamble(tmp_path, preamble):
    path = write_text(tmp_path, preamble + "x,y\nmm,g\n" + "".join(f"{i},{i}.5\n" for i in range(200)))
    recording = load_recording(path, rate_hz=500)
    assert recording.names == ("x", "y")
    assert recording.samples[:, 1].tolist() == [i + 0.5 for i in range(200)]


def test_a_preamble_does_not_hide_damaged_samples(tmp_path):
    path = write_text(tmp_path, "about: a rig\nx,y\n" + "1,2\n" * 5 + "3,?\n" + "1,2\n" * 200)
    with pytest.raises(RecordingError, match=r"is not a number|columns"):
        load_recording(path, rate_hz=1)


def test_csv_in_latin_1(tmp_path):
    path = tmp_path / "rig.csv"
    path.write_bytes("x °C,y\n1,2\n3,4\n".encode("latin-1"))
    assert list_channels(path) == {"x °C": 2, "y": 2}


def test_csv_comments_state_numbers(tmp_path):
    path = write_text(tmp_path, "# rig 7\n# fs = 25600\n# rpm: 1797.5\n# fs2 = e\nx,y\n1,2\n# rest\n3,4\n")
    recording = load_recording(path)
    assert recording.samples.tolist() == [[1, 2], [3, 4]]
    assert (recording.rate_hz, recording.rate_source) == (25_600, "stated as fs")
    assert recording.scalars == {"fs": 25_600.0, "rpm": 1_797.5}


# What a file says beside its channels.


def test_scalars_and_texts(tmp_path):
    path = tmp_path / "rig.npz"
    np.savez(path, x=X, fs=640.0, omega=np.array([535.2]), spr=64, label="healthy", cube=np.zeros((2, 2, 2)))
    recording = load_recording(path)
    assert recording.scalars == {"fs": 640.0, "omega": 535.2, "spr": 64.0}
    assert recording.texts == {"label": "healthy"}
    with pytest.raises(RecordingError, match=r"'cube' of .* is 3-dimensional.*; it holds .*, cube \(3-D\)"):
        load_recording(path, {"a": "cube"})


def test_a_listing_is_one_line_of_bounded_length(tmp_path):
    path = tmp_path / "rig.npz"
    np.savez(path, **{"a\nb": X, "many": np.zeros((200, 60))})
    with pytest.raises(RecordingError) as caught:
        load_recording(path, {"x": "c"}, 100)
    assert str(caught.value).endswith("many[48] (200), and 11 more")
    assert r"it holds 'a\nb' (400), many[0] (200), " in str(caught.value)


@pytest.mark.parametrize(
    ("name", "factor", "words"),
    [
        ("t", 1, "seconds"),
        ("Time", 1, "seconds"),
        ("time_s", 1, "seconds"),
        ("rig.time", 1, "seconds"),
        ("t [ms]", 1e3, "ms"),
        ("elapsed (us)", 1e6, "us"),
        ("time_ns", 1e9, "ns"),
    ],
)
def test_the_rate_follows_from_a_time_column(tmp_path, name, factor, words):
    path = tmp_path / "rig.npz"
    np.savez(path, **{name: (3.0 + np.arange(400) / 500) * factor, "x": X})
    recording = load_recording(path)
    assert recording.names == ("x",)
    assert recording.rate_hz == pytest.approx(500)
    assert recording.rate_source == f"derived from time column {name!r}, read as {words}"
    assert load_recording(path, {"at": name}).names == ("at",)


def test_the_rate_follows_from_the_first_column_without_a_header(tmp_path):
    path = write_text(tmp_path, "".join(f"{i / 250:g};{x:.6f};{-x:.6f}\n" for i, x in enumerate(X)))
    recording = load_recording(path)
    assert recording.names == ("1", "2")
    assert recording.rate_hz == pytest.approx(250)
    assert recording.rate_source == "derived from time column '0', read as seconds"


def test_sample_numbers_are_no_time(tmp_path):
    path = write_text(tmp_path, "".join(f"{i};{y:.6f}\n" for i, y in enumerate(Y)))
    with pytest.raises(RecordingError, match=r"does not state one\. Give it with --fs"):
        load_recording(path)
    assert load_recording(path, rate_hz=100).names == ("0", "1")


def test_an_uneven_time_column_is_told(tmp_path):
    path = tmp_path / "rig.npz"
    t = np.arange(400) / 500
    t[200:] += 0.0109
    np.savez(path, time=t, x=X)
    with pytest.raises(
        RecordingError, match=r"the steps of its time column 'time' are uneven \(0\.002 to 0\.0129 s\)"
    ):
        load_recording(path)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_time_column_with_holes_is_no_time(tmp_path, wrong):
    path = tmp_path / "rig.npz"
    t = np.arange(400) / 500
    t[[7, 8]] = wrong
    np.savez(path, time=t, x=X)
    with pytest.raises(RecordingError, match=r"does not state one, and the steps .* are uneven"):
        load_recording(path)


@pytest.mark.parametrize("name", ["T", "torque", "temperature", "start"])
def test_other_columns_are_no_time(tmp_path, name):
    path = tmp_path / "rig.npz"
    np.savez(path, **{name: np.arange(400) / 500, "x": X})
    assert load_recording(path, rate_hz=1).names == (name, "x")
    with pytest.raises(RecordingError, match=r"does not state one\. Give"):
        load_recording(path)


def test_time_of_other_channels_does_not_count(tmp_path):
    path = tmp_path / "rig.npz"
    np.savez(path, t=np.arange(20) / 5, x=X, slow=X[:20])
    with pytest.raises(RecordingError, match="does not state one"):
        load_recording(path)
    assert load_recording(path, {"s": "slow"}).rate_hz == pytest.approx(5)


def test_what_is_given_must_agree_with_what_is_stated(tmp_path):
    path = tmp_path / "rig.mat"
    savemat(path, {"x": X, "fs": 640})
    recording = load_recording(path)
    assert (recording.rate_hz, recording.names) == (640, ("x",))
    recording = load_recording(path, rate_hz=641)
    assert (recording.rate_hz, recording.rate_source) == (641, "given; fs of the file is 640 Hz")
    with pytest.raises(RecordingError, match=r"is 640 Hz \(fs\) by the file and 100 Hz as given: leave --fs"):
        load_recording(path, rate_hz=100)
    assert load_recording(path, rate_hz=640).rate_source == "given"


def save_with_time(path, t, **others):
    """The same table in the format that the suffix says; dates have a place in some formats only."""
    columns = {"t": t, "x": np.linspace(-0.9, 0.9, len(t)), **others}
    if path.suffix == ".npz":
        np.savez(path, **columns)
    elif path.suffix == ".mat":
        savemat(path, columns)
    elif path.suffix == ".parquet":
        pq.write_table(pa.table(columns), path)
    else:
        names, rows = ";".join(columns), zip(*columns.values(), strict=True)
        path.write_text(f"{names}\n" + "".join(";".join(f"{v:.12g}" for v in row) + "\n" for row in rows))
    return path


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".mat", ".parquet"])
def test_a_given_rate_that_contradicts_the_time_column_is_refused(tmp_path, suffix):
    path = save_with_time(tmp_path / f"rig{suffix}", np.arange(400) / 48_000)
    with pytest.raises(
        RecordingError,
        match=r"is 48000 Hz \(time column 't', read as seconds\) by the file and 12000 Hz as given: leave",
    ):
        load_recording(path, {"x": "x"}, 12_000)
    assert load_recording(path, {"x": "x"}, 48_100).rate_hz == 48_100


def test_a_wav_file_states_its_rate(tmp_path):
    path = tmp_path / "rig.wav"
    wavfile.write(path, RATE_HZ, X)
    with pytest.raises(RecordingError, match=r"is 8000 Hz \(rate_hz\) by the file and 9000 Hz as given"):
        load_recording(path, rate_hz=9000)


def test_a_time_column_is_believed_as_far_as_its_digits_go(tmp_path):
    """Stamps in whole seconds tell the rate of a long recording, and nothing of a short one."""
    seconds = np.floor(np.arange(90_000) / 1000)
    path = save_with_time(tmp_path / "rig.csv", seconds)
    assert load_recording(path, {"x": "x"}, 1010).rate_hz == 1010
    with pytest.raises(RecordingError, match=r"'t', read as seconds\) by the file and 1200 Hz as given"):
        load_recording(path, {"x": "x"}, 1200)
    short = save_with_time(tmp_path / "short.csv", seconds[:2000])
    assert load_recording(short, {"x": "x"}, 1200).rate_hz == 1200


def test_a_time_column_without_a_unit_may_be_in_another_one(tmp_path):
    path = save_with_time(tmp_path / "rig.csv", np.arange(400) / 12.0)
    assert load_recording(path, {"x": "x"}, 12_000).rate_hz == 12_000
    with pytest.raises(RecordingError, match="by the file and 48000 Hz as given"):
        load_recording(path, {"x": "x"}, 48_000)


def test_a_file_that_contradicts_itself_is_refused_unless_the_rate_is_given(tmp_path):
    path = save_with_time(tmp_path / "rig.npz", np.arange(400) / 500, fs=640)
    with pytest.raises(
        RecordingError,
        match=r"is 640 Hz \(fs\) and 500 Hz \(time column 't'.*\) by the file, which contradicts",
    ):
        load_recording(path)
    assert load_recording(path, rate_hz=500).rate_hz == 500
    assert load_recording(path, rate_hz=640).rate_hz == 640


@pytest.mark.parametrize("given", [None, 500.0])
def test_a_gap_in_the_time_column_is_a_gap(tmp_path, given):
    t = np.round(np.arange(1000) / 500, 4)
    there = np.ones(1000, bool)
    there[[100, *range(300, 420), 700]] = False
    path = save_with_time(tmp_path / "rig.csv", t[there])
    recording = load_recording(path, {"x": "x"}, given)
    assert recording.rate_hz == pytest.approx(500)
    assert np.array_equal(np.isfinite(recording.samples[:, 0]), there)
    assert recording.nan_count == 122


def test_a_recording_that_is_mostly_a_gap_is_refused(tmp_path):
    t = np.arange(400) / 500
    t[200:] += 3600.0
    path = save_with_time(tmp_path / "rig.csv", t)
    with pytest.raises(
        RecordingError, match=r"lacks 1,800,000 of .* by its time column 't', .* behind sample 200;"
    ):
        load_recording(path)


def test_a_derived_rate_must_be_sensible(tmp_path):
    path = tmp_path / "rig.npz"
    np.savez(path, t=np.arange(400) * 60, x=X)
    with pytest.raises(RecordingError, match=r"0\.0166667 Hz \(derived from time column 't'.*with --fs"):
        load_recording(path)


def test_time_alone_is_no_recording(tmp_path):
    path = tmp_path / "rig.npz"
    np.savez(path, t=np.arange(400) / 500)
    with pytest.raises(RecordingError, match="no channel beside its time column 't'; it holds t"):
        load_recording(path)


def set_back(t):
    """Ten rows in the wrong order."""
    t[600:610] = t[600:610][::-1].copy()


def stamp_wrongly(t):
    """A few stamps that are far off, the last one too."""
    t[[3, 700, -1]] = 0.0


def restart_clock(t):
    t[400:] -= t[400]


def jitter(t):
    """Half a sample, and coarse digits."""
    t += np.random.default_rng(3).uniform(-0.45, 0.45, len(t)) / 12_000
    t[600:610] = t[600:610][::-1].copy()


def coarsen(t):
    np.floor(t * 1000, out=t)
    t /= 1000
    t[600:620] = t[600:620][::-1].copy()


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".mat", ".parquet"])
@pytest.mark.parametrize("spoil", [set_back, stamp_wrongly, restart_clock, jitter, coarsen])
def test_a_time_column_that_goes_back_here_and_there_still_tells_the_rate(tmp_path, suffix, spoil):
    t = np.arange(12_000) / 12_000
    spoil(t)
    path = save_with_time(tmp_path / f"rig{suffix}", t)
    with pytest.raises(RecordingError, match=r"by the file and 48000 Hz as given: leave --fs out"):
        load_recording(path, {"x": "x"}, 48_000)
    recording = load_recording(path, {"x": "x"}, 12_000)
    assert (recording.rate_hz, len(recording.samples), recording.nan_count) == (12_000, 12_000, 0)
    (note,) = recording.notes
    assert "time column 't' goes back in " in note
    if spoil in {set_back, stamp_wrongly, restart_clock}:
        assert load_recording(path).rate_hz == pytest.approx(12_000, rel=1e-6)
        assert load_recording(path).names == ("x",)
    else:
        with pytest.raises(RecordingError, match="does not state one"):
            load_recording(path)


def test_times_that_go_backwards_are_told(tmp_path):
    t = np.arange(400) / 1000
    with pytest.raises(RecordingError, match=r"the times of its column 't' go backwards"):
        load_recording(save_with_time(tmp_path / "rig.csv", t[::-1]))
    t = np.random.default_rng(1).normal(size=400)
    with pytest.raises(
        RecordingError, match=r"are uneven \(-\d.* to \d.* s\), and \d+ of them go back. Give"
    ):
        load_recording(save_with_time(tmp_path / "rig.csv", t))
    t[::2] = np.nan
    with pytest.raises(RecordingError, match=r"time column 't' has no two times in a row. Give it with --fs"):
        load_recording(save_with_time(tmp_path / "rig.csv", t[:3]))


def test_a_gap_beside_stamps_out_of_order_is_a_gap(tmp_path):
    t = np.arange(1000) / 500
    there = np.ones(1000, bool)
    there[300:420] = False
    t[600:610] = t[600:610][::-1].copy()
    recording = load_recording(save_with_time(tmp_path / "rig.csv", t[there]), {"x": "x"})
    assert np.array_equal(np.isfinite(recording.samples[:, 0]), there)
    assert "goes back in 9 steps" in recording.notes[0]


@pytest.mark.parametrize("dtype", [np.uint32, np.int16])
def test_differences_of_unsigned_or_short_stamps_do_not_wrap(tmp_path, dtype):
    t = (np.arange(400) * 150).astype(dtype)  # those of int16 begin again beyond 32 767, as of a counter
    t[0], t[50:53] = t[5], t[50:53][::-1].copy()
    np.savez(tmp_path / "rig.npz", time_us=t, x=X[:400])
    recording = load_recording(tmp_path / "rig.npz")
    assert recording.rate_hz == pytest.approx(1e6 / 150)
    assert (len(recording.samples), recording.nan_count) == (400, 0)
    assert "goes back in" in recording.notes[0]


def test_a_column_that_goes_back_everywhere_tells_nothing(tmp_path):
    """What is called t is a torque here: the rate has to be given."""
    t = np.random.default_rng(1).normal(size=4000)
    path = save_with_time(tmp_path / "rig.csv", t)
    recording = load_recording(path, {"x": "x"}, 12_000)
    assert (recording.rate_hz, recording.notes) == (12_000, ())
    with pytest.raises(RecordingError, match="Give it with --fs"):
        load_recording(path, {"x": "x"})
