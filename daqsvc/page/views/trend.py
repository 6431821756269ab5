"""Figures over hours and months, from the history on the box."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.history.points import Step
from daqsvc.page.charts import ChartAxis, chart, legend, source
from daqsvc.page.earlier import opened_history
from daqsvc.page.views.view import Choice, Figure, Shown
from daqsvc.rounding import readable, unit_behind

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.history.points import TrendPoints
    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive

HOURS = {
    "1": "1 hour",
    "0.25": "15 minutes",
    "8": "8 hours",
    "24": "1 day",
    "168": "1 week",
    "720": "30 days",
    "8760": "1 year",
}
SECONDS_UP_TO_H, MINUTES_UP_TO_H = 1.0, 200.0
MINUTES_TO_H = 1.0
"""What is no longer is shown in minutes."""
DAYS_FROM_H = 48.0
"""What is longer is shown in days."""
MOST_POINTS = 1500
"""Of a line: a screen cannot show more."""
NONE = "no history of this machine is stored yet; that needs [history] in its machine file"


class TrendView:
    """See `daqsvc.page.views.view.MachineView`."""

    name = "trend"
    title = "Trend"
    sentence = (
        "A figure over hours or months: its mean, and the range from its least to its greatest value within "
        "each point. Where nothing was measured the line is broken."
    )
    every_s = 5.0

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        return [
            Choice("reading", "Figure", {name: name for name in _names(live)}),
            Choice("hours", "Over", HOURS),
        ]

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        return "" if _names(live) else NONE

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        del live, chosen
        return set()

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        reading, hours = chosen["reading"], float(chosen["hours"])
        per_unit, unit = _unit_of(hours)
        figure_unit = _units(live).get(reading, "")
        made = chart(
            ChartAxis(f"time before now, {unit}", -hours / per_unit, 0.0),
            ChartAxis(f"{reading}, {figure_unit}" if unit_behind(figure_unit) else reading),
            theme,
            tips=[
                ("time", f"@t{{0.000}} {unit}"),
                ("mean", "@mean"),
                ("least", "@low"),
                ("greatest", "@high"),
            ],
        )
        data = source("trend", ["t", "low", "mean", "high"])
        made.varea("t", "low", "high", source=data, fill_color=theme.series[0], fill_alpha=0.25)
        made.line("t", "mean", source=data, line_color=theme.series[0], legend_label=reading)
        for key, limit in _limits(live, reading):
            colour = theme.series[1] if key.startswith("danger") else theme.quiet
            made.line(
                [-hours / per_unit, 0.0],
                [limit, limit],
                line_color=colour,
                line_dash="dashed",
                legend_label=key.replace("_", " "),
            )
        legend(made, theme)
        return [Figure("trend", f"{reading} over {HOURS[chosen['hours']]}", made)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        hours = float(chosen["hours"])
        now_s = time.time()
        with opened_history(live) as reader:
            if reader is None:
                return Shown(note=NONE)
            series = next(one for one in reader.series(live.name) if one.name == chosen["reading"])
            step = step_of(hours)
            points = reader.trend(series, step, now_s - 3600.0 * hours, now_s + 1.0)
        if not len(points.t_s):
            return Shown(note="nothing was stored in this time")
        t_h, low, mean, high = thinned(points, now_s, step)
        rows = [
            ("mean", readable(float(np.average(points.mean, weights=points.n))), series.unit),
            ("least", readable(float(points.low.min())), series.unit),
            ("greatest", readable(float(points.high.max())), series.unit),
            ("newest", readable(float(points.mean[-1])), series.unit),
        ]
        t = t_h / _unit_of(hours)[0]
        return Shown({"trend": {"t": t, "low": low, "mean": mean, "high": high}}, rows)


def step_of(hours: float) -> Step:
    """The step from point to point, by the time that is shown."""
    if hours <= SECONDS_UP_TO_H:
        return Step.SECOND
    return Step.MINUTE if hours <= MINUTES_UP_TO_H else Step.HOUR


def thinned(points: TrendPoints, now_s: float, step: Step) -> tuple[np.ndarray, ...]:
    """Time in hours before now, least, mean and greatest, in no more points than can be seen.

    A hole is where a whole point has nothing.
    """
    first_s, last_s = int(points.t_s[0]), int(points.t_s[-1])
    width_s = max(int(step), -(-(last_s - first_s + int(step)) // MOST_POINTS))
    place = (points.t_s - first_s) // width_s
    count = int(place[-1]) + 1
    weight = np.zeros(count)
    np.add.at(weight, place, points.n)
    mean, low, high = np.zeros(count), np.full(count, np.inf), np.full(count, -np.inf)
    np.add.at(mean, place, points.mean.astype(np.float64) * points.n)
    np.minimum.at(low, place, points.low)
    np.maximum.at(high, place, points.high)
    nothing = weight == 0
    mean = np.divide(mean, weight, out=np.full(count, np.nan), where=~nothing)
    low[nothing] = high[nothing] = np.nan
    t_h = (first_s + width_s * np.arange(count) - now_s) / 3600.0
    return t_h, low, mean, high


def _unit_of(hours: float) -> tuple[float, str]:
    """The unit of the time axis, in h, and its name."""
    if hours >= DAYS_FROM_H:
        return 24.0, "days"
    return (1.0, "hours") if hours > MINUTES_TO_H else (1.0 / 60.0, "minutes")


def _units(live: MachineLive) -> dict[str, str]:
    with opened_history(live) as reader:
        return {} if reader is None else {one.name: one.unit for one in reader.series(live.name)}


def _names(live: MachineLive) -> list[str]:
    """The figures that there are: at first those with limits, then r.m.s. values."""
    alarmed = {_watched(one) for one in live.values.get("alarms", ())}
    return sorted(_units(live), key=lambda name: (name not in alarmed, not name.endswith("rms"), name))


def _watched(alarm: Mapping[str, Any]) -> str:
    """The figure that an alarm of the machine file watches, by its name here."""
    return f"levels/{alarm.get('sensor', '')}.{alarm.get('measure', '')}"


def _limits(live: MachineLive, reading: str) -> Iterator[tuple[str, float]]:
    """The limits of a figure by the machine file, each with the key that states it."""
    for alarm in live.values.get("alarms", ()):
        if _watched(alarm) == reading:
            for key in ("alert", "danger", "alert_low", "danger_low"):
                if isinstance(limit := alarm.get(key), int | float):
                    yield key, float(limit)
