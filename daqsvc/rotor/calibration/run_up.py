"""A rotor from its run-up: natural frequency, damping, eccentricity and centre of a Laval rotor.

Away from steady speed the 1X vector lags behind what it would be if the speed stood still, and a fast run-up
rings after the critical speed. So the whole record is fitted in the time domain (paper, section II, with a
speed that changes; phi is theta, omega_s and zeta are those of the shaft):

    z'' + 2 zeta omega_s z' + omega_s^2 (z - c) = e (theta'^2 - i theta'') exp(i theta)

Eccentricity e, centre c and the transient at the start are linear and are solved for at every omega_s and
zeta (variable projection: Golub and Pereyra 1973); only these two are searched.

The right-hand side is -e d^2/dt^2 exp(i theta). So the response is that of the transfer function -s^2 / (s^2
+ 2 zeta omega_s s + omega_s^2) to e exp(i theta), and the angle need not be differentiated.

What follows from the fit for other speeds is in `RunUpFit`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.dsp.speed.revolutions import Revolutions
from daqsvc.rotor.laval import LavalRotor, unbalance_response
from daqsvc.rotor.synchronous.baseline import LEAST_REVOLUTIONS, NotCalibratableError
from daqsvc.rotor.synchronous.vectors import HARMONICS, SynchronousVectors, synchronous_vectors

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]


LEAST_SPEED_RATIO = 1.1
"""Highest over lowest speed from which on a recording is a run-up or a coast-down."""

_SAMPLES_PER_REVOLUTION = 48
"""More samples in the shortest revolution than this many are averaged: only the noise is in them."""
_PIECES = 64
"""Parts of the record whose scores show how the residual is coloured."""
_MOST_FREQUENCY_ERROR = 0.1
"""Relative uncertainty of the natural frequency from which on it was not seen."""
_MOST_DAMPING_ERROR = 0.5
_LEAST_NATS = 100.0
"""Energy of the whirl over the noise of a sample below which there is no usable orbit."""
_REVERSED = 2.0
"""Backward over forward 1X of an orbit that turns the wrong way."""
_SURE = 2.0
"""Standard deviations that noise may be above its mean in what the model seems to leave unexplained."""
_LEAST_DAMPING, _MOST_DAMPING = 1e-3, 0.9
_FORWARD, _BACKWARD = (HARMONICS.index(k) for k in (1, -1))


def fit_run_up(xy_um: Floats, angle_rad: Floats, rate_hz: float) -> RunUpFit:
    """Fit a Laval rotor to a run-up or a coast-down.

    Args:
        xy_um: float64 ``[n, 2]``, orbit in um, rotation from x to y; NaN where missing.
        angle_rad: float64 ``[n]``, shaft angle of every sample, unwrapped and growing.
        rate_hz: samples per second.

    Raises:
        NotCalibratableError: too short, too even a speed, no whirl, or a natural frequency that the speeds
            do not show.
        ValueError: shapes that do not fit.
    """
    if xy_um.ndim != 2 or xy_um.shape[1] != 2 or angle_rad.shape != xy_um.shape[:1]:
        raise ValueError(
            f"a run-up is an orbit [n, 2] with an angle [n], not {list(xy_um.shape)} and "
            f"{list(angle_rad.shape)}"
        )
    if len(xy_um) < 2:
        raise NotCalibratableError("the run-up holds no samples; give a recording of one")
    z = xy_um[:, 0] + 1j * xy_um[:, 1]
    cut = revolutions_of(z, angle_rad)
    speeds_rpm = 60.0 * rate_hz / cut.period_samples
    low, high = float(speeds_rpm.min(initial=math.inf)), float(speeds_rpm.max(initial=0.0))
    if len(cut) < LEAST_REVOLUTIONS:
        raise NotCalibratableError(
            f"the run-up has {len(cut)} whole revolutions; a fit needs {LEAST_REVOLUTIONS}: "
            "record a slower one"
        )
    if high < LEAST_SPEED_RATIO * low:
        raise NotCalibratableError(
            f"the speed goes from {low:.0f} to {high:.0f} rpm only; a run-up that shows the natural "
            "frequency passes it"
        )
    vectors = synchronous_vectors(cut)
    if np.count_nonzero(vectors.usable) < LEAST_REVOLUTIONS:
        raise NotCalibratableError(
            f"only {np.count_nonzero(vectors.usable)} of {len(cut)} revolutions of the run-up have enough "
            "samples; record it again, with at least 8 samples in the shortest revolution"
        )
    _refuse_reversed(vectors)
    model = Chirp(z, angle_rad, rate_hz, max(1, int(cut.period_samples.min() / _SAMPLES_PER_REVOLUTION)))
    omega, zeta = _search(model, _starts(vectors, rate_hz))
    return _conclude(model, omega, zeta, angle_rad, (low, high))


def revolutions_of(z: Complexes, angle_rad: Floats) -> Revolutions:
    """Cut by an angle that is known for every sample."""
    if not np.all(np.diff(angle_rad) > 0.0):
        raise ValueError("the angle of a run-up must grow from sample to sample; unwrap it")
    whole = np.arange(math.ceil(angle_rad[0] / math.tau), math.floor(angle_rad[-1] / math.tau) + 1)
    edges = np.interp(whole * math.tau, angle_rad, np.arange(len(angle_rad)))
    starts = np.ceil(edges).astype(np.int64)
    begin, end = (int(starts[0]), int(starts[-1])) if len(whole) else (0, 0)
    return Revolutions(
        first_index=begin,
        xy=np.column_stack((z.real, z.imag))[begin:end],
        angle_rad=np.mod(angle_rad[begin:end], math.tau),
        starts=starts[:-1] - begin,
        period_samples=np.diff(edges),
        trusted=np.ones(len(starts[:-1]), dtype=np.bool_),
    )


def _refuse_reversed(vectors: SynchronousVectors) -> None:
    """Refuse an orbit that turns against the shaft."""
    size = np.sqrt((np.abs(vectors.vectors[vectors.usable]) ** 2).mean(axis=0))
    if size[_BACKWARD] > _REVERSED * size[_FORWARD]:
        raise NotCalibratableError(
            f"the orbit turns against the stated rotation (backward 1X {size[_BACKWARD]:.3g} um rms, forward "
            f"{size[_FORWARD]:.3g} um); x and y are swapped, one probe has the wrong sign, or the shaft "
            "turns clockwise; swap the probes, or give the speed a minus sign"
        )


def _starts(vectors: SynchronousVectors, rate_hz: float) -> list[tuple[float, float]]:
    """Where to search from: the best of a grid, taking every revolution's 1X as that of a steady speed."""
    seen = vectors[vectors.usable]
    speed = 2.0 * math.pi * rate_hz / seen.period_samples
    forward = seen.vectors[:, _FORWARD]
    omega = np.geomspace(0.7 * speed.min(), 1.4 * speed.max(), 80)
    zeta = np.geomspace(0.005, 0.6, 14)
    response = unbalance_response(speed / omega[:, np.newaxis, np.newaxis], zeta[:, np.newaxis])
    explained = np.abs((response.conj() * forward).sum(axis=-1)) ** 2 / (np.abs(response) ** 2).sum(axis=-1)
    best_zeta = explained.argmax(axis=1)
    best = explained.max(axis=1)
    beside = np.concatenate(([-np.inf], best, [-np.inf]))
    peaks = np.flatnonzero((best >= beside[:-2]) & (best >= beside[2:]))
    peaks = peaks[np.argsort(-best[peaks])][:3]
    return [(float(omega[i]), float(zeta[best_zeta[i]])) for i in peaks]


