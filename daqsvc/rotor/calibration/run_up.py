"""A rotor from its run-up: natural frequency, damping, eccentricity and centre of a Laval rotor.

Away from steady speed the 1X vector lags behind what it would be if the speed stood still, and a fast run-up
rings after the critical speed. So the whole record is fitted in the time domain (paper, section II, with a
speed that changes; phi is theta, omega_s and zeta are those of the shaft):

    z'' + 2 zeta omega_s z' + omega_s^2 (z - c) = e (theta'^2 - i theta'') exp(i theta)

Eccentricity e, centre c and the transient at the start are linear and are solved for at every omega_s and
zeta (variable projection: Golub and Pereyra 1973); only these two are searched.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import least_squares

from daqsvc.dsp.speed.revolutions import Revolutions
from daqsvc.rotor.calibration.chirp import Chirp
from daqsvc.rotor.calibration.run_up_fit import RunUpFit
from daqsvc.rotor.laval import unbalance_response
from daqsvc.rotor.synchronous.baseline import LEAST_REVOLUTIONS, NotCalibratableError
from daqsvc.rotor.synchronous.vectors import HARMONICS, SynchronousVectors, synchronous_vectors

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

LEAST_SPEED_RATIO = 1.1
"""Highest over lowest speed from which on a recording is a run-up or a coast-down."""

_SAMPLES_PER_REVOLUTION = 48
"""More samples in the shortest revolution than this many are averaged: only the noise is in them."""
_PIECES = 64
"""Parts of the record whose scores say how the residual is coloured."""
_MOST_FREQUENCY_DOUBT = 0.1
"""Relative uncertainty of the natural frequency from which on it was not seen."""
_MOST_DAMPING_DOUBT = 0.5
_LEAST_NATS = 100.0
"""Energy of the whirl over the noise of a sample below which there is no orbit to speak of."""
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
    cut = _revolutions(z, angle_rad)
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


def _revolutions(z: Complexes, angle_rad: Floats) -> Revolutions:
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
            f"{size[_FORWARD]:.3g} um): x and y are swapped, one probe has the wrong sign, or the shaft "
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

    def residual(logs: Floats) -> Floats:
        _, left, _ = model.solve(math.exp(logs[0]), math.exp(logs[1]))
        return left.view(np.float64)

    best_cost, best = math.inf, starts[0]
    for omega, zeta in starts:
        bounds = (
            [math.log(omega / 2.0), math.log(_LEAST_DAMPING)],
            [math.log(omega * 2.0), math.log(_MOST_DAMPING)],
        )
        found = least_squares(
            residual, [math.log(omega), math.log(zeta)], bounds=bounds, x_scale=[0.01, 0.1], xtol=1e-7
        )
        if found.cost < best_cost:
            best_cost, best = found.cost, (math.exp(found.x[0]), math.exp(found.x[1]))
    return best


def _conclude(
    model: Chirp, omega: float, zeta: float, angle_rad: Floats, speed_range_rpm: tuple[float, float]
) -> RunUpFit:
    """What the search has found, with its uncertainties and what it leaves unexplained."""
    linear, residual, columns = model.solve(omega, zeta)
    covariance = _covariance(model, omega, zeta, linear, residual, columns)
    whirl, left = model.split(omega, zeta, linear)
    turning = synchronous_vectors(_revolutions(whirl, angle_rad))
    unexplained = synchronous_vectors(_revolutions(left, angle_rad))
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
    correlated over less than a piece counts for what it is worth (White 1980, clustered).
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
    for what, doubt, most in (
        ("natural frequency", math.sqrt(covariance[0, 0]), _MOST_FREQUENCY_DOUBT),
        ("damping ratio", math.sqrt(covariance[1, 1]), _MOST_DAMPING_DOUBT),
    ):
        if not doubt <= most:
            raise NotCalibratableError(
                f"the run-up from {low:.0f} to {high:.0f} rpm does not show the {what} (uncertain by "
                f"{100.0 * doubt:.0f} %, at most {100.0 * most:.0f} %; the best guess of the critical speed "
                f"is {critical_rpm:.0f} rpm); record a run-up that passes the critical speed"
            )
