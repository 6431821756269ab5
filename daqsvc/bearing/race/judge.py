"""The race test: from samples to a verdict, of one record or window after window.

`race_test` is a pure function: significance (`decision`) and size (`lines`) of the kinematic lines of each
part, in the envelope of the whitened signal. Significance alone is not enough: bearings in good order
modulate too, faintly and very regularly. `RaceWatch` gathers the evidence of a running machine over the
last ten seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft

from daqsvc.bearing.race.decision import (
    LEAST_LINE_NATS,
    MOST_MARGIN,
    MOST_UNCERTAINTY,
    EnvelopeView,
    Scales,
    decide,
    less_confident,
    refuse_rivals,
    shared_belief,
    view_of,
)
from daqsvc.bearing.race.lines import (
    NOTCHED_HARMONICS,
    TEETH,
    false_alarm_probability,
    fundamental,
    highest_order,
    part_lines,
)
from daqsvc.bearing.race.track import shaft_track
from daqsvc.bearing.race.unknown import STATED_Z
from daqsvc.bearing.race.verdict import (
    PARTS,
    PLACES,
    TOP_SHARE,
    BandLevels,
    EnvelopeSpectrum,
    Part,
    PartEvidence,
    RaceBaseline,
    RaceLine,
    RaceRules,
    RaceVerdict,
    band_levels,
)
from daqsvc.dsp.drive_lines import SHARP, TOP_ORDER, VAGUE, LineLevels, drive_lines
from daqsvc.dsp.envelope import levelled, line_power, squared_envelope, whiten
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.accelerometers import LEAST_BAND, checked
from daqsvc.dsp.quality.occupied import occupied_top_hz
from daqsvc.dsp.speed.harmonics import NEAR, REMEDY, shaft_rate, slow_series
from daqsvc.rounding import rounded_up

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.track import SpeedTrack
    from daqsvc.bearing.race.unknown import UnknownStrikes
    from daqsvc.dsp.drive_lines import DriveLines


LOG_OFFSET = np.float32(1e-3)
"""Keeps the logarithm of the envelope from following its zeros."""


@dataclass(frozen=True, slots=True)
class RaceFeatures:
    """What is measured before anything is decided.

    Attributes:
        evidence: of each part.
        lines: kinematic lines found, strongest first.
        levels: mean square in octave bands.
        speed_rpm: of the shaft, as its harmonics show it.
        speed_unconfirmed: why they do not confirm it; empty if they do.
        rival_rpm: the speed that they indicate instead; None if they do not.
        beside_rpm: the speed of a louder shaft nearby, where this one has harmonics of its own; None if there
            is none.
        revolutions: of the shaft in the record.
        notes: what is odd about the samples.
        repairs: what was wrong with them and put right.
        lost: share of the record that the repairs left nothing of.
        drives: gears and motors whose lines stand out, and are taken for no part's.
        unknown: strikes that fit no part; None if none stand out.
        shared: parts whose order a gear seems to have, too.
        covered: whether a drive, or strikes that fit no part, have the lines of a part.
        spectrum: envelope spectrum, for figures.
    """

    evidence: Mapping[Part, PartEvidence]
    lines: tuple[RaceLine, ...]
    levels: BandLevels
    speed_rpm: float
    speed_unconfirmed: str
    rival_rpm: float | None
    beside_rpm: float | None
    revolutions: float
    notes: tuple[str, ...]
    repairs: tuple[str, ...]
    lost: float
    drives: tuple[DriveLines, ...]
    unknown: UnknownStrikes | None
    shared: tuple[Part, ...]
    covered: bool
    spectrum: EnvelopeSpectrum

    @property
    def elsewhere(self) -> bool:
        """Whether the shaft may turn at another speed."""
        return self.rival_rpm is not None or self.beside_rpm is not None


def race_test(
    samples: NDArray[np.floating],
    rate_hz: float,
    speed_rpm: float,
    bearing: BearingOrders,
    rules: RaceRules | None = None,
    baseline: RaceBaseline | None = None,
) -> RaceVerdict:
    """State which part of a bearing is damaged, if any.

    Args:
        samples: ``[n]``, acceleration of the bearing's housing in any unit; 2.5 s or more for the races,
            10 s for a ball.
        rate_hz: their sample rate.
        speed_rpm: speed of the shaft, right to about 1 %.
        bearing: its fault orders.
        rules: settings of the test.
        baseline: of the same machine in good order, by `race_baseline`; it makes ``"changed"`` possible.

    Raises:
        UnfitError: no verdict can rest on these samples.
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
    return RaceBaseline(features.evidence, features.levels, features.speed_rpm, bearing)


