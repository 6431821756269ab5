"""Run-ups and coast-downs: Bode and polar plots of 1X."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from bokeh.layouts import column

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.page.charts import ChartAxis, chart, legend, source
from daqsvc.page.views.view import Choice, Figure, Shown

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive
    from daqsvc.page.runs import Vectors

    Floats = NDArray[np.float64]

COMPENSATIONS = {"none": "as measured", "slow-roll": "less the slow roll"}
AMPLITUDES = {"peak": "peak", "pp": "peak to peak"}
MOST_POINTS = 2000
LEAST_RANGE = 1.1
"""From the lowest to the highest speed; below, the speed has not changed."""
BIN = 0.005
"""Width of a bin of speed, as a part of it."""
HALF_POWER = 1.0 / np.sqrt(2.0)
NO_KEY = "it needs a keyphasor that is sampled with the sensor: without one the phase is not known"


class Critical(NamedTuple):
    """A critical speed.

    Attributes:
        speed_rpm: where 1X is largest.
        peak: its amplitude there.
        q: amplification factor by the half-power points; None where they were not passed on both sides.
    """

    speed_rpm: float
    peak: float
    q: float | None


def critical_speed(speed_rpm: Floats, amplitude: Floats) -> Critical | None:
    """The critical speed that was passed; None if 1X is largest at an end of the run.

    The amplification factor is that of API 684: the critical speed over the width between the half-power
    points, where the amplitude is .707 of the peak.

    Args:
        speed_rpm: ``[n]``, in any order.
        amplitude: ``[n]``, of 1X.
    """
    bins = np.round(np.log(speed_rpm) / BIN).astype(int)
    each = np.unique(bins)
    speed = np.array([np.median(speed_rpm[bins == one]) for one in each])
    height = np.array([np.median(amplitude[bins == one]) for one in each])
    top = int(height.argmax())
    if top in {0, len(height) - 1} or max(height[0], height[-1]) > 0.9 * height[top]:
        return None
    level = HALF_POWER * height[top]
    below = np.flatnonzero(height[:top] < level)
    above = np.flatnonzero(height[top:] < level) + top
    q = None
    if len(below) and len(above):
        low = _crossing(speed, height, below[-1], level)
        high = _crossing(speed, height, above[0] - 1, level)
        q = float(speed[top] / (high - low))
    return Critical(float(speed[top]), float(height[top]), q)


def _crossing(speed: Floats, height: Floats, at: int, level: float) -> float:
    """Where the height passes a level between a bin and the next one."""
    part = (level - height[at]) / (height[at + 1] - height[at])
    return float(speed[at] + part * (speed[at + 1] - speed[at]))


class _RunView:
    every_s = 1.0

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        sensors = {name: name for name in _with_marks(live)}
        return [
            Choice("sensor", "Sensor", sensors),
            Choice("amplitude", "Amplitude", AMPLITUDES),
            Choice("compensation", "Vector", COMPENSATIONS),
        ]

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        return "" if _with_marks(live) else NO_KEY

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        places = live.place_of([chosen["sensor"], live.keyphasor() or ""]) or []
        return {one.stream for one in places}


class BodeView(_RunView):
    """See `daqsvc.page.views.view.MachineView`."""

    name = "bode"
    title = "Bode"
    sentence = (
        "Amplitude and phase lag of 1X against the speed, every four revolutions, since the page looks at "
        "this sensor. A run-up or coast-down shows the critical speeds: there the amplitude has its peak, "
        "and the lag changes by 180 degrees."
    )

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        sensor = chosen["sensor"]
        unit = f"{live.sensors[sensor].unit} {AMPLITUDES[chosen['amplitude']]}"
        tips = [("speed", "@s{0} rpm"), ("1X", f"@a{{0.00}} {unit}"), ("lag", "@p{0} deg")]
        run = source("run", ["s", "a", "p"])
        speed = ChartAxis("speed, rpm")
        height = chart(speed, ChartAxis(f"1X of {sensor}, {unit}"), theme, height=260, tips=tips)
        lag = chart(speed, ChartAxis("phase lag, deg", 360.0, 0.0), theme, height=200, tips=tips)
        lag.x_range = height.x_range
        for made, of_what in ((height, "a"), (lag, "p")):
            made.scatter("s", of_what, source=run, size=3, color=theme.series[0], legend_label="1X")
            now = source(f"now_{of_what}", ["s", of_what])
            made.scatter("s", of_what, source=now, size=9, color=theme.series[1], legend_label="now")
            legend(made, theme)
        # Zoomed together, so they are one figure.
        both = column(height, lag, sizing_mode="stretch_width")
        return [Figure("bode", f"Amplitude and phase lag of 1X of {sensor} against the speed", both)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        seen = live.vectors_of(chosen["sensor"])
        if not len(seen.t_ns):
            return Shown(note="too few whole revolutions of this sensor have come yet")
        vectors, factor = _compensated(seen, chosen), 2.0 if chosen["amplitude"] == "pp" else 1.0
        amplitude, lag = factor * np.abs(vectors), np.degrees(-np.angle(vectors)) % 360.0
        thin = slice(None, None, -(-len(vectors) // MOST_POINTS))
        run = {"s": seen.speed_rpm[thin], "a": amplitude[thin], "p": lag[thin]}
        last = slice(-1, None)
        sources = {
            "run": run,
            "now_a": {"s": seen.speed_rpm[last], "a": amplitude[last]},
            "now_p": {"s": seen.speed_rpm[last], "p": lag[last]},
        }
        return Shown(sources, _rows(live, chosen, seen, amplitude, lag), _note(seen))


class PolarView(_RunView):
    """See `daqsvc.page.views.view.MachineView`."""

    name = "polar"
    title = "Polar"
    sentence = (
        "The vector of 1X as the speed changes, since the page looks at this sensor. Zero degrees of lag is "
        "at the probe, and the lag counts against the sense of rotation: a critical speed is a loop."
    )

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        sensor = chosen["sensor"]
        unit = f"{live.sensors[sensor].unit} {AMPLITUDES[chosen['amplitude']]}"
        tips = [("speed", "@s{0} rpm"), ("1X", f"@a{{0.00}} {unit}"), ("lag", "@p{0} deg")]
        made = chart(
            ChartAxis(unit), ChartAxis(f"1X of {sensor}, {unit}"), theme, height=520, tips=tips, is_round=True
        )
        axes = source("probe", ["x", "y"])
        made.line("x", "y", source=axes, line_color=theme.quiet, line_dash="dashed", legend_label="probe")
        run = source("run", ["x", "y", "s", "a", "p"])
        made.line("x", "y", source=run, line_color=theme.series[0], legend_label="1X")
        made.scatter("x", "y", source=run, size=3, color=theme.series[0])
        now = source("now", ["x", "y"])
        made.scatter("x", "y", source=now, size=9, color=theme.series[1], legend_label="now")
        legend(made, theme)
        return [Figure("polar", f"Vector of 1X of {sensor} as the speed changes", made)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        sensor = live.sensors[chosen["sensor"]]
        seen = live.vectors_of(chosen["sensor"])
        if not len(seen.t_ns):
            return Shown(note="too few whole revolutions of this sensor have come yet")
        vectors, factor = _compensated(seen, chosen), 2.0 if chosen["amplitude"] == "pp" else 1.0
        amplitude, lag = factor * np.abs(vectors), np.degrees(-np.angle(vectors)) % 360.0
        sense = -1.0 if live.turns_clockwise else 1.0
        at = amplitude * np.exp(1j * np.radians((sensor.angle_deg or 0.0) - sense * lag))
        reach = 1.1 * float(amplitude.max())
        probe = reach * np.exp(1j * np.radians(sensor.angle_deg or 0.0))
        thin = slice(None, None, -(-len(vectors) // MOST_POINTS))
        run = {"x": at.real, "y": at.imag, "s": seen.speed_rpm, "a": amplitude, "p": lag}
        sources: dict[str, dict[str, Any]] = {
            "run": {column: values[thin] for column, values in run.items()},
            "now": {"x": at.real[-1:], "y": at.imag[-1:]},
            "probe": {"x": np.array([0.0, probe.real]), "y": np.array([0.0, probe.imag])},
        }
        return Shown(sources, _rows(live, chosen, seen, amplitude, lag), _note(seen))


def _with_marks(live: MachineLive) -> list[str]:
    """The sensors that are sampled with the keyphasor."""
    key = live.keyphasor()
    return [name for name in live.vibration_sensors() if key and live.place_of([name, key])]


def _compensated(seen: Vectors, chosen: Mapping[str, str]) -> NDArray[np.complex128]:
    """The vectors, less that at the lowest speed if that was chosen."""
    if chosen["compensation"] != "slow-roll":
        return seen.vectors
    slowest = seen.speed_rpm <= seen.speed_rpm.min() * 1.02
    less: NDArray[np.complex128] = seen.vectors - seen.vectors[slowest].mean()
    return less


def _rows(
    live: MachineLive, chosen: Mapping[str, str], seen: Vectors, amplitude: Floats, lag: Floats
) -> list[tuple[str, str, str]]:
    unit = f"{live.sensors[chosen['sensor']].unit} {AMPLITUDES[chosen['amplitude']]}"
    rows = [
        ("speed now", f"{seen.speed_rpm[-1]:.0f}", "rpm"),
        ("1X now", f"{amplitude[-1]:.2f}", unit),
        ("lag now", f"{lag[-1]:.0f}", "deg"),
        ("lowest speed", f"{seen.speed_rpm.min():.0f}", "rpm"),
        ("highest speed", f"{seen.speed_rpm.max():.0f}", "rpm"),
    ]
    if seen.speed_rpm.max() >= LEAST_RANGE * seen.speed_rpm.min():
        critical = critical_speed(seen.speed_rpm, amplitude)
        if critical is not None:
            rows += [
                ("critical speed", f"{critical.speed_rpm:.0f}", "rpm"),
                ("1X there", f"{critical.peak:.2f}", unit),
            ]
            if critical.q is not None:
                rows.append(("amplification factor", f"{critical.q:.1f}", ""))
    return rows


def _note(seen: Vectors) -> str:
    if seen.speed_rpm.max() >= LEAST_RANGE * seen.speed_rpm.min():
        return ""
    over_s = (seen.t_ns[-1] - seen.t_ns[0]) / NS_PER_S
    return f"the speed has hardly changed in the last {over_s:.0f} s: a run-up or coast-down shows more"
