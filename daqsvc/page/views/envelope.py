"""The envelope spectrum of an accelerometer, with the lines of the bearings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.fft

from daqsvc.dsp.envelope import line_power, squared_envelope, whiten
from daqsvc.page.bearing_lines import bearing_lines
from daqsvc.page.charts import ChartAxis, chart, legend, source
from daqsvc.page.views.view import Choice, Figure, Shown

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive

LENGTHS = {"5": "5 s", "2": "2 s", "15": "15 s"}
LOW_HZ = 400.0
"""The band begins above the shaft's harmonics."""
TOP_SHARE = 0.45
"""It ends at this share of the rate."""
LEAST_RATE_HZ = 2000.0
WHITENING_HZ = 100.0
SHOWN_HZ = 500.0
LEAST_S = 0.5
SLIP = 0.01
"""Distance from its computed frequency within which a line of a bearing is sought, as its balls slip."""


class EnvelopeSpectrumView:
    """See `daqsvc.page.views.view.MachineView`."""

    name = "envelope"
    title = "Envelope spectrum"
    sentence = (
        "How regularly the high frequencies of an accelerometer swell and fade, as they do when a damaged "
        "bearing is struck. Dashed lines are where each part of a bearing would be seen at this speed."
    )
    every_s = 1.0

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        sensors = {name: name for name in _accelerometers(live)}
        return [Choice("sensor", "Sensor", sensors), Choice("length", "Length", LENGTHS)]

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        if _accelerometers(live):
            return ""
        return f"it needs an accelerometer that is sampled at {LEAST_RATE_HZ:g} Hz or faster"

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        return {one.stream for one in live.place_of([chosen["sensor"]]) or []}

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        del live
        sensor = chosen["sensor"]
        made = chart(
            ChartAxis("frequency, Hz", 0.0, SHOWN_HZ),
            ChartAxis(f"swell of {sensor}, share of the mean"),
            theme,
            tips=[("frequency", "@f{0.00} Hz"), ("swell", "@a{0.000}")],
        )
        made.line(
            "f", "a", source=source("envelope", ["f", "a"]), line_color=theme.series[0], legend_label=sensor
        )
        lines = source("bearing_lines", ["x", "name"])
        made.vspan(x="x", source=lines, line_color=theme.series[1], line_dash="dashed")
        legend(made, theme)
        return [Figure("envelope", f"Envelope spectrum of {sensor} up to {SHOWN_HZ:g} Hz", made)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        sensor = chosen["sensor"]
        newest = live.newest_of(sensor, float(chosen["length"]))
        if newest is None:
            return Shown(note="no samples of this sensor have come yet")
        values, rate_hz = newest
        there = np.isfinite(values)
        if there.sum() < LEAST_S * rate_hz:
            return Shown(note="too few samples have come for an envelope")
        frequency, swell = envelope_spectrum(np.where(there, values - values[there].mean(), 0.0), rate_hz)
        rows, lines = [], {"x": [], "name": []}  # type: tuple[list[tuple[str, str, str]], dict[str, list[Any]]]
        # A multiple of the speed beside a line is the shaft, and no bearing.
        speed_hz = abs(live.speed_rpm) / 60.0
        turns = frequency / speed_hz if speed_hz else np.full(len(frequency), 0.5)
        own = np.abs(turns - np.rint(turns)) * speed_hz > 1.5 * frequency[1]
        for name, order in bearing_lines(live, sensor):
            at_hz = order * speed_hz
            near = (np.abs(frequency - at_hz) <= max(SLIP * at_hz, 1.5 * frequency[1])) & own
            if at_hz < SHOWN_HZ and near.any():
                peak = np.flatnonzero(near)[swell[near].argmax()]
                what = f"{name}, {at_hz:.1f} Hz"
                rows.append((what, f"{swell[peak]:.3f}", f"of the mean, at {frequency[peak]:.1f} Hz"))
                lines["x"].append(at_hz)
                lines["name"].append(name)
        highest = int(swell[1:].argmax()) + 1
        rows.append((f"largest at {frequency[highest]:.1f} Hz", f"{swell[highest]:.3f}", "of the mean"))
        missing = int((~there).sum())
        note = f"{missing} of {len(values)} samples are missing" if missing else ""
        return Shown({"envelope": {"f": frequency, "a": swell}, "bearing_lines": lines}, rows, note)


def envelope_spectrum(values: Any, rate_hz: float) -> tuple[Any, Any]:
    """Amplitudes of the squared envelope of the whitened band above `LOW_HZ`, up to `SHOWN_HZ`.

    Args:
        values: float64 ``[n]``, without mean.
        rate_hz: samples per second.

    Returns:
        Frequencies, Hz, and peak amplitudes as a share of the envelope's mean.
    """
    length = scipy.fft.prev_fast_len(len(values), real=True)
    spectrum = scipy.fft.rfft(values[:length])
    band = whiten(spectrum, length, rate_hz, LOW_HZ, TOP_SHARE * rate_hz, WHITENING_HZ)
    bins = min(int(SHOWN_HZ * length / rate_hz) + 1, len(band.clipped) // 2)
    swell = np.sqrt(line_power(squared_envelope(band.clipped, bins), bins))
    return np.arange(len(swell)) * rate_hz / length, swell


def _accelerometers(live: MachineLive) -> list[str]:
    """The accelerometers that are sampled fast enough."""
    names = []
    for sensor in live.sensors.values():
        places = live.place_of([sensor.name])
        if sensor.kind == "accelerometer" and places and live.rate_hz(places[0].stream) >= LEAST_RATE_HZ:
            names.append(sensor.name)
    return names