def _search(model: Chirp, starts: list[tuple[float, float]]) -> tuple[float, float]:
    """Natural frequency in rad/s and damping ratio with the least residual."""
    from scipy.optimize import least_squares  # noqa: PLC0415 - slow to import, and the service fits nothing

    def residual(logs: Floats) -> Floats:
        _, left, _ = model.solve(math.exp(logs[0]), math.exp(logs[1]))
        return left.view(np.float64)

    best_cost, best = math.inf, starts[0]
    for omega, zeta in starts:
        bounds = (
            [math.log(omega / 2.0), math.log(_LEAST_DAMPING)],
            [math.log(omega * 2.0), math.log(_MOST_DAMPING)],
        )
        fit = least_squares(
            residual, [math.log(omega), math.log(zeta)], bounds=bounds, x_scale=[0.01, 0.1], xtol=1e-7
        )
        if fit.cost < best_cost:
            best_cost, best = fit.cost, (math.exp(fit.x[0]), math.exp(fit.x[1]))
    return best


def _conclude(
    model: Chirp, omega: float, zeta: float, angle_rad: Floats, speed_range_rpm: tuple[float, float]
) -> RunUpFit:
    """What the search has found, with its uncertainties and what it leaves unexplained."""
    linear, residual, columns = model.solve(omega, zeta)
    covariance = _covariance(model, omega, zeta, linear, residual, columns)
    whirl, left = model.split(omega, zeta, linear)
    turning = synchronous_vectors(revolutions_of(whirl, angle_rad))
    unexplained = synchronous_vectors(revolutions_of(left, angle_rad))
    usable = turning.usable & unexplained.usable
    turning, unexplained = turning[usable], unexplained[usable]
    samples = turning.samples
    noise = float(np.average(unexplained.noise, weights=np.maximum(samples - len(HARMONICS), 1.0)))
    power = float(samples @ (np.abs(turning.vectors) ** 2).sum(axis=1))
    if not power > _LEAST_NATS * noise:
        raise NotCalibratableError(
            f"there is no whirl: 1X of rms {math.sqrt(power / samples.sum()):.3g} um in noise of "
            f"{math.sqrt(noise / 2.0):.3g} um; check that the machine turns, the probes' names and their unit"
        )
    _refuse_unseen(omega, covariance, speed_range_rpm)
    repeats = samples @ np.abs(unexplained.vectors) ** 2
    return RunUpFit(
        natural_frequency_hz=omega / math.tau,
        damping_ratio=zeta,
        eccentricity_um=complex(linear[0]),
        centre_um=complex(linear[1]),
        covariance=covariance[:4, :4],
        centre_uncertainty_um=math.sqrt((covariance[4, 4] + covariance[5, 5]) / 2.0),
        ellipticity=math.sqrt(_beyond_noise(float(repeats[_BACKWARD]), len(samples), noise) / power),
        noise_um=math.sqrt(noise / 2.0),
        fit_error=math.sqrt(
            _beyond_noise(float(repeats.sum()), len(HARMONICS) * len(samples), noise) / power
        ),
        speed_range_rpm=speed_range_rpm,
        revolutions=len(samples),
    )


