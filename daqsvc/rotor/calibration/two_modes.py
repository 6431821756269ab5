"""The rotor's two lowest modes from its run-up: anisotropy, gyroscopic moment, oil film, higher modes.

Where one Laval rotor does not explain a run-up, two coupled axes mostly do: supports softer in one direction
part the critical speed in two, and so do gyroscopic moments; see `daqsvc.rotor.model`. What is fitted is 1X
of every revolution, forward and backward: 17 figures, by least squares. The supports are in series with the
shaft (`daqsvc.rotor.model.TwoModes`), which makes their part in it visible: their dampers stiffen the whirl.

A speed that changes at the rate r turns the impulse response h of 1X into h exp(i r tau^2 / 2): ringing and a
late peak, exact while the rate is even. For small rates it leaves 1X behind by -i/2 r H''(w), with the steady
response H; the search begins with that, and ends with the former.

Not everything can be told from a run-up: where nothing whirls backward, the gyroscopic moment is as good as
more inertia. So each figure is kept near 0 by a weak prior, and stays there unless the orbits show otherwise.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.rotor.model import RotorParameters, TwoModes, series_stiffness
from daqsvc.rotor.synchronous.baseline import LEAST_REVOLUTIONS, NotCalibratableError
from daqsvc.rotor.synchronous.vectors import BACKWARD, FORWARD

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.rotor.laval import LavalRotor
    from daqsvc.rotor.synchronous.vectors import SynchronousVectors

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

FIT_LIMIT = 0.1
"""Part of the whirl that may be left unexplained for two modes to represent the machine."""
_BEYOND = 0.1
"""Part of a speed by which a machine may run beyond its run-up."""

_USUAL = np.array([1.0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.5])
_PRIORS = np.array(
    [0.3, 0.03, 0.3, 0.3, 2.0, 0.1, 0.1, 0.1, 10.0, 10.0, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.5]
)
"""Prior of each figure: its mean and standard deviation.

