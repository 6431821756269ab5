"""The paper's statements about the rotor, each beside the result of the experiment."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.decision import DecisionRules
from sim_hw.reproduce.results import ResultRow
from sim_hw.reproduce.rotor import motion
from sim_hw.reproduce.rotor.experiment import (
    CONVERGENCE,
    DAMPING,
    MODE_DURATION,
    MODES,
    PAPER_REVOLUTIONS,
    RUB_REVOLUTIONS,
    SAMPLES_PER_REV,
    SNR_DB,
    delays_rev,
    in_decibels,
    plant,
    spoken,
    wrong_changes,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from numpy.typing import NDArray

    from daqsvc.rotor.decision import Rule
    from sim_hw.reproduce.rotor.experiment import RotorExperiment

    Floats = NDArray[np.float64]


_SETTLED_REV = 13.0
"""Revolutions after an onset that a linear mode is given to settle: F1 L2 forgets 99 % in this time."""
_CONVERGED_REV = 20.0
_ACCURATE = 0.25
"""An error of this share of the orbit is still a picture of it."""
_CONVERGING = 0.75
"""The error converges when its RMS over a revolution first falls below this share of that in F1 L2."""
_CONVERGENCE_TOLERANCE = 10.0
"""Normalised time; the paper's figure is read off a picture."""
_PERIODIC = 1e-2
_NOT_CHAOTIC_PER_REV = 5e-3


def rows(experiment: RotorExperiment) -> tuple[ResultRow, ...]:
    """The table, in the order of the paper."""
    makers: tuple[Callable[[RotorExperiment], Iterable[ResultRow]], ...] = (
        _model,
        _schedule,
        _linear_motion,
        _rub,
        _observers,
        _convergence,
        _detection_rows,
    )
    return tuple(itertools.chain.from_iterable(make(experiment) for make in makers))


def _model(experiment: RotorExperiment) -> Iterable[ResultRow]:
    yield ResultRow(
        name="printed-sign",
        figure="II",
        paper="x' = Ax + Bu + gamma f(Cx): the contact force enters with a plus",
        obtained=f"{experiment.escape_rev:.2f} rev after the first contact the disc is two clearances out",
        agrees=False,
        remark="f points outwards: the printed sign pulls the disc through the housing. Everything below has "
        "a minus there, and friction that opposes the sliding of the rim.",
        values={"escape_rev": experiment.escape_rev},
    )


def _schedule(experiment: RotorExperiment) -> Iterable[ResultRow]:
    per_rev = 2.0 * math.pi / plant("N").speed_ratio
    revolutions = MODE_DURATION / per_rev
    yield ResultRow(
        name="schedule",
        figure="V",
        paper=f"N, F1 and F1 L2 last {MODE_DURATION:g} s, i.e. {PAPER_REVOLUTIONS} revolutions; "
        f"F1 L3 lasts {RUB_REVOLUTIONS}",
        obtained=f"{MODE_DURATION:g} s are {revolutions:.2f} revolutions at w = 1",
        agrees=round(revolutions) == PAPER_REVOLUTIONS,
        remark=f"{MODE_DURATION:g} s each are used: F1 L3 then begins at {3 * MODE_DURATION:g} s, which "
        f"fits the convergence at {CONVERGENCE:g} s; {PAPER_REVOLUTIONS} revolutions each would make it "
        f"{3 * PAPER_REVOLUTIONS * per_rev:.0f} s. The run ends at {experiment.end_rev * per_rev:.0f} s.",
        values={"revolutions_per_mode": revolutions},
    )


def _linear_motion(experiment: RotorExperiment) -> Iterable[ResultRow]:
    z = experiment.x + 1j * experiment.y
    for mode in MODES[:-1]:
        part = z[experiment.samples_of(mode, settled_rev=0.0 if mode == "N" else _SETTLED_REV)]
        section = part[::SAMPLES_PER_REV]
        spread = motion.spread(section)
        centred = part - plant(mode).rest
        amplitude = float(np.abs(centred).mean())
        largest = float(experiment.radius[experiment.samples_of(mode)].max())
        whirl = motion.whirl_per_rev(centred, SAMPLES_PER_REV)
        yield ResultRow(
            name=f"motion-{mode}",
            figure="4" if mode == "N" else "V",
            paper="small-amplitude linear orbital motion" if mode == "N" else "no rub before F1 L3",
            obtained=f"period one (Poincare points within {spread:.1g}), forward whirl at {whirl:+.3f} per "
            f"rev, radius {amplitude:.3f}, at most {largest:.3f} from the centre",
            agrees=spread < _PERIODIC and whirl > 0.0 and largest < 1.0,
            remark=f"theory: radius e / (2 zeta) = {abs(plant(mode).orbit_1x):.3f} about the sagging shaft; "
            "lengths in clearances.",
            values={
                "poincare_spread": spread,
                "whirl_per_rev": whirl,
                "orbit_radius": amplitude,
                "largest_radius": largest,
            },
        )


