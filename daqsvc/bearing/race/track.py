"""A shaft that does not turn evenly: its speed over the record, followed by its own harmonics.

A ramp or a hunt of half a percent smears the tenth harmonic over many bins. It hides a bearing's lines, and
smeared harmonics of the shaft lie beside them, where a bearing's are looked for. Where 1X to 4X, in
the signal or in the envelope, become sharper on an even angle of the shaft, that angle is taken (order
tracking).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import scipy.fft

from daqsvc.dsp.envelope import EXP_MEDIAN, hann

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Real = NDArray[np.float64]
    Complex = NDArray[np.complex128]
    Series = NDArray[np.floating]

Sample = TypeVar("Sample", np.float32, np.float64)

HARMONICS = (1, 2, 3, 4)
REACH = 0.03
"""How far the speed may wander from the stated one, as a share."""
LEAST_REACH_BINS = 12
"""A local noise level needs as many on either side."""
RAMP = 0.025
"""Steepest ramp that is looked for, over the whole record, as a share of the speed."""
RAMP_BINS = 0.5
"""Step of the search in bins that 1X is smeared over."""
OFFSET_BINS = 0.25
CLEAR = 10.0
"""Power of a harmonic over the noise about it from which on its phase is followed by itself."""
END_SHARE = 0.06
SMOOTH_REVOLUTIONS = 12.0
"""Over as many the phase is averaged."""
AUDIBLE = 2.0
"""The same from which on a harmonic votes."""
CAP_NATS = 16.0
"""Most that one harmonic counts."""
RAMP_LEAD_NATS = 0.5
RAMP_LEAD_PER_BIN = 0.25
FOLLOWED_LEAD_NATS = 1.75
"""Leads in votes over an even speed, of a ramp (and per bin that it smears 1X over) and of a followed
phase. This is more than they had in measured records of shafts that turn evenly (0.3 and 1.7)."""
HEARD_NATS = 5.0
"""Votes of a harmonic from which on it stands out by itself."""
LOST_NATS = 0.3
"""Most votes that such a harmonic may lose: the shaft's all become sharper together. What sharpens one line
and smears another follows a line that is not the shaft's. Of shafts that wandered by 2 % none lost any;
beside the line of a motor, of a mate or of another machine one lost 0.6 to 1.7."""
LEAST_WANDER = 5e-4
LEAST_POWER = 1e-300


@dataclass(frozen=True, slots=True)
class SpeedTrack:
    """How a shaft turned over a record.

    Attributes:
        turned: share of all its revolutions by share of the time, at even steps, ``[knots]``; from 0 to 1.
        wander: largest less smallest speed over the mean.
    """

    turned: Real
    wander: float

    def places(self, times: Real) -> Real:
        """Shares of all revolutions at some shares of the time, as ``times``."""
        return np.interp(times, np.linspace(0.0, 1.0, len(self.turned)), self.turned)

    def even(self, series: NDArray[Sample]) -> NDArray[Sample]:
        """A series on an even angle of the shaft instead of even time, ``[n]``.

        Args:
            series: ``[n]`` over the whole record, far oversampled: it is read between its samples by straight
                lines.
        """
        n = len(series)
        time = np.interp(np.arange(n) / n, self.turned, np.linspace(0.0, 1.0, len(self.turned)))
        return np.asarray(np.interp(time * n, np.arange(n), series), dtype=series.dtype)


def shaft_track(signal: Series, envelope: Series, revolutions: float) -> SpeedTrack | None:
    """Follow a shaft; None where its harmonics are no sharper for it, as if it turns evenly.

    Args:
        signal: ``[n]``, the low part of the signal over the record.
        envelope: ``[m]``, the envelope of its band over the same time.
        revolutions: of the shaft in it, as stated.
    """
    rows = _HarmonicSeries.of((signal, envelope), revolutions)
    if not len(rows.harmonic):
        return None
    flat = rows.votes(np.zeros(rows.points))
    even = float(flat.sum())
    heard = flat > HEARD_NATS
    u = np.arange(rows.points) / rows.points - 0.5
    count = int(RAMP * revolutions / RAMP_BINS)
    ramps = np.delete(np.arange(-count, count + 1), count) * RAMP_BINS
    candidates = [
        (0.5 * ramp * u**2, max(RAMP_LEAD_NATS, RAMP_LEAD_PER_BIN * abs(float(ramp)))) for ramp in ramps
    ]
    followed = rows.followed()
    if followed is not None:
        candidates.append((followed, FOLLOWED_LEAD_NATS))
    votes = [rows.votes(candidate) for candidate, _ in candidates]
    leads = [
        float(each.sum()) - even if (flat[heard] - each[heard]).max(initial=0.0) <= LOST_NATS else -np.inf
        for each in votes
    ]
    leading = [(lead, ahead) for lead, (ahead, least) in zip(leads, candidates, strict=True) if lead >= least]
    if not leading:
        return None
    _, ahead = max(leading, key=lambda each: each[0])
    ahead = ahead - np.interp(u, u[[0, -1]], ahead[[0, -1]])
    turned = np.append(u + 0.5 + ahead / revolutions, 1.0)
    speed = np.diff(turned) * rows.points
    wander = float(np.ptp(speed))
    if wander < LEAST_WANDER or speed.min() <= 0.0:
        return None
    return SpeedTrack(turned, wander)


@dataclass(frozen=True, slots=True)
class _HarmonicSeries:
    """1X to 4X of several series about the stated speed, shifted to zero frequency.

    Attributes:
        waves: over the record, ``[rows, points]``.
        harmonic: of each, ``[rows]``.
        shift: what the rounding of its place took, in bins, ``[rows]``.
        floor: noise power in a bin of their spectra, ``[rows]``.
        clear: their power over that of the noise in their band, ``[rows]``.
        revolutions: as stated.
    """

    waves: Complex
    harmonic: NDArray[np.int64]
    shift: Real
    floor: Real
    clear: Real
    revolutions: float

    @property
    def points(self) -> int:
        """Points of a wave over the record."""
        return int(self.waves.shape[1])

    @classmethod
    def of(cls, series: tuple[Series, ...], revolutions: float) -> _HarmonicSeries:
        """Cut the harmonics out of the spectra of some series."""
        widest = max(int(np.ceil(REACH * HARMONICS[-1] * revolutions)), LEAST_REACH_BINS)
        points = scipy.fft.next_fast_len(2 * widest + 1)
        lines = np.zeros((len(series) * len(HARMONICS), points), dtype=np.complex128)
        floor, clear = np.ones(len(lines)), np.zeros(len(lines))
        for i, one in enumerate(series):
            spectrum = scipy.fft.rfft((one - one.mean()) * hann(len(one)))
            for j, order in enumerate(HARMONICS):
                row, centre = i * len(HARMONICS) + j, round(order * revolutions)
                reach = max(int(np.ceil(REACH * order * revolutions)), LEAST_REACH_BINS)
                if centre + reach >= len(spectrum) or centre - reach < 1:
                    continue
                about = np.arange(-reach, reach + 1)
                lines[row, about] = spectrum[centre + about]
                power = np.abs(lines[row, about]) ** 2
                floor[row] = max(float(np.median(power)) / EXP_MEDIAN, LEAST_POWER)
                clear[row] = float(power.sum()) / (floor[row] * len(about)) - 1.0
        audible = clear > AUDIBLE
        harmonic = np.tile(HARMONICS, len(series))[audible]
        return cls(
            waves=scipy.fft.ifft(lines[audible], axis=1),
            harmonic=harmonic,
            shift=harmonic * revolutions - np.rint(harmonic * revolutions),
            floor=floor[audible],
            clear=clear[audible],
            revolutions=revolutions,
        )

    def votes(self, ahead: Real) -> Real:
        """Votes of each harmonic, ``[rows]``, for the best speed if the shaft is ahead by some revolutions.

        Args:
            ahead: ``[points]``.
        """
        turns = np.exp(-2j * np.pi * np.outer(self.harmonic, ahead))
        power = np.abs(scipy.fft.fft(self.waves * turns, axis=1)) ** 2
        nats = np.clip(np.log(np.maximum(power / self.floor[:, np.newaxis], LEAST_POWER)), 0.0, CAP_NATS)
        reach = REACH * self.revolutions
        offsets = np.arange(-reach, reach + OFFSET_BINS, OFFSET_BINS)
        bins = np.rint(np.outer(self.harmonic, offsets) + self.shift[:, np.newaxis]).astype(np.int64)
        voices = np.take_along_axis(nats, bins % self.points, axis=1)
        return np.asarray(voices[:, int(voices.sum(axis=0).argmax())])

    def followed(self) -> Real | None:
        """How far the shaft is ahead by the clearest harmonic's own phase; None if none is clear."""
        row = int(np.argmax(self.clear))
        if self.clear[row] < CLEAR:
            return None
        phase = np.unwrap(np.angle(self.waves[row])) / (2.0 * np.pi * int(self.harmonic[row]))
        width = max(int(SMOOTH_REVOLUTIONS / self.revolutions * self.points), 1)
        padded = np.pad(phase, width, mode="reflect", reflect_type="odd")
        smooth = np.convolve(padded, np.ones(width) / width, "same")[width:-width]
        # The window leaves nothing to follow at the ends: the shaft is thought to go on as beside them.
        end = max(int(END_SHARE * self.points), 2)
        n = len(smooth)
        head, tail = np.arange(end), np.arange(n - end, n)
        for at, beside in ((head, np.arange(end, 3 * end)), (tail, np.arange(n - 3 * end, n - end))):
            smooth[at] = np.polyval(np.polyfit(beside, smooth[beside], 1), at)
        return np.asarray(smooth)
