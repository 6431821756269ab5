"""Spectra: of one sensor, and of the shaft's centre forward and backward."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.dsp.quality.unit import M_S2_PER_UNIT
from daqsvc.page.bearing_lines import bearing_lines
from daqsvc.page.charts import ChartAxis, chart, legend, source
from daqsvc.page.lines import amplitudes, largest, one_sided, size_of
from daqsvc.page.shaft import whirl
from daqsvc.page.views.position import NO_PAIR, pairs_of
from daqsvc.page.views.view import NO_WAVEFORM, Choice, Figure, Shown
from daqsvc.rounding import readable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive

LENGTHS = {"2": "2 s", "0.5": "0.5 s", "10": "10 s"}
CURSORS: dict[str, tuple[float, ...]] = {
    "1X to 3X": (1.0, 2.0, 3.0),
    "1X to 10X": tuple(map(float, range(1, 11))),
    "fractions of 1X": (0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 0.75, 1.0),
}
"""Multiples of the speed that are marked, by what a person reads."""
HARMONICS = (1, 2, 3)
"""Of a line of a bearing that are marked."""
AXES = {"hz": "frequency, Hz", "order": "orders of the speed"}
SCALES = {"linear": "linear", "log": "logarithmic"}
AMPLITUDES = {"peak": ("peak", 1.0), "pp": ("peak to peak", 2.0), "rms": ("r.m.s.", 1.0 / np.sqrt(2.0))}
"""What a person reads, and how large it is of a wave with the peak 1."""
OWN = "own"
QUANTITIES = {OWN: "as measured", "velocity": "velocity, mm/s"}
INTEGRATED_FROM_HZ = 2.0
"""Below, a velocity is drift of the sensor (ISO 20816-1 begins at 2 Hz)."""
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
        "How strong each frequency is in what a sensor measures, by a Hann window. Dashed lines are "
        "multiples of the speed, or of a line of a bearing, as chosen; the cursor shows the order of a line."
    )
    every_s = 0.5

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        sensors = {name: name for name in live.waveform_sensors()}
        cursors = {name: name for name in (*CURSORS, *(name for name, _ in bearing_lines(live, "")))}
        choices = [
            Choice("sensor", "Sensor", sensors),
            Choice("length", "Length", LENGTHS),
            Choice("cursors", "Cursors", cursors),
            Choice("axis", "Axis", AXES),
            Choice("amplitude", "Amplitude", {key: words for key, (words, _) in AMPLITUDES.items()}),
            Choice("scale", "Scale", SCALES),
        ]
        if any(live.sensors[name].unit in M_S2_PER_UNIT for name in sensors):
            choices.append(Choice("quantity", "Quantity", QUANTITIES))
        return choices

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        return "" if live.waveform_sensors() else NO_WAVEFORM

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        return {one.stream for one in live.place_of([chosen["sensor"]]) or []}

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        sensor = chosen["sensor"]
        _, unit = _factor_and_unit(live, chosen)
        places = live.place_of([sensor])
        highest = live.rate_hz(places[0].stream) / 2.0 if places else 1.0
        by_order = chosen["axis"] == "order" and live.speed_rpm != 0.0
        across = (
            ChartAxis("order, multiples of the speed", 0.0, highest * 60.0 / abs(live.speed_rpm))
            if by_order
            else ChartAxis("frequency, Hz", 0.0, highest)
        )
        made = chart(
            across,
            ChartAxis(f"{sensor}, {unit}", log=chosen["scale"] == "log"),
            theme,
            tips=[("frequency", "@f{0.00} Hz"), ("order", "@o{0.00}X"), (sensor, f"@a{{0.0000}} {unit}")],
        )
        lines = source("spectrum", ["x", "f", "o", "a"])
        made.line("x", "a", source=lines, line_color=theme.series[0], legend_label=sensor)
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
        factor, unit = _factor_and_unit(live, chosen)
        lines = lines * factor
        if _is_velocity(live, chosen):
            per_s = 2.0 * np.pi * np.maximum(frequency, INTEGRATED_FROM_HZ)
            lines = np.where(frequency < INTEGRATED_FROM_HZ, 0.0, lines / per_s)
        speed_hz = abs(live.speed_rpm) / 60.0
        cursors = _cursor_orders(live, chosen["cursors"]) if speed_hz else {}
        rows = []
        for name, order in cursors.items():
            near = np.abs(frequency - order * speed_hz) <= 2.0 * rate_hz / len(values)
            if near.any():
                rows.append((f"{name} at {order * speed_hz:.2f} Hz", readable(size_of(lines[near])), unit))
        highest = int(lines[1:].argmax()) + 1
        around = lines[max(highest - 2, 1) : highest + 3]
        rows.append((f"largest at {frequency[highest]:.2f} Hz", readable(size_of(around)), unit))
        if speed_hz:
            rows.append(("that is order", f"{frequency[highest] / speed_hz:.2f}", "X"))
        overall = np.sqrt(np.sum(np.square(lines[1:] / AMPLITUDES[chosen["amplitude"]][1])) / 3.0)
        rows.append(("overall", readable(overall), f"{_unit(live, chosen)} r.m.s."))
        note = f"{missing} of {len(values)} samples are missing, and left out" if missing else ""
        frequency, lines = largest(frequency, lines, MOST_LINES)
        orders = frequency / speed_hz if speed_hz else np.full(len(frequency), np.nan)
        by_order = chosen["axis"] == "order" and speed_hz
        columns = {"x": orders if by_order else frequency, "f": frequency, "o": orders, "a": lines}
        marks = {"x": [one if by_order else one * speed_hz for one in cursors.values()]}
        return Shown({"spectrum": columns, "orders": marks}, rows, note)


def _is_velocity(live: MachineLive, chosen: Mapping[str, str]) -> bool:
    return chosen.get("quantity", OWN) != OWN and live.sensors[chosen["sensor"]].unit in M_S2_PER_UNIT


def _factor_and_unit(live: MachineLive, chosen: Mapping[str, str]) -> tuple[float, str]:
    """By what a peak amplitude of the sensor is to be multiplied, and the unit of what comes of it."""
    words, factor = AMPLITUDES[chosen["amplitude"]]
    if _is_velocity(live, chosen):
        factor *= 1000.0 * M_S2_PER_UNIT[live.sensors[chosen["sensor"]].unit]
    return factor, f"{_unit(live, chosen)} {words}"


def _unit(live: MachineLive, chosen: Mapping[str, str]) -> str:
    return "mm/s" if _is_velocity(live, chosen) else live.sensors[chosen["sensor"]].unit


def _cursor_orders(live: MachineLive, chosen: str) -> dict[str, float]:
    """The multiples of the speed that are marked, by what they are called."""
    if chosen in CURSORS:
        return {f"{order:.3g}X": order for order in CURSORS[chosen]}
    order = dict(bearing_lines(live, "")).get(chosen, 1.0)
    return {f"{number if number > 1 else ''} {chosen}".strip(): number * order for number in HARMONICS}


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
                rows.append((f"{abs(one):g}X {which}", f"{size_of(lines[near]):.2f}", "um peak"))
        missing = int((~np.isfinite(values)).sum())
        note = f"{missing} of {len(values)} samples are missing, and left out" if missing else ""
        wanted = np.abs(order) <= FULL_ORDERS
        order, lines = largest(order[wanted], lines[wanted], MOST_LINES)
        return Shown({"full_spectrum": {"o": order, "a": lines}, "orders": {"x": [-1.0, 1.0]}}, rows, note)


def _cursors(made: Any, theme: Theme) -> None:
    """Where the orders are; for the browser, as the speed changes."""
    made.vspan(x="x", source=source("orders", ["x"]), line_color=theme.series[1], line_dash="dashed")
