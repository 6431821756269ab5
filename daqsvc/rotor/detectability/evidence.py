"""What a linear bank will state about a rotor, computed instead of simulated.

A linear observer of mode i that watches a machine in mode j is a linear time-invariant system. Its
innovation has a mean, driven by the difference of the two orbits through the observer's own closed
loop, and a variance, driven by the noise of the sensor and of the motion. Both follow exactly from one
augmented system, the state of the truth beside that of the observer, for any mismatch of damping,
stiffness, orbit or rest. From them follows the expected log-likelihood of every sample.

The shaft is isotropic: a complex number holds both axes, and the mean has two parts, one that stands
still (the rests differ) and one that turns with the shaft (the orbits differ). Averaged over the shaft
angle at which a change happens their powers add, so that angle does not enter.

No closed form is known of a rotor that rubs: it is simulated. That is a prediction, not a test of the
detector: the motion is stepped with the same Strang splitting as the rub observer's, from the bank's own
parameters. Every pair of modes with a rub in it is run through one schedule many times, from shaft angles of
its own: first mode, rub, first mode again.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from daqsvc.kernels import njit
from daqsvc.rotor import kernels
from daqsvc.rotor.discretise import (
    axis_flow,
    axis_process_covariance,
    constant_gain,
    discretise,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.discretise import BankMode
    from daqsvc.rotor.model import NormalisedRotor

    Floats = NDArray[np.float64]
    Observers = NDArray[np.void]
    Complexes = NDArray[np.complex128]


_Number = TypeVar("_Number", float, "Floats")


class Axis:
    """One axis of a rotor and of the observer that models it; all that pairs of modes share.

    Args:
        mode: the mode; a rub observer is taken as it is inside the clearance, linear.
        noise: standard deviation of the measured position, in clearances.
        duration: normalised time between samples, omega_s dt.
        process_noise: power spectral density q of the machine's own acceleration noise, normalised.
        variance_factor: how much larger the observer takes the variance of its innovations to be.
    """

    def __init__(
        self,
        mode: BankMode,
        *,
        noise: float,
        duration: float,
        process_noise: float,
        variance_factor: float = 1.0,
    ) -> None:
        self.rotor = mode.rotor
        self.noise = noise
        self.process_noise = process_noise
        self.duration = duration
        self.flow = axis_flow(mode.rotor, duration)
        self.motion = axis_process_covariance(mode.rotor, process_noise, duration)
        gain, variance = constant_gain(mode.rotor, mode.process_noise, noise, duration)
        self.variance = variance * variance_factor
        self.drive = self.flow @ gain
        self.closed = self.flow - np.outer(self.drive, [1.0, 0.0])

    def log_likelihood(self, mean_squared: _Number, variance: _Number) -> _Number:
        """Expected log-likelihood of an innovation of this mode's observer, both axes, in nats.

        Args:
            mean_squared: squared modulus of its mean.
            variance: its variance on one axis.
        """
        excess = -0.5 * (mean_squared + 2.0 * variance) / self.variance
        return excess - math.log(2.0 * math.pi * self.variance)

    @property
    def decay(self) -> float:
        """Slowest decay of the rotor and of its observer, per sample: a transient falls by exp(-decay)."""
        poles = np.abs(np.linalg.eigvals(self.flow)), np.abs(np.linalg.eigvals(self.closed))
        return -math.log(float(np.max(poles)))


@dataclass(frozen=True, slots=True)
class Observation:
    """An observer of mode ``model`` on a machine in mode ``truth``.

    Attributes:
        truth: the mode that the machine is in.
        model: the mode that the observer models.
    """

    truth: Axis
    model: Axis

    @property
    def transition(self) -> Floats:
        """Flow of (the truth's deviation from its steady motion, the observer's), float64 ``[4, 4]``."""
        A = np.zeros((4, 4))
        A[:2, :2] = self.truth.flow
        A[2:, 0] = self.model.drive
        A[2:, 2:] = self.model.closed
        return A

    def steady_covariance(self) -> Floats:
        """Stationary covariance of one axis of the augmented state, float64 ``[4, 4]``."""
        Q = np.zeros((4, 4))
        Q[:2, :2] = self.truth.motion
        Q[2:, 2:] = self.model.noise**2 * np.outer(self.model.drive, self.model.drive)
        return np.asarray(solve_discrete_lyapunov(self.transition, Q), dtype=np.float64)

    def steady_variance(self) -> float:
        """Stationary variance of the innovation of one axis."""
        return float(_SEEN @ self.steady_covariance() @ _SEEN) + self.model.noise**2

    def steady_estimate(self, w: float) -> Complexes:
        """Steady estimate, counted from the model's own motion: ``[2, 2]``, at rest and with the shaft.

        Args:
            w: normalised shaft speed.

        Returns:
            Complex amplitudes, one row at zero frequency and one at 1X, of position and velocity.
        """
        seen = _difference(self.truth.rotor, self.model.rotor, w)[:, 0]
        turns = (1.0, cmath.exp(1j * w * self.model.duration))
        return np.array(
            [
                np.linalg.solve(turn * np.eye(2) - self.model.closed, self.model.drive * amplitude)
                for turn, amplitude in zip(turns, seen, strict=True)
            ]
        )

    def steady_innovation(self, w: float) -> Complexes:
        """Steady mean of the innovation, complex ``[2]``: at rest and with the shaft."""
        seen = _difference(self.truth.rotor, self.model.rotor, w)
        return np.asarray(seen[:, 0] - self.steady_estimate(w)[:, 0], dtype=np.complex128)

    def steady_log_likelihood(self, w: float) -> float:
        """Expected log-likelihood of a sample in the steady state, in nats, at normalised speed ``w``."""
        return self.model.log_likelihood(self._steady_power(w), self.steady_variance())

    def steady_misfit(self, w: float) -> float:
        """What the mean of the innovation alone takes from the log-likelihood of a sample, in nats.

        This part depends on the orbits. What the variance takes depends on the assumed noise of the machine.
        """
        return 0.5 * self._steady_power(w) / self.model.variance

    def _steady_power(self, w: float) -> float:
        return float(np.sum(np.abs(self.steady_innovation(w)) ** 2))

    def course_after(self, before: Axis, w: float, samples: int) -> tuple[Complexes, Floats]:
        """The innovations of every sample after the machine has gone from another mode to the truth.

        Args:
            before: the mode that the machine was in for long; it changes abruptly at sample 0.
            w: normalised shaft speed.
            samples: how many samples.

        Returns:
            Their mean, complex ``[2, samples]`` at rest and with the shaft, as if the shaft had been at angle
            0 at the change; and their variance, float64 ``[samples]`` for one axis.
        """
        earlier = Observation(before, self.model)
        # The disc cannot jump: what it deviates from its new motion by is where it was on the old one.
        moved = _difference(before.rotor, self.truth.rotor, w)
        learnt = earlier.steady_estimate(w) - self.steady_estimate(w)
        start = np.concatenate((moved, learnt), axis=1)
        seen = _powers(_SEEN, self.transition, samples)
        turning = np.exp(1j * w * self.model.duration * np.arange(samples))
        steady = self.steady_innovation(w)
        mean = np.stack((steady[0] + seen @ start[0], steady[1] * turning + seen @ start[1]))
        stationary = self.steady_covariance()
        excess = earlier.steady_covariance() - stationary
        variance = float(_SEEN @ stationary @ _SEEN) + self.model.noise**2
        return mean, variance + np.einsum("ni,ij,nj->n", seen, excess, seen)


@dataclass(frozen=True, slots=True)
class Growth:
    """How the log-likelihood ratio of one mode over another grows, sample by sample.

    Attributes:
        drift: float64 ``[n]``, expected increment, nats.
        spread: float64 ``[n]``, variance of the increment, nats squared.
    """

    drift: Floats
    spread: Floats


def growth_after(before: Axis, after: Axis, w: float, samples: int) -> Growth:
    """Growth of the evidence of a mode over the one before it, from the change on.

    The increments are taken as independent: the innovations of the true mode are white. What the means
    of the innovations differ by brings twice as much variance as drift, as for any signal in white noise;
    so does the little that their variances differ by.

    Args:
        before: the mode that the machine was in for long.
        after: the mode that it changed to abruptly, at sample 0.
        w: normalised shaft speed.
        samples: how many samples.
    """
    mean, variance = Observation(after, after).course_after(before, w, samples)
    rival_mean, rival_variance = Observation(after, before).course_after(before, w, samples)
    return _growth(after, before, (mean, variance), (rival_mean, rival_variance))


def steady_growth(truth: Axis, mode: Axis, rival: Axis, w: float) -> Growth:
    """Growth of the evidence of a mode over its rival in a machine that has been in one mode for long.

    Args:
        truth: the mode that the machine is in.
        mode: the mode whose evidence it is.
        rival: the mode against which it is.
        w: normalised shaft speed.

    Returns:
        Growth of one sample.
    """
    courses = [
        (seen.steady_innovation(w)[:, np.newaxis], np.array([seen.steady_variance()]))
        for seen in (Observation(truth, mode), Observation(truth, rival))
    ]
    return _growth(mode, rival, *courses)


def _growth(
    mode: Axis, rival: Axis, course: tuple[Complexes, Floats], rival_course: tuple[Complexes, Floats]
) -> Growth:
    (mean, variance), (rival_mean, rival_variance) = course, rival_course
    power, rival_power = (np.sum(np.abs(m) ** 2, axis=0) for m in (mean, rival_mean))
    drift = mode.log_likelihood(power, variance) - rival.log_likelihood(rival_power, rival_variance)
    moved = 0.5 * (rival_power / rival.variance - power / mode.variance)
    contrast = rival_mean / rival.variance - mean / mode.variance
    spread = variance * np.sum(np.abs(contrast) ** 2, axis=0)
    return Growth(drift, spread + 2.0 * np.abs(drift - moved))


_SEEN = np.array([1.0, 0.0, -1.0, 0.0])
"""The innovation is where the truth is, less where the observer has it."""


def orbit_noise(rotor: NormalisedRotor, process_noise: float, w: float) -> Floats:
    """Power spectral density of the orbit's own noise at rest and at 1X, float64 ``[2]``.

    Two-sided, of x + iy, in clearances squared times normalised time: divided by a time T it is the variance
    that an average over T leaves.

    Args:
        rotor: the rotor.
        process_noise: power spectral density q of the acceleration noise of one axis, normalised.
        w: normalised shaft speed.
    """
    frequencies = np.array([0.0, w])
    response = 1.0 / np.abs(rotor.k - frequencies**2 + 2j * rotor.zeta * frequencies)
    return np.asarray(2.0 * process_noise * response**2, dtype=np.float64)


def _difference(one: NormalisedRotor, other: NormalisedRotor, w: float) -> Complexes:
    """Steady motion of one rotor less another's: ``[2, 2]``, position and velocity at rest and at 1X."""
    orbit = one.orbit(w) - other.orbit(w)
    return np.array([[one.rest - other.rest, 0.0], [orbit, 1j * w * orbit]], dtype=np.complex128)


