"""The probabilities of the modes over time, and what the detectors find."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.page.charts import ChartAxis, chart, legend, source, step_lines
from daqsvc.page.earlier import probabilities_before
from daqsvc.page.views.view import Choice, Figure, Shown

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive

LENGTHS = {"60": "1 minute", "300": "5 minutes", "10": "10 s"}


class ModesView:
    """See `daqsvc.page.views.view.MachineView`."""

    name = "modes"
    title = "Probabilities"
    sentence = (
        "How probable each condition of the machine is by what the detector has seen so far, from 0 to 1. "
        "N is the machine as it should be; the others are its faults."
    )
    every_s = 0.5

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        detectors = {name: name for name in [*live.probable]}
        return [Choice("detector", "Detector", detectors), Choice("length", "Length", LENGTHS)]

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        return "" if live.probable else "no detector of this machine has stated probabilities yet"

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        del live, chosen
        return set()

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        detector = chosen["detector"]
        modes = list(live.probable[detector]["probabilities"])
        made = chart(
            ChartAxis("time before now, s", -float(chosen["length"]), 0.0),
            ChartAxis("probability", -0.02, 1.02),
            theme,
            tips=[
                ("time", "@t{0.0} s"),
                *((mode, f"@m{number}{{0.000}}") for number, mode in enumerate(modes)),
            ],
        )
        columns = ["t", *(f"m{number}" for number in range(len(modes)))]
        data = source("modes", columns)
        step_lines(made, data, modes, theme)
        legend(made, theme)
        return [Figure("modes", f"Probabilities of the modes of {detector} over time", made)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        detector = chosen["detector"]
        statements = [*live.statements.get(detector, ())]
        latest = live.latest[detector]
        now_ns = int(latest["monotonic_ns"])
        since_ns = now_ns - float(chosen["length"]) * NS_PER_S
        modes = list(live.probable[detector]["probabilities"])
        wanted = [one for one in statements if one.probabilities]
        first_ns = min((one.t_ns for one in wanted), default=now_ns)
        if detector not in live.earlier:
            live.earlier[detector] = probabilities_before(live, detector, modes, first_ns)
        earlier = live.earlier[detector]
        t_ns = np.append(earlier.t_ns, np.array([one.t_ns for one in wanted], np.int64))
        lately = np.array(
            [[one.probabilities.get(mode, np.nan) for mode in modes] for one in wanted], np.float64
        )
        values = np.concatenate([earlier.values, lately.reshape(-1, len(modes))])
        shown = t_ns >= since_ns
        columns = {"t": (t_ns[shown] - now_ns) / NS_PER_S}
        columns |= {f"m{number}": values[shown, number] for number in range(len(modes))}
        rows = [(f"p({mode})", in_words(p), "") for mode, p in latest["probabilities"].items()]
        rows.append(("decides", latest["decision"], ""))
        if len(latest["group"]) > 1:
            rows.append(("not told apart", ", ".join(latest["group"]), ""))
        return Shown({"modes": columns}, rows, latest["reason"])


def in_words(probability: float | None) -> str:
    """A probability as a person reads it."""
    if probability is None:
        return "not known"
    if probability > 0.999:
        return "> 0.999"
    return "< 0.001" if probability < 0.001 else f"{probability:.3f}"
