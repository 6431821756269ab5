"""The race test of one record: from samples to a verdict.

A pure function: significance (`null`) and size (`depth`) of the kinematic lines of each part, in the envelope
of the whitened signal. Significance alone is not enough: bearings in good order modulate too, faintly and
very regularly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft

from daqsvc.bearing.race.baseline import TOP_SHARE, BandLevels, RaceBaseline, band_levels
from daqsvc.bearing.race.combs import TEETH, highest_order
from daqsvc.bearing.race.decision import decide
from daqsvc.bearing.race.lines import NOTCHED_HARMONICS
from daqsvc.bearing.race.null import false_alarm_probability
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
from daqsvc.bearing.race.weigh import EnvelopeView, Scales, view_of
from daqsvc.dsp.envelope import squared_envelope, whiten

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders


LOG_OFFSET = np.float32(1e-3)
"""Keeps the logarithm of the envelope from following its zeros."""
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
        notes: what is odd about the samples.
        spectrum: envelope spectrum, for figures.
    """

    evidence: Mapping[Part, PartEvidence]
    lines: tuple[RaceLine, ...]
    levels: BandLevels
    speed_rpm: float
    speed_seen: bool
    revolutions: float
    notes: tuple[str, ...]
    spectrum: EnvelopeSpectrum


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
    notes = [*features.notes]
    notes += [f"{part} not testable here: {e.reason}" for part, e in evidence.items() if not e.testable]
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
        level_db=None if change_db is None else change_db[0],
        notes=tuple(notes),
        spectrum=features.spectrum,
    )


def race_features(
    samples: NDArray[np.floating], rate_hz: float, speed_rpm: float, bearing: BearingOrders, rules: RaceRules
) -> RaceFeatures:
    """Measure what the decision rests on; arguments and errors as of `race_test`."""
    sound = checked(np.asarray(samples, dtype=np.float64), rate_hz, speed_rpm, rules)
    length = scipy.fft.prev_fast_len(len(sound.values), real=True)
    spectrum = scipy.fft.rfft(sound.values[:length])
    shaft = shaft_rate(spectrum, rate_hz / length, speed_rpm / 60.0, rules.speed_tolerance, bearing.cage)
    revolutions = length / rate_hz * shaft.rate_hz
    top_hz = min(TOP_SHARE * rate_hz, rules.high_hz)
    band = whiten(spectrum, length, rate_hz, rules.low_hz, top_hz, rules.whitening_hz)
    top_order = max(highest_order(bearing), NOTCHED_HARMONICS + 1.0)
    bins = min(int(top_order * revolutions) + 10, len(band.phase) // 2)
    phases, sizes = squared_envelope(band.phase, bins), squared_envelope(band.clipped, bins)
    square = view_of(phases, sizes, bins, revolutions)
    log = view_of(np.log(phases + LOG_OFFSET), np.log(sizes + LOG_OFFSET), bins, revolutions)
    evidence = Scales(square, log, bearing, shaft, revolutions, rules).weigh()
    return RaceFeatures(
        evidence=evidence,
        lines=_found(evidence, square, bearing, shaft.rate_hz),
        levels=band_levels(spectrum, length, rate_hz),
        speed_rpm=60.0 * shaft.rate_hz,
        speed_seen=shaft.seen,
        revolutions=revolutions,
        notes=sound.notes,
        spectrum=EnvelopeSpectrum(
            order=np.arange(bins) / revolutions,
            amplitude=np.sqrt(square.power),
            floor=np.sqrt(square.depth.floor),
        ),
    )


def _found(
    evidence: Mapping[Part, PartEvidence], view: EnvelopeView, bearing: BearingOrders, shaft_hz: float
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