def _powers(row: Floats, A: Floats, count: int) -> Floats:
    """``row @ A**n`` for n = 0 .. count - 1, float64 ``[count, len(row)]``, by doubling."""
    rows = np.empty((count, len(row)))
    rows[0] = row
    known = 1
    power = A
    while known < count:
        more = min(known, count - known)
        rows[known : known + more] = rows[:more] @ power
        known += more
        power = power @ power
    return rows


RUNS = 16
"""Runs of every pair; with 20 steady revolutions in each, the evidence of a rub is known within 2 %."""
_SETTLING_REV = 20.0
_STEADY_REV = 20.0
_RUB_REV = 60.0
_AFTER_REV = 40.0
_SAMPLES_PER_REV = 64
"""As many as a bank needs: at one noise density, faster sampling brings no further evidence."""


@dataclass(frozen=True, slots=True)
class RubPair:
    """The evidence between a rub and another mode, sample by sample.

    Attributes:
        other: index of the other mode.
        rub: index of the rub.
        llr: float64 ``[RUNS, n]``, log-likelihood ratio of every sample, rub over the other, nats.
        samples_per_rev: samples in a revolution.
    """

    other: int
    rub: int
    llr: Floats
    samples_per_rev: float

    def nats_per_rev(self) -> tuple[float, float]:
        """Steady evidence: of the other mode over the rub while it lasts, and of the rub over it."""
        of_other = -self._between(_SETTLING_REV, _SETTLING_REV + _STEADY_REV)
        of_rub = self._between(_RUB_BEGINS + _RUB_REV / 2.0, _RUB_ENDS)
        return self.samples_per_rev * float(of_other.mean()), self.samples_per_rev * float(of_rub.mean())

    def delay_to_rub_rev(self, threshold_nats: float) -> float:
        """Median revolutions until the evidence of the rub against the other mode passes a threshold."""
        quiet = self._between(_SETTLING_REV, _RUB_BEGINS)
        return self._median_delay(quiet, self._between(_RUB_BEGINS, _RUB_ENDS), threshold_nats)

    def delay_from_rub_rev(self, threshold_nats: float) -> float:
        """Median revolutions until the evidence of the other mode against the rub passes a threshold."""
        rubbing = -self._between(_RUB_BEGINS + _RUB_REV / 2.0, _RUB_ENDS)
        return self._median_delay(rubbing, -self._between(_RUB_ENDS, _END), threshold_nats)

    def _between(self, begin_rev: float, end_rev: float) -> Floats:
        return self.llr[:, round(begin_rev * self.samples_per_rev) : round(end_rev * self.samples_per_rev)]

    def _median_delay(self, before: Floats, after: Floats, threshold_nats: float) -> float:
        """Median over the runs from the change to the threshold; infinite if half of them never pass it."""
        total = np.cumsum(np.concatenate((before, after), axis=1), axis=1)
        cusum = total - np.minimum(np.minimum.accumulate(total, axis=1), 0.0)
        passed = cusum[:, before.shape[1] :] >= threshold_nats
        delays = np.where(passed.any(axis=1), passed.argmax(axis=1), np.inf)
        return float(np.median(delays)) / self.samples_per_rev


