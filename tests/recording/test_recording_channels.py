from __future__ import annotations

import argparse

import numpy as np
import pytest

from daqsvc.dsp.quality.unit import LENGTH_UNITS
from daqsvc.recording import RecordingError
from daqsvc.recording.channels import channel_map, metres_per_unit, sampling_rate_hz, to_um


def test_channel_map():
    assert channel_map("x=x_disc") == {"x": "x_disc"}
    assert channel_map(" x = bearing.gs ,y=data[1]") == {"x": "bearing.gs", "y": "data[1]"}
    assert channel_map("x=a=b") == {"x": "a=b"}


@pytest.mark.parametrize("text", ["", "x", "x=", "=a", "x=a,", "x=a,,y=b"])
def test_what_is_no_map(text):
    with pytest.raises(argparse.ArgumentTypeError, match="is not a map; write NAME=VARIABLE"):
        channel_map(text)


def test_a_map_names_each_channel_once():
    with pytest.raises(
        argparse.ArgumentTypeError, match="names 'x' twice; give each channel a name of its own"
    ):
        channel_map("x=a,y=b, x=c")


@pytest.mark.parametrize("text", ["", "fast", "0", "0.5", "-100", "nan", "inf", "2e7"])
def test_what_is_no_sampling_rate(text):
    with pytest.raises(argparse.ArgumentTypeError, match="not a sampling rate from 1 to 10,000,000 Hz"):
        sampling_rate_hz(text)


def test_sampling_rate():
    assert sampling_rate_hz("25.6e3") == 25_600


def test_lengths():
    assert LENGTH_UNITS == ("m", "mm", "um", "mil")
    lengths = np.array([[1.0, np.nan], [-2.0, 0.0]])
    for unit, um in {"m": 1e6, "mm": 1e3, "um": 1.0, "mil": 25.4}.items():
        assert np.array_equal(to_um(lengths, unit), lengths * um, equal_nan=True)
        assert metres_per_unit(unit) == pytest.approx(um * 1e-6, rel=1e-15)


@pytest.mark.parametrize("convert", [metres_per_unit, lambda unit: to_um(np.ones(2), unit)])
def test_other_units_are_refused(convert):
    with pytest.raises(RecordingError, match="'inch' is not a unit of length; use m, mm, um, mil"):
        convert("inch")
