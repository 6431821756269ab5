"""What the race test remembers of the same machine in good order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.signal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.bearing.race.verdict import Part, PartEvidence

    Real = NDArray[np.float64]

FIRST_EDGE_HZ = 400.0
RESOLUTION_HZ = 50.0


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
        """
        common = min(len(self.power), len(before.power))
        now, then = np.array(self.power[:common]), np.array(before.power[:common])
        bands = 10.0 * np.log10(np.maximum(now, 1e-300) / np.maximum(then, 1e-300))
        whole = 10.0 * np.log10(max(now.sum(), 1e-300) / max(then.sum(), 1e-300))
        return float(whole), float(bands[np.argmax(np.abs(bands))])


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


def band_levels(samples: Real, rate_hz: float) -> BandLevels:
    """Mean square in the octave bands above 400 Hz that end below 0.48 of the sample rate.

    Args:
        samples: ``[n]``.
        rate_hz: their sample rate.
    """
    edges = [FIRST_EDGE_HZ]
    while 2.0 * edges[-1] <= 0.48 * rate_hz:
        edges.append(2.0 * edges[-1])
    length = min(len(samples), scipy.fft.next_fast_len(int(rate_hz / RESOLUTION_HZ)))
    frequency, density = scipy.signal.welch(samples, rate_hz, nperseg=length)
    width = frequency[1]
    band = np.searchsorted(edges, frequency, side="right") - 1
    power = tuple(float(density[band == k].sum() * width) for k in range(len(edges) - 1))
    return BandLevels(tuple(edges), power)