_RUB_BEGINS = _SETTLING_REV + _STEADY_REV
_RUB_ENDS = _RUB_BEGINS + _RUB_REV
_END = _RUB_ENDS + _AFTER_REV


def simulate_rubs(
    modes: Sequence[BankMode],
    *,
    noise: float,
    duration: float,
    process_noise: float,
    variance_factor: float = 1.0,
    seed: int,
) -> list[RubPair]:
    """Run every pair of modes of which one rubs; none if no mode does.

    Args:
        modes: the hypotheses, as for `discretise`.
        noise: standard deviation of the measured position, in clearances.
        duration: normalised time between samples, omega_s dt. Where that is more samples than a bank needs,
            as many are averaged to one as leave enough of them.
        process_noise: power spectral density q of the machine's own acceleration noise, normalised.
        variance_factor: how much larger the bank takes the variance of its innovations to be.
        seed: seed of the noise and of the shaft angles.

    Raises:
        ValueError: the modes or figures cannot make a bank, or a rub has no bounded motion.
    """
    pairs = [
        (i, j)
        for j, rub in enumerate(modes)
        if rub.rub
        for i, other in enumerate(modes)
        if not other.rub or i < j
    ]
    if not pairs:
        return []
    w = modes[0].rotor.w
    averaged = max(1, math.floor(2.0 * math.pi / (abs(w) * duration) / _SAMPLES_PER_REV))
    duration, noise = duration * averaged, noise / math.sqrt(averaged)
    per_rev = 2.0 * math.pi / (abs(w) * duration)
    begins, ends, n = (round(rev * per_rev) for rev in (_RUB_BEGINS, _RUB_ENDS, _END))
    rng = np.random.default_rng(seed)
    start = rng.uniform(0.0, 2.0 * math.pi, (len(pairs), RUNS))
    angle = start + w * duration * np.arange(n)[:, np.newaxis, np.newaxis]
    observers = discretise(modes, noise=noise, duration=duration, variance_factor=variance_factor)
    kicks = np.array(
        [np.linalg.cholesky(axis_process_covariance(m.rotor, process_noise, duration)) for m in modes]
    )
    z = np.empty((n, len(pairs), RUNS), dtype=np.complex128)
    states = np.zeros((len(pairs), RUNS, 4))
    others, rubs = np.array(pairs).T
    before = others
    for mode, part in ((others, slice(begins)), (rubs, slice(begins, ends)), (others, slice(ends, n))):
        draws = rng.standard_normal((len(z[part]), 2, 2, len(pairs), RUNS))
        _move(observers[before], observers[mode], kicks[mode], angle[part], draws, states, z[part])
        _check_bounded([modes[i] for i in mode], z[part][-1])
        before = mode
    z += noise * (rng.standard_normal(z.shape) + 1j * rng.standard_normal(z.shape))
    return [
        RubPair(i, j, _log_likelihood_ratios(observers[[0, i, j]], z[:, p], angle[:, p]), per_rev)
        for p, (i, j) in enumerate(pairs)
    ]


