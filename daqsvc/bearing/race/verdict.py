"""The terms of the race test: its rules, its memory of a machine in good order, its verdict and evidence."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np

from daqsvc.dsp.quality import UnfitError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.dsp.drive_lines import DriveLines

    Complex = NDArray[np.complex128]


Part = Literal["inner", "outer", "ball"]
RaceWord = Literal["normal", "changed", "inner", "outer", "ball", "inner_or_outer"]

PARTS: tuple[Part, ...] = ("inner", "outer", "ball")
PLACES: Mapping[Part, str] = {"inner": "inner race", "outer": "outer race", "ball": "ball"}
"""The parts in words."""


@dataclass(frozen=True, slots=True)
class PartEvidence:
    """The evidence for damage of one part.

    Attributes:
        z: significance of its kinematic lines, in standard deviations of the Gaussian-noise null, search
            included.
        depth: size: root sum of squares of the modulation indices of its lines in the whitened envelope.
        steadiness: depth in the logarithm of the envelope over depth in its square. It is small if a few
            hard transients make the lines, as a rub or a loose part does, and not strike after strike.
        severity: ``z * depth``, what the rule weighs parts by.
        z_limit: the significance from which the part may be named.
        steadiness_limit: the steadiness from which a race may be named; 0 for a ball.
        limit: the severity from which the part is named.
        false_alarm_probability: probability of such a ``z`` or a larger one in Gaussian noise.
        order: its fundamental order as found (the stated one, up to slip).
        testable: False where the record is too short to tell its lines from harmonics of the shaft.
        reason: why it is not testable.
    """

    z: float
    depth: float
    steadiness: float
    severity: float
    z_limit: float
    steadiness_limit: float
    limit: float
    false_alarm_probability: float
    order: float
    testable: bool = True
    reason: str = ""


@dataclass(frozen=True, slots=True)
class RaceLine:
    """A kinematic line that stands out of the envelope spectrum.

    Attributes:
        part: the part whose damage makes such a line.
        frequency_hz: where it was found.
        order: the same per revolution of the shaft.
        harmonic: multiple of the part's fundamental; 0 for a line of the cage alone.
        sideband: offset in multiples of the modulating rate (shaft for the inner race, cage for a ball);
            0 for the harmonic itself.
        evidence: generalised log-likelihood ratio in nats against noise.
        depth: modulation index of the line in the whitened envelope.
    """

    part: Part
    frequency_hz: float
    order: float
    harmonic: int
    sideband: int
    evidence: float
    depth: float


@dataclass(frozen=True, slots=True)
class EnvelopeSpectrum:
    """The spectrum that the lines were looked for in, for figures.

    Attributes:
        order: events per revolution of the shaft, ``[n]``.
        amplitude: modulation index of the whitened envelope, ``[n]``.
        floor: its local noise level, ``[n]``.
    """

    order: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    floor: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RaceVerdict:
    """The statement of the race test about one bearing from one channel.

    Attributes:
        verdict: the one word; ``"changed"`` needs a baseline.
        group: parts that the evidence cannot tell apart, the verdict among them; or both races.
        both: whether the parts of the group have their own lines each: all of them may be damaged.
        evidence: of each part.
        probability: share of belief per word, summing to one, of the words that were weighed.
        lines: kinematic lines found, strongest first.
        margin: how far the decision is from another, as a factor of severity: 1 is on the fence, 10 the most
            that is stated.
        speed_rpm: of the shaft, as the harmonics show it.
        speed_seen: whether harmonics of the shaft stood out at all.
        revolutions: of the shaft in the evidence.
        false_alarm_probability: what the significance limit is set to, per test of three parts, in noise.
        level_db: broadband level over the baseline; None without one.
        notes: what a reader should know, e.g. ``"ball not testable here: ..."``.
        repairs: those of the notes that state what was wrong with the samples and put right; while there are
            any, ``"normal"`` clears nothing.
        drives: gears and motors whose lines stand out, and are taken for no part's.
        spectrum: for figures.
    """

    verdict: RaceWord
    group: tuple[str, ...]
    evidence: Mapping[Part, PartEvidence]
    probability: Mapping[str, float]
    lines: tuple[RaceLine, ...]
    margin: float
    speed_rpm: float
    speed_seen: bool
    revolutions: float
    false_alarm_probability: float
    level_db: float | None = None
    notes: tuple[str, ...] = ()
    both: bool = False
    repairs: tuple[str, ...] = ()
    drives: tuple[DriveLines, ...] = ()
    spectrum: EnvelopeSpectrum | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True, slots=True)
class RaceRules:
    """Settings of the race test; the defaults are what the documentation's table was measured with.

    Attributes:
        low_hz: where the analysed band begins: above the shaft's harmonics, below most resonances.
        high_hz: where it ends, if the sample rate allows.
        whitening_hz: width of the local median amplitude of the whitening.
        speed_tolerance: how far the shaft may be from the stated speed, as a share.
        slip: how far the fault orders may be from the stated ones, as a share.
        z_limit: significance from which a part may be named.
        z_unresolved: what is added to it if the part's line cannot be told from a harmonic of the shaft.
        strong_z: significance from which a part that cannot be named keeps a weaker one from being named.
        regular_z: significance that no noise has, from which lines too small for damage are reported.
        regular_least_damage: least belief in damage with such lines.
        severity_limit: of a race; ``z`` times ``depth``.
        ball_severity_limit: of a ball.
        unseen_caution: factor on a race's limit of severity where no harmonics confirm the speed.
        unseen_ball_caution: the same for a ball: at a wrong speed it is a ball that races are most taken for.
        elsewhere_ball_caution: the same where harmonics indicate another speed instead.
        depth_limit: least size of a race's lines.
        ball_depth_limit: least size of a ball's lines.
        steadiness_limit: least steadiness of a race's lines.
        steady_z: significance in 75 revolutions that many strikes reach and some transients do not; beyond it
            the limit of steadiness falls in proportion.
        ball_weight: what a ball's severity counts against a race's.
        group_factor: parts whose weights are within this factor cannot be told apart.
        both_factor: factor by which two parts must pass their limits, each by lines that the other does not
            explain, for both to be called damaged.
        beside_ball_z: significance of a ball's lines from which it is called damaged beside a race; beside a
            race alone they reached 9.5 in measured records.
        beside_ball_factor: factor by which it must pass its other limits for that.
        unresolved_bins: lines closer to a harmonic of the shaft, in bins, are not resolved from it.
        ball_testable_bins: the same for a ball, below which it is not tested at all.
        smear_share: distance of a line from a harmonic of the shaft, as a share of its order, up to which
            that harmonic may be smeared as far.
        smear_mirrored: power beyond that harmonic over the line's, from which on it is such a smear.
        changed_db: change of the whole level that makes a record "changed" against a baseline.
        changed_band_db: the same of one octave band.
        changed_ease: share of the limit of severity that suffices where the level has changed and the part's
            lines have grown.
        changed_growth: growth of size over the baseline that counts as grown.
        z_growth: growth of significance over the baseline that counts as grown.
        line_growth: growth of size that a line needs which was significant in the baseline already.
    """

    low_hz: float = 400.0
    high_hz: float = 20_000.0
    whitening_hz: float = 30.0
    speed_tolerance: float = 0.012
    slip: float = 0.015
    z_limit: float = 5.0
    z_unresolved: float = 1.5
    strong_z: float = 8.0
    regular_z: float = 9.0
    regular_least_damage: float = 0.1
    severity_limit: float = 3.0
    ball_severity_limit: float = 2.2
    unseen_caution: float = 2.0
    unseen_ball_caution: float = 3.5
    elsewhere_ball_caution: float = 4.5
    depth_limit: float = 0.12
    ball_depth_limit: float = 0.20
    steadiness_limit: float = 0.30
    steady_z: float = 20.0
    ball_weight: float = 0.6
    group_factor: float = 1.15
    both_factor: float = 1.2
    beside_ball_z: float = 10.5
    beside_ball_factor: float = 0.5
    unresolved_bins: float = 4.0
    ball_testable_bins: float = 2.5
    smear_share: float = 0.02
    smear_mirrored: float = 0.25
    changed_db: float = 2.0
    changed_band_db: float = 3.0
    changed_ease: float = 0.5
    changed_growth: float = 1.8
    z_growth: float = 4.0
    line_growth: float = 1.3


UNIT_DB = 15.0
SAME_DB = 1.5
LEAST_POWER = 1e-300
FIRST_EDGE_HZ = 400.0
TOP_SHARE = 0.48
"""Of the sample rate: anti-aliasing filters have their edge about here."""


@dataclass(frozen=True, slots=True)
class BandLevels:
    """Mean square of a channel in octave bands above 400 Hz.

    Attributes:
        edges_hz: band limits, ``[bands + 1]``.
        power: mean square in each, in the channel's unit squared, ``[bands]``.
    """

    edges_hz: tuple[float, ...]
    power: tuple[float, ...]

    def change_db(self, before: BandLevels) -> tuple[float, float]:
        """Change since ``before`` of the whole and of the band that changed most, in dB.

        Only bands that both have are compared, so the two may differ in sample rate.

        Raises:
            UnfitError: all bands changed alike and much, as by another unit.
        """
        common = min(len(self.power), len(before.power))
        now = np.maximum(self.power[:common], LEAST_POWER)
        then = np.maximum(before.power[:common], LEAST_POWER)
        bands = 10.0 * np.log10(now / then)
        whole = float(10.0 * np.log10(now.sum() / then.sum()))
        if common > 1 and abs(whole) > UNIT_DB and np.ptp(bands) < SAME_DB:
            raise UnfitError(
                "unit",
                f"differs from the baseline's: all bands changed by {whole:+.1f} dB alike",
                "give both recordings in the same unit",
            )
        return whole, float(bands[np.argmax(np.abs(bands))])


@dataclass(frozen=True, slots=True)
class RaceBaseline:
    """Evidence and level of the same bearing in good order, at about the same speed; see `race_baseline`.

    Attributes:
        evidence: of each part although it was in good order.
        levels: mean square in octave bands.
        speed_rpm: of the shaft.
        orders: of the bearing; None if not known.
    """

    evidence: Mapping[Part, PartEvidence]
    levels: BandLevels
    speed_rpm: float
    orders: BearingOrders | None = None


def band_levels(spectrum: Complex, samples: int, rate_hz: float) -> BandLevels:
    """Mean square in the octave bands above 400 Hz that end below 0.48 of the sample rate.

    Args:
        spectrum: one-sided spectrum of the signal, unwindowed.
        samples: length of the signal.
        rate_hz: its sample rate.
    """
    edges = [FIRST_EDGE_HZ]
    while 2.0 * edges[-1] <= TOP_SHARE * rate_hz:
        edges.append(2.0 * edges[-1])
    places = [round(edge * samples / rate_hz) for edge in edges]
    squares = spectrum.real**2 + spectrum.imag**2
    power = [2.0 * float(squares[low:high].sum()) / samples**2 for low, high in pairwise(places)]
    return BandLevels(tuple(edges), tuple(power))
