"""Every format gives back what was written, and from a damaged file never anything but a `RecordingError`."""

from __future__ import annotations

import gzip
import io
import struct
import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.io import savemat, wavfile
from support.examples import examples

from daqsvc.recording import RecordingError
from daqsvc.recording.recording import load_recording

pytestmark = pytest.mark.property
RATE_HZ = 1_000


def npz(samples, *, compressed=False):
    stream = io.BytesIO()
    write = np.savez_compressed if compressed else np.savez
    write(stream, **{f"c{i}": column for i, column in enumerate(samples.T)}, fs=RATE_HZ, label="healthy")
    return stream.getvalue()


def mat(samples, *, compressed=False):
    stream = io.BytesIO()
    channels = {f"c{i}": column for i, column in enumerate(samples.T)}
    about = {"rig": {"fs": RATE_HZ, "name": "hall 3"}, "parts": np.array([1.0, "a"], dtype=object)}
    savemat(stream, channels | about | {"z": np.array([1 + 2j])}, do_compression=compressed)
    return stream.getvalue()


def csv(samples):
    names = ";".join(f"c{i}" for i in range(samples.shape[1]))
    rows = "\n".join(";".join(repr(float(value)) for value in row) for row in samples)
    return f"# fs = {RATE_HZ}\n{names}\n{rows}\n".encode()


def wav(samples):
    stream = io.BytesIO()
    wavfile.write(stream, RATE_HZ, samples)
    return stream.getvalue()


def parquet(samples):
    stream = io.BytesIO()
    table = pa.table({f"c{i}": column for i, column in enumerate(samples.T)})
    pq.write_table(table.replace_schema_metadata({"fs": str(RATE_HZ)}), stream)
    return stream.getvalue()


WRITERS = {
    "a.npz": npz,
    "b.npz": lambda samples: npz(samples, compressed=True),
    "a.mat": mat,
    "b.mat": lambda samples: mat(samples, compressed=True),
    "a.csv": csv,
    "a.csv.gz": lambda samples: gzip.compress(csv(samples)),
    "a.wav": wav,
    "a.parquet": parquet,
}

FINITE = st.floats(allow_nan=False, allow_infinity=False)
SAMPLES = np.random.default_rng(5).normal(size=(60, 2))
WHOLE = {name: write(SAMPLES) for name, write in WRITERS.items()}


@pytest.fixture(scope="module")
def folder():
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@pytest.mark.parametrize("name", WRITERS)
@given(samples=arrays(np.float64, st.tuples(st.integers(2, 12), st.integers(1, 3)), elements=FINITE))
@settings(max_examples=examples(25))
def test_round_trip(folder, name, samples):
    path = folder / name
    path.write_bytes(WRITERS[name](samples))
    recording = load_recording(path)
    assert np.array_equal(recording.samples, samples)
    assert recording.rate_hz == RATE_HZ


def load_damaged(path, content):
    """Either what is left of a recording, or a message about it; any other exception fails the test."""
    path.write_bytes(content)
    try:
        samples, message = load_recording(path, rate_hz=RATE_HZ).samples, ""
    except RecordingError as error:
        samples, message = SAMPLES, str(error)
    assert "\n" not in message
    assert not message or str(path) in message
    assert len(samples) >= 2
    assert samples.dtype == np.float64


@pytest.mark.parametrize("name", WRITERS)
@given(data=st.data())
@settings(max_examples=examples(120))
def test_changed_bytes(folder, name, data):
    content = bytearray(WHOLE[name])
    # Heads and tails hold the structure, and deserve as many tries as all of the samples.
    place = st.integers(0, min(400, len(content) - 1))
    places = st.one_of(place, place.map(lambda i: len(content) - 1 - i), st.integers(0, len(content) - 1))
    for at in data.draw(st.lists(places, min_size=1, max_size=4)):
        content[at] = data.draw(st.sampled_from([0, 1, 5, 9, 14, 127, 128, 255]) | st.integers(0, 255))
    load_damaged(folder / name, bytes(content))


@pytest.mark.parametrize("name", WRITERS)
@given(data=st.data())
@settings(max_examples=examples(60))
def test_bytes_missing_or_too_many(folder, name, data):
    content = WHOLE[name]
    first, last = sorted(data.draw(st.tuples(*[st.integers(0, len(content))] * 2)))
    load_damaged(folder / name, content[:first] + data.draw(st.binary(max_size=9)) + content[last:])


@pytest.mark.parametrize("name", WRITERS)
@given(content=st.binary(max_size=300))
@settings(max_examples=examples(60))
def test_any_bytes(folder, name, content):
    load_damaged(folder / name, WHOLE[name][: len(content) % 7] + content)


@pytest.mark.parametrize("name", [name for name in WRITERS if not name.endswith((".csv", ".mat"))])
def test_cut_short(folder, name):
    """Text cut after a line is whole, and so is MATLAB cut after a variable; the others know their length."""
    content = WHOLE[name]
    path = folder / name
    for length in np.linspace(0, len(content) - 1, 60).astype(int):
        path.write_bytes(content[:length])
        with pytest.raises(RecordingError):
            load_recording(path)


@pytest.mark.parametrize("value", [0, 1, 5, 9, 17])
def test_matlab_structure_is_checked_before_scipy_reads_it(folder, value):
    """SciPy itself would end this process on several of these bytes."""
    content = WHOLE["a.mat"]
    size = len(SAMPLES) * 8
    samples = content.index(struct.pack("<II", 9, size)) + 8
    for at in (*range(128, samples), *range(content.index(b"rig") - 60, len(content))):
        damaged = bytearray(content)
        damaged[at] = value
        load_damaged(folder / "a.mat", bytes(damaged))
