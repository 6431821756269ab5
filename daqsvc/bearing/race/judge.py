"""The race test of one record: from samples to a verdict.

A pure function: significance (`null`) and size (`depth`) of the kinematic lines of each part, in the envelope
of the whitened signal. Significance alone is not enough: bearings in good order modulate too, faintly and
very regularly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft

from daqsvc.bearing.race.baseline import TOP_SHARE, BandLevels, RaceBaseline, band_levels
from daqsvc.bearing.race.combs import TEETH, best_comb, fundamental, highest_order, part_lines
from daqsvc.bearing.race.decision import decide, weight_of
from daqsvc.bearing.race.depth import ModulationDepth, sharpest
from daqsvc.bearing.race.lines import NOTCHED_HARMONICS, LineEvidence, line_evidence
from daqsvc.bearing.race.null import false_alarm_probability, significance
from daqsvc.bearing.race.quality import checked
from daqsvc.bearing.race.rules import RaceRules
from daqsvc.bearing.race.speed import shaft_rate
from daqsvc.bearing.race.verdict import (
    PARTS,
    EnvelopeSpectrum,
    Part,
    PartEvidence,
    RaceLine,
    RaceVerdict,
)
from daqsvc.dsp.envelope import line_power, squared_envelope, whiten

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders

    Real = NDArray[np.float64]
    Envelope = NDArray[np.float32]

LOG_OFFSET = np.float32(1e-3)
"""Keeps the logarithm of the envelope from following its zeros."""
SHARPEN_SHARE = 0.01
LEAST_LINE_NATS = 3.0


@dataclass(frozen=True, slots=True)
class RaceFeatures:
    """What is measured before anything is decided.

    Attributes:
        evidence: of each part.
        lines: kinematic lines found, strongest first.
        levels: mean square in octave bands.
        speed_rpm: of the shaft, as its harmonics show it.
        speed_seen: whether they stood out.
        revolutions: of the shaft in the record.
        spectrum: envelope spectrum, for figures.
    """

    evidence: Mapping[Part, PartEvidence]
    lines: tuple[RaceLine, ...]
    levels: BandLevels
    speed_rpm: float
    speed_seen: bool
    revolutions: float
    spectrum: EnvelopeSpectrum


@dataclass(frozen=True, slots=True)
class _Envelope:
    """One non-linearity's view: evidence by the phases alone, sizes by clipped amplitudes."""

    lines: LineEvidence
    depth: ModulationDepth
    power: Real


def race_test(
    samples: NDArray[np.floating],
    rate_hz: float,
    speed_rpm: float,
    bearing: BearingOrders,
    rules: RaceRules | None = None,
    baseline: RaceBaseline | None = None,
) -> RaceVerdict:
    """Say which part of a bearing is damaged, if any.

    Args:
        samples: ``[n]``, acceleration of the bearing's housing in any unit; 2.5 s or more for the races,
            10 s for a ball.
        rate_hz: their sample rate.
        speed_rpm: speed of the shaft, right to about 1 %.
        bearing: its fault orders.
        rules: settings of the test.
        baseline: of the same machine in good order, by `race_baseline`; it makes ``"changed"`` possible.

    Raises:
        RaceInputError: no verdict can rest on these samples.
    """
    rules = rules or RaceRules()
    return verdict_of(race_features(samples, rate_hz, speed_rpm, bearing, rules), rules, baseline)


def race_baseline(
    samples: NDArray[np.floating],
    rate_hz: float,
    speed_rpm: float,
    bearing: BearingOrders,
    rules: RaceRules | None = None,
) -> RaceBaseline:
    """Remember a bearing in good order; arguments and errors as of `race_test`."""
    features = race_features(samples, rate_hz, speed_rpm, bearing, rules or RaceRules())
    return RaceBaseline(features.evidence, features.levels, features.speed_rpm)


def verdict_of(features: RaceFeatures, rules: RaceRules, baseline: RaceBaseline | None) -> RaceVerdict:
    """Decide on features."""
    change_db = None if baseline is None else features.levels.change_db(baseline.levels)
    decision = decide(features.evidence, rules, baseline, change_db)
    evidence = features.evidence
    notes = [f"{part} not testable here: {e.reason}" for part, e in evidence.items() if not e.testable]
    if not features.speed_seen:
        notes.append("no harmonics of the shaft stand out; the stated speed was taken as it is")
    return RaceVerdict(
        verdict=decision.verdict,
        group=decision.group,
        evidence=features.evidence,
        probability=decision.probability,
        lines=features.lines,
        margin=decision.margin,
        speed_rpm=features.speed_rpm,
        speed_seen=features.speed_seen,
        revolutions=features.revolutions,
        false_alarm_probability=len(PARTS) * false_alarm_probability(rules.z_limit),
        level_db=float("nan") if change_db is None else change_db[0],
        notes=tuple(notes),
        spectrum=features.spectrum,
    )


