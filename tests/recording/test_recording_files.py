from __future__ import annotations

import gzip
import io
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat, wavfile
from support.given_codes import had
from support.paths import ROOT

from daqsvc.errors.recordings import TOO_SHORT
from daqsvc.recording import RecordingError
from daqsvc.recording.recording import list_channels, load_recording

DATA = Path(os.environ.get("DAQSVC_DATA", ROOT / ".." / "shared" / "data")).resolve()
needs_data = [
    pytest.mark.data,
    pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings at {DATA}; set DAQSVC_DATA"),
]


def _npz(**arrays):
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


A = np.round(np.random.default_rng(2).normal(size=500), 6)
B = np.round(np.linspace(-3, 3, 500), 6)

ENCRYPTED_NPZ = bytearray(_npz(x=A))
ENCRYPTED_NPZ[ENCRYPTED_NPZ.index(b"PK\x01\x02") + 8] |= 1


@pytest.fixture
def mat(tmp_path):
    path = tmp_path / "rig.mat"
    savemat(
        path,
        {
            "DE": A[:, None],
            "FE": B[None, :],
            "short": B[:20],
            "RPM": 1797,
            "note": "drive end",
            "empty": np.zeros((0, 0)),
            "both": np.column_stack([A, B]),
            "bearing": {"gs": B, "sr": 48_828, "inner": {"x": A}},
        },
        do_compression=True,
    )
    return path


def write_csv(tmp_path, text, name="rig.csv"):
    path = tmp_path / name
    if name.endswith(".gz"):
        path.write_bytes(gzip.compress(text.encode()))
    else:
        path.write_bytes(text.encode())
    return path


def rows(delimiter, number=repr, ending="\n"):
    return ending.join(delimiter.join(number(float(v)) for v in row) for row in zip(A, B, strict=True))


def test_mat_variables_struct_fields_and_matrix_columns(mat):
    mapping = {"a": "DE", "b": "FE", "c": "bearing.gs", "d": "bearing.inner.x", "e": "both[1]"}
    recording = load_recording(mat, mapping, 48_828)
    assert recording.names == ("a", "b", "c", "d", "e")
    assert recording.samples.dtype == np.float64
    assert np.array_equal(recording.samples, np.column_stack([A, B, B, A, B]))
    assert (recording.rate_hz, recording.source, recording.nan_count) == (48_828.0, mat, 0)


def test_without_a_map_the_longest_channels_are_taken(mat):
    recording = load_recording(mat)
    assert recording.names == ("DE", "FE", "both[0]", "both[1]", "bearing.gs", "bearing.inner.x")
    assert recording.rate_hz == 48_828.0  # as the file states in bearing.sr
    assert list_channels(mat) == dict.fromkeys(recording.names, 500) | {"short": 20}
    assert load_recording(mat, rate_hz=48_800.0).rate_hz == 48_800.0


@pytest.mark.parametrize("name", ["rig.csv", "rig.csv.gz", "RIG.CSV"])
@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|", " ", ", ", "  "])
def test_csv_delimiters(tmp_path, name, delimiter):
    path = write_csv(tmp_path, rows(delimiter), name)
    recording = load_recording(path, rate_hz=100)
    assert recording.names == ("0", "1")
    assert np.array_equal(recording.samples, np.column_stack([A, B]))
    assert np.array_equal(load_recording(path, {"y": "1"}, 100).samples[:, 0], B)


def test_csv_decimal_commas(tmp_path):
    path = write_csv(tmp_path, "weg;kraft\r\n" + rows(";", lambda v: f"{v:.6f}".replace(".", ","), "\r\n"))
    recording = load_recording(path, {"force": "kraft", "way": "0"}, 100)
    assert np.array_equal(recording.samples, np.column_stack([B, A]))


def test_csv_header_comments_text_columns_and_byte_order_mark(tmp_path):
    lines = "".join(f"2026-01-31 12:00:{i:02d};{A[i]};{B[i]};ok\n" for i in range(40))
    path = write_csv(tmp_path, f"\ufeff# rig 7\n\nwhen;x;x;state\n{lines}")
    assert list_channels(path) == {"x": 40, "2": 40}
    recording = load_recording(path, {"x": "x", "y": "2"})
    assert np.array_equal(recording.samples, np.column_stack([A[:40], B[:40]]))
    assert load_recording(path, {"x": "1"}, 1).samples[:, 0].tolist() == A[:40].tolist()
    with pytest.raises(
        RecordingError, match=r"'when' .* is not numeric; it holds when \(not numeric\), x \(40\)"
    ):
        load_recording(path, {"t": "when"}, 1)


def test_csv_of_one_column(tmp_path):
    path = write_csv(tmp_path, "accel\n" + "\n".join(map(str, A)))
    assert np.array_equal(load_recording(path, {"a": "accel"}, 1).samples[:, 0], A)


