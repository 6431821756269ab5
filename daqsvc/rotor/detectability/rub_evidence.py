"""What a bank will say about a rotor that rubs: simulated, because no closed form is known.

A prediction, not a test of the detector: the motion is stepped with the same Strang splitting as the rub
observer's, from the bank's own parameters. Every pair of modes with a rub in it is run through one
schedule many times, from shaft angles of its own: first mode, rub, first mode again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.rotor import kernels
from daqsvc.rotor.discretise import axis_flow, axis_process_covariance, contact_substeps, discretise

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.discretise import BankMode

    Floats = NDArray[np.float64]
    Complexes = NDArray[np.complex128]

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
    others = [modes[i] for i, _ in pairs]
    rubs = [modes[j] for _, j in pairs]
    motion = _Motion(others, start, duration=duration, process_noise=process_noise, rng=rng)
    z = np.empty((n, len(pairs), RUNS), dtype=np.complex128)
    motion.run(others, z[:begins], angle[:begins])
    motion.run(rubs, z[begins:ends], angle[begins:ends])
    motion.run(others, z[ends:], angle[ends:])
    z += noise * (rng.standard_normal(z.shape) + 1j * rng.standard_normal(z.shape))
    observers = discretise(modes, noise=noise, duration=duration, variance_factor=variance_factor)
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
        # A rub observer that is told nothing starts on the healthy orbit, as in the bank.
        states = np.where(observers["substeps"][:, np.newaxis] > 0, np.nan, np.zeros((3, 4)))
        scores = np.empty((3, n))
        cos, sin = np.cos(angle[:, run]), np.sin(angle[:, run])
        kernels.run_free(xy, usable, cos, sin, observers, states, scores)
        llr[run] = scores[2] - scores[1]
    return llr


class _Motion:
    """The disc's motion in many runs at once, pair by run; its state is continuous through every change."""

    def __init__(
        self,
        modes: Sequence[BankMode],
        angle: Floats,
        *,
        duration: float,
        process_noise: float,
        rng: np.random.Generator,
    ) -> None:
        self._duration = duration
        self._process_noise = process_noise
        self._rng = rng
        speed = modes[0].rotor.w
        orbit = _column([mode.rotor.orbit() for mode in modes]) * np.exp(1j * angle)
        self._z = orbit + _column([mode.rotor.rest for mode in modes])
        self._v = 1j * speed * orbit

    def run(self, modes: Sequence[BankMode], z: Complexes, angle: Floats) -> None:
        """Positions from the state on.

        Args:
            modes: the mode of every pair.
            z: complex128 ``[n, pairs, RUNS]``, out: positions, in clearances.
            angle: float64 ``[n, pairs, RUNS]``, shaft angles, rad.

        Raises:
            ValueError: the disc has left its housing: the mode has no bounded motion.
        """
        rotors = [mode.rotor for mode in modes]
        speed = rotors[0].w
        substeps = max(contact_substeps(mode.rotor, self._duration) if mode.rub else 1 for mode in modes)
        step = self._duration / substeps
        half = [_column(entry) for entry in np.array([axis_flow(r, step / 2).ravel() for r in rotors]).T]
        radius = _column([rotor.orbit() for rotor in rotors])
        rest = _column([rotor.rest for rotor in rotors])
        stiffness = _column([mode.rotor.contact_stiffness if mode.rub else 0.0 for mode in modes])
        alpha = _column([rotor.alpha for rotor in rotors])
        mu = _column([rotor.mu for rotor in rotors])
        surface = _column([speed * rotor.contact_radius for rotor in rotors])
        shake = [
            np.linalg.cholesky(axis_process_covariance(r, self._process_noise, self._duration)).ravel()
            for r in rotors
        ]
        shake_xx, _, shake_vx, shake_vv = (_column(entry) for entry in np.array(shake).T)
        half_turn, turn = np.exp(0.5j * speed * step), np.exp(1j * speed * step)
        for k in range(len(z)):
            z[k] = self._z
            pointer = np.exp(1j * angle[k])
            orbit = radius * pointer
            d, v = self._z - orbit - rest, self._v - 1j * speed * orbit
            for _ in range(substeps):
                d, v = half[0] * d + half[1] * v, half[2] * d + half[3] * v
                middle = orbit * half_turn
                position, velocity = middle + rest + d, 1j * speed * middle + v
                v = v + step * _contact(position, velocity, stiffness, alpha, mu, surface)
                d, v = half[0] * d + half[1] * v, half[2] * d + half[3] * v
                orbit = orbit * turn
            a, b = self._rng.standard_normal((2, 2, *d.shape))
            kick_x, kick_v = a[0] + 1j * a[1], b[0] + 1j * b[1]
            self._z = orbit + rest + d + shake_xx * kick_x
            self._v = 1j * speed * orbit + v + shake_vx * kick_x + shake_vv * kick_v
        escaped = ~(np.abs(self._z) < kernels.ESCAPE_RADIUS).all(axis=1)
        if escaped.any():
            name = modes[int(escaped.argmax())].name
            raise ValueError(
                f"rotor bank: in mode {name!r} the disc leaves its housing, more than "
                f"{kernels.ESCAPE_RADIUS:g} clearances from the centre: this mode has no bounded motion; "
                "raise its damping ratio, or lower the contact stiffness or the friction"
            )


def _contact(
    z: Complexes, velocity: Complexes, stiffness: Floats, alpha: Floats, mu: Floats, surface: Floats
) -> Complexes:
    """Acceleration by the contact: Hertzian repulsion and Coulomb friction against the slip."""
    radius = np.maximum(np.abs(z), 1.0)
    slip = surface + (z.conjugate() * velocity).imag / radius
    force = stiffness * (radius - 1.0) ** alpha / radius
    return np.asarray(-force * z * (1.0 + 1j * mu * np.sign(slip)), dtype=np.complex128)


def _column(values: Sequence[Any] | Floats) -> Any:
    """One figure for each pair, for all its runs."""
    return np.asarray(values)[:, np.newaxis]