def _log_likelihood_ratios(observers: NDArray[np.void], z: Complexes, angle: Floats) -> Floats:
    """Of the last of three observers over the second, float64 ``[RUNS, n]``, nats."""
    n, runs = z.shape
    usable = np.ones(n, dtype=np.bool_)
    llr = np.empty((runs, n))
    for run in range(runs):
        xy = np.column_stack((z[:, run].real, z[:, run].imag))
        # A rub observer without a state starts on the healthy orbit, as in the bank.
        states = np.where(observers["substeps"][:, np.newaxis] > 0, np.nan, np.zeros((3, 4)))
        scores = np.empty((3, n))
        cos, sin = np.cos(angle[:, run]), np.sin(angle[:, run])
        kernels.run_free(xy, usable, cos, sin, observers, states, scores)
        llr[run] = scores[2] - scores[1]
    return llr


@njit(cache=True, nogil=True, error_model="numpy")
def _move(
    before: Observers,
    observers: Observers,
    kicks: Floats,
    angle: Floats,
    draws: Floats,
    states: Floats,
    z: Complexes,
) -> None:
    """The disc's motion in many runs, pair by run; its state is continuous through the change of the mode.

    Args:
        before: ``[pairs]`` of `discretise.OBSERVER`, the modes that the states are counted from.
        observers: ``[pairs]``, the modes from now on.
        kicks: float64 ``[pairs, 2, 2]``, lower root of the process noise's covariance of a sample.
        angle: float64 ``[n, pairs, RUNS]``, shaft angles, rad.
        draws: float64 ``[n, 2, 2, pairs, RUNS]``, normal: for position and velocity, for each axis.
        states: float64 ``[pairs, RUNS, 4]``, deviations from the orbit, changed in place.
        z: complex128 ``[n, pairs, RUNS]``, out: positions, in clearances.
    """
    for p in range(len(states)):
        mode, xx, vx, vv = observers[p], kicks[p, 0, 0], kicks[p, 1, 0], kicks[p, 1, 1]
        for r in range(states.shape[1]):
            cos, sin = math.cos(angle[0, p, r]), math.sin(angle[0, p, r])
            state = (states[p, r, 0], states[p, r, 1], states[p, r, 2], states[p, r, 3])
            state = kernels.transfer(before[p], mode, cos, sin, state)
            for k in range(len(z)):
                cos, sin = math.cos(angle[k, p, r]), math.sin(angle[k, p, r])
                x, _, y, _ = kernels.orbit(mode, cos, sin)
                z[k, p, r] = complex(x + state[0], y + state[2])
                dx, du, dy, dv = kernels.predict(mode, cos, sin, state)
                a_x, a_y = draws[k, 0, 0, p, r], draws[k, 0, 1, p, r]
                b_x, b_y = draws[k, 1, 0, p, r], draws[k, 1, 1, p, r]
                state = (dx + xx * a_x, du + vx * a_x + vv * b_x, dy + xx * a_y, dv + vx * a_y + vv * b_y)
            states[p, r, 0], states[p, r, 1], states[p, r, 2], states[p, r, 3] = state


def _check_bounded(modes: Sequence[BankMode], z: Complexes) -> None:
    """Raises ValueError where the disc has left its housing; complex128 ``[pairs, RUNS]``, positions."""
    escaped = ~(np.abs(z) < kernels.ESCAPE_RADIUS).all(axis=1)
    if escaped.any():
        name = modes[int(escaped.argmax())].name
        raise ValueError(
            f"rotor bank: in mode {name!r} the disc leaves its housing, more than "
            f"{kernels.ESCAPE_RADIUS:g} clearances from the centre: this mode has no bounded motion; "
            "raise its damping ratio, or lower the contact stiffness or the friction"
        )
