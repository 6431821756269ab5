"""A channel as the race test hears it, sample by sample: whitened by a spectrum that no single event bends.

The test gives every frequency of its band one voice. An event that is small beside the vibration as a whole
can yet be louder than all of the bands where the machine is quiet, and then its phases are all that the test
hears. So defects of samples are looked for where they do harm: in the whitened band.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.fft
from scipy.signal import oaconvolve

from daqsvc.dsp.envelope import EXP_MEDIAN, row_medians

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Real = NDArray[np.float64]

RESOLUTION_HZ = 60.0
SEGMENTS = 200
"""As many are enough for a median spectrum."""


MIRRORED = 1 / 3
"""What the whitened channel counts at its ends: half of it is made of the mirror image."""


class Prewhitening:
    """A filter without delay that whitens the band of the race test.

    Its spectrum is the median over short segments: what happens in less than half of them does not count.

    Args:
        samples: ``[n]``, that it is made for.
        rate_hz: their sample rate.
        low_hz: where the band begins.
        high_hz: where it ends.

    Attributes:
        kernel: ``[2 half + 1]``, its impulse response, scaled so that noise of the channel's median spectrum
            comes out with unit deviation.
        half: samples on either side of the middle of the kernel.
    """

    def __init__(self, samples: Real, rate_hz: float, low_hz: float, high_hz: float) -> None:
        length = 2 ** int(np.ceil(np.log2(rate_hz / RESOLUTION_HZ)))
        hop = max(length // 2, (len(samples) - length) // SEGMENTS)
        segments = np.lib.stride_tricks.sliding_window_view(samples, length)[::hop]
        taper = np.hanning(length)
        centred = (segments - segments.mean(axis=1, keepdims=True)) * taper
        amplitude = np.sqrt(row_medians(np.abs(scipy.fft.rfft(centred, axis=1)).T ** 2))
        frequency = scipy.fft.rfftfreq(length, 1.0 / rate_hz)
        band = (frequency >= low_hz) & (frequency <= high_hz) & (amplitude > 0.0)
        gain = np.where(band, 1.0 / np.where(band, amplitude, 1.0), 0.0)
        self.half = length // 2
        response = scipy.fft.fftshift(scipy.fft.irfft(gain, length))
        kernel = np.append(response, response[0])
        kernel[[0, -1]] *= 0.5
        variance = float(np.mean(band)) / (EXP_MEDIAN * float(np.square(taper).sum()))
        self.kernel = kernel / np.sqrt(max(variance, np.finfo(np.float64).tiny))

    def __call__(self, samples: Real) -> Real:
        """The whitened channel, ``[n]``; beyond its ends it is thought to go on as its mirror image."""
        centred = (samples - samples.mean()).astype(np.float32)
        extended = np.pad(centred, self.half, mode="reflect", reflect_type="odd")
        # Noise comes out as 1, and nothing finer matters: single precision does, and takes half the time.
        whitened = oaconvolve(extended, self.kernel.astype(np.float32), mode="valid")
        whitened[: self.half] *= MIRRORED
        whitened[len(whitened) - self.half :] *= MIRRORED
        return whitened


def loudest_by_revolution(whitened: Real, revolution: int) -> Real:
    """Largest absolute value in each revolution, ``[revolutions]``."""
    count = len(whitened) // revolution
    return np.asarray(np.abs(whitened[: count * revolution]).reshape(count, revolution).max(axis=1))