def _beyond_noise(energy: float, components: int, noise: float) -> float:
    """Energy in so many complex components, less the most that noise alone leaves in them."""
    return max(energy - noise * (components + _SURE * math.sqrt(components)), 0.0)


def _covariance(
    model: Chirp, omega: float, zeta: float, linear: Complexes, residual: Complexes, columns: Complexes
) -> Floats:
    """Covariance of ln omega, ln zeta, Re and Im of ln e, Re and Im of c, and the free motions.

    A sandwich: scores are summed over pieces of the record before they are squared, so a residual that is
    correlated over less than a piece gets its right weight (White 1980, clustered).
    """
    step = 1e-4

    def along(omega_by: float, zeta_by: float) -> Complexes:
        up = model.columns(omega * (1.0 + omega_by), zeta * (1.0 + zeta_by)) @ linear
        down = model.columns(omega * (1.0 - omega_by), zeta * (1.0 - zeta_by)) @ linear
        return np.asarray((up - down) / (2.0 * step))

    eccentric = linear[0] * columns[:, 0]
    slopes = [along(step, 0.0), along(0.0, step), eccentric, 1j * eccentric]
    slopes += [factor * columns[:, k] for k in (1, 2, 3) for factor in (1.0, 1j)]
    jacobian = np.column_stack(slopes)
    scale = np.sqrt((np.abs(jacobian) ** 2).sum(axis=0))
    scale[scale == 0.0] = 1.0
    jacobian /= scale
    scores = (jacobian.conj() * residual[:, np.newaxis]).real
    edges = np.linspace(0, len(scores), _PIECES + 1).astype(np.int64)[:-1]
    pieces = np.add.reduceat(scores, edges, axis=0)
    bread = np.linalg.pinv((jacobian.conj().T @ jacobian).real, rcond=1e-12, hermitian=True)
    free = _PIECES / (_PIECES - 4.0)
    covariance = bread @ (pieces.T @ pieces) @ bread * free
    return np.asarray(covariance / np.outer(scale, scale))


