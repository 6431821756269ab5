"""What sniffers share: the sensors that they propose."""

from __future__ import annotations

import tomllib

import pytest

from drivers.sniffing import WAVEFORM_HZ, sensor_lines


@pytest.mark.parametrize(
    ("unit", "rate_hz", "kind"),
    [
        ("mm/s", 20.0, "trend"),
        ("mm/s", WAVEFORM_HZ, "velocity"),
        ("g", 20.0, "accelerometer"),
        ("°C", 20.0, "trend"),
    ],
)
def test_a_velocity_that_comes_slowly_is_a_level_and_no_waveform(
    unit: str, rate_hz: float, kind: str
) -> None:
    # Of a level the RMS of its changes says nothing: 6.2 mm/s would be shown as next to nothing.
    [sensor] = tomllib.loads("\n".join(sensor_lines("device", {"VRMS": unit}, set(), rate_hz)))["sensors"]
    assert sensor["type"] == kind