def verdict_of(features: RaceFeatures, rules: RaceRules, baseline: RaceBaseline | None) -> RaceVerdict:
    """Decide on features."""
    change_db = None if baseline is None else features.levels.change_db(baseline.levels)
    decision = decide(features.evidence, rules, baseline, change_db)
    evidence = features.evidence
    notes = [*features.notes, *features.repairs]
    # At another speed the lines of all parts are elsewhere, and under those of a drive a part's are not seen:
    # nothing was looked for in their places.
    lost = MOST_UNCERTAINTY if features.elsewhere or features.covered else features.lost
    notes += [f"{part} not testable here: {e.reason}" for part, e in evidence.items() if not e.testable]
    if decision.verdict in {"normal", "changed"}:
        before = None if baseline is None else baseline.evidence
        notes += [_withheld(part, e, rules, before) for part, e in evidence.items() if _is_regular(e, rules)]
        if features.unknown is not None:
            notes.append(features.unknown.describe(features.speed_rpm / 60.0))
            lost = max(lost, rules.regular_least_damage)
    if decision.both:
        damaged = [part for part in PARTS if part in decision.group]
        places = " and ".join(PLACES[part] for part in damaged)
        z = " and ".join(f"{evidence[part].z:.1f}" for part in damaged)
        notes.append(f"{places} stand out, each by itself (z {z}): both may be damaged")
    if features.beside_rpm is not None:
        notes.append(
            f"harmonics of a louder shaft stand out at {features.beside_rpm:.1f} rpm: those at "
            f"{features.speed_rpm:.1f} rpm are used, which are nearer to the stated speed; check the speed"
        )
    if features.speed_unconfirmed:
        notes.append(f"the speed is not confirmed: {features.speed_unconfirmed}")
    repairs = len(features.repairs)
    probability = less_confident(decision.probability, len(notes) - repairs, repairs, lost=lost)
    for part in features.shared:
        if part in decision.group:
            probability = shared_belief(probability, part)
    return RaceVerdict(
        verdict=decision.verdict,
        group=decision.group,
        evidence=features.evidence,
        probability=probability,
        lines=features.lines,
        margin=min(decision.margin, MOST_MARGIN),
        speed_rpm=features.speed_rpm,
        speed_seen=not features.speed_unconfirmed,
        revolutions=features.revolutions,
        false_alarm_probability=len(PARTS) * false_alarm_probability(rules.z_limit),
        level_db=None if change_db is None else change_db[0],
        notes=tuple(notes),
        both=decision.both,
        repairs=features.repairs,
        drives=features.drives,
        spectrum=features.spectrum,
    )


def _is_regular(e: PartEvidence, rules: RaceRules) -> bool:
    """Whether a part has lines that no noise has, and nothing else is stated of it."""
    return e.testable and e.z >= rules.regular_z


def _withheld(
    part: Part, e: PartEvidence, rules: RaceRules, before: Mapping[Part, PartEvidence] | None
) -> str:
    """Why a part is not named although its lines stand out."""
    found = f"lines of the {PLACES[part]} stand out (z {e.z:.1f})"
    depth_limit = rules.ball_depth_limit if part == "ball" else rules.depth_limit
    if e.severity < e.limit:
        return (
            f"{found}, too small for damage (size {e.depth:.2f}, severity {e.severity:.1f} of {e.limit:.1f})"
        )
    if e.depth < depth_limit:
        return f"{found}, too small for damage (size {e.depth:.2f} of {depth_limit:.2f})"
    if e.steadiness < e.steadiness_limit:
        return (
            f"{found}, but its impacts are too uneven (steadiness {e.steadiness:.3f} of "
            f"{e.steadiness_limit:.3f}): damage, a loose part or a rub may make them"
        )
    if before is not None and before[part].z >= before[part].z_limit:
        return f"{found}, as they did in the healthy run (z {before[part].z:.1f}): they have not grown enough"
    return f"{found}, but something else has stronger ones: it may make these, too"


