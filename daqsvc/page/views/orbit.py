"""The orbit of the shaft's centre: as it is, and its order 1X alone."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.page.charts import legend, source
from daqsvc.page.shaft import order_1x, whirl
from daqsvc.page.views.position import NO_PAIR, pairs_of, plane
from daqsvc.page.views.view import Choice, Figure, Shown

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive

REVOLUTIONS = {"4": "4 revolutions", "1": "1 revolution", "16": "16 revolutions"}


class OrbitView:
    """See `daqsvc.page.views.view.MachineView`."""

    name = "orbit"
    title = "Orbit"
    sentence = (
        "The path of the shaft's centre, seen along the shaft: as the probes have it, and its 1X alone. The "
        "dot is where the centre is when the keyphasor's mark passes; the circle is the clearance."
    )
    every_s = 0.1

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        return [pairs_of(live), Choice("revolutions", "Length", REVOLUTIONS)]

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        return "" if live.probes() else NO_PAIR

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        probes = chosen["probes"].split(",")
        key = live.keyphasor()
        places = (live.place_of([*probes, key]) if key else None) or live.place_of(probes) or []
        return {one.stream for one in places}

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        made = plane(live, theme, [("x", "@x{0.0} um"), ("y", "@y{0.0} um")])
        made.line(
            "x", "y", source=source("orbit", ["x", "y"]), line_color=theme.series[0], legend_label="orbit"
        )
        made.line(
            "x",
            "y",
            source=source("orbit_1x", ["x", "y"]),
            line_color=theme.series[1],
            line_width=2,
            legend_label="1X",
        )
        marks = source("orbit_marks", ["x", "y"])
        made.scatter("x", "y", source=marks, size=9, color=theme.series[0], legend_label="keyphasor")
        legend(made, theme)
        probes = chosen["probes"].replace(",", " and ")
        return [Figure("orbit", f"Orbit of the shaft's centre by {probes}, with its 1X and clearance", made)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        x, y = chosen["probes"].split(",")
        seen = whirl(live, (x, y), float(chosen["revolutions"]))
        if seen is None:
            return Shown(note="no samples of these probes have come yet")
        sources = {"orbit": {"x": seen.xy_um[:, 0], "y": seen.xy_um[:, 1]}}
        index = np.arange(len(seen.xy_um))
        sources["orbit_marks"] = {
            axis: np.interp(seen.marks, index, seen.xy_um[:, column]) for column, axis in enumerate("xy")
        }
        measured = live.measured_rpm is not None
        rows = [("speed", f"{60.0 * seen.speed_hz:.1f}", "rpm" if measured else "rpm nominal")]
        if (order := order_1x(seen)) is not None:
            ellipse = order.ellipse_um()
            sources["orbit_1x"] = {"x": ellipse[:, 0], "y": ellipse[:, 1]}
            for axis, mean, vector in zip("xy", order.mean_um, order.vectors_um, strict=True):
                rows.append((f"mean {axis}", f"{mean:.1f}", "um"))
                rows.append((f"1X {axis}", f"{abs(vector):.1f}", "um peak"))
                if seen.has_keyphasor:
                    lag_deg = math.degrees(-np.angle(vector)) % 360.0
                    rows.append((f"1X {axis} behind the mark", f"{lag_deg:.0f}", "degrees"))
        there = seen.xy_um[np.isfinite(seen.xy_um).all(axis=1)]
        if not len(there):
            return Shown(note="the samples of these probes are missing")
        largest = np.hypot(*(there - there.mean(axis=0)).T).max()
        rows.append(("largest distance from the mean", f"{largest:.1f}", "um"))
        missing = len(seen.xy_um) - len(there)
        note = f"{missing} of {len(seen.xy_um)} samples are missing" if missing else ""
        return Shown(sources, rows, note)