def _refuse_unseen(omega: float, covariance: Floats, speed_range_rpm: tuple[float, float]) -> None:
    """Refuse figures that the speeds do not show."""
    low, high = speed_range_rpm
    critical_rpm = omega * 30.0 / math.pi
    for what, uncertain, most in (
        ("natural frequency", math.sqrt(covariance[0, 0]), _MOST_FREQUENCY_ERROR),
        ("damping ratio", math.sqrt(covariance[1, 1]), _MOST_DAMPING_ERROR),
    ):
        if not uncertain <= most:
            raise NotCalibratableError(
                f"the run-up from {low:.0f} to {high:.0f} rpm does not show the {what} (uncertain by "
                f"{100.0 * uncertain:.0f} %, at most {100.0 * most:.0f} %; the best guess of the critical "
                f"speed is {critical_rpm:.0f} rpm); record a run-up that passes the critical speed"
            )


LAVAL_LIMIT = 0.05
"""Fit error, and backward over forward 1X, up to which a machine counts as a Laval rotor."""

_ROTOR_TOLERANCE = 0.02
"""What a fitted rotor may still be off at best: independent rotor codes agree to that."""
_GENERIC_TOLERANCE = 0.2
"""The same where the machine is no Laval rotor, and the figures only name the nearest one."""