def _rub(experiment: RotorExperiment) -> Iterable[ResultRow]:
    part = experiment.samples_of("F1L3")
    onset = experiment.begins_rev[-1]
    first = int(np.flatnonzero(experiment.radius > 1.0)[0])
    contact, contact_tau = first / SAMPLES_PER_REV - onset, float(experiment.tau[first])
    limit = motion.rub_limit(plant("N"))
    largest = float(experiment.radius[part].max())
    yield ResultRow(
        name="rub-begins",
        figure="5",
        paper=f"when the damping falls to {DAMPING['F1L3']:g}, rubbing begins",
        obtained=f"first contact {contact:.2f} rev after the onset, at t = {contact_tau:.1f} s; "
        f"at most {largest:.3f} clearances from the centre",
        agrees=first >= part.start,
        remark=f"the orbit reaches the housing below zeta = {limit:.4f}, whatever its stiffness: "
        f"between F1 L2 ({DAMPING['F1L2']:g}) and F1 L3.",
        values={
            "first_contact_rev": contact,
            "first_contact_s": contact_tau,
            "largest_radius": largest,
            "damping_limit": limit,
        },
    )
    settled = experiment.settled
    drifts = settled.drift > 0.5 * settled.periods
    yield ResultRow(
        name="quasi-periodic",
        figure="5",
        paper="quasi-periodic motion ensues",
        obtained=f"never repeats: comes nearest to it after {settled.return_rev} rev, misses by "
        f"{settled.return_miss:.1g}, and after {settled.periods} times as long by {settled.drift:.1f} times "
        f"as much; a small displacement grows by exp({settled.growth_per_rev:.0e}) per rev",
        agrees=drifts and abs(settled.growth_per_rev) < _NOT_CHAOTIC_PER_REV,
        remark=f"over {settled.revolutions} rev after the transient. A periodic motion would come back, a "
        "chaotic one would let a displacement grow.",
        values={
            "return_rev": settled.return_rev,
            "return_miss": settled.return_miss,
            "drift_ratio": settled.drift,
            "drift_periods": settled.periods,
            "growth_per_rev": settled.growth_per_rev,
        },
    )
    loop_rev = 1.0 / abs(settled.rotation_per_rev)
    yield ResultRow(
        name="poincare-rub",
        figure="5",
        paper="(Poincare map: a picture)",
        obtained=f"a closed curve, once round in {loop_rev:.2f} rev; later points lie within "
        f"{settled.curve_residual:.1g} rms of the curve through the earlier ones",
        agrees=None,
        remark="a point for a periodic motion, a curve for two frequencies, a cloud for chaos.",
        values={"loop_rev": loop_rev, "curve_residual": settled.curve_residual},
    )
    yield ResultRow(
        name="whirl-rub",
        figure="5",
        paper="",
        obtained=f"backward whirl at {settled.whirl_per_rev:+.3f} per rev beating with the forward 1X, "
        f"at most {settled.largest_radius:.3f} clearances from the centre",
        agrees=None,
        remark="friction at the housing drives the disc against its rotation.",
        values={"whirl_per_rev": settled.whirl_per_rev, "largest_radius": settled.largest_radius},
    )


def _rms(error: Floats) -> float:
    """RMS of a vector's length over time."""
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def _rms_over_rev(error: Floats) -> Floats:
    """RMS of a vector's length over the revolution up to each sample; shorter at the start."""
    total = np.cumsum((error**2).sum(axis=1))
    mean = total.copy()
    mean[SAMPLES_PER_REV:] = total[SAMPLES_PER_REV:] - total[:-SAMPLES_PER_REV]
    return np.sqrt(mean / np.minimum(np.arange(1, len(total) + 1), SAMPLES_PER_REV))


