"""Spectra: of one sensor, and of the shaft's centre forward and backward."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.page.charts import ChartAxis, chart, legend, source
from daqsvc.page.lines import amplitudes, largest, one_sided
from daqsvc.page.shaft import whirl
from daqsvc.page.views.position import NO_PAIR, pairs_of
from daqsvc.page.views.view import Choice, Figure, Shown

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive

LENGTHS = {"2": "2 s", "0.5": "0.5 s", "10": "10 s"}
ORDERS = (1, 2, 3)
"""Multiples of the speed that are marked."""
MOST_LINES = 4096
"""Of a spectrum that are sent; of more the largest of each group."""
LEAST_SAMPLES = 32
REVOLUTIONS = {"20": "20 revolutions", "5": "5 revolutions", "80": "80 revolutions"}
FULL_ORDERS = 6.0
"""How far the full spectrum is shown, in multiples of the speed."""


class SpectrumView:
    """See `daqsvc.page.views.view.MachineView`."""

    name = "spectrum"
    title = "Spectrum"
    sentence = (
        "How strong each frequency is in what a sensor measures: peak amplitudes, by a Hann window. Dashed "
        "lines are 1X, 2X and 3X of the speed."
    )
    every_s = 0.5

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        sensors = {name: name for name in live.vibration_sensors()}
        return [Choice("sensor", "Sensor", sensors), Choice("length", "Length", LENGTHS)]

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        return "" if live.vibration_sensors() else "the machine has no sensors of vibration"

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        return {one.stream for one in live.place_of([chosen["sensor"]]) or []}

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        sensor = chosen["sensor"]
        unit = live.sensors[sensor].unit
        places = live.place_of([sensor])
        highest = live.rate_hz(places[0].stream) / 2.0 if places else 1.0
        made = chart(
            ChartAxis("frequency, Hz", 0.0, highest),
            ChartAxis(f"{sensor}, {unit} peak"),
            theme,
            tips=[("frequency", "@f{0.00} Hz"), (sensor, f"@a{{0.000}} {unit}")],
        )
        lines = source("spectrum", ["f", "a"])
        made.line("f", "a", source=lines, line_color=theme.series[0], legend_label=sensor)
        _cursors(made, theme)
        legend(made, theme)
        return [Figure("spectrum", f"Spectrum of {sensor} up to {highest:g} Hz", made)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        sensor = chosen["sensor"]
        newest = live.newest_of(sensor, float(chosen["length"]))
        if newest is None:
            return Shown(note="no samples of this sensor have come yet")
        values, rate_hz = newest
        missing = int(np.isnan(values).sum())
        if len(values) - missing < LEAST_SAMPLES:
            return Shown(note="too few samples have come for a spectrum")
        frequency, lines = one_sided(values, rate_hz)
        unit = live.sensors[sensor].unit
        rows = []
        speed_hz = abs(live.speed_rpm) / 60.0
        for order in ORDERS:
            near = np.abs(frequency - order * speed_hz) <= 2.0 * rate_hz / len(values)
            if speed_hz and near.any():
                rows.append(
                    (f"{order}X at {order * speed_hz:.2f} Hz", f"{lines[near].max():.4g}", f"{unit} peak")
                )
        highest = int(lines[1:].argmax()) + 1
        rows.append((f"largest at {frequency[highest]:.2f} Hz", f"{lines[highest]:.4g}", f"{unit} peak"))
        note = f"{missing} of {len(values)} samples are missing, and left out" if missing else ""
        frequency, lines = largest(frequency, lines, MOST_LINES)
        orders = {"x": [order * speed_hz for order in ORDERS if speed_hz]}
        return Shown({"spectrum": {"f": frequency, "a": lines}, "orders": orders}, rows, note)


class FullSpectrumView:
    """See `daqsvc.page.views.view.MachineView`."""

    name = "full-spectrum"
    title = "Full spectrum"
    sentence = (
        "The whirl of the shaft's centre by frequency, in multiples of the speed: to the right what turns "
        "with the shaft (forward), to the left what turns against it (backward)."
    )
    every_s = 0.5

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        return [pairs_of(live), Choice("revolutions", "Length", REVOLUTIONS)]

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        return "" if live.probes() else NO_PAIR

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        key = live.keyphasor()
        probes = chosen["probes"].split(",")
        places = (live.place_of([*probes, key]) if key else None) or live.place_of(probes) or []
        return {one.stream for one in places}

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        del live
        made = chart(
            ChartAxis("order, multiples of the speed", -FULL_ORDERS, FULL_ORDERS),
            ChartAxis("um peak"),
            theme,
            tips=[("order", "@o{0.00}X"), ("amplitude", "@a{0.00} um")],
        )
        lines = source("full_spectrum", ["o", "a"])
        made.line("o", "a", source=lines, line_color=theme.series[0], legend_label="backward | forward")
        _cursors(made, theme)
        legend(made, theme)
        probes = chosen["probes"].replace(",", " and ")
        return [Figure("full-spectrum", f"Full spectrum of the shaft's centre by {probes}", made)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        x, y = chosen["probes"].split(",")
        seen = whirl(live, (x, y), float(chosen["revolutions"]))
        if seen is None or np.isfinite(seen.xy_um).all(axis=1).sum() < LEAST_SAMPLES:
            return Shown(note="too few samples of these probes have come")
        values = seen.xy_um[:, 0] + 1j * seen.xy_um[:, 1]
        lines = np.fft.fftshift(amplitudes(values))
        order = np.fft.fftshift(np.fft.fftfreq(len(values), 1.0 / seen.rate_hz)) / seen.speed_hz
        width = seen.rate_hz / len(values) / seen.speed_hz
        rows = []
        for one in (1.0, -1.0, 2.0, -2.0):
            near = np.abs(order - one) <= 2.0 * width
            if near.any():
                which = "forward" if one > 0 else "backward"
                rows.append((f"{abs(one):g}X {which}", f"{lines[near].max():.2f}", "um peak"))
        missing = int((~np.isfinite(values)).sum())
        note = f"{missing} of {len(values)} samples are missing, and left out" if missing else ""
        wanted = np.abs(order) <= FULL_ORDERS
        order, lines = largest(order[wanted], lines[wanted], MOST_LINES)
        return Shown({"full_spectrum": {"o": order, "a": lines}, "orders": {"x": [-1.0, 1.0]}}, rows, note)


def _cursors(made: Any, theme: Theme) -> None:
    """Where the orders are; the browser is told, for the speed changes."""
    made.vspan(x="x", source=source("orders", ["x"]), line_color=theme.series[1], line_dash="dashed")