class NotLavalError(ValueError):
    """The machine is no Laval rotor, so nothing follows from one speed for another."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunUpFit:
    """A Laval rotor fitted to a run-up or a coast-down. Uncertainties are standard deviations.

    Attributes:
        natural_frequency_hz: undamped natural frequency omega_s / 2 pi.
        damping_ratio: zeta.
        eccentricity_um: complex mass eccentricity e; its argument is the heavy spot's angle from the mark.
        centre_um: where the shaft would run without whirl, c; sag and the probes' zero are in it.
        covariance: float64 ``[4, 4]`` of ln f, ln zeta, and real and imaginary part of ln e.
        centre_uncertainty_um: of each coordinate of ``centre_um``.
        ellipticity: backward over forward whirl, rms over the record, beyond what noise explains.
        noise_um: standard deviation of the noise of one probe's sample.
        fit_error: rms of the part that repeats with the shaft and that no Laval rotor explains, beyond noise,
            over that of the whirl.
        speed_range_rpm: lowest and highest speed seen.
        revolutions: in the record.
    """

    natural_frequency_hz: float
    damping_ratio: float
    eccentricity_um: complex
    centre_um: complex
    covariance: Floats
    centre_uncertainty_um: float
    ellipticity: float
    noise_um: float
    fit_error: float
    speed_range_rpm: tuple[float, float]
    revolutions: int

    @property
    def natural_frequency_uncertainty_hz(self) -> float:
        """Standard deviation of the natural frequency."""
        return self.natural_frequency_hz * math.sqrt(self.covariance[0, 0])

    @property
    def damping_uncertainty(self) -> float:
        """Standard deviation of the damping ratio."""
        return self.damping_ratio * math.sqrt(self.covariance[1, 1])

    @property
    def eccentricity_uncertainty_um(self) -> float:
        """Standard deviation of the eccentricity's modulus."""
        return abs(self.eccentricity_um) * math.sqrt(self.covariance[2, 2])

    @property
    def heavy_spot_uncertainty_deg(self) -> float:
        """Standard deviation of the eccentricity's argument."""
        return math.degrees(math.sqrt(self.covariance[3, 3]))

    @property
    def laval(self) -> bool:
        """Whether one Laval rotor explains the whole record."""
        return self.fit_error <= LAVAL_LIMIT and self.ellipticity <= LAVAL_LIMIT

    def describe(self) -> str:
        """The verdict in words."""
        low, high = self.speed_range_rpm
        seen = f"from {low:.0f} to {high:.0f} rpm"
        if self.laval:
            return (
                f"one Laval rotor explains the orbit {seen} within {100.0 * self.fit_error:.1f} %: 1X at any "
                "speed in between follows from it, and loss of damping can be told from unbalance"
            )
        limit = f"at most {100.0 * LAVAL_LIMIT:.0f} % each"
        return (
            f"no Laval rotor explains the orbit {seen} (unexplained {100.0 * self.fit_error:.0f} %, backward "
            f"over forward whirl {100.0 * self.ellipticity:.0f} %, {limit}): calibrate at every speed that "
            "is watched; nothing follows from one speed for another"
        )

    def rotor(self, *, clearance_um: float | None = None, static_sag_um: float | None = None) -> LavalRotor:
        """What is known about the rotor from now on; with wide tolerances if it is no Laval rotor."""
        least = _ROTOR_TOLERANCE if self.laval else _GENERIC_TOLERANCE
        frequency, damping = (2.0 * math.sqrt(self.covariance[i, i]) for i in (0, 1))
        return LavalRotor(
            natural_frequency_hz=self.natural_frequency_hz,
            damping_ratio=self.damping_ratio,
            natural_frequency_tolerance=min(0.9, max(least, frequency)),
            damping_tolerance=min(0.9, max(least, damping)),
            clearance_um=clearance_um,
            static_sag_um=static_sag_um,
        )

    def predict(self, speed_rpm: float) -> tuple[complex, float]:
        """1X vector at a steady speed.

        Args:
            speed_rpm: shaft speed, in the direction of the run-up.

        Returns:
            The forward 1X vector in um, and the standard deviation of it, in um.

        Raises:
            NotLavalError: the machine is no Laval rotor.
            ValueError: a speed outside of those seen.
        """
        if not self.laval:
            raise NotLavalError(
                f"1X at {speed_rpm:.0f} rpm cannot be predicted: the machine is no Laval rotor (the run-up "
                f"fits within {100.0 * self.fit_error:.0f} %, backward over forward whirl is "
                f"{100.0 * self.ellipticity:.0f} %, at most {100.0 * LAVAL_LIMIT:.0f} % each); record it at "
                "that speed"
            )
        low, high = self.speed_range_rpm
        if not low <= speed_rpm <= high:
            raise ValueError(
                f"1X at {speed_rpm:.0f} rpm cannot be predicted: the run-up went from {low:.0f} to "
                f"{high:.0f} rpm; give a speed in between"
            )
        ratio = speed_rpm / 60.0 / self.natural_frequency_hz
        vector = complex(self.eccentricity_um * unbalance_response(ratio, self.damping_ratio))
        step = 1e-5
        moved = np.array(
            [
                unbalance_response(ratio / (1.0 + step), self.damping_ratio),
                unbalance_response(ratio, self.damping_ratio * (1.0 + step)),
            ]
        )
        here = unbalance_response(ratio, self.damping_ratio)
        slope = np.concatenate(((moved / here - 1.0) / step, [1.0, 1j]))
        variance = float((slope.conj() @ self.covariance @ slope).real)
        return vector, abs(vector) * math.sqrt(max(variance, 0.0))


