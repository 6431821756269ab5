"""What the race test says, with its evidence."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

Part = Literal["inner", "outer", "ball"]
RaceWord = Literal["normal", "changed", "inner", "outer", "ball", "inner_or_outer"]

PARTS: tuple[Part, ...] = ("inner", "outer", "ball")
PLACES: Mapping[Part, str] = {"inner": "inner race", "outer": "outer race", "ball": "ball"}
"""The parts in words."""


@dataclass(frozen=True, slots=True)
class PartEvidence:
    """What speaks for damage of one part.

    Attributes:
        z: significance of its kinematic lines, in standard deviations of the Gaussian-noise null, search
            included.
        depth: size: root sum of squares of the modulation indices of its lines in the whitened envelope.
        steadiness: depth in the logarithm of the envelope over depth in its square: small if a few hard
            knocks make the lines, as a rub or a loose part does, and not strike after strike.
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
        both: whether both races are in the group because each has lines of its own: both may be damaged.
        evidence: what speaks for each part.
        probability: share of belief per word, summing to one, of the words that were weighed.
        lines: kinematic lines found, strongest first.
        margin: how far the decision is from another, as a factor of severity: 1 is on the fence, 10 the most
            that is told.
        speed_rpm: of the shaft, as the harmonics show it.
        speed_seen: whether harmonics of the shaft stood out at all.
        revolutions: of the shaft in the evidence.
        false_alarm_probability: what the significance limit is set to, per test of three parts, in noise.
        level_db: broadband level over the baseline; None without one.
        notes: what a reader should know, e.g. ``"ball not testable here: ..."``.
        repairs: those of the notes that say what was wrong with the samples and put right; while there are
            any, ``"normal"`` clears nothing.
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
    spectrum: EnvelopeSpectrum | None = field(default=None, repr=False, compare=False)
