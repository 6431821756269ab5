"""Spectra over time, and over the speed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.page.charts import ChartAxis, chart, source
from daqsvc.page.runs import MOST_SPECTRA
from daqsvc.page.views.view import NO_WAVEFORM, Choice, Figure, Shown
from daqsvc.rounding import readable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive

WINDOWS = {"1": "1 s each", "0.5": "0.5 s each", "4": "4 s each"}
OVER = {"time": "time (waterfall)", "speed": "speed (cascade)"}
TALLEST = 6.0
"""The largest line is so many times as high as spectra are apart."""


class WaterfallView:
    """See `daqsvc.page.views.view.MachineView`."""

    name = "waterfall"
    title = "Waterfall"
    sentence = (
        "Spectra one behind the other, since the page looks at this sensor: over time, the newest on top, as "
        "a waterfall, over the speed as a cascade. What keeps its frequency is a resonance or comes from "
        "outside; what moves with the speed is an order."
    )
    every_s = 1.0

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        sensors = {name: name for name in live.waveform_sensors()}
        return [
            Choice("sensor", "Sensor", sensors),
            Choice("over", "Over", OVER),
            Choice("window", "Spectra", WINDOWS),
        ]

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        return "" if live.waveform_sensors() else NO_WAVEFORM

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        return {one.stream for one in live.place_of([chosen["sensor"]]) or []}

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        sensor = chosen["sensor"]
        places = live.place_of([sensor])
        highest = live.rate_hz(places[0].stream) / 2.0 if places else 1.0
        unit = live.sensors[sensor].unit
        over = "speed, rpm" if chosen["over"] == "speed" else "time before now, s"
        made = chart(
            ChartAxis("frequency, Hz", 0.0, highest),
            ChartAxis(over),
            theme,
            height=520,
            tips=[("frequency", "@f{0.0} Hz"), (sensor, f"@a{{0.000}} {unit} peak"), (over, "@z{0.0}")],
        )
        lines = source("waterfall", ["f", "y", "a", "z"])
        made.line("f", "y", source=lines, line_color=theme.series[0])
        return [Figure("waterfall", f"Spectra of {sensor} up to {highest:g} Hz, one behind the other", made)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        sensor = chosen["sensor"]
        window_s = float(chosen["window"])
        spectra = live.spectra_of(sensor, window_s)
        if not spectra:
            return Shown(note=f"the first spectrum comes after {window_s:g} s")
        by_speed = chosen["over"] == "speed"
        newest_ns = spectra[-1].t_ns
        places_z = [one.speed_rpm if by_speed else (one.t_ns - newest_ns) / NS_PER_S for one in spectra]
        apart = _apart(places_z, window_s)
        largest = max(float(one.peak[1:].max(initial=0.0)) for one in spectra) or 1.0
        parts = []
        for one, z in zip(spectra, places_z, strict=True):
            height = one.peak * (TALLEST * apart / largest)
            parts.append(np.column_stack([one.frequency_hz, z + height, one.peak, np.full(len(height), z)]))
            parts.append(np.full((1, 4), np.nan))
        drawn = np.concatenate(parts)
        unit = live.sensors[sensor].unit
        newest = spectra[-1]
        at = int(newest.peak[1:].argmax()) + 1
        rows = [
            ("spectra", f"{len(spectra)}", f"of {MOST_SPECTRA} at most"),
            (f"newest at {newest.frequency_hz[at]:.1f} Hz", readable(newest.peak[at]), f"{unit} peak"),
            ("largest of all", readable(largest), f"{unit} peak"),
            ("speed of the newest", f"{newest.speed_rpm:.0f}", "rpm"),
        ]
        columns = dict(zip(("f", "y", "a", "z"), drawn.T, strict=True))
        return Shown({"waterfall": columns}, rows)


def _apart(z: list[float], window_s: float) -> float:
    """How far spectra are from each other, on average."""
    span = max(z) - min(z)
    return span / max(len(z) - 1, 1) or window_s