They are: k; kappa; q; the supports' lag c; gamma; d; unbalance; higher modes; runout forward and backward;
beta. Complex ones are two.
"""
_FLOOR = 0.003
"""Least error that is assumed of such a model and of each revolution, as a part of the whirl."""
_WORTH = 100.0
"""Revolutions that count, however many there are: what the model misses is the same in all of them."""
_MOST_POINTS = 200
"""Neighbouring revolutions are averaged to this many."""
_STEP = 1e-3
_GRID, _FINE = 8192, 0.002
"""Speeds of a grid about 0, and their distance: its inverse is the longest ringing, 1e-3 of damping."""
_EVEN, _RATES = 0.1, 4
"""Rates that spread less than this part of the largest are one; else the response is made for so many."""
_SHARES = (0.15, 0.5, 0.85)
_TURNS = 4
_LEAST_LAG, _MOST_LAG = 1e-3, 5.0
_LEAST_SHARE = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class TwoModeFit:
    """A rotor with two modes, as a run-up shows it.

    Attributes:
        natural_frequency_hz: undamped, of the static stiffness, mean of both directions.
        damping_ratio: of the supports' dampers at that frequency, mean of both directions.
        eccentricity_um: complex; its argument is the heavy spot's angle from the mark.
        modes: what makes the two modes differ.
        fit_error: part of the whirl that is left unexplained, rms.
        speed_range_rpm: lowest and highest speed seen.
    """

    natural_frequency_hz: float
    damping_ratio: float
    eccentricity_um: complex
    modes: TwoModes
    fit_error: float
    speed_range_rpm: tuple[float, float]

    @property
    def explains(self) -> bool:
        """Whether two modes represent the machine."""
        return self.fit_error <= FIT_LIMIT

    def rotor(self, known: RotorParameters, *, clockwise: bool = False) -> RotorParameters:
        """The rotor of a bank: what the run-up shows, and of the rest what is known.

        Args:
            known: clearance, sag and contact are taken from it.
            clockwise: whether the shaft turns so; the fit has the x axis mirrored then, the bank has not.
        """
        eccentricity, modes = self.eccentricity_um, self.modes
        if clockwise:
            # z = -conj(z of the fit): forward stays forward, and every complex figure is conjugated.
            eccentricity = -eccentricity.conjugate()
            forward, backward = (-part.conjugate() for part in modes.runout_um)
            modes = replace(
                modes,
                cross_stiffness=-modes.cross_stiffness,
                anisotropy=modes.anisotropy.conjugate(),
                damping_anisotropy=modes.damping_anisotropy.conjugate(),
                higher_modes=modes.higher_modes.conjugate(),
                runout_um=(forward, backward),
            )
        return replace(
            known,
            natural_frequency_hz=self.natural_frequency_hz,
            damping_ratio=self.damping_ratio,
            eccentricity_um=abs(eccentricity),
            heavy_spot_deg=math.degrees(cmath.phase(eccentricity)),
            two_modes=modes,
        )

    def holds_at(self, speed_rpm: float) -> bool:
        """Whether the run-up passed this speed of either sign, or nearly did."""
        low, high = self.speed_range_rpm
        return low * (1.0 - _BEYOND) <= abs(speed_rpm) <= high * (1.0 + _BEYOND)

    def beside(self, known: LavalRotor) -> LavalRotor:
        """What is known of a rotor, and its two modes if they explain the run-up.

        Args:
            known: the Laval rotor that is nearest to it.
        """
        if not self.explains:
            return known
        modes = RotorParameters(
            natural_frequency_hz=known.natural_frequency_hz,
            damping_ratio=known.damping_ratio,
            eccentricity_um=0.0,
            clearance_um=1.0,
            static_sag_um=known.sag_um,
        )
        return replace(known, two_modes=self.rotor(modes))

    def describe(self) -> str:
        """The verdict in words."""
        low, high = self.speed_range_rpm
        seen = f"1X from {low:.0f} to {high:.0f} rpm"
        split = f"{100.0 * abs(self.modes.anisotropy):.1f} %"
        if self.explains:
            share = f"{100.0 * self.modes.support_share:.0f} %"
            return (
                f"two modes explain {seen} within {100.0 * self.fit_error:.1f} %: the supports take {share} "
                f"of the deflection and differ by +- {split} between the directions; a rotor bank can be "
                "made of this"
            )
        return (
            f"two modes do not explain {seen} (unexplained {100.0 * self.fit_error:.0f} %, at most "
            f"{100.0 * FIT_LIMIT:.0f} %): a rotor bank cannot be made of this run-up"
        )


def fit_two_modes(
    vectors: SynchronousVectors, rate_hz: float, *, natural_frequency_hz: float, damping_ratio: float
) -> TwoModeFit:
    """Fit two coupled axes to the 1X vectors of a run-up or a coast-down.

    Args:
        vectors: of every revolution of it, in um.
        rate_hz: samples per second.
        natural_frequency_hz: about where the critical speed is, e.g. of the nearest Laval rotor.
        damping_ratio: the same of the damping.

    Raises:
        NotCalibratableError: too few usable revolutions.
    """
    time_s = (vectors.end_index - vectors.period_samples / 2.0) / rate_hz
    speed = math.tau * rate_hz / vectors.period_samples
    rate = np.gradient(speed, time_s) if len(speed) > 1 else np.zeros(len(speed))
    seen = vectors.usable & np.isfinite(rate)
    if np.count_nonzero(seen) < LEAST_REVOLUTIONS:
        raise NotCalibratableError(
            f"only {np.count_nonzero(seen)} revolutions of the run-up can be used; two modes need "
            f"{LEAST_REVOLUTIONS}: record a slower one"
        )
    unit = math.tau * natural_frequency_hz
    count = int(np.count_nonzero(seen))
    together = np.arange(count) * _MOST_POINTS // max(_MOST_POINTS, count)
    w = _means(speed[seen] / unit, together)
    w_rate = _means(_smooth(rate[seen]) / unit**2, together)
    orbit = np.stack([_means(vectors.vectors[seen][:, k], together) for k in (FORWARD, BACKWARD)])
    whirl = math.sqrt(float(np.mean((np.abs(orbit) ** 2).sum(axis=0))))
    noise = float(np.sqrt(np.mean(vectors.noise[seen] / vectors.samples[seen])))
    orbit = orbit / whirl
    noise *= math.sqrt(len(w) / count)
    scale = max(_FLOOR, noise / whirl) * math.sqrt(max(1.0, len(w) / _WORTH))

    def left(figures: Floats) -> Floats:
        misfit = ((_orbits(figures, w, w_rate) - orbit) / scale).ravel()
        return np.concatenate((misfit.real, misfit.imag, (figures - _USUAL) / _PRIORS))

    from scipy.optimize import least_squares  # noqa: PLC0415 - slow to import, and the service fits nothing

    low, high = np.full(len(_USUAL), -np.inf), np.full(len(_USUAL), np.inf)
    low[0], high[0] = 0.4, 2.5
    low[4], high[4] = _LEAST_LAG, _MOST_LAG
    low[16], high[16] = _LEAST_SHARE, 1.0
    late = _Lateness(w_rate)

    def left_late(figures: Floats) -> Floats:
        misfit = ((_orbits(figures, w, w_rate, late) - orbit) / scale).ravel()
        return np.concatenate((misfit.real, misfit.imag, (figures - _USUAL) / _PRIORS))

    best = None
    # Stiff direction and share are not known, and from one start the search may end at wrong ones. The best
    # figures without the ringing need not be the best with it, so the best of every share is searched on.
    for share in _SHARES:
        nearest = None
        for number in range(_TURNS):
            begin = _start(damping_ratio, share, 0.05 * np.exp(1j * math.tau * number / _TURNS))
            response = _orbits(begin, w, w_rate)[0]
            forcing = complex(np.vdot(response, orbit[0]) / np.vdot(response, response))
            begin[8:10] = forcing.real, forcing.imag
            begin = np.clip(begin, low + 1e-6, high - 1e-6)
            fit = least_squares(left, begin, bounds=(low, high), x_scale=_PRIORS, max_nfev=40)
            if nearest is None or fit.cost < nearest.cost:
                nearest = fit
        assert nearest is not None  # noqa: S101 - there is at least one start
        fit = least_squares(left_late, nearest.x, bounds=(low, high), x_scale=_PRIORS, max_nfev=40)
        if best is None or fit.cost < best.cost:
            best = fit
    assert best is not None  # noqa: S101 - as above
    residual = _orbits(best.x, w, w_rate, late) - orbit
    energy = float(np.mean((np.abs(residual) ** 2).sum(axis=0))) - 2.0 * (noise / whirl) ** 2
    return _concluded(
        best.x,
        whirl,
        natural_frequency_hz,
        math.sqrt(max(energy, 0.0)),
        (float(speed.min()) * 30.0 / math.pi, float(speed.max()) * 30.0 / math.pi),
    )


def _start(damping_ratio: float, share: float, anisotropy: complex) -> Floats:
    """Figures to search from, with an unbalance of 1."""
    figures = _USUAL.copy()
    figures[2:4] = anisotropy.real, anisotropy.imag
    figures[4] = 2.0 * damping_ratio / share
    figures[8], figures[16] = 1.0, share
    return figures


def _means(values: NDArray[Any], together: NDArray[np.int64]) -> NDArray[Any]:
    """Means of the values that belong together, by rising numbers."""
    begins = np.flatnonzero(np.diff(together, prepend=-1))
    counts = np.diff(begins, append=len(values))
    return np.asarray(np.add.reduceat(values, begins) / counts)


def _smooth(rate: Floats) -> Floats:
    """The rate of the speed without the jitter of single edges: mean over 15 revolutions."""
    width = min(15, len(rate) // 2 * 2 - 1)
    padded = np.pad(rate, width // 2, mode="edge")
    return np.asarray(np.convolve(padded, np.full(width, 1.0 / width), mode="valid"))


class _Lateness:
    """What a speed that changes adds to the steady response, over a grid of speeds and some rates.

    Args:
        w_rate: float64 ``[n]``, rate of the normalised speed at the points.
    """

    def __init__(self, w_rate: Floats) -> None:
        low, high = float(w_rate.min()), float(w_rate.max())
        even = high - low < _EVEN * max(abs(low), abs(high))
        self._rates = np.array([float(np.mean(w_rate))]) if even else np.linspace(low, high, _RATES)
        grid = (np.arange(_GRID) - _GRID // 2) * _FINE
        self._w = grid
        # The transform wants zero first; tau of the second half is that of what came before the impulse.
        tau = np.fft.fftfreq(_GRID, _FINE / math.tau)
        self._turns = np.exp(0.5j * self._rates[:, np.newaxis] * tau**2) - 1.0

    def add(self, figures: Floats, w: Floats, w_rate: Floats) -> Complexes:
        """What comes to the compliances, complex128 ``[2, n]``."""
        steady = np.fft.ifftshift(_compliances(figures, self._w), axes=-1)
        impulse = np.fft.ifft(steady)[:, np.newaxis]
        late = np.fft.fftshift(np.fft.fft(impulse * self._turns), axes=-1)
        place = np.clip(
            np.interp(w_rate, self._rates, np.arange(len(self._rates), dtype=np.float64)),
            0.0,
            len(self._rates) - 1.0,
        )
        below = np.minimum(place.astype(np.int64), max(0, len(self._rates) - 2))
        above = np.minimum(below + 1, len(self._rates) - 1)
        at = np.array(
            [[np.interp(w, self._w, rate) for rate in component] for component in late]
        )  # [2, rates, n]
        points = np.arange(len(w))
        part = place - below
        return np.asarray((1.0 - part) * at[:, below, points] + part * at[:, above, points])


def _orbits(figures: Floats, w: Floats, w_rate: Floats, late: _Lateness | None = None) -> Complexes:
    """1X at speeds that change, forward and backward, complex128 ``[2, n]``, in parts of the whirl."""
    unbalance, higher = complex(*figures[8:10]), complex(*figures[10:12])
    here = _compliances(figures, w)
    if late is not None:
        compliances = here + late.add(figures, w, w_rate)
    else:
        bent = _compliances(figures, w + _STEP) + _compliances(figures, w - _STEP) - 2.0 * here
        compliances = here - 0.5j * w_rate * bent / _STEP**2
    # The heavy spot also lags while the shaft speeds up: d^2/dt^2 exp(i theta) = (i w' - w^2) exp(i theta).
    forcing = (w**2 - 1j * w_rate) * unbalance
    forward = forcing * compliances[0] + w**2 * higher + complex(*figures[12:14])
    backward = (forcing * compliances[1]).conj() + complex(*figures[14:16])
    return np.stack((forward, backward))


def _compliances(figures: Floats, w: NDArray[Any]) -> Complexes:
    """As `NormalisedRotor` has them, for many speeds: complex128 ``[2, n]``."""
    forward, to_forward, to_backward, backward = series_stiffness(
        figures[16],
        complex(1.0, figures[1]),
        w * figures[4],
        complex(*figures[2:4]),
        w * complex(*figures[6:8]),
    )
    a = figures[0] * forward - w**2 * (1.0 - figures[5])
    d = figures[0] * backward - w**2 * (1.0 + figures[5])
    b, c = figures[0] * to_forward, figures[0] * to_backward
    whole = 1.0 / (a * d - b * c)
    return np.stack((whole * d, -whole * c))


def _concluded(
    figures: Floats,
    whirl_um: float,
    unit_hz: float,
    fit_error: float,
    speed_range_rpm: tuple[float, float],
) -> TwoModeFit:
    """The figures in units of the natural frequency that the static stiffness makes."""
    stiffness = float(figures[0])
    root = math.sqrt(stiffness)
    eccentricity = complex(*figures[8:10])
    modes = TwoModes(
        support_share=float(figures[16]),
        support_lag=float(figures[4]) * root,
        cross_stiffness=float(figures[1]),
        anisotropy=complex(*figures[2:4]),
        damping_anisotropy=complex(*figures[6:8]) * root,
        gyroscopic=float(figures[5]),
        higher_modes=complex(*figures[10:12]) / eccentricity * stiffness if eccentricity else 0j,
        runout_um=(complex(*figures[12:14]) * whirl_um, complex(*figures[14:16]) * whirl_um),
    )
    return TwoModeFit(
        natural_frequency_hz=unit_hz * root,
        damping_ratio=modes.damping_ratio(),
        eccentricity_um=eccentricity * whirl_um,
        modes=modes,
        fit_error=fit_error,
        speed_range_rpm=speed_range_rpm,
    )