def race_features(
    samples: NDArray[np.floating], rate_hz: float, speed_rpm: float, bearing: BearingOrders, rules: RaceRules
) -> RaceFeatures:
    """Measure what the decision rests on; arguments and errors as of `race_test`."""
    x = checked(np.asarray(samples, dtype=np.float64), rate_hz, speed_rpm, rules)
    x = x[: scipy.fft.prev_fast_len(len(x), real=True)]
    length = len(x)
    spectrum = scipy.fft.rfft(x - x.mean())
    shaft = shaft_rate(spectrum, rate_hz / length, speed_rpm / 60.0, rules.speed_tolerance)
    revolutions = length / rate_hz * shaft.rate_hz
    top_hz = min(TOP_SHARE * rate_hz, rules.high_hz)
    band = whiten(spectrum, length, rate_hz, rules.low_hz, top_hz, rules.whitening_hz)
    top_order = max(highest_order(bearing), NOTCHED_HARMONICS + 1.0)
    bins = min(int(top_order * revolutions) + 10, len(band.phase) // 2)
    phases, sizes = squared_envelope(band.phase, bins), squared_envelope(band.clipped, bins)
    square = _view(phases, sizes, bins, revolutions)
    log = _view(np.log(phases + LOG_OFFSET), np.log(sizes + LOG_OFFSET), bins, revolutions)
    # A speed that is not known sharply shifts every line: the search grows by that, and is paid for.
    slip = rules.slip if shaft.sharp else rules.slip + rules.speed_tolerance
    evidence = _weigh_all(square, log, bearing, revolutions, slip, rules)
    return RaceFeatures(
        evidence=evidence,
        lines=_found(evidence, square, bearing, shaft.rate_hz),
        levels=band_levels(spectrum, length, rate_hz),
        speed_rpm=60.0 * shaft.rate_hz,
        speed_seen=shaft.seen,
        revolutions=revolutions,
        spectrum=EnvelopeSpectrum(
            order=np.arange(bins) / revolutions,
            amplitude=np.sqrt(square.power),
            floor=np.sqrt(square.depth.floor),
        ),
    )


def _view(phases: Envelope, sizes: Envelope, bins: int, revolutions: float) -> _Envelope:
    lines = line_evidence(line_power(phases, bins), revolutions)
    power = line_power(sizes, bins)
    return _Envelope(lines, ModulationDepth(power, lines.notched, revolutions), power)


def _weigh_all(
    square: _Envelope,
    log: _Envelope,
    bearing: BearingOrders,
    revolutions: float,
    slip: float,
    rules: RaceRules,
) -> dict[Part, PartEvidence]:
    """Evidence for all parts; lines that the foremost part explains do not speak for another one."""
    evidence = {part: _weigh(part, square, log, bearing, revolutions, slip, rules) for part in PARTS}
    first = max(PARTS, key=lambda part: weight_of(part, evidence[part], rules))
    explained = part_lines(first, evidence[first].order, bearing)
    rest_square = replace(square, lines=square.lines.without(explained))
    rest_log = replace(log, lines=log.lines.without(explained))
    for part, e in evidence.items():
        if part != first and e.z >= e.z_limit:
            evidence[part] = _weigh(part, rest_square, rest_log, bearing, revolutions, slip, rules)
    return evidence


def _weigh(
    part: Part,
    square: _Envelope,
    log: _Envelope,
    bearing: BearingOrders,
    revolutions: float,
    slip: float,
    rules: RaceRules,
) -> PartEvidence:
    """Evidence for a part: the lesser of the two views, as each is fooled by something the other is not."""
    comb = best_comb((square.lines, log.lines), bearing, part, slip)
    z = significance(comb.score, part, revolutions, slip)
    order = fundamental(bearing, part)
    gap = abs(order - round(order))
    # Never across a harmonic of the shaft: what lies beyond it is not this part.
    reach = min(SHARPEN_SHARE, 0.5 * gap / order)
    found = sharpest((square.depth, log.depth), comb.order, reach, revolutions)
    by_square, by_log = (float(view.depth.comb(np.array([found]))[0]) for view in (square, log))
    depth = by_square if part == "ball" else min(by_square, by_log)
    away = gap * revolutions
    testable = part != "ball" or away >= rules.ball_testable_bins
    return PartEvidence(
        z=z,
        depth=depth,
        steadiness=by_log / max(by_square, 1e-9),
        severity=max(z, 0.0) * depth,
        z_limit=rules.z_limit + (rules.z_unresolved if away < rules.unresolved_bins else 0.0),
        limit=rules.ball_severity_limit if part == "ball" else rules.severity_limit,
        false_alarm_probability=false_alarm_probability(z),
        order=found,
        testable=testable,
        reason="" if testable else _why_not(order, rules),
    )


def _why_not(order: float, rules: RaceRules) -> str:
    """Why a ball is not testable."""
    needed = rules.ball_testable_bins / max(abs(order - round(order)), 1e-6)
    return (
        f"2 BSF = {order:.3f} is too close to {round(order)}X; a record of {needed:.0f} revolutions "
        "or more would tell them apart"
    )


def _found(
    evidence: Mapping[Part, PartEvidence], view: _Envelope, bearing: BearingOrders, shaft_hz: float
) -> tuple[RaceLine, ...]:
    lines = []
    for part, e in evidence.items():
        modulation = bearing.cage if part == "ball" else 1.0
        for tooth in TEETH[part]:
            order = tooth.harmonic * e.order + tooth.sideband * modulation
            nats = view.lines.at(order)
            if nats >= LEAST_LINE_NATS:
                depth = float(np.sqrt(view.depth.line(np.array([order]))[0]))
                line = (order * shaft_hz, order, tooth.harmonic, tooth.sideband, nats, depth)
                lines.append(RaceLine(part, *line))
    return tuple(sorted(lines, key=lambda line: -line.evidence))