def forcing_of(angle_rad: Floats) -> Complexes:
    """What drives a rotor sampled at this angle, complex128 ``[n]``, so that ramps between samples are exact.

    Ramps between the samples of a turning vector pass sinc^2 of its turns in a step; the rest are images at
    the sampling rate, which a rotor does not follow.

    Args:
        angle_rad: float64 ``[n]``, unwrapped.
    """
    return np.asarray(np.exp(1j * angle_rad) / np.sinc(np.gradient(angle_rad) / math.tau) ** 2)


def whirl_by_unbalance(
    forcing: Complexes, angle_rad: Floats, step_s: float, omega: float, zeta: float
) -> Complexes:
    """Motion of a rotor at rest to unit eccentricity that turns with the angle, complex128 ``[n]``.

    Args:
        forcing: `forcing_of` the angle.
        angle_rad: float64 ``[n]``, unwrapped.
        step_s: time between samples.
        omega: natural frequency in rad/s.
        zeta: damping ratio.
    """
    from scipy.signal import cont2discrete, lfilter  # noqa: PLC0415 - takes a second to load

    damping = 2.0 * zeta * omega
    numerator, denominator, _ = cont2discrete(
        (np.array([damping, omega**2]), np.array([1.0, damping, omega**2])), step_s, method="foh"
    )
    return np.asarray(lfilter(numerator.ravel(), denominator, forcing) - np.exp(1j * angle_rad))


class Chirp:
    """The record, and a Laval rotor's response to its shaft angle.

    Args:
        z: complex128 ``[n]``, the orbit in um.
        angle_rad: float64 ``[n]``.
        rate_hz: samples per second.
        averaged: samples that are averaged, in the record and in the model alike.
    """

    def __init__(self, z: Complexes, angle_rad: Floats, rate_hz: float, averaged: int) -> None:
        self._step_s = 1.0 / rate_hz
        self._averaged = averaged
        self._length = len(z) // averaged * averaged
        self._time_s = np.arange(len(z)) * self._step_s
        self._angle_rad = angle_rad
        self._forcing = forcing_of(angle_rad)
        self._recorded = z
        seen = self._mean(z)
        self._there = np.isfinite(seen)
        self._seen = seen[self._there]

    def _mean(self, values: Complexes) -> Complexes:
        return np.asarray(values[: self._length].reshape(-1, self._averaged).mean(axis=1))

    def columns(self, omega: float, zeta: float) -> Complexes:
        """Complex128 ``[m, 4]``: response to unit eccentricity, unit centre, and the two free motions."""
        forced, *free = (self._mean(column)[self._there] for column in self._motions(omega, zeta))
        return np.column_stack((forced, np.ones(len(forced)), *free))

    def _motions(self, omega: float, zeta: float) -> Iterator[Complexes]:
        """Response to unit eccentricity and the two free motions, complex128 ``[n]`` each."""
        yield whirl_by_unbalance(self._forcing, self._angle_rad, self._step_s, omega, zeta)
        pole = omega * complex(-zeta, math.sqrt(1.0 - zeta**2))
        yield np.exp(pole * self._time_s)
        yield np.exp(pole.conjugate() * self._time_s)

    def solve(self, omega: float, zeta: float) -> tuple[Complexes, Complexes, Complexes]:
        """Best linear parameters complex128 ``[4]``, residual ``[m]`` and columns ``[m, 4]``."""
        columns = self.columns(omega, zeta)
        linear: Complexes = np.asarray(np.linalg.lstsq(columns, self._seen, rcond=1e-10)[0], np.complex128)
        return linear, self._seen - columns @ linear, columns

    def split(self, omega: float, zeta: float, linear: Complexes) -> tuple[Complexes, Complexes]:
        """The record as the whirl by unbalance and what the model leaves of it, complex128 ``[n]`` each."""
        forced, *free = self._motions(omega, zeta)
        whirl = linear[0] * forced
        left = self._recorded - whirl - linear[1] - linear[2] * free[0] - linear[3] * free[1]
        return whirl, left
