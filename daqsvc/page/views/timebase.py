"""The waveform of one or all vibration sensors over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.page.charts import ChartAxis, chart, legend, source
from daqsvc.page.views.view import Choice, Figure, Shown
from daqsvc.rounding import readable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive

LENGTHS = {"1": "1 s", "0.2": "0.2 s", "5": "5 s", "15": "15 s"}
MOST_POINTS = 2000
"""Of a line that are sent: a screen cannot show more."""


class TimebaseView:
    """See `daqsvc.page.views.view.MachineView`."""

    name = "timebase"
    title = "Timebase"
    sentence = (
        "What a sensor measures, sample by sample, over the last moments; gaps are samples that are missing."
    )
    every_s = 0.1

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        sensors = {name: name for name in (*live.vibration_sensors(), *filter(None, [live.keyphasor()]))}
        return [Choice("sensor", "Sensor", sensors), Choice("length", "Length", LENGTHS)]

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        return "" if live.sensors else "the machine has no sensors"

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        return {one.stream for one in live.place_of([chosen["sensor"]]) or []}

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        sensor = chosen["sensor"]
        unit = live.sensors[sensor].unit
        made = chart(
            ChartAxis("time before now, s", -float(chosen["length"]), 0.0),
            ChartAxis(f"{sensor}, {unit}"),
            theme,
            tips=[("time", "@t{0.0000} s"), (sensor, f"@v{{0.000}} {unit}")],
        )
        made.line(
            "t", "v", source=source("timebase", ["t", "v"]), line_color=theme.series[0], legend_label=sensor
        )
        legend(made, theme)
        return [Figure("timebase", f"Waveform of {sensor} over the last {chosen['length']} s", made)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        sensor, seconds = chosen["sensor"], float(chosen["length"])
        newest = live.newest_of(sensor, seconds)
        if newest is None:
            return Shown(note="no samples of this sensor have come yet")
        values, rate_hz = newest
        t_s = (np.arange(len(values)) - len(values) + 1) / rate_hz
        there = values[np.isfinite(values)]
        unit = live.sensors[sensor].unit
        rows = []
        if len(there):
            mean = there.mean()
            figures = {
                "mean": mean,
                "rms about the mean": np.sqrt(np.mean((there - mean) ** 2)),
                "peak to peak": np.ptp(there),
            }
            rows = [(name, readable(value), unit) for name, value in figures.items()]
        missing = len(values) - len(there)
        note = f"{missing} of {len(values)} samples are missing" if missing else ""
        t_s, values = thinned(t_s, values)
        return Shown({"timebase": {"t": t_s, "v": values}}, rows, note)


def thinned(t: Any, values: Any, most: int = MOST_POINTS) -> tuple[Any, Any]:
    """A line with the same extremes and no more points than can be seen: least and largest of each stretch.

    Args:
        t: float64 ``[n]``, growing.
        values: float64 ``[n]``; NaN makes a hole of its stretch only where all of that is missing.
        most: points that are wanted.
    """
    stretch = -(-2 * len(values) // most)
    if stretch < 3:
        return t, values
    whole = len(values) // stretch * stretch
    parts = values[:whole].reshape(-1, stretch)
    missing = np.isnan(parts).all(axis=1)
    lowest = np.where(missing[:, None], 0.0, np.nan_to_num(parts, nan=np.inf)).argmin(axis=1)
    highest = np.where(missing[:, None], 0.0, np.nan_to_num(parts, nan=-np.inf)).argmax(axis=1)
    places = np.sort(np.column_stack([lowest, highest]), axis=1) + stretch * np.arange(len(parts))[:, None]
    kept = np.append(places.ravel(), np.arange(whole, len(values)))
    return t[kept], values[kept]