def race_features(
    samples: NDArray[np.floating], rate_hz: float, speed_rpm: float, bearing: BearingOrders, rules: RaceRules
) -> RaceFeatures:
    """Measure what the decision rests on; arguments and errors as of `race_test`.

    Harmonics of another speed may be of a machine nearby. Where the bearing's own lines stand out at that
    speed, too, it is this machine that turns at it.
    """
    features = _measured(samples, rate_hz, speed_rpm, bearing, rules)
    others: list[float] = []
    if features.rival_rpm is not None:
        # Half and double a speed have many of its harmonics.
        others = [features.rival_rpm * factor for factor in (1.0, 0.5, 2.0)]
        others = [rpm for rpm in others if abs(rpm / speed_rpm - 1.0) > NEAR]
    named = decide(features.evidence, rules).group
    if features.beside_rpm is not None:
        others.append(features.beside_rpm)
    here = max(e.severity for e in features.evidence.values())
    for rpm in others:
        try:
            there = _measured(samples, rate_hz, rpm, bearing, rules).evidence
        except UnfitError:
            continue  # too few revolutions at that speed, or in doubt itself: it contradicts nothing
        part = max(PARTS, key=lambda part: there[part].severity)
        if rpm == features.beside_rpm and part in named:
            continue  # within the search for slip of both speeds
        if decide(there, rules).verdict != "normal" and there[part].severity > here:
            raise UnfitError(
                "shaft speed or sample rate",
                f"is wrong: harmonics of a shaft and lines of the {PLACES[part]} stand out at about "
                f"{rpm:.0f} rpm, not at {speed_rpm:g} rpm",
                REMEDY,
            )
    return features