def test_csv_first_line_may_carry_totals(tmp_path):
    path = write_csv(tmp_path, "0;1.5;2.5;9;9\n" + "".join(f"{i};{i}.5 ;{i}.25 \n" for i in range(1, 50)))
    recording = load_recording(path, {"x": "1", "y": "2"}, 20_000)
    assert recording.samples[:3].tolist() == [[1.5, 2.5], [1.5, 1.25], [2.5, 2.25]]
    assert list_channels(path) == {"0": 50, "1": 50, "2": 50}


def test_nan_and_empty_cells_are_counted(tmp_path):
    path = write_csv(tmp_path, "x,y\n1,2\nnan,3\n,4\n5,6\n")
    recording = load_recording(path, rate_hz=1)
    assert recording.nan_count == 2
    assert np.isnan(recording.samples[1:3, 0]).all()
    assert recording.samples[:, 1].tolist() == [2, 3, 4, 6]


def test_npz(tmp_path):
    path = tmp_path / "rig.npz"
    np.savez(path, x=A.astype(np.float32), y=np.arange(500, dtype=np.int16), fs=640.0, label="healthy")
    recording = load_recording(path)
    assert recording.names == ("x", "y")
    assert recording.rate_hz == 640.0
    assert np.array_equal(recording.samples[:, 0], A.astype(np.float32))
    assert np.array_equal(recording.samples[:, 1], np.arange(500))


@pytest.mark.parametrize(
    ("channels", "message", "code"),
    [
        (
            {"a": "XE"},
            r"no channel 'XE'; it holds DE \(500\), FE \(500\), short \(20\), RPM, note",
            "R05",
        ),
        ({"a": "RPM"}, "'RPM' .* is a single number", "R05"),
        ({"a": "empty"}, "'empty' .* is empty", "R05"),
        ({"a": "note"}, "'note' .* is not numeric", "R05"),
        ({"a": "0"}, "no channel '0'", "R05"),
        ({"a": "DE", "b": "short"}, r"different lengths: a \(DE\) 500, b \(short\) 20", "R10"),
    ],
)
def test_channels_that_cannot_be_played(mat, channels, message, code):
    with pytest.raises(RecordingError, match=message) as refused:
        load_recording(mat, channels, 100)
    assert refused.value.code.id == code
    if code == "R10":
        had("R10", refused.value)


@pytest.mark.parametrize("rate_hz", [0, -1, 0.9, 1.1e7, float("nan"), float("inf")])
def test_rate_must_be_sensible(mat, rate_hz):
    with pytest.raises(RecordingError, match="from 1 to 10,000,000 Hz with --fs"):
        load_recording(mat, rate_hz=rate_hz)


