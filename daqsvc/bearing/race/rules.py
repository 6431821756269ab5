"""The numbers of the race test: one set for all machines."""

from __future__ import annotations

from dataclasses import dataclass


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
        regular_z: significance that no noise has, from which lines too small for damage are told.
        regular_doubt: least belief in damage with such lines.
        severity_limit: of a race; ``z`` times ``depth``.
        ball_severity_limit: of a ball.
        unseen_caution: factor on a race's limit of severity where no harmonics confirm the speed.
        unseen_ball_caution: the same for a ball: at a wrong speed it is a ball that races are most taken for.
        elsewhere_ball_caution: the same where harmonics speak for another speed instead.
        depth_limit: least size of a race's lines.
        ball_depth_limit: least size of a ball's lines.
        steadiness_limit: least steadiness of a race's lines.
        steady_z: significance in 75 revolutions that many strikes reach and some knocks do not; beyond it the
            limit of steadiness falls in proportion.
        ball_weight: what a ball's severity counts against a race's.
        group_factor: parts whose weights are within this factor cannot be told apart.
        both_factor: factor by which both races must pass their limits, each by lines that the other does not
            explain, for both to be called damaged.
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
    regular_doubt: float = 0.1
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
