"""Arrays that come back from a process and lie in files."""

from __future__ import annotations

import mmap

import numpy as np
import pytest

from daqsvc.confined import process, spilled
from daqsvc.confined.process import ConfinedError
from daqsvc.recording.recording import load_recording

N = 3_000_000


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "rig.npz"
    np.savez(path, x=np.arange(N, dtype=np.float32), y=np.ones(N, np.float32), fs=1e3)
    return path


def base_of(array):
    while isinstance(array, np.ndarray):
        array = array.base
    return array.obj if isinstance(array, memoryview) else array


def test_large_arrays_lie_in_a_file_and_small_ones_do_not(recording, monkeypatch):
    whole = load_recording(recording).samples
    monkeypatch.setattr(process, "LEAST_BYTES", 2**40)
    narrow = load_recording(recording, narrow=True).samples
    assert (whole.dtype, narrow.dtype) == (np.float64, np.float32)
    assert not isinstance(base_of(narrow), mmap.mmap)
    monkeypatch.setattr(process, "LEAST_BYTES", 1_000)
    in_file = load_recording(recording, narrow=True).samples
    assert isinstance(base_of(in_file), mmap.mmap)
    assert np.array_equal(in_file, whole)
    assert np.array_equal(narrow, whole)
    spilled.let_go(in_file)
    assert np.array_equal(in_file[-10:], whole[-10:])
    spilled.let_go(whole)  # not in a file: nothing happens


def test_samples_that_float32_would_round_stay_float64(tmp_path):
    path = tmp_path / "rig.npz"
    np.savez(path, x=np.arange(30, dtype=np.int32), y=np.arange(30, dtype=np.int16), fs=1e3)
    assert load_recording(path, {"x": "x"}, narrow=True).samples.dtype == np.float64
    assert load_recording(path, {"y": "y"}, narrow=True).samples.dtype == np.float32


def test_a_full_disk_is_told(recording, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(process, "LEAST_BYTES", 1_000)
    monkeypatch.setattr(process, "spilled", full)
    with pytest.raises(Exception, match=r"does not fit into .* \(No space left on device\)") as refused:
        load_recording(recording, narrow=True)
    assert not isinstance(refused.value, ConfinedError)