def _observers(experiment: RotorExperiment) -> Iterable[ResultRow]:
    noise = math.sqrt(2.0) * experiment.noise
    error = experiment.error("N")
    settled = _rms(error[experiment.samples_of("N", settled_rev=_SETTLED_REV)])
    over_rev = _rms_over_rev(error[experiment.samples_of("N")])
    late = float(np.flatnonzero(over_rev > 0.1 * abs(plant("N").orbit_1x))[-1] + 1) / SAMPLES_PER_REV
    yield ResultRow(
        name="observer-N",
        figure="4",
        paper="the performance of the Kalman filters in the linear regime is evident",
        obtained=f"from a disc at rest in the centre the error falls to a tenth of the orbit in {late:.1f} "
        f"rev, and to {settled:.4f} rms for a noise of {noise:.3f} rms",
        agrees=settled < 0.1 * noise,
        remark=f"{in_decibels(experiment.snr_db)}; errors and noise are rms of (x, y) in clearances.",
        values={"converged_rev": late, "error_rms": settled, "noise_rms": noise},
    )
    part = experiment.samples_of("F1L3", settled_rev=_CONVERGED_REV)
    rub = _rms(experiment.error("F1L3")[part])
    size = _rms(np.column_stack((experiment.x, experiment.y))[part])
    whirl = experiment.whirl_of_observer
    inwards = _inwards_in_contact(experiment, part)
    yield ResultRow(
        name="observer-F1L3",
        figure="5",
        paper="the nonlinear observers accurately reconstruct orbit, Poincare map and phase plot in spite of "
        "noise and mismatch (alpha 1.0 for 1.5, mu 0.1 for 0.3)",
        obtained=f"error {rub:.3f} rms for an orbit of {size:.3f} and a noise of {noise:.3f} rms: "
        f"{100 * rub / size:.0f} % of the orbit; in contact the estimate is {inwards:.3f} further in",
        agrees=rub < _ACCURATE * size,
        remark=f"the observer's own rotor, left to itself, whirls at {whirl:+.2f} per rev and the process at "
        f"{experiment.settled.whirl_per_rev:+.2f}: "
        + (
            "only its gain keeps it with the process."
            if whirl * experiment.settled.whirl_per_rev < 0.0
            else "both the same way."
        ),
        values={
            "error_rms": rub,
            "orbit_rms": size,
            "noise_rms": noise,
            "whirl_of_observer_per_rev": whirl,
            "inwards_in_contact": inwards,
        },
    )


def _inwards_in_contact(experiment: RotorExperiment, part: slice) -> float:
    """How much less than the true radius the F1 L3 observer expects while the disc touches, on average."""
    estimates = experiment.estimates["F1L3"]
    true, expected = experiment.radius[part], np.hypot(estimates.x, estimates.y)[part]
    return float((true - expected)[true > 1.0].mean())


@dataclass(frozen=True, slots=True)
class Convergence:
    """When the F1 L3 observer begins to track the process.

    Attributes:
        begins: normalised time at which its error first falls below ``level``.
        before: RMS error in F1 L2, in clearances.
        after: RMS error in F1 L3 once it has settled.
        level: the error that counts as converging.
    """

    begins: float
    before: float
    after: float
    level: float


def convergence(experiment: RotorExperiment) -> Convergence:
    """When the error of the F1 L3 observer begins to converge; infinite if it does not."""
    error = experiment.error("F1L3")
    over_rev = _rms_over_rev(error)
    before = _rms(error[experiment.samples_of("F1L2", settled_rev=_SETTLED_REV)])
    level = _CONVERGING * before
    onset = experiment.samples_of("F1L3").start
    below = np.flatnonzero(over_rev[onset:] < level)
    return Convergence(
        begins=float(experiment.tau[onset + below[0]]) if len(below) else math.inf,
        before=before,
        after=_rms(error[experiment.samples_of("F1L3", settled_rev=_CONVERGED_REV)]),
        level=level,
    )


def _convergence(experiment: RotorExperiment) -> Iterable[ResultRow]:
    converging = convergence(experiment)
    converges = math.isfinite(converging.begins)
    yield ResultRow(
        name="convergence",
        figure="5",
        paper=f"the F1 L3 observer error begins to converge at t = {CONVERGENCE:g} s",
        obtained=(f"at t = {converging.begins:.0f} s; " if converges else "it does not; ")
        + f"from {converging.before:.2f} rms in F1 L2 to {converging.after:.2f} rms",
        agrees=abs(converging.begins - CONVERGENCE) <= _CONVERGENCE_TOLERANCE
        and converging.after < _CONVERGING * converging.before,
        remark=f"begins: RMS over a revolution below {100 * _CONVERGING:.0f} % of that in F1 L2, for "
        "the first time. The paper gives no gain; this one trusts its model.",
        values={
            **({"begins_s": converging.begins} if converges else {}),
            "error_before": converging.before,
            "error_after": converging.after,
        },
    )


THRESHOLD = DecisionRules().probability_threshold
_NONE_SEEN = 3.0
"""Events that may be expected where none is seen, with 95 % confidence."""


def _detection_rows(experiment: RotorExperiment) -> Iterable[ResultRow]:
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