def test_an_unknown_rate_is_asked_for(tmp_path):
    path = tmp_path / "rig.npz"
    np.savez(path, x=A)
    with pytest.raises(RecordingError, match=r"does not state one\. Give it with --fs"):
        load_recording(path)
    np.savez(path, x=A, fs=10, sample_rate=20)
    with pytest.raises(RecordingError, match=r"states several: \{'fs': 10.0, 'sample_rate': 20.0\}"):
        load_recording(path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", b"", "is empty"),
        ("a.csv", b"# nothing\n\n", "is empty"),
        ("a.csv", b"x,y\n", "header but no samples"),
        ("a.csv", b"one\ntwo\n", "no numeric channel: its first line is 'one', and no line behind it"),
        ("a.csv", b"t,a\n0.1,two\nthree,four\n", "no numeric channel: its first line is 't,a'"),
        ("a.csv", b"1,2\n3,4\n5,x\n7,8\n", r"a.csv, line 3, column 2: 'x' is not a number"),
        ("a.csv", b"x,y\n" + b"1,2\n" * 30 + b"1\n", r"a.csv, line 32 has 1 column where the others have 2"),
        ("a.csv", b"\xff\xfe1", "cannot be read"),
        ("a.csv.gz", b"1,2\n", "cannot be read.*gzip"),
        ("a.mat", b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400), "save it in MATLAB with"),
        ("a.mat", b"no such thing" * 20, "cannot be read"),
        ("a.mat", b"", "cannot be read"),
        ("a.npz", b"PK no such thing", "cannot be read"),
        ("a.npz", b"\x80\x04no pickle either", "cannot be read: it is not a zip archive"),
        (
            "a.npz",
            _npz(x=A)[:1000],
            "cannot be read: it is cut short, as the directory at its end is missing",
        ),
        ("a.npz", _npz(x=np.array([{"a": 1}])), r"no numeric channel; it holds x \(not numeric\)"),
        ("a.npz", _npz(x=np.array([1.0])), "is too short: no channel has two samples"),
        ("a.npz", _npz(x=np.array([])), "is too short"),
        ("a.csv", b"1,2\n", "is too short"),
        ("a.npz", ENCRYPTED_NPZ, "cannot be read: .*encrypted"),
        (
            "a.sie",
            b"TDSm",
            r"use .npz, .mat, .csv, .csv.gz, .wav, .parquet, .tdms, .mf4, .uff, .unv, .h5, .hdf5, .mcap$",
        ),
    ],
)
def test_files_that_cannot_be_read(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        load_recording(path, rate_hz=1)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_a_table_of_far_too_many_columns_is_called_so(tmp_path, delimiter):
    """Its lines are longer than a cell may be."""
    header = delimiter.join(f"c{i}" for i in range(100_000))
    path = write_csv(tmp_path, f"{header}\n" + 2 * (delimiter.join(["0"] * 100_000) + "\n"))
    with pytest.raises(RecordingError, match="has 100,000 columns or variables, and at most 4,096 are read"):
        load_recording(path, rate_hz=1)


@pytest.mark.parametrize("ending", [".npz", ".wav", ".csv"])
def test_a_rate_is_not_told_as_a_channel(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    if ending == ".npz":
        np.savez(path, **{"0": A, "rate_hz": 100})
    elif ending == ".wav":
        wavfile.write(path, 100, A)
    else:
        path.write_text("# rate_hz = 100\n" + "\n".join(map(str, A)))
    with pytest.raises(RecordingError, match=r"has no channel 'de'; it holds 0 \(500\)$"):
        load_recording(path, {"x": "de"})


def test_a_file_of_single_samples_has_the_code_of_one_that_is_too_short(tmp_path):
    with pytest.raises(RecordingError, match="no channel has two samples") as raised:
        load_recording(write_csv(tmp_path, "x,y\n1,2\n"))
    assert raised.value.code is TOO_SHORT


def test_channels_of_different_lengths_come_with_an_example_of_those_taken_together(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, fs=100, x=A, y=A, oil=A[:20])
    with pytest.raises(RecordingError, match=r"map only channels taken together, such as x and y$"):
        load_recording(path, {"x": "x", "oil": "oil", "y": "y"})


def test_one_sample_asked_for_by_name_is_too_short(tmp_path):
    path = write_csv(tmp_path, "1,2\n")
    with pytest.raises(RecordingError, match=r"too short: it holds one sample a channel"):
        load_recording(path, {"x": "0"}, 100)


def test_infinities_are_counted(tmp_path):
    recording = load_recording(write_csv(tmp_path, "1,2\ninf,nan\n-inf,4\n"), rate_hz=1)
    assert (recording.nan_count, recording.infinity_count) == (1, 2)


def test_channels_of_another_length_are_told(mat):
    assert load_recording(mat).left_out == {"short": 20}
    assert load_recording(mat, {"a": "DE"}).left_out == {}


@pytest.mark.parametrize("name", ["nothing.csv", "nothing.mat", "nothing.npz", "nothing"])
def test_a_missing_file_is_named(name, tmp_path):
    with pytest.raises(RecordingError, match=rf"{name} cannot be read: there is no such file"):
        list_channels(tmp_path / name)


def test_truncated_mat_and_gzip(tmp_path, mat):
    whole = mat.read_bytes()
    for length in range(0, len(whole) - 8, 97):
        mat.write_bytes(whole[:length])
        with pytest.raises(RecordingError, match=r"rig\.mat cannot be read"):
            load_recording(mat, rate_hz=1)
    path = write_csv(tmp_path, rows(","), "rig.csv.gz")
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(RecordingError, match="cannot be read"):
        load_recording(path, rate_hz=1)


class TestMeasured:
    pytestmark = needs_data

    def test_cwru(self):
        path = DATA / "cwru" / "105.mat"
        recording = load_recording(path, {"accel-de": "X105_DE_time"}, 12_000)
        assert recording.samples.shape == (121_265, 1)
        assert recording.samples.std() == pytest.approx(0.29, abs=0.02)
        assert set(list_channels(path)) == {"X105_DE_time", "X105_FE_time", "X105_BA_time"}

    def test_mfpt_states_its_rate(self):
        recording = load_recording(
            DATA / "mfpt" / "train" / "InnerRaceFault_vload_1.mat", {"a": "bearing.gs"}
        )
        assert recording.samples.shape == (146_484, 1)
        assert recording.rate_hz == 48_828.0

    def test_accelerometer_on_a_fault_simulator(self):
        (path, *_) = sorted((DATA / "adi_cbm" / "Data_ADXL356C").glob("1800_GoB*.csv.gz"))
        recording = load_recording(path)
        assert recording.names == ("1", "2", "3")
        assert recording.rate_hz == pytest.approx(20_000)
        assert recording.rate_source == "derived from time column '0', read as seconds"
        assert recording.samples.shape == (40_000, 3)
        assert recording.samples.mean(axis=0) == pytest.approx([0.9] * 3, abs=0.05)

    def test_finite_element_rotor(self):
        recording = load_recording(DATA / "ross" / "A1_healthy_e0p1.npz", {"x": "x_disc", "y": "y_disc"})
        assert recording.samples.shape == (29_440, 2)
        assert recording.rate_hz == pytest.approx(10_903.4, abs=0.1)
        assert recording.scalars["omega"] == pytest.approx(535.219, abs=0.001)
        assert recording.texts["labels"] == "N"

    def test_trends_with_a_date_column(self):
        recording = load_recording(DATA / "skab" / "other" / "5.csv", {"i": "Current", "u": "Voltage"}, 1.0)
        assert recording.samples[0].tolist() == [2.5889, 231.257]
