"""The evidence of the observers' innovations for and against each mode, over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.page.charts import ChartAxis, chart, legend, source, step_lines
from daqsvc.page.views.view import Choice, Figure, Shown

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive

    Document = dict[str, Any]

LENGTHS = {"60": "1 minute", "300": "5 minutes", "10": "10 s"}
AGAINST, LEAD = "cusum.", "lead."
LIMITS = {"cusum": "it takes to change", "cusum.back": "it takes to change back"}
"""Thresholds of a bank, by what a person reads."""


class EvidenceView:
    """See `daqsvc.page.views.view.MachineView`."""

    name = "evidence"
    title = "Innovations"
    sentence = (
        "How much better the observer of each mode predicts the samples than that of the declared one, in "
        "nats. It is the log-likelihood ratio of their innovations, summed since it began to grow. Past "
        "the dashed line the bank changes its decision."
    )
    every_s = 0.5

    def choices(self, live: MachineLive) -> list[Choice]:
        """See `daqsvc.page.views.view.MachineView.choices`."""
        detectors = {name: name for name, one in [*live.probable.items()] if _modes(one)}
        return [Choice("detector", "Detector", detectors), Choice("length", "Length", LENGTHS)]

    def why_not(self, live: MachineLive) -> str:
        """See `daqsvc.page.views.view.MachineView.why_not`."""
        if any(_modes(one) for one in [*live.probable.values()]):
            return ""
        return "no bank of observers has reported evidence yet"

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """See `daqsvc.page.views.view.MachineView.streams`."""
        del live, chosen
        return set()

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """See `daqsvc.page.views.view.MachineView.figures`."""
        detector = chosen["detector"]
        modes = _modes(live.probable[detector])
        made = chart(
            ChartAxis("time before now, s", -float(chosen["length"]), 0.0),
            ChartAxis("evidence against the declared mode, nats", 0.0),
            theme,
            tips=[
                ("time", "@t{0.0} s"),
                ("declared", "@decision"),
                *((mode, f"@m{number}{{0.0}} nats") for number, mode in enumerate(modes)),
            ],
        )
        data = source("evidence", ["t", "decision", *(f"m{number}" for number in range(len(modes)))])
        step_lines(made, data, modes, theme)
        made.hspan(y="y", source=source("limits", ["y"]), line_color=theme.quiet, line_dash="dashed")
        legend(made, theme)
        return [Figure("evidence", f"Evidence of each mode of {detector} against the declared one", made)]

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """See `daqsvc.page.views.view.MachineView.shown`."""
        detector = chosen["detector"]
        latest = live.latest[detector]
        now_ns = int(latest["monotonic_ns"])
        since_ns = now_ns - float(chosen["length"]) * NS_PER_S
        wanted = [
            one for one in [*live.statements.get(detector, ())] if one.t_ns >= since_ns and one.evidence
        ]
        columns: dict[str, Any] = {
            "t": np.array([(one.t_ns - now_ns) / NS_PER_S for one in wanted]),
            "decision": [one.decision for one in wanted],
        }
        modes = _modes(live.probable[detector])
        for number, mode in enumerate(modes):
            against = [one.evidence.get(f"{AGAINST}{mode}") for one in wanted]
            columns[f"m{number}"] = np.array([0.0 if one is None else one for one in against])
        rows = [("declared", str(latest["decision"]), "")]
        for mode in modes:
            for name, words in ((AGAINST, "for {} against it"), (LEAD, "it leads {} by")):
                nats = latest["evidence"].get(f"{name}{mode}")
                if nats is not None:
                    rows.append((words.format(mode), f"{nats:.1f}", "nats"))
        limits = {words: latest["thresholds"].get(name) for name, words in LIMITS.items()}
        rows += [(words, f"{nats:.3g}", "nats") for words, nats in limits.items() if nats is not None]
        levels = [nats for nats in limits.values() if nats is not None]
        return Shown({"evidence": columns, "limits": {"y": levels}}, rows, latest["reason"])


def _modes(statement: Document) -> list[str]:
    """The modes of a bank of observers that has reported evidence."""
    is_bank = any(name.startswith((AGAINST, LEAD)) for name in statement["evidence"])
    return [*statement["probabilities"]] if is_bank else []