def _measured(
    samples: NDArray[np.floating], rate_hz: float, speed_rpm: float, bearing: BearingOrders, rules: RaceRules
) -> RaceFeatures:
    channel = np.asarray(samples, dtype=np.float64)
    occupied_hz = _occupied(channel, rate_hz, rules)
    top_hz = min(rules.high_hz, occupied_hz or rules.high_hz)
    least_hz = LEAST_BAND * rules.low_hz
    # Too little of a band is refused behind what else may be wrong, and more to the point.
    band_hz = rules.low_hz, top_hz if top_hz >= least_hz else rules.high_hz
    sound = checked(channel, rate_hz, speed_rpm, band_hz)
    if occupied_hz is not None and occupied_hz < least_hz:
        raise UnfitError(
            "channel",
            f"has {_empty_above(top_hz, rate_hz)}, which leaves the band {rules.low_hz:g} to {top_hz:.0f} Hz",
            f"record up to {rounded_up(least_hz, 4)} Hz or more",
        )
    del channel
    length = scipy.fft.prev_fast_len(len(sound.values), real=True)
    spectrum = scipy.fft.rfft(sound.values[:length])
    notes, repairs = sound.notes, sound.repairs
    holes = np.array(sound.stretches, dtype=np.float64).reshape(-1, 2) / length
    # Of a long record each of these is as large as the record: what has been used is let go.
    del sound
    levels = band_levels(spectrum, length, rate_hz)
    top_hz = min(TOP_SHARE * rate_hz, top_hz)
    if occupied_hz is not None:
        notes = (*notes, f"{_empty_above(top_hz, rate_hz)}; judged by {rules.low_hz:g} to {top_hz:.0f} Hz")
    band = whiten(spectrum, length, rate_hz, rules.low_hz, top_hz, rules.whitening_hz)
    top_order = max(highest_order(bearing), NOTCHED_HARMONICS + 1.0)
    stated_hz, step_hz = speed_rpm / 60.0, rate_hz / length
    bins = min(int(top_order * stated_hz / step_hz) + 10, len(band.phase) // 2)
    series, series_hz = slow_series(spectrum, step_hz, stated_hz)
    line_levels = LineLevels(spectrum, step_hz, TOP_ORDER * stated_hz)
    del spectrum
    phases, sizes = squared_envelope(band.phase, bins), squared_envelope(band.clipped, bins)
    del band
    track = shaft_track(series, levelled(phases, holes), stated_hz / step_hz)
    if track is not None:
        series = track.even(series)
        phases, sizes = track.even(phases), track.even(sizes)
        holes = track.places(holes)
    power = line_power(levelled(phases, holes), bins)
    shaft = shaft_rate(
        series, series_hz, power, 1.0 / step_hz, stated_hz, rules.speed_tolerance, bearing.cage
    )
    revolutions = shaft.rate_hz / step_hz
    # On an even angle of the shaft the lines of a motor are none, and in even time those of a gear.
    known = SHARP if shaft.sharp else VAGUE
    drives = drive_lines(line_levels, shaft.rate_hz, known=known) if track is None else ()
    ambiguous = [drive for drive in drives if _is_bearings(drive, bearing, rules.slip)]
    notes = (*notes, *(f"{drive.describe_as_doubt()}: taken for the bearing's" for drive in ambiguous))
    shared = tuple(
        part
        for part in PARTS
        if any(_is_at(drive, fundamental(bearing, part), rules.slip) for drive in ambiguous)
    )
    drives = tuple(drive for drive in drives if drive not in ambiguous)
    for drive in drives:
        if drive.mate_teeth is not None and drive.spacing is not None:
            shaft = shaft.explained(drive.spacing * shaft.rate_hz)
    others = [order for drive in drives for order in drive.explained(top_order)]
    square = view_of(power, line_power(levelled(sizes, holes), bins), revolutions, others)
    log_phases, log_sizes = (
        line_power(levelled(np.log(envelope + LOG_OFFSET), holes), bins) for envelope in (phases, sizes)
    )
    log = view_of(log_phases, log_sizes, revolutions, others)
    scales = Scales(square, log, bearing, shaft, revolutions, rules, drives)
    evidence, unknown = scales.weigh(), scales.unknown
    refuse_rivals(evidence, bearing, shaft, rules.slip)
    return RaceFeatures(
        evidence=evidence,
        lines=_race_lines(evidence, square, bearing, shaft.rate_hz),
        levels=levels,
        speed_rpm=60.0 * shaft.rate_hz,
        speed_unconfirmed=shaft.doubt,
        rival_rpm=None if shaft.rival_hz is None else 60.0 * shaft.rival_hz,
        beside_rpm=None if shaft.beside_hz is None else 60.0 * shaft.beside_hz,
        revolutions=revolutions,
        notes=notes if track is None else (*notes, _wander_note(track)),
        repairs=repairs,
        lost=float(np.diff(holes, axis=1).sum()),
        drives=drives,
        unknown=unknown if unknown is not None and (scales.struck or unknown.z >= STATED_Z) else None,
        shared=shared,
        covered=bool(scales.covered or scales.struck),
        spectrum=EnvelopeSpectrum(
            order=np.arange(bins) / revolutions,
            amplitude=np.sqrt(square.power),
            floor=np.sqrt(square.depth.floor),
        ),
    )


def _is_bearings(drive: DriveLines, bearing: BearingOrders, slip: float) -> bool:
    """Whether a gear's mate would turn as often as a part is struck, or as the cage turns."""
    own = (*(fundamental(bearing, part) for part in PARTS), bearing.cage)
    return drive.kind == "gear" and any(_is_at(drive, order, slip) for order in own)


def _is_at(drive: DriveLines, order: float, slip: float) -> bool:
    """Whether the sidebands of a drive are as far apart as an order."""
    return abs((drive.spacing or 0.0) / order - 1.0) <= slip


def _occupied(samples: NDArray[np.float64], rate_hz: float, rules: RaceRules) -> float | None:
    """Where a record ends within the band of the test; None where it does not."""
    if samples.ndim != 1 or not (np.isfinite(rate_hz) and rate_hz > 0.0):
        return None
    there = np.isfinite(samples)
    mean = float(samples[there].mean()) if there.any() else 0.0
    top_hz = occupied_top_hz(np.where(there, samples - mean, 0.0), rate_hz)
    if top_hz is None or top_hz >= min(TOP_SHARE * rate_hz, rules.high_hz):
        return None
    return top_hz


def _empty_above(top_hz: float, rate_hz: float) -> str:
    """The note about a record that holds nothing above some frequency."""
    return (
        f"nothing above {top_hz:.0f} Hz at a sample rate of {rate_hz:g} Hz: low-passed, or sampled at about "
        f"{2e-3 * top_hz:.2g} kHz and upsampled"
    )


def _wander_note(track: SpeedTrack) -> str:
    return (
        f"the speed wanders by {track.wander:.1%} within the record: followed by the harmonics of the shaft; "
        "record at a steady speed for a more certain result"
    )


def _race_lines(
    evidence: Mapping[Part, PartEvidence], view: EnvelopeView, bearing: BearingOrders, shaft_hz: float
) -> tuple[RaceLine, ...]:
    """The lines of all parts; one that the foremost part explains is no other part's."""
    lines = []
    first = max(PARTS, key=lambda part: evidence[part].severity)
    leads = evidence[first].z >= evidence[first].z_limit
    unexplained = view.without(part_lines(first, evidence[first].order, bearing)) if leads else view
    for part, e in evidence.items():
        left = view if part == first else unexplained
        modulation = bearing.cage if part == "ball" else 1.0
        for tooth in TEETH[part]:
            order = tooth.harmonic * e.order + tooth.sideband * modulation
            nats = left.lines.at(order)
            if nats >= LEAST_LINE_NATS:
                depth = float(np.sqrt(view.depth.line(np.array([order]))[0]))
                line = (order * shaft_hz, order, tooth.harmonic, tooth.sideband, nats, depth)
                lines.append(RaceLine(part, *line))
    return tuple(sorted(lines, key=lambda line: -line.evidence))


WINDOW_S = 2.5
SPAN_S = 10.0


class RaceWatch:
    """Race test of consecutive windows: the last `SPAN_S` seconds are judged together; memory stays flat.

    Args:
        rate_hz: sample rate of the windows.
        speed_rpm: stated speed of the shaft.
        bearing: its fault orders.
        rules: settings of the test.
        baseline: of the same machine in good order.
    """

    def __init__(
        self,
        rate_hz: float,
        speed_rpm: float,
        bearing: BearingOrders,
        rules: RaceRules | None = None,
        baseline: RaceBaseline | None = None,
    ) -> None:
        self.rate_hz = rate_hz
        self.speed_rpm = speed_rpm
        self.window = round(WINDOW_S * rate_hz)
        self._bearing = bearing
        self._rules = rules or RaceRules()
        self._baseline = baseline
        self._held: NDArray[np.float64] = np.empty(0)
        self._span = round(SPAN_S * rate_hz)

    def evaluate(self, window_samples: NDArray[np.floating], speed_rpm: float | None = None) -> RaceVerdict:
        """Take in the next window and judge the last ten seconds.

        Args:
            window_samples: ``[n]``, about `window` samples that follow those before; call `forget` where they
                do not.
            speed_rpm: the shaft's speed now, if it is measured; a change of more than the tolerance of the
                test begins again.

        Raises:
            UnfitError: no verdict can rest on these samples. They are forgotten.
        """
        if speed_rpm is not None:
            if abs(speed_rpm / self.speed_rpm - 1.0) > self._rules.speed_tolerance:
                self.forget()
            self.speed_rpm = speed_rpm
        joined = np.concatenate((self._held, np.asarray(window_samples, dtype=np.float64)))[-self._span :]
        self._held = np.empty(0)
        features = race_features(joined, self.rate_hz, self.speed_rpm, self._bearing, self._rules)
        self._held = joined
        return verdict_of(features, self._rules, self._baseline)

    def forget(self) -> None:
        """Begin again: samples are missing, or the machine has changed."""
        self._held = np.empty(0)
