"""Whether what is said of the level detectors fits the streams and sensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.settings.problems import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.detectors.levels.settings import Levels
    from daqsvc.settings.models import MachineFile, Sensor

_RING_WINDOWS = 2
_LEAST_WINDOW_SAMPLES = 16
_LEAST_PERIODS = 2.0
"""A taper of Hann spreads each frequency by two of its bins."""
_WAVEFORMS = ("proximity", "accelerometer", "velocity")
"""Types of sensors whose levels are measured here, window by window."""


def level_checks(draft: MachineFile, levels: Levels) -> Iterator[Iterator[Finding]]:
    """Every check of the level detectors.

    Args:
        draft: the machine file, or what is valid of it.
        levels: its level detectors.
    """
    yield _window(draft, levels)
    yield _velocity_band(draft, levels)
    yield _lowest_frequency(draft, levels)


def _rate_hz(draft: MachineFile, sensor: Sensor) -> float | None:
    return draft.streams[sensor.stream].rate_hz if sensor.stream in draft.streams else None


def _window(draft: MachineFile, levels: Levels) -> Iterator[Finding]:
    window_s, ring_s = levels.window_s, draft.pipeline.ring_s
    at = ("pipeline", "levels", "window_s")
    waveforms = {sensor.stream for sensor in draft.sensors if sensor.type in _WAVEFORMS}
    slow = [(draft.streams[name].rate_hz, name) for name in waveforms if name in draft.streams]
    if slow and window_s * min(slow)[0] < _LEAST_WINDOW_SAMPLES:
        slowest_hz, name = min(slow)
        remedy = f"write window_s = {_LEAST_WINDOW_SAMPLES / slowest_hz:.3g} or more"
        yield Finding(
            at,
            f"{window_s:g} s at {slowest_hz:g} Hz are fewer than {_LEAST_WINDOW_SAMPLES} samples",
            remedy + _if_no_waveform(draft, name),
        )
    if ring_s < _RING_WINDOWS * window_s:
        yield Finding(
            at,
            f"a ring of {ring_s:g} s must hold at least {_RING_WINDOWS} windows",
            f"write ring_s = {_RING_WINDOWS * window_s:g} or more in [pipeline], or a shorter window",
        )


def _velocity_band(draft: MachineFile, levels: Levels) -> Iterator[Finding]:
    at = ("pipeline", "levels", "velocity_band_hz")
    low_hz, high_hz = levels.velocity_band_hz
    casing = [sensor for sensor in draft.sensors if sensor.type in {"accelerometer", "velocity"}]
    if not casing and "velocity_band_hz" in levels.model_fields_set:
        yield Finding(
            at,
            "has no effect: no accelerometer or velocity sensor sends a waveform, and a trend value has the "
            "band of its device",
            "remove it",
            fatal=False,
        )
    for sensor in casing:
        rate_hz = _rate_hz(draft, sensor)
        if rate_hz is not None and high_hz >= rate_hz / 2:
            usable_hz = 0.4 * rate_hz
            remedy = (
                f"write velocity_band_hz = [{low_hz:.1f}, {usable_hz:.1f}]"
                if usable_hz > low_hz
                else "sample faster, or write a lower band"
            )
            yield Finding(
                at,
                f"the band {low_hz:g} Hz to {high_hz:g} Hz must end below {rate_hz / 2:g} Hz, half the rate "
                f'of stream "{sensor.stream}" (sensor "{sensor.name}")',
                remedy + _if_no_waveform(draft, sensor.stream),
            )
            return


def _lowest_frequency(draft: MachineFile, levels: Levels) -> Iterator[Finding]:
    """A window holds the lowest frequency of the velocity band: below, the mean value leaks into it."""
    if not any(sensor.type in {"accelerometer", "velocity"} for sensor in draft.sensors):
        return
    low_hz, window_s = levels.velocity_band_hz[0], levels.window_s
    if low_hz * window_s < _LEAST_PERIODS:
        yield Finding(
            ("pipeline", "levels", "window_s"),
            f"{window_s:g} s hold {low_hz * window_s:.3g} periods of {low_hz:g} Hz, the lowest frequency of "
            "velocity_band_hz: its velocity is not told from the mean value",
            f"write window_s = {_LEAST_PERIODS / low_hz:.3g} or more, or begin the band at "
            f"{_LEAST_PERIODS / window_s:.3g} Hz",
            fatal=False,
        )


def _if_no_waveform(draft: MachineFile, stream: str) -> str:
    """What else to do about a stream that is too slow for waveforms, if its registers are polled."""
    polled = draft.streams[stream].layout.polled
    return ', or type = "trend" for sensors whose level the device measures itself' if polled else ""
