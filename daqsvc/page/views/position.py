"""Where the shaft is: its centre on average over minutes, and where it is once a revolution."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.dsp.probes import probes_to_xy, shaft_axes_deg
from daqsvc.page.charts import ChartAxis, chart, legend, source
from daqsvc.page.shaft import UM, whirl
from daqsvc.page.views.view import Choice, Figure, Shown

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive

MINUTES = {"10": "10 minutes", "1": "1 minute", "60": "1 hour"}
REVOLUTIONS = {"100": "100 revolutions", "20": "20 revolutions", "200": "200 revolutions"}
LARGER = 1.15
NO_PAIR = "it needs two proximity probes of one plane, 60 to 120 degrees apart, sampled together"
SAME_NS = NS_PER_S // 2
"""Means of two probes that are so close in time belong together."""


def pairs_of(live: MachineLive) -> Choice:
    """The pairs of probes that can be chosen."""
    return Choice("probes", "Probes", {f"{x},{y}": f"{x} and {y}" for x, y in live.probes()})


def plane(live: MachineLive, theme: Theme, tips: list[tuple[str, str]]) -> Any:
    """The plane of the probes with the circle of the clearance, if that is known."""
    clearance_um = float(live.values["machine"].get("rotor", {}).get("clearance_um", 0.0))
    reach = LARGER * clearance_um if clearance_um else None
    low = None if reach is None else -reach
    made = chart(
        ChartAxis("x, um", low, reach),
        ChartAxis("y, um", low, reach),
        theme,
        height=520,
        tips=tips,
        is_round=True,
    )
    if clearance_um:
        turn = np.linspace(0.0, 2.0 * math.pi, 181)
        made.line(
            clearance_um * np.cos(turn),
            clearance_um * np.sin(turn),
            line_color=theme.quiet,
            line_dash="dashed",
            legend_label=f"clearance {clearance_um:g} um",
        )
    return made


class CentrelineView:
    """See `daqsvc.page.views.view.MachineView`."""

    name = "centreline"
    title = "Shaft centreline"
    sentence = (
        "Where the shaft's centre is on average, over the last minutes: a bearing that wears or a load that "
        "comes on moves it. The dot is where it is now."
    )
    every_s = 1.0

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        return [pairs_of(live), Choice("minutes", "Over", MINUTES)]

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        if not live.probes():
            return NO_PAIR
        if all(f"levels/{name}" in live.latest for name in live.probes()[0]):
            return ""
        return "it needs the means of the probes: write [pipeline.levels] into the machine file"

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        del live, chosen
        return set()

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        made = plane(live, theme, [("x", "@x{0.0} um"), ("y", "@y{0.0} um"), ("time", "@t{0.0} min")])
        path = source("centreline", ["x", "y", "t"])
        made.line("x", "y", source=path, line_color=theme.series[0], legend_label="centre")
        now = source("centre_now", ["x", "y"])
        made.scatter("x", "y", source=now, size=9, color=theme.series[1], legend_label="now")
        legend(made, theme)
        probes = chosen["probes"].replace(",", " and ")
        return [Figure("centreline", f"Mean position of the shaft's centre by {probes}", made)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        probes = chosen["probes"].split(",")
        t_ns, along = _means(live, (probes[0], probes[1]))
        if not len(t_ns):
            return Shown(note="there are no mean values of these probes yet")
        wanted = t_ns >= t_ns[-1] - float(chosen["minutes"]) * 60.0 * NS_PER_S
        sensors = [live.sensors[name] for name in probes]
        angles = (sensors[0].angle_deg or 0.0, sensors[1].angle_deg or 0.0)
        axes = shaft_axes_deg(angles, clockwise=live.turns_clockwise)
        xy = (along * [UM.get(one.unit, 1.0) for one in sensors])[wanted] @ probes_to_xy(axes)
        t_min = (t_ns[wanted] - t_ns[-1]) / (60.0 * NS_PER_S)
        x, y = xy[-1]
        rows = [("x now", f"{x:.1f}", "um"), ("y now", f"{y:.1f}", "um")]
        rows.append(("moved since the first", f"{np.hypot(*(xy[-1] - xy[0])):.1f}", "um"))
        path = {"x": xy[:, 0], "y": xy[:, 1], "t": t_min}
        return Shown({"centreline": path, "centre_now": {"x": [x], "y": [y]}}, rows)


class PoincareView:
    """See `daqsvc.page.views.view.MachineView`."""

    name = "poincare"
    title = "Poincare map"
    sentence = (
        "Where the shaft's centre is each time the keyphasor's mark passes. One cloud is a whirl that is the "
        "same each revolution; two or more are subharmonics, a curve or dust a rub."
    )
    every_s = 0.5

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        return [pairs_of(live), Choice("revolutions", "Length", REVOLUTIONS)]

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        if not live.probes():
            return NO_PAIR
        key = live.keyphasor()
        together = key is not None and live.place_of([*live.probes()[0], key]) is not None
        return "" if together else "it needs a keyphasor that is sampled together with the probes"

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        key = live.keyphasor()
        places = live.place_of([*chosen["probes"].split(","), *([key] if key else [])]) or []
        return {one.stream for one in places}

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        made = plane(live, theme, [("x", "@x{0.0} um"), ("y", "@y{0.0} um")])
        marks = source("poincare", ["x", "y"])
        made.scatter(
            "x", "y", source=marks, size=5, color=theme.series[0], alpha=0.7, legend_label="once a turn"
        )
        legend(made, theme)
        probes = chosen["probes"].replace(",", " and ")
        return [Figure("poincare", f"Position of the shaft's centre once a revolution by {probes}", made)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        x, y = chosen["probes"].split(",")
        seen = whirl(live, (x, y), float(chosen["revolutions"]))
        if seen is None or not seen.has_keyphasor:
            return Shown(note="no mark of the keyphasor has come yet")
        index = np.arange(len(seen.xy_um))
        at = np.column_stack([np.interp(seen.marks, index, seen.xy_um[:, column]) for column in (0, 1)])
        at = at[np.isfinite(at).all(axis=1)]
        if not len(at):
            return Shown(note="the samples of these probes are missing")
        x_rms, y_rms = at.std(axis=0)
        rows = [
            ("revolutions", f"{len(at)}", ""),
            ("spread of x", f"{x_rms:.1f}", "um r.m.s."),
            ("spread of y", f"{y_rms:.1f}", "um r.m.s."),
        ]
        wanted = round(float(chosen["revolutions"]))
        note = f"{wanted} revolutions are asked for, and {len(at)} are there" if len(at) < wanted - 1 else ""
        return Shown({"poincare": {"x": at[:, 0], "y": at[:, 1]}}, rows, note)


def _means(live: MachineLive, probes: tuple[str, str]) -> tuple[Any, Any]:
    """When, ns ``[n]``, and the means of both probes in their units ``[n, 2]``, as they were sent."""
    means = [
        [
            (one.t_ns, one.statistics["mean"])
            for one in [*live.statements.get(f"levels/{name}", ())]
            if "mean" in one.statistics
        ]
        for name in probes
    ]
    first, second = (np.array(one, np.float64).reshape(-1, 2) for one in means)
    if not len(first) or not len(second):
        return np.empty(0), np.empty((0, 2))
    near = np.searchsorted(second[:, 0], first[:, 0]).clip(0, len(second) - 1)
    together = np.abs(second[near, 0] - first[:, 0]) <= SAME_NS
    return first[together, 0], np.column_stack([first[together, 1], second[near[together], 1]])
