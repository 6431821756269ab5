"""What the race test remembers of the same machine in good order."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.dsp.quality import UnfitError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.bearing.race.verdict import Part, PartEvidence

    Complex = NDArray[np.complex128]

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
        evidence: what spoke for each part although it was in good order.
        levels: mean square in octave bands.
        speed_rpm: of the shaft.
    """

    evidence: Mapping[Part, PartEvidence]
    levels: BandLevels
    speed_rpm: float


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
