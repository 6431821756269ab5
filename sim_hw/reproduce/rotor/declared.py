"""What the paper says about the probabilities of the modes, and what either rule declares."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.decision import DecisionRules
from sim_hw.reproduce.results import ResultRow
from sim_hw.reproduce.rotor.detection import delays_rev, wrong_changes
from sim_hw.reproduce.rotor.setup import MODES, SNR_DB, in_decibels, spoken

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from daqsvc.rotor.decision import Rule
    from sim_hw.reproduce.rotor.experiment import RotorExperiment

THRESHOLD = DecisionRules().probability_threshold
_NONE_SEEN = 3.0
"""Events that may be expected where none is seen, with 95 % confidence."""


def rows(experiment: RotorExperiment) -> Iterable[ResultRow]:
    """This part of the table."""
    yield from _declarations(experiment)
    yield from _order(experiment)
    yield from _delays(experiment)
    yield from _wrong(experiment)


def _declarations(experiment: RotorExperiment) -> Iterable[ResultRow]:
    declared = experiment.trace.declared
    at = np.flatnonzero(declared >= 0)
    per_rev = len(at) / experiment.end_rev
    reset = 1.0 / len(MODES)
    yield ResultRow(
        name="saw-tooth",
        figure="6, 7",
        paper=f"at a declaration all probabilities are reset to {reset:g}",
        obtained=f"saw-teeth: {per_rev:.2f} declarations per revolution, each followed by {reset:g} in all",
        agrees=bool(np.allclose(experiment.trace.probabilities[at], reset)) and per_rev > 1.0,
        remark=f"at {in_decibels(experiment.snr_db)}. At a declaration all observers take over its estimate.",
        values={"declarations_per_rev": per_rev},
    )
    shares = {}
    for i, mode in enumerate(MODES):
        inside = declared[experiment.samples_of(mode)]
        shares[mode] = float((inside[inside >= 0] == i).mean()) if (inside >= 0).any() else 0.0
    yield ResultRow(
        name="declared-rightly",
        figure="6, 7",
        paper=f"a mode is detected when its probability exceeds {THRESHOLD:g}",
        obtained="declarations that name the true mode: "
        + ", ".join(f"{spoken(mode)} {100 * share:.0f} %" for mode, share in shares.items()),
        agrees=min(shares.values()) > THRESHOLD,
        remark=f"a probability of {THRESHOLD:g} is an error of up to one in ten by itself, and the "
        "observers' models are not exact.",
        values={f"right_share_{mode}": share for mode, share in shares.items()},
    )


_SPOKEN_RULES: dict[Rule, str] = {
    "paper": f"the paper's rule ({THRESHOLD:g}, reset, hand-over)",
    "cusum": "this service's rule (CUSUM of log-likelihood ratios)",
}


def _order(experiment: RotorExperiment) -> Iterable[ResultRow]:
    """When each mode was first declared rightly in the run that is shown."""
    for rule, spoken_rule in _SPOKEN_RULES.items():
        changes = experiment.shown[rule].changes
        delays = delays_rev(changes, experiment.begins_rev, experiment.end_rev)
        all_declared = bool(np.isfinite(delays).all())
        only = [mode for _, mode in changes] == list(range(len(MODES)))
        at = [
            f"{spoken(mode)} "
            + (f"{2.0 * math.pi * (begin + delay):.0f} s" if math.isfinite(delay) else "never")
            for mode, begin, delay in zip(MODES, experiment.begins_rev, delays.tolist(), strict=True)
        ]
        yield ResultRow(
            name=f"order-{rule}",
            figure="6, 7",
            paper="N, F1, F1 L2 and F1 L3 are detected one after the other" if rule == "paper" else "",
            obtained=f"{spoken_rule}: first declared rightly at t = {', '.join(at)}; "
            + ("nothing else is declared" if only else f"{len(changes)} changes of the declared mode in all"),
            agrees=all_declared if rule == "paper" else None,
            remark=f"the run of the figures, {in_decibels(experiment.snr_db)}.",
            values={
                "changes": len(changes),
                **{
                    f"delay_rev_{m}": d
                    for m, d in zip(MODES, delays.tolist(), strict=True)
                    if math.isfinite(d)
                },
            },
        )


def _delays(experiment: RotorExperiment) -> Iterable[ResultRow]:
    for rule, spoken_rule in _SPOKEN_RULES.items():
        medians, reached = {}, []
        for snr_db in SNR_DB:
            runs = experiment.statistics[rule, snr_db]
            delays = [delays_rev(run.changes, experiment.begins_rev, experiment.end_rev)[1:] for run in runs]
            medians[snr_db] = np.median(delays, axis=0).tolist()
            reached.append(float(np.isfinite(delays).mean()))
        draws = len(experiment.statistics[rule, SNR_DB[0]])
        yield ResultRow(
            name=f"delays-{rule}",
            figure="6, 7",
            paper="the signal has -5 to 5 dB" if rule == "paper" else "",
            obtained=f"{spoken_rule}: median delay of F1 / F1 L2 / F1 L3 in revolutions "
            + "; ".join(
                f"{in_decibels(snr_db)}: " + " / ".join(f"{delay:.2f}" for delay in medians[snr_db])
                for snr_db in SNR_DB
            )
            + f"; found in {100 * min(reached):.1f} % of the changes",
            agrees=min(reached) > 0.99 if rule == "paper" else None,
            remark=f"{draws} draws of the sensor noise each, relative to the AC power of a probe in mode N."
            + (" Soon, but see the wrong ones." if rule == "paper" else ""),
            values={
                f"median_delay_rev_{mode}_{snr_db:+g}dB": delay
                for snr_db in SNR_DB
                for mode, delay in zip(MODES[1:], medians[snr_db], strict=True)
                if math.isfinite(delay)
            },
        )


def _wrong(experiment: RotorExperiment) -> Iterable[ResultRow]:
    for rule, spoken_rule in _SPOKEN_RULES.items():
        per_1000_rev = {}
        for snr_db in SNR_DB:
            runs = experiment.statistics[rule, snr_db]
            total = sum(wrong_changes(run.changes, experiment.begins_rev) for run in runs)
            watched = len(runs) * experiment.end_rev
            per_1000_rev[snr_db] = 1000.0 * total / watched
        yield ResultRow(
            name=f"wrong-{rule}",
            figure="6, 7",
            paper="",
            obtained=f"{spoken_rule}: wrong changes of the declared mode per 1000 rev "
            + "; ".join(f"{in_decibels(snr_db)}: {rate:.3g}" for snr_db, rate in per_1000_rev.items()),
            agrees=None,
            remark=_about_wrong(rule, per_1000_rev, watched),
            values={f"wrong_per_1000_rev_{snr_db:+g}dB": rate for snr_db, rate in per_1000_rev.items()},
        )


def _about_wrong(rule: Rule, per_1000_rev: Mapping[float, float], watched_rev: float) -> str:
    if rule == "paper":
        more = per_1000_rev[max(per_1000_rev)] > per_1000_rev[min(per_1000_rev)]
        return (
            "more of them the better the signal, since each declaration has its chance of being wrong; "
            if more
            else ""
        ) + "shown as probabilities, never an alarm."
    limit = 1000.0 * _NONE_SEEN / watched_rev
    return f"{watched_rev:,.0f} rev at each ratio: none seen means less than {limit:.2f} (95 % confidence)."
